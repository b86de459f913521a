"""What one answer is read from is one picture of the database, whatever others write in between."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from sqlalchemy import event, func, select, text

from service.store.database import Database
from service.store.depth import QueueDepth
from service.store.faults import DatabaseAwayError
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.outbox import EventStore
from service.store.queue import RunQueue
from service.store.tables import run
from tests.service.plans import result_of, submit


@pytest.fixture
def grids(database: Database) -> GridStore:
    return GridStore(database)


@pytest.fixture
def other(url: str) -> Iterator[RunQueue]:
    """Somebody else, with connections of its own."""
    database = Database(url)
    yield RunQueue(database)
    database.close()


@contextmanager
def after_first_statement(database: Database, act: Callable[[], object]) -> Iterator[None]:
    """Let somebody write between the first statement that reads and the second."""
    waiting = [act]

    def between(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        # SQLite's BEGIN and a pool's question are no reading yet.
        if statement.startswith("SELECT") and " FROM " in statement.replace("\n", " ") and waiting:
            waiting.pop()()

    event.listen(database.reader, "after_cursor_execute", between)
    yield
    event.remove(database.reader, "after_cursor_execute", between)
    assert not waiting, "nothing was read"


def test_a_run_stored_meanwhile_has_no_result_yet(database: Database, grids: GridStore, other: RunQueue) -> None:
    submit(grids, 1)
    generation = Leadership(database).take("one")
    assert generation is not None
    (lease,) = other.claim(generation, 1)
    with after_first_statement(database, lambda: other.store(lease, result_of(lease))):
        found = grids.run(lease.run_id)
    assert (found.state, found.result, found.attempts) == ("leased", None, [])
    after = grids.run(lease.run_id)
    assert after.state == "done"
    assert after.result is not None


def test_counts_of_a_grid_are_those_of_the_moment_that_its_state_is_of(
    database: Database, grids: GridStore, other: RunQueue
) -> None:
    grid_id = submit(grids, 3)
    generation = Leadership(database).take("one")
    assert generation is not None
    leases = other.claim(generation, 3)

    def finish() -> None:
        other.store_all([(lease, result_of(lease)) for lease in leases])

    with after_first_statement(database, finish):
        found = grids.grid(grid_id)
    assert (found.state, found.counts.leased, found.counts.done) == ("running", 3, 0)


def test_a_summary_counts_the_runs_that_its_state_knows_of(
    database: Database, grids: GridStore, other: RunQueue
) -> None:
    grid_id = submit(grids, 3)
    generation = Leadership(database).take("one")
    assert generation is not None
    leases = other.claim(generation, 3)

    def finish() -> None:
        other.store_all([(lease, result_of(lease)) for lease in leases])

    with after_first_statement(database, finish):
        found = grids.summary(grid_id, 100)
    assert (found["state"], found["n_stored"], found["rows"]) == ("running", 0, [])


def test_the_queue_s_depth_adds_up(database: Database, grids: GridStore, other: RunQueue) -> None:
    submit(grids, 5)
    generation = Leadership(database).take("one")
    assert generation is not None
    with after_first_statement(database, lambda: other.claim(generation, 3)):
        found = QueueDepth(database).look()
    assert (found.queued, found.delayed, found.leased) == (5, 0, 0)


def test_events_end_with_the_grid_that_they_are_of(database: Database, grids: GridStore, other: RunQueue) -> None:
    grid_id = submit(grids, 1)
    generation = Leadership(database).take("one")
    assert generation is not None
    (lease,) = other.claim(generation, 1)
    with after_first_statement(database, lambda: other.store(lease, result_of(lease))):
        page = EventStore(database).page(grid_id, 0, 100)
    assert (page.ended, [item.kind for item in page.items]) == (False, ["grid_submitted", "run_started"])


def test_who_only_reads_cannot_write(database: Database, grids: GridStore) -> None:
    submit(grids, 1)
    with pytest.raises(DatabaseAwayError, match=r"read-?only"), database.read() as connection:
        connection.execute(run.delete())
    with database.read() as connection:
        assert connection.scalar(select(func.count()).select_from(run)) == 1


@pytest.mark.postgres
def test_a_picture_leaves_no_setting_behind(migrated_postgres: str) -> None:
    database = Database(migrated_postgres)
    with database.read() as connection:
        assert connection.scalar(text("SHOW transaction_isolation")) == "repeatable read"
        assert connection.scalar(text("SHOW default_transaction_isolation")) == "read committed"
    with database.write() as connection:
        assert connection.scalar(text("SHOW transaction_isolation")) == "read committed"
    database.close()
