"""The table of transitions is the only way a run changes its state, on both databases."""

from __future__ import annotations

from itertools import product

import pytest
from sqlalchemy import select, update
from sqlalchemy.exc import IntegrityError

from service.domain.states import OPEN_STATES, TERMINAL_STATES, TRANSITIONS, RunState
from service.store.database import Database
from service.store.grids import GridStore
from service.store.tables import run
from service.store.transitions import move
from tests.service.plans import submit


@pytest.fixture
def run_id(database: Database) -> str:
    grids = GridStore(database)
    return grids.runs(submit(grids, 1), 1).items[0].id


@pytest.mark.parametrize(("name", "state"), list(product(TRANSITIONS, RunState)))
def test_a_transition_is_carried_out_from_its_sources_alone(
    database: Database, run_id: str, name: str, state: RunState
) -> None:
    transition = TRANSITIONS[name]
    token = {"token": "a" * 32 if state is RunState.LEASED else None}
    with database.write() as connection:
        connection.execute(update(run).where(run.c.id == run_id).values(state=state, **token))
        values = {"token": "b" * 32} if transition.target is RunState.LEASED else {}
        moved = move(connection, transition, run.c.id == run_id, **values)
        after = connection.execute(select(run.c.state, run.c.token)).one()
    allowed = state in transition.sources
    assert moved == ([run_id] if allowed else [])
    assert after.state == (transition.target if allowed else state)
    assert (after.token is not None) == (after.state == RunState.LEASED)


def test_only_an_explicit_retry_leaves_a_terminal_state() -> None:
    leaving = {name for name, transition in TRANSITIONS.items() if transition.sources & TERMINAL_STATES}
    assert leaving == {"revive"}
    assert RunState.DONE not in TRANSITIONS["revive"].sources
    assert {RunState.QUEUED, RunState.PAUSED, RunState.LEASED} == OPEN_STATES


def test_the_database_refuses_a_lease_without_a_token(database: Database, run_id: str) -> None:
    with pytest.raises(IntegrityError), database.write() as connection:
        connection.execute(update(run).where(run.c.id == run_id).values(state="leased"))
