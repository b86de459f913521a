"""Operations of the store, and a process that dies at a chosen boundary between two of their statements.

The boundaries are the moment before each statement, the one before the commit and the one after it, as SQLAlchemy
tells of them: whatever an operation comes to consist of, none is forgotten.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Connection, event

from service.domain.identifiers import utc_now
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Lease, Outcome, end_attempts, leased_by
from service.store.queue import Failure, RunQueue
from tests.service.plans import body, planned, result_of, submit, submit_until, until

DEAD = 9
BROKEN = Failure(Outcome.ERROR, "error", "broken", retries=1)
PERMANENT = Failure(Outcome.ERROR, "error", "broken", retries=0)
CRASHED = Failure(Outcome.WORKER_LOST, "worker_lost", "gone", retries=0, suspect=True)


@dataclass(frozen=True)
class Stores:
    """One process' view of a database."""

    database: Database
    grids: GridStore
    queue: RunQueue
    leadership: Leadership

    def lead(self) -> int:
        """Lead, whoever led before."""
        generation = self.leadership.take("mine", lambda _: True)
        assert generation is not None
        return generation


@contextmanager
def stores(url: str) -> Iterator[Stores]:
    database = Database(url, pooled=False)
    # Without delay, so that what is given back can be claimed at once.
    yield Stores(database, GridStore(database), RunQueue(database, retry_delay_s=0.0), Leadership(database))
    database.close()


@dataclass(frozen=True)
class Scene:
    """A grid with four runs, two of them leased, and another grid that waits."""

    grid_id: str
    generation: int
    leases: tuple[Lease, ...]


def prepare(mine: Stores) -> Scene:
    grid_id = submit(mine.grids, 4)
    submit(mine.grids, 1, seed=50)
    generation = mine.lead()
    return Scene(grid_id, generation, tuple(mine.queue.claim(generation, 2)))


def _paused(mine: Stores) -> Scene:
    scene = prepare(mine)
    mine.grids.pause(scene.grid_id)
    return scene


def _cancelled(mine: Stores) -> Scene:
    scene = prepare(mine)
    mine.grids.cancel(scene.grid_id)
    return scene


def _failed(mine: Stores) -> Scene:
    scene = prepare(mine)
    for lease in scene.leases:
        mine.queue.fail(lease, PERMANENT)
    return scene


def _poisoned(mine: Stores) -> Scene:
    """The first lease cannot be ended: its attempt is on record as ended already."""
    scene = prepare(mine)
    with mine.database.write() as connection:
        end_attempts(connection, leased_by(connection, scene.leases[:1]), Outcome.DONE, utc_now())
    return scene


def _last(mine: Stores) -> Scene:
    """A grid whose last run is under way."""
    grid_id = submit(mine.grids, 1)
    generation = mine.lead()
    return Scene(grid_id, generation, tuple(mine.queue.claim(generation, 1)))


def _nearly_known(mine: Stores) -> Scene:
    """Of six replicates three are needed: two are stored, two are under way and two wait."""
    grid_id = submit_until(mine.grids, 1, until(1.0, at_most=6))
    generation = mine.lead()
    first, second, *leases = mine.queue.claim(generation, 4)
    mine.queue.store_all([(lease, result_of(lease)) for lease in (first, second)])
    return Scene(grid_id, generation, tuple(leases))


def _known(mine: Stores) -> Scene:
    """The last replicate of a point that is known well enough is still under way."""
    scene = _nearly_known(mine)
    mine.queue.store(scene.leases[0], result_of(scene.leases[0]))
    return replace(scene, leases=scene.leases[1:])


def _known_but_failed(mine: Stores) -> Scene:
    scene = _known(mine)
    mine.queue.fail(scene.leases[0], PERMANENT)
    return scene


@dataclass(frozen=True)
class Operation:
    """What a process was about to do when it died, and what was there before."""

    act: Callable[[Stores, Scene], object]
    prepare: Callable[[Stores], Scene] = prepare


def _submit(mine: Stores, _: Scene) -> object:
    return mine.grids.create(body(3, 99), lambda: planned(3, 99), key="once")


def _store(mine: Stores, scene: Scene) -> object:
    return mine.queue.store(scene.leases[0], result_of(scene.leases[0]))


