"""The queue: claim, store, fail, hand back. Each method is one transaction, so a crash is before it or after it."""

from __future__ import annotations

import json
import logging
import random
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Text,
    cast,
    exists,
    false,
    func,
    literal_column,
    or_,
    select,
    true,
    update,
)

from service.domain.identifiers import new_token, utc_now
from service.domain.payload import MeasurementPayload, Payload, ResultPayload
from service.domain.states import CANCEL_RUNNING, CLAIM, FAIL, FINISH, QUARANTINE, GridState, RunState
from service.store.bulk import insert_rows
from service.store.database import Database
from service.store.leadership import require_generation
from service.store.leases import (
    AT_ONCE,
    Lease,
    LeasedRow,
    Outcome,
    Pair,
    add_event,
    add_events,
    close_grids,
    end_attempts,
    leased,
    leased_by,
    lock_grids,
    new_event,
    requeue,
    set_aside,
)
from service.store.points import Replicate, judge_points
from service.store.results import estimate_rows, measurement_row, result_row
from service.store.settling import held_grids
from service.store.sums import add_to_inputs, add_to_moments
from service.store.tables import attempt, estimate, grid, measurement, result, run
from service.store.transitions import move, moving
from service.store.upkeep import Upkeep

_LOG = logging.getLogger(__name__)
_MAX_DELAY_S = 600.0
_JITTER = (0.5, 1.5)
_DOUBLINGS = 12
"""Attempts whose back-off is told apart; after more of them it is taken to have reached its bound."""
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
            if rows:
                # Without the lock of its grid, which nobody may wait for who holds runs.
                started = [new_event(row.grid_id, "run_started", now, row.id, attempt=row.attempt) for row in rows]
                add_events(connection, started)
        leases = []
        for row in sorted(rows, key=lambda row: (row.not_before, row.id)):
            spec = _read_spec(row.spec)
            lease = Lease(
                row.id, row.grid_id, row.attempt, token, generation, row.digest, spec or {}, now,
                row.engine_digest, row.suspect, row.kind,
            )  # fmt: skip
            if spec is None:
                # In a transaction of its own, because grids are locked before runs. A crash before it leaves a lease
                # that nobody knows of, which goes back to the queue and comes here again.
                self._refuse_spec(lease)
            else:
                leases.append(lease)
        return leases

    def _refuse_spec(self, lease: Lease) -> None:
        """End a run whose specification nobody can read: it keeps no other from being claimed."""
        detail = "the stored specification is not a JSON object"
        _LOG.error("run %s fails: %s", lease.run_id, detail)
        self.fail(lease, Failure(Outcome.ERROR, "invalid_spec", detail, retries=0))

    def store(self, lease: Lease, payload: Payload) -> Stored:
        """Store a result if the lease is still valid.

        State, result, attempt and event change together: there is no moment at which a run is done without a result
        or has two. A lease that is no longer valid leaves everything as it is; its result is compared with the one
        that was stored instead, because two executions of one run ought to agree.
        """
        return self.store_all([(lease, payload)])[0]

    def store_all(self, results: Sequence[tuple[Lease, Payload]]) -> list[Stored]:
        """Store several results as :meth:`store` does each, in one transaction: all of them are stored, or none.

        Short runs end faster than a disk can confirm one transaction each.
        """
        now = self._clock()
        with self._database.write() as connection:
            rows = leased_by(connection, [lease for lease, _ in results])
            # Taken out as they are used: a lease that comes twice is valid once.
            held = {(row.id, row.token): row for row in rows}
            stored = [held.pop(lease.pair, None) is not None for lease, _ in results]
            valid = [one for one, is_valid in zip(results, stored, strict=True) if is_valid]
            if valid:
                self._finish(connection, rows, valid, now)
            return [
                Stored.STORED if is_valid else self._stale(connection, lease, payload, now)
                for (lease, payload), is_valid in zip(results, stored, strict=True)
            ]

    def _finish(
        self,
        connection: Connection,
        rows: Sequence[LeasedRow],
        results: Sequence[tuple[Lease, Payload]],
        now: datetime,
    ) -> None:
        """Move leased runs to done with their results; the caller holds the locks."""
        ids = [lease.run_id for lease, _ in results]
        end_attempts(connection, rows, Outcome.DONE, now)
        move(connection, FINISH, run.c.id.in_(ids), finished_at=now, error_code=None, error_detail=None)
        found = [(lease, payload) for lease, payload in results if isinstance(payload, ResultPayload)]
        if found:
            self.note_spared(_insert_results(connection, found, now))
        measured = [(lease, payload) for lease, payload in results if isinstance(payload, MeasurementPayload)]
        if measured:
            insert_rows(connection, measurement, [measurement_row(*one, now) for one in measured])
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
            rows = leased_by(connection, [lease])
            if not rows:
                return None
            charged = self._charged(connection, lease, rows[0].charged_from, failure.outcome)
            mine = run.c.id == lease.run_id
            if charged < failure.retries:
                later = now + self._delay(charged) * random.uniform(*_JITTER)  # noqa: S311
                self._requeue(connection, rows, failure.outcome, now, failure.detail, later, suspect=failure.suspect)
                return RunState(connection.scalars(select(run.c.state).where(mine)).one())
            end_attempts(connection, rows, failure.outcome, now, failure.code, failure.detail)
            transition = QUARANTINE if failure.suspect else FAIL
            reason = {"error_code": failure.code, "error_detail": failure.detail}
            move(connection, transition, mine, finished_at=now, **reason)
            kind = f"run_{transition.target}"
            add_event(connection, lease.grid_id, kind, now, lease.run_id, attempt=lease.attempt, code=failure.code)
            close_grids(connection, [lease.grid_id], now)
            return transition.target

    def _delay(self, charged: int) -> timedelta:
        """Back-off, without jitter, of a run that has been charged so many times before."""
        return timedelta(seconds=min(self._retry_delay_s * 2.0**charged, _MAX_DELAY_S))

    def hand_back(self, leases: Sequence[Lease], outcome: Outcome = Outcome.HANDED_BACK) -> int:
        """Give runs back uncharged, at a stop; how many of the leases were still valid."""
        return self._give_back(leases, outcome)

    def requeue_lost(self, lease: Lease, outcome: Outcome, detail: str) -> bool:
        """Give one run back uncharged that went missing through no fault of its own."""
        return bool(self._give_back([lease], outcome, detail))

    def suspect(self, leases: Sequence[Lease], detail: str) -> int:
        """Give back runs one of which may have killed a worker: nobody is charged, all wait in the suspect lane."""
        return self._give_back(leases, Outcome.SUSPECTED, detail, suspect=True)

    def _give_back(
        self, leases: Sequence[Lease], outcome: Outcome, detail: str | None = None, *, suspect: bool = False
    ) -> int:
        given = 0
        # Each part is a transaction of its own: what a crash leaves is still leased, and given back by the next leader.
        for first in range(0, len(leases), AT_ONCE):
            with self._database.write() as connection:
                rows = leased_by(connection, leases[first : first + AT_ONCE])
                given += len(self._requeue(connection, rows, outcome, self._clock(), detail, suspect=suspect))
        return given

    def refuse_engine(self, lease: Lease, engine: str) -> bool:
        """Give a run back uncharged whose result came from another engine than its grid's.

        With the delay of a retry, or the same worker could take it again at once.
        """
        with self._database.write() as connection:
            now = self._clock()
            later = now + timedelta(seconds=self._retry_delay_s)
            detail = f"the worker's engine is {engine}, the grid's is {lease.engine}"
            rows = leased_by(connection, [lease])
            return bool(self._requeue(connection, rows, Outcome.OTHER_ENGINE, now, detail, later))

    def _requeue(self, connection: Connection, *arguments: Any, **options: Any) -> list[str]:
        done = requeue(connection, *arguments, **options)
        self.note_refused(len(done.refused))
        return done.given

    def note_refused(self, runs: int) -> None:
        """So many runs could not go back to the queue and were set aside; for who counts them."""

    def note_spared(self, runs: int) -> None:
        """So many runs wait no more, since results made them superfluous; for who counts them."""

    def set_aside(self, lease: Lease, reason: Exception) -> bool:
        """Quarantine a run whose end the database refuses for what it is; whether the lease was still valid."""
        with self._database.write() as connection:
            rows = leased_by(connection, [lease])
            for row in rows:
                set_aside(connection, row, self._clock(), reason)
            return bool(rows)

    def held(self, generation: int) -> set[Pair]:
        """Runs leased in this generation, each with its token."""
        with self._database.read() as connection:
            return self._leased_now(connection, generation)

    def requeue_forgotten(self, generation: int, known: Collection[Pair]) -> list[str]:
        """Give back runs leased in this generation that the dispatcher does not know of.

        That happens when a claim was committed and the answer to it was lost. Up to 5,000 at a time; a look that finds
        none, which is the rule, needs no lock.
        """
        unknown = sorted(self.held(generation).difference(known))[:AT_ONCE]
        if not unknown:
            return []
        with self._database.write() as connection:
            rows = leased(connection, run.c.id.in_([run_id for run_id, _ in unknown]))
            these = set(unknown)
            forgotten = [row for row in rows if (row.id, row.token) in these]
            return self._requeue(connection, forgotten, Outcome.FORGOTTEN, self._clock())

    def release_postdated(self) -> int:
        """Let runs be claimed now that wait for a time which only a clock that was wrong can have set; how many.

        A run that has not been tried waits for nothing, and no retry waits for longer than the back-off after so many
        attempts. Without this a clock that is set back, or that of another machine which is ahead, would hold up the
        queue.
        """
        now = self._clock()
        tries = run.c.attempt - run.c.charged_from
        wrong = (run.c.state == literal_column(f"'{RunState.QUEUED}'")) & (run.c.not_before > now + _SLACK)
        wrong &= or_(
            tries == 0,
            *((tries == charged + 1) & self._later_than(now, self._delay(charged)) for charged in range(_DOUBLINGS)),
            (tries > _DOUBLINGS) & self._later_than(now, timedelta(seconds=_MAX_DELAY_S)),
        )
        # Not made distinct there, or a database may go through all runs in the order of their grids.
        grids = select(run.c.grid_id).where(wrong)
        with self._database.read() as connection:
            if connection.scalar(grids.limit(1)) is None:
                return 0
        with self._database.write() as connection:
            lock_grids(connection, connection.scalars(grids))
            return connection.execute(update(run).where(wrong).values(not_before=now)).rowcount

    @staticmethod
    def _later_than(now: datetime, delay: timedelta) -> ColumnElement[bool]:
        return run.c.not_before > now + _SLACK + delay * _JITTER[1]

    def to_cancel(self, generation: int) -> set[Pair]:
        """Runs leased in this generation whose grid has been cancelled, each with its token."""
        with self._database.read() as connection:
            cancelled = select(grid.c.id).where(grid.c.cancelled_at.is_not(None), _OPEN)
            return self._leased_now(connection, generation, run.c.grid_id.in_(cancelled))

    @staticmethod
    def _leased_now(connection: Connection, generation: int, *where: ColumnElement[bool]) -> set[Pair]:
        mine = (run.c.state == literal_column(f"'{RunState.LEASED}'"), run.c.generation == generation)
        return {(row.id, row.token) for row in connection.execute(select(run.c.id, run.c.token).where(*mine, *where))}

    def cancel_leased(self, lease: Lease) -> bool:
        """Cancel a run in flight, whose result finds its lease gone; False where it was not cancelled.

        Then its lease was gone, or somebody has revived its grid since: it goes back to the queue.
        """
        now = self._clock()
        with self._database.write() as connection:
            rows = leased_by(connection, [lease])
            if not rows:
                return False
            cancelled = select(grid.c.cancelled_at).where(grid.c.id == lease.grid_id)
            if connection.scalar(cancelled) is None:
                self._requeue(connection, rows, Outcome.HANDED_BACK, now)
                return False
            end_attempts(connection, rows, Outcome.CANCELLED, now)
            move(connection, CANCEL_RUNNING, run.c.id == lease.run_id, finished_at=now)
            add_event(connection, lease.grid_id, "run_cancelled", now, lease.run_id, attempt=lease.attempt)
            close_grids(connection, [lease.grid_id], now)
            return True

    @staticmethod
    def _charged(connection: Connection, lease: Lease, charged_from: int, outcome: Outcome) -> int:
        counted = select(func.count()).where(
            attempt.c.run_id == lease.run_id, attempt.c.outcome == outcome, attempt.c.number > charged_from
        )
        return connection.scalar(counted) or 0

    @staticmethod
    def _stale(connection: Connection, lease: Lease, payload: Payload, now: datetime) -> Stored:
        table = measurement if isinstance(payload, MeasurementPayload) else result
        wanted = select(table.c.payload_digest).where(table.c.run_id == lease.run_id)
        stored: Any = connection.scalar(wanted)
        same = stored is None or stored == payload.digest
        known = connection.scalar(select(grid.c.id).where(grid.c.id == lease.grid_id))
        if known is not None:
            detail = {"attempt": lease.attempt, "same": same}
            add_event(connection, lease.grid_id, "stale_result", now, lease.run_id, **detail)
        return Stored.STALE_SAME if same else Stored.STALE_OTHER


