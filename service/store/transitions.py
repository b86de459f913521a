"""The one statement that changes a run's state, by the table of :mod:`service.domain.states`."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, Connection, Update, update

from service.domain.states import Transition
from service.store.tables import run


def move(connection: Connection, transition: Transition, *where: ColumnElement[bool], **values: Any) -> list[str]:
    """Carry out a transition on the runs that ``where`` picks and return the ids of those that it changed."""
    return list(connection.scalars(moving(transition, *where, **values).returning(run.c.id)))


def moving(transition: Transition, *where: ColumnElement[bool], **values: Any) -> Update:
    """What carries out a transition on the runs that ``where`` picks.

    Runs in a state that the transition does not allow are left alone: no row, no change. This is the only statement
    of the service that changes a run's state. The token is cleared unless ``values`` sets one, so a lease ends with
    the state that it belonged to.
    """
    return (
        update(run)
        .where(run.c.state.in_(sorted(transition.sources)), *where)
        .values(state=transition.target, **{"token": None, "generation": None, **values})
    )
