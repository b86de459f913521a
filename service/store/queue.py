"""The queue: claim, store, fail, hand back. Each method is one transaction, so a crash is before it or after it."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, exists, false, func, literal_column, select, true, update

from service.identifiers import new_token, utc_now
from service.payload import ResultPayload
from service.store.bulk import insert_rows
from service.store.database import Database
from service.store.leadership import require_generation
from service.store.leases import (
    AT_ONCE,
    Lease,
    Outcome,
    add_event,
    add_events,
    close_grids,
    end_attempts,
    held_by,
    leased,
    lock_grids,
    new_event,
    requeue,
)
from service.store.results import result_row
from service.store.settling import held_grids
from service.store.states import CANCEL_RUNNING, CLAIM, FAIL, FINISH, QUARANTINE, RunState, move, moving
from service.store.sums import add_to_sums
from service.store.tables import attempt, grid, result, run
from service.store.upkeep import Upkeep

_MAX_DELAY_S = 600.0
_JITTER = (0.5, 1.5)
_SLACK = timedelta(seconds=1)
"""By so much clocks may differ and nobody minds."""


class Stored(StrEnum):
    """What became of a result."""

    STORED = "stored"
    STALE_SAME = "stale_same"
    STALE_OTHER = "stale_other"


@dataclass(frozen=True)
class Failure:
    """Why an attempt failed, and how many more the run is given.

    ``retries`` counts attempts that ended with the same outcome. A ``suspect`` (it was alone on a worker that died)
    is tried again in the suspect lane, and quarantined once no retry is left; others become failed.
    """

    outcome: Outcome
    code: str
    detail: str
    retries: int
    suspect: bool = False


class RunQueue:
    """The queue in the database.

    Parameters
    ----------
    database
        Where it lies.
    clock
        The present; tests hold it still.
    retry_delay_s
        Back-off before the first retry; doubles with each, with jitter.
    """

    def __init__(self, database: Database, clock: Callable[[], datetime] = utc_now, retry_delay_s: float = 2.0) -> None:
        self._database = database
        self._clock = clock
        self._retry_delay_s = retry_delay_s
        self.upkeep = Upkeep(database, clock)

    def waiting(self, engine: str | None = None, *, suspects: bool = False) -> bool:
        """Whether a claim would find a run; asked first, because a look needs no lock and an idle queue is the rule."""
        with self._database.read() as connection:
            return bool(connection.scalar(select(exists().where(_ready(self._clock(), engine, suspects)))))

    def claim(self, generation: int, limit: int, engine: str | None = None, *, suspects: bool = False) -> list[Lease]:
        """Lease up to ``limit`` runs in the order of the queue, for workers that carry ``engine`` (None: whichever).

        5,000 at a time. Suspects have a queue of their own: they are claimed by asking for them, and only then. One
        transaction with the look at the leader row, so that a deposed dispatcher cannot claim after the new one has
        voided its leases.

        Raises
        ------
        service.store.leadership.LeadershipLostError
            Another dispatcher leads.
        """
        now, token = self._clock(), new_token()
        picked = (
            select(run.c.id)
            .where(_ready(now, engine, suspects))
            .order_by(run.c.not_before, run.c.id)
            .limit(min(limit, AT_ONCE))
            .with_for_update(skip_locked=True)
            .cte("picked")
            # Materialised, or PostgreSQL may run it again for each row and lock more than ``limit``.
            .prefix_with("MATERIALIZED", dialect="postgresql")
        )
        taken = moving(
            CLAIM,
            run.c.id.in_(select(picked.c.id)),
            token=token,
            generation=generation,
            leased_at=now,
            attempt=run.c.attempt + 1,
        ).returning(*_CLAIMED)
        with self._database.write() as connection:
            require_generation(connection, generation)
            rows = connection.execute(taken).all()
        return [
            Lease(
                row.id, row.grid_id, row.attempt, token, generation, row.digest, row.spec, now,
                row.engine_digest, row.suspect,
            )
            for row in sorted(rows, key=lambda row: (row.not_before, row.id))
        ]  # fmt: skip

    def store(self, lease: Lease, payload: ResultPayload) -> Stored:
        """Store a result if the lease is still valid.

        State, result, attempt and event change together: there is no moment at which a run is done without a result
        or has two. A lease that is no longer valid leaves everything as it is; its result is compared with the one
        that was stored instead, because two executions of one run ought to agree.
        """
        return self.store_all([(lease, payload)])[0]

    def store_all(self, results: Sequence[tuple[Lease, ResultPayload]]) -> list[Stored]:
        """Store several results as :meth:`store` does each, in one transaction: all of them are stored, or none.

        Short runs end faster than a disk can confirm one transaction each.
        """
        now = self._clock()
        with self._database.write() as connection:
            rows = leased(connection, _held_by_any([lease for lease, _ in results]))
            held = {(row.id, row.token) for row in rows}
            valid = [(lease, payload) for lease, payload in results if (lease.run_id, lease.token) in held]
            if valid:
                self._finish(connection, rows, valid, now)
            return [
                Stored.STORED if (lease.run_id, lease.token) in held else self._stale(connection, lease, payload, now)
                for lease, payload in results
            ]

    @staticmethod
    def _finish(
        connection: Connection,
        rows: Sequence[Row[*tuple[Any, ...]]],
        results: Sequence[tuple[Lease, ResultPayload]],
        now: datetime,
    ) -> None:
        """Move leased runs to done with their results; the caller holds the locks."""
        ids = [lease.run_id for lease, _ in results]
        end_attempts(connection, rows, Outcome.DONE, now)
        move(connection, FINISH, run.c.id.in_(ids), finished_at=now, error_code=None, error_detail=None)
        asked = connection.execute(select(run.c.id, run.c.inputs).where(run.c.id.in_(ids)))
        inputs = {row.id: row.inputs for row in asked}
        stored = [result_row(lease, inputs[lease.run_id], payload, now) for lease, payload in results]
        insert_rows(connection, result, stored)
        add_to_sums(connection, stored)
        add_events(
            connection,
            [new_event(lease.grid_id, "run_done", now, lease.run_id, attempt=lease.attempt) for lease, _ in results],
        )
        close_grids(connection, {lease.grid_id for lease, _ in results}, now)

    def fail(self, lease: Lease, failure: Failure) -> RunState | None:
        """End a failed attempt: back to the queue with a delay while retries are left, else to a terminal state.

        The attempts are counted in the same transaction that decides, so a crash charges nobody twice. Returns the
        run's new state, None where the lease was no longer valid.
        """
        now = self._clock()
        with self._database.write() as connection:
            rows = leased(connection, held_by(lease))
            if not rows:
                return None
            charged = self._charged(connection, lease, rows[0].charged_from, failure.outcome)
            if charged < failure.retries:
                delay = min(self._retry_delay_s * 2.0**charged, _MAX_DELAY_S) * random.uniform(*_JITTER)  # noqa: S311
                later = now + timedelta(seconds=delay)
                requeue(connection, held_by(lease), failure.outcome, now, failure.detail, later, failure.suspect)
                return RunState(connection.scalars(select(run.c.state).where(run.c.id == lease.run_id)).one())
            end_attempts(connection, rows, failure.outcome, now, failure.code, failure.detail)
            transition = QUARANTINE if failure.suspect else FAIL
            reason = {"error_code": failure.code, "error_detail": failure.detail}
            move(connection, transition, held_by(lease), finished_at=now, **reason)
            kind = f"run_{transition.target}"
            add_event(connection, lease.grid_id, kind, now, lease.run_id, attempt=lease.attempt, code=failure.code)
            close_grids(connection, [lease.grid_id], now)
            return transition.target

    def hand_back(self, leases: Sequence[Lease], outcome: Outcome = Outcome.HANDED_BACK) -> int:
        """Give runs back uncharged, at a stop; how many of the leases were still valid."""
        given = 0
        # Each part is a transaction of its own: what a crash leaves is still leased, and given back by the next leader.
        for first in range(0, len(leases), AT_ONCE):
            with self._database.write() as connection:
                some = _held_by_any(leases[first : first + AT_ONCE])
                given += len(requeue(connection, some, outcome, self._clock()))
        return given

    def requeue_lost(self, lease: Lease, outcome: Outcome, detail: str) -> bool:
        """Give one run back uncharged that went missing through no fault of its own."""
        with self._database.write() as connection:
            return bool(requeue(connection, held_by(lease), outcome, self._clock(), detail))

    def suspect(self, leases: Sequence[Lease], detail: str) -> int:
        """Give back runs one of which may have killed a worker: nobody is charged, all wait in the suspect lane."""
        with self._database.write() as connection:
            now = self._clock()
            return len(requeue(connection, _held_by_any(leases), Outcome.SUSPECTED, now, detail, suspect=True))

    def refuse_engine(self, lease: Lease, engine: str) -> bool:
        """Give a run back uncharged whose result came from another engine than its grid's.

        With the delay of a retry, or the same worker could take it again at once.
        """
        with self._database.write() as connection:
            now = self._clock()
            later = now + timedelta(seconds=self._retry_delay_s)
            detail = f"the worker's engine is {engine}, the grid's is {lease.engine}"
            return bool(requeue(connection, held_by(lease), Outcome.OTHER_ENGINE, now, detail, later))

    def requeue_forgotten(self, generation: int, known: Collection[str]) -> list[str]:
        """Give back runs leased in this generation that the dispatcher does not know of.

        That happens when a claim was committed and the answer to it was lost. Up to 5,000 at a time; a look that finds
        none, which is the rule, needs no lock.
        """
        mine = (run.c.state == literal_column(f"'{RunState.LEASED}'")) & (run.c.generation == generation)
        with self._database.read() as connection:
            unknown = sorted(set(connection.scalars(select(run.c.id).where(mine))).difference(known))[:AT_ONCE]
        if not unknown:
            return []
        with self._database.write() as connection:
            these = (run.c.generation == generation) & run.c.id.in_(unknown)
            return requeue(connection, these, Outcome.FORGOTTEN, self._clock())

    def release_postdated(self) -> int:
        """Let runs be claimed now that wait for a time which only a clock that was wrong can have set; how many.

        A run that has not been tried waits for nothing, and no retry waits for longer than the longest back-off.
        Without this a clock that is set back, or that of an API elsewhere which is ahead, would hold up the queue.
        """
        now = self._clock()
        longest = timedelta(seconds=_MAX_DELAY_S * _JITTER[1])
        wrong = (run.c.state == literal_column(f"'{RunState.QUEUED}'")) & (run.c.not_before > now + _SLACK)
        wrong &= (run.c.attempt == run.c.charged_from) | (run.c.not_before > now + longest)
        # Not made distinct there, or a database may go through all runs in the order of their grids.
        grids = select(run.c.grid_id).where(wrong)
        with self._database.read() as connection:
            if connection.scalar(grids.limit(1)) is None:
                return 0
        with self._database.write() as connection:
            lock_grids(connection, connection.scalars(grids))
            return connection.execute(update(run).where(wrong).values(not_before=now)).rowcount

    def to_hold(self, generation: int) -> list[str]:
        """Ids of runs leased in this generation whose grid has been paused."""
        return self._leased_where(generation, grid.c.paused_at.is_not(None))

    def to_cancel(self, generation: int) -> list[str]:
        """Ids of runs leased in this generation whose grid has been cancelled."""
        return self._leased_where(generation, grid.c.cancelled_at.is_not(None))

    def _leased_where(self, generation: int, condition: ColumnElement[bool]) -> list[str]:
        with self._database.read() as connection:
            wanted = (
                select(run.c.id)
                .join(grid, grid.c.id == run.c.grid_id)
                .where(run.c.state == literal_column(f"'{RunState.LEASED}'"), run.c.generation == generation)
                .where(condition)
            )
            return list(connection.scalars(wanted))

    def cancel_leased(self, lease: Lease) -> bool:
        """Cancel a run in flight; a result that comes later finds its lease gone."""
        now = self._clock()
        with self._database.write() as connection:
            rows = leased(connection, held_by(lease))
            end_attempts(connection, rows, Outcome.CANCELLED, now)
            moved = move(connection, CANCEL_RUNNING, held_by(lease), finished_at=now)
            if moved:
                add_event(connection, lease.grid_id, "run_cancelled", now, lease.run_id, attempt=lease.attempt)
                close_grids(connection, [lease.grid_id], now)
            return bool(moved)

    @staticmethod
    def _charged(connection: Connection, lease: Lease, charged_from: int, outcome: Outcome) -> int:
        counted = select(func.count()).where(
            attempt.c.run_id == lease.run_id, attempt.c.outcome == outcome, attempt.c.number > charged_from
        )
        return connection.scalar(counted) or 0

    @staticmethod
    def _stale(connection: Connection, lease: Lease, payload: ResultPayload, now: datetime) -> Stored:
        wanted = select(result.c.payload_digest).where(result.c.run_id == lease.run_id)
        stored: Any = connection.scalar(wanted)
        same = stored is None or stored == payload.digest
        known = connection.scalar(select(grid.c.id).where(grid.c.id == lease.grid_id))
        if known is not None:
            detail = {"attempt": lease.attempt, "same": same}
            add_event(connection, lease.grid_id, "stale_result", now, lease.run_id, **detail)
        return Stored.STALE_SAME if same else Stored.STALE_OTHER


_ENGINE = select(grid.c.engine_digest).where(grid.c.id == run.c.grid_id).correlate(run).scalar_subquery()
# All by the statement that claims: each one more is another wait for the server's turn.
_CLAIMED = (
    run.c.id,
    run.c.grid_id,
    run.c.attempt,
    run.c.digest,
    run.c.spec,
    run.c.suspect,
    run.c.not_before,
    _ENGINE.label("engine_digest"),
)


def _ready(now: datetime, engine: str | None, suspects: bool) -> ColumnElement[bool]:
    """Runs that may be claimed for an engine.

    The states are spelt out: a database takes a partial index only where it sees that the condition implies it.
    """
    queued = run.c.state == literal_column(f"'{RunState.QUEUED}'")
    ready = queued & (run.c.suspect == (true() if suspects else false())) & (run.c.not_before <= now)
    others = None if engine is None else grid.c.engine_digest != engine
    return ready & run.c.grid_id.not_in(held_grids(others))


def _held_by_any(leases: Sequence[Lease]) -> ColumnElement[bool]:
    """The runs of these leases, as long as the leases are valid."""
    wanted = run.c.id.in_([lease.run_id for lease in leases])
    return wanted & run.c.token.in_({lease.token for lease in leases})