OPERATIONS = {
    "submit": Operation(_submit),
    "claim": Operation(lambda mine, scene: mine.queue.claim(scene.generation, 2)),
    "store": Operation(lambda mine, scene: mine.queue.store(scene.leases[0], result_of(scene.leases[0]))),
    "store the last": Operation(
        lambda mine, scene: mine.queue.store(scene.leases[0], result_of(scene.leases[0])), _last
    ),
    "store several": Operation(
        lambda mine, scene: mine.queue.store_all([(lease, result_of(lease)) for lease in scene.leases])
    ),
    "set aside": Operation(lambda mine, scene: mine.queue.set_aside(scene.leases[0], ValueError("refused"))),
    "lose": Operation(lambda mine, scene: mine.queue.requeue_lost(scene.leases[0], Outcome.FORGOTTEN, "gone")),
    "take-over of what is refused": Operation(lambda mine, _: mine.lead(), _poisoned),
    "retry": Operation(lambda mine, scene: mine.queue.fail(scene.leases[0], BROKEN)),
    "fail": Operation(lambda mine, scene: mine.queue.fail(scene.leases[0], PERMANENT)),
    "quarantine the last": Operation(lambda mine, scene: mine.queue.fail(scene.leases[0], CRASHED), _last),
    "suspect": Operation(lambda mine, scene: mine.queue.suspect(scene.leases, "one of two")),
    "refuse": Operation(lambda mine, scene: mine.queue.refuse_engine(scene.leases[0], "0" * 64)),
    "hand back": Operation(lambda mine, scene: mine.queue.hand_back(scene.leases)),
    "hand back cancelled": Operation(lambda mine, scene: mine.queue.hand_back(scene.leases), _cancelled),
    "hand back paused": Operation(lambda mine, scene: mine.queue.hand_back(scene.leases), _paused),
    "requeue": Operation(lambda mine, scene: mine.queue.requeue_forgotten(scene.generation, [])),
    "take-over": Operation(lambda mine, _: mine.lead()),
    "cancel": Operation(lambda mine, scene: mine.grids.cancel(scene.grid_id)),
    "cancel running that was revived": Operation(lambda mine, scene: mine.queue.cancel_leased(scene.leases[0])),
    "cancel running": Operation(lambda mine, scene: mine.queue.cancel_leased(scene.leases[0]), _cancelled),
    "pause": Operation(lambda mine, scene: mine.grids.pause(scene.grid_id)),
    "resume": Operation(lambda mine, scene: mine.grids.resume(scene.grid_id), _paused),
    "store what is enough": Operation(_store, _nearly_known),
    "hand back what is not needed": Operation(lambda mine, scene: mine.queue.hand_back(scene.leases), _known),
    "take-over of what is not needed": Operation(lambda mine, _: mine.lead(), _known),
    "revive what is not needed": Operation(lambda mine, scene: mine.grids.revive(scene.grid_id), _known_but_failed),
    "revive": Operation(lambda mine, scene: mine.grids.revive(scene.grid_id), _failed),
}


def die_at(url: str, name: str, scene: Scene, boundary: int, *, within: bool = True, commits: bool = False) -> None:
    """Carry out an operation in this process, and die without a word at its ``boundary``-th boundary.

    Not ``within`` its transactions only those between two of them count; with ``commits`` those before and after each
    commit alone, be the connection given back or not.
    """
    with stores(url) as mine:
        passed = 0
        committed = False

        def boundary_passed(*_: Any, **__: Any) -> None:
            nonlocal passed
            passed += 1
            if passed == boundary:
                os._exit(DEAD)

        def committing(*_: Any) -> None:
            nonlocal committed
            boundary_passed()
            committed = True

        def after_a_commit(*_: Any, **__: Any) -> None:
            nonlocal committed
            if committed:
                boundary_passed()
            committed = False

        if commits:
            event.listen(mine.database.engine, "commit", committing)
            event.listen(mine.database.engine, "before_cursor_execute", after_a_commit)
            event.listen(mine.database.engine.pool, "reset", after_a_commit)
            OPERATIONS[name].act(mine, scene)
            return
        if within:
            event.listen(mine.database.engine, "before_cursor_execute", boundary_passed)
            event.listen(mine.database.engine, "commit", _before(boundary_passed))
        event.listen(mine.database.engine.pool, "reset", boundary_passed)
        OPERATIONS[name].act(mine, scene)


def _before(passed: Callable[[], None]) -> Callable[[Connection], None]:
    def committing(_: Connection) -> None:
        passed()

    return committing
