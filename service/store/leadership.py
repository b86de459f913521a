"""Who dispatches: one row with a generation, which every claim is fenced by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import Connection, insert, select, update

from service.identifiers import utc_now
from service.store.database import Database
from service.store.leases import Outcome, requeue
from service.store.tables import leader, run


class LeadershipLostError(RuntimeError):
    """Another dispatcher leads now: this one must stop."""


@dataclass(frozen=True)
class LeaderView:
    """The leader row as last written: ``workers`` counts threads, ``engines`` those of each engine by its digest."""

    generation: int
    holder: str
    workers: int
    engines: dict[str, int]
    beat_at: datetime
    expires_at: datetime


def require_generation(connection: Connection, generation: int) -> None:
    """Stay in this transaction only as the leader; the lock keeps a successor out until it ends.

    It is the weakest that does, so that claims and heartbeats do not wait for each other.

    Raises
    ------
    LeadershipLostError
        The row carries another generation.
    """
    mine = select(leader.c.generation).where(leader.c.id == 1)
    current = connection.scalar(mine.with_for_update(read=True, key_share=True))
    if current != generation:
        raise LeadershipLostError(f"generation {generation} was deposed by generation {current}")


def leader_view(connection: Connection) -> LeaderView | None:
    """The leader row, None before the first dispatcher."""
    row = connection.execute(select(leader).where(leader.c.id == 1)).one_or_none()
    if row is None:
        return None
    return LeaderView(row.generation, row.holder, row.workers, row.engines, row.beat_at, row.expires_at)


class Leadership:
    """The leader row.

    Times of several machines are compared, but nothing rests on their agreement: a leader that is deposed too early
    is fenced by its generation like any other.
    """

    def __init__(self, database: Database, ttl_s: float = 30.0, clock: Callable[[], datetime] = utc_now) -> None:
        self._database = database
        self._ttl = timedelta(seconds=ttl_s)
        self._clock = clock

    def take(self, holder: str, is_dead: Callable[[str], bool] = lambda _: False) -> int | None:
        """Become the leader if there is none, its lease has run out, or its process is known to be dead.

        Voids all older leases in the same transaction, or a run could be claimed by nobody. Returns the new
        generation, None where another leads.
        """
        now = self._clock()
        with self._database.write() as connection:
            row = connection.execute(select(leader).where(leader.c.id == 1).with_for_update()).one_or_none()
            values = {"holder": holder, "workers": 0, "engines": {}, "beat_at": now, "expires_at": now + self._ttl}
            if row is None:
                # Two first dispatchers: the primary key lets one in, the other gets an IntegrityError and tries again.
                connection.execute(insert(leader).values(id=1, generation=1, **values))
                return 1
            if row.expires_at > now and not is_dead(row.holder):
                return None
            generation = int(row.generation) + 1
            connection.execute(update(leader).values(generation=generation, **values))
            requeue(connection, run.c.generation < generation, Outcome.DISPATCHER_LOST, now)
            return generation

    def beat(self, generation: int, engines: dict[str, int]) -> bool:
        """Say that the leader lives and how many worker threads it has of each engine; False once another leads."""
        now = self._clock()
        with self._database.write() as connection:
            beaten = connection.execute(
                update(leader)
                .where(leader.c.id == 1, leader.c.generation == generation)
                .values(workers=sum(engines.values()), engines=engines, beat_at=now, expires_at=now + self._ttl)
            )
            return beaten.rowcount == 1

    def resign(self, generation: int) -> None:
        """Let a standby take over at once."""
        now = self._clock()
        with self._database.write() as connection:
            mine = (leader.c.id == 1) & (leader.c.generation == generation)
            connection.execute(update(leader).where(mine).values(workers=0, engines={}, expires_at=now))

    def view(self) -> LeaderView | None:
        """The leader row, None before the first dispatcher."""
        with self._database.read() as connection:
            return leader_view(connection)

    def alive(self) -> LeaderView | None:
        """The leader if its lease has not run out."""
        view = self.view()
        return view if view is not None and view.expires_at > self._clock() else None