# The states are spelt out: a database takes a partial index only where it sees that the condition implies it.
_OPEN = grid.c.state == literal_column(f"'{GridState.QUEUED}'")
_ENGINE = select(grid.c.engine_digest).where(grid.c.id == run.c.grid_id).correlate(run).scalar_subquery()
# All by the statement that claims: each one more is another wait for the server's turn.
_CLAIMED = (
    run.c.id,
    run.c.grid_id,
    run.c.attempt,
    run.c.digest,
    run.c.kind,
    # As text, or one row that is no JSON would make the whole claim fail, again and again.
    cast(run.c.spec, Text).label("spec"),
    run.c.suspect,
    run.c.not_before,
    _ENGINE.label("engine_digest"),
)


def _insert_results(connection: Connection, results: Sequence[tuple[Lease, ResultPayload]], now: datetime) -> int:
    """Write results of realizations with all that is added up from them; how many others are not needed any more."""
    ids = [lease.run_id for lease, _ in results]
    asked = connection.execute(select(run.c.id, run.c.ordinal, run.c.inputs).where(run.c.id.in_(ids)))
    runs = {row.id: row for row in asked}
    stored = [result_row(lease, runs[lease.run_id].inputs, payload, now) for lease, payload in results]
    for row, input_id in zip(stored, add_to_inputs(connection, stored), strict=True):
        row["input_id"] = input_id
    answers = [
        answer
        for row, (lease, payload) in zip(stored, results, strict=True)
        for answer in estimate_rows(lease.run_id, row["input_id"], payload)
    ]
    insert_rows(connection, result, stored)
    if answers:
        insert_rows(connection, estimate, answers)
    add_to_moments(connection, stored, answers)
    replicates = [Replicate(row["grid_id"], runs[row["run_id"]].ordinal, row["input_id"]) for row in stored]
    return judge_points(connection, replicates, now)


def _read_spec(text: str) -> dict[str, Any] | None:
    """A specification as it was stored; None where it is no JSON object, which only a change by hand can make it."""
    try:
        spec = json.loads(text)
    except ValueError:
        return None
    return spec if isinstance(spec, dict) else None


def _ready(now: datetime, engine: str | None, suspects: bool) -> ColumnElement[bool]:
    """Runs that may be claimed for an engine."""
    queued = run.c.state == literal_column(f"'{RunState.QUEUED}'")
    ready = queued & (run.c.suspect == (true() if suspects else false())) & (run.c.not_before <= now)
    others = None if engine is None else grid.c.engine_digest != engine
    return ready & run.c.grid_id.not_in(held_grids(others))
