"""Who dispatches: one row with a generation, which every claim is fenced by."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from threading import Lock

from sqlalchemy import Connection, insert, select, update

from service.domain.identifiers import utc_now
from service.store.database import Database
from service.store.leases import Outcome, leased, requeue
from service.store.tables import leader, run


class LeadershipLostError(RuntimeError):
    """Another dispatcher leads now: this one must stop."""


@dataclass(frozen=True)
class LeaderView:
    """The leader row as last written: ``workers`` counts threads, ``engines`` those of each engine by its digest.

    Its times are those of the leader's own clock, which may be wrong: they tell whether something has changed, and
    nobody reckons with them.
    """

    generation: int
    holder: str
    workers: int
    engines: dict[str, int]
    beat_at: datetime
    expires_at: datetime
    artefacts_away: bool = False
    """It waits for the artefact store, and claims nothing meanwhile."""

    @property
    def resigned(self) -> bool:
        """Whether its leader has left, and a standby need not wait."""
        return self.expires_at <= self.beat_at


class Pulse:
    """For how long a leader has not beaten, by the clock of who looks.

    Clocks of other machines may be hours off, so a heartbeat counts from the moment at which it was *seen* to have
    changed. Who has not looked for longer than ``ttl_s`` knows as little as who looks for the first time. Threads may
    share one.
    """

    def __init__(self, ttl_s: float, monotonic: Callable[[], float]) -> None:
        self._ttl_s = ttl_s
        self._monotonic = monotonic
        self._beat: tuple[int, datetime] | None = None
        self._since = self._looked = 0.0
        self._lock = Lock()

    def age_s(self, view: LeaderView, at_first: float = 0.0) -> float:
        """Seconds since the last change; ``at_first`` is what to believe of a heartbeat that nobody saw change."""
        beat, now = (view.generation, view.beat_at), self._monotonic()
        with self._lock:
            if self._beat is None:
                self._since = now - at_first
            elif beat != self._beat:
                unseen = now - self._looked
                self._since = now - (min(at_first, unseen) if unseen > self._ttl_s else 0.0)
            self._beat, self._looked = beat, now
            return now - self._since

    def forget(self) -> None:
        """Begin anew: for a while nobody could see whether the leader beats."""
        with self._lock:
            self._beat = None


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


def leader_view(connection: Connection, *, lock: bool = False) -> LeaderView | None:
    """The leader row, None before the first dispatcher; locked to the end of the transaction where that is asked."""
    wanted = select(leader).where(leader.c.id == 1)
    row = connection.execute(wanted.with_for_update() if lock else wanted).one_or_none()
    if row is None:
        return None
    return LeaderView(
        row.generation, row.holder, row.workers, row.engines, row.beat_at, row.expires_at, row.artefacts_away
    )


class Leadership:
    """The leader row.

    Whether a leader is dead is judged by whether its heartbeat changes, by this process' own clock: no two machines
    have to agree on the time. A leader that is deposed too early all the same is fenced by its generation.

    Parameters
    ----------
    database
        Where it lies.
    ttl_s
        A leader that has not been seen to beat for so long may be replaced.
    clock
        The present, for what is written down.
    monotonic
        Seconds that go by at a steady pace, for what is waited for.
    """

    def __init__(
        self,
        database: Database,
        ttl_s: float = 30.0,
        clock: Callable[[], datetime] = utc_now,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._database = database
        self._ttl_s = ttl_s
        self._clock = clock
        self._rival = Pulse(ttl_s, monotonic)
        self._shown = Pulse(ttl_s, monotonic)

    def take(self, holder: str, is_dead: Callable[[str], bool] = lambda _: False) -> int | None:
        """Become the leader if there is none, it has resigned, does not beat or its process is known to be dead.

        One that was never seen before is given the whole time-to-live from now on, whatever its row says of the time:
        a standby asks again and again. Voids all older leases in the same transaction, or a run could be claimed by
        nobody. Returns the new generation, None where another leads.
        """
        with self._database.read() as connection:
            judged = leader_view(connection)
        if judged is not None and not self._may_replace(judged, holder, is_dead):
            return None
        now = self._clock()
        with self._database.write() as connection:
            found = leader_view(connection, lock=True)
            values = {
                "holder": holder, "workers": 0, "engines": {}, "artefacts_away": False, "beat_at": now,
                "expires_at": now + timedelta(seconds=self._ttl_s),
            }  # fmt: skip
            if found is None:
                # Two first dispatchers: the primary key lets one in, the other gets an IntegrityError and tries again.
                connection.execute(insert(leader).values(id=1, generation=1, **values))
                return 1
            if found != judged:
                return None  # it has beaten since, or another was faster
            generation = found.generation + 1
            connection.execute(update(leader).values(generation=generation, **values))
            requeue(connection, leased(connection, run.c.generation < generation), Outcome.DISPATCHER_LOST, now)
            return generation

    def _may_replace(self, view: LeaderView, holder: str, is_dead: Callable[[str], bool]) -> bool:
        # Its own name: it has taken the lead before, and never got the answer.
        certain = view.resigned or view.holder == holder or is_dead(view.holder)
        return self._rival.age_s(view) >= self._ttl_s or certain

    def forget(self) -> None:
        """The database was away: nobody could beat, and nothing is known of the leader."""
        self._rival.forget()

    def beat(self, generation: int, engines: dict[str, int], artefacts_away: bool = False) -> bool:
        """Say that the leader lives, how many worker threads it has of each engine, and whether it waits for artefacts.

        False once another leads.
        """
        now = self._clock()
        expires_at = now + timedelta(seconds=self._ttl_s)
        with self._database.write() as connection:
            beaten = connection.execute(
                update(leader)
                .where(leader.c.id == 1, leader.c.generation == generation)
                .values(
                    workers=sum(engines.values()),
                    engines=engines,
                    artefacts_away=artefacts_away,
                    beat_at=now,
                    expires_at=expires_at,
                )
            )
            return beaten.rowcount == 1

    def resign(self, generation: int) -> None:
        """Let a standby take over at once."""
        with self._database.write() as connection:
            mine = (leader.c.id == 1) & (leader.c.generation == generation)
            connection.execute(update(leader).where(mine).values(workers=0, engines={}, expires_at=leader.c.beat_at))

    def view(self) -> LeaderView | None:
        """The leader row, None before the first dispatcher."""
        with self._database.read() as connection:
            return leader_view(connection)

    def alive(self) -> LeaderView | None:
        """The leader if it beats."""
        view = self.view()
        return view if view is not None and self.beats(view) else None

    def beats(self, view: LeaderView) -> bool:
        """Whether the leader of this row beats, as far as this process can tell."""
        return not view.resigned and self.silent_s(view) < self._ttl_s

    def silent_s(self, view: LeaderView) -> float:
        """Seconds since the last heartbeat that this process has seen.

        When it looks for the first time it believes the clocks, as it knows no better: where these are wrong, a dead
        leader passes for alive for its time-to-live, and a living one for dead until it beats.
        """
        return self._shown.age_s(view, max((self._clock() - view.beat_at).total_seconds(), 0.0))
