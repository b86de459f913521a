"""Which worker takes no work, and whose memory it was; with clocks of their own."""

from __future__ import annotations

from collections.abc import Callable

from service.dispatcher.stalls import Condition, Stall, Stalls, WorkerMemory, read_conditions

MIB = 2**20


def stalls_of(
    condition: Callable[[int], Condition], given: float | None = None, looks: int = 30, step: float = 2.0
) -> list[tuple[float, Stall]]:
    """Look at one worker again and again; what was found, and when."""
    stalls, found = Stalls(silent_s=60.0, patience_s=20.0), []
    for look in range(looks):
        now = 1000.0 + look * step
        busy = {} if given is None else {"a": given}
        found += [(now - 1000.0, stall) for stall in stalls.look({"a": condition(look)}, busy, now)]
    return found


def condition(status: str, executing: int | None = 0, heard: float = 0.0) -> Condition:
    return Condition(status, heard, executing, 0.0, 500 * MIB)


def test_a_worker_that_takes_no_work_is_found_within_half_a_minute_and_one_that_works_never() -> None:
    def first(*arguments: object, given: float | None = 1000.0) -> tuple[float, str, bool] | None:
        status, executing, beats = arguments
        found = stalls_of(lambda look: condition(str(status), executing, look * bool(beats)), given)  # type: ignore[arg-type]
        return (found[0][0], found[0][1].reason, found[0][1].begun) if found else None

    assert first("paused", 0, True, given=None) == (20.0, "paused", False)
    assert first("paused", 0, True) == (20.0, "paused", False)
    assert first("paused", 1, True) == (20.0, "paused", True)
    assert first("closing_gracefully", 0, True, given=None) == (20.0, "closing", False)
    assert first("closing_gracefully", 1, True) is None, "it may end what it is at"
    assert first("running", 0, True) == (20.0, "not_started", False)
    assert first("running", 0, True, given=None) is None
    assert first("running", 1, True) is None
    assert first("running", None, True) is None
    silent = stalls_of(lambda _: condition("running", 1), 1000.0, looks=40)
    assert [(when, stall.reason) for when, stall in silent] == [(60.0, "silent")]


def test_a_pause_of_a_moment_is_none_and_time_that_nobody_looked_does_not_count() -> None:
    assert not stalls_of(lambda look: condition("paused" if look % 8 else "running", heard=look))
    # Looks an hour apart, as after a suspended machine: each counts for a moment.
    assert not stalls_of(lambda look: condition("paused", heard=look), looks=4, step=3600.0)


def test_a_run_is_to_blame_for_memory_where_it_would_have_filled_a_fresh_worker_too() -> None:
    fresh = WorkerMemory(pid=1, fresh=200 * MIB, latest=200 * MIB, limit=1000 * MIB, pause_fraction=0.8)
    assert fresh.would_fill_a_fresh_one(810 * MIB)
    # Half of it was there before this run began.
    leaked = WorkerMemory(pid=1, fresh=200 * MIB, latest=500 * MIB, limit=1000 * MIB, pause_fraction=0.8)
    assert not leaked.would_fill_a_fresh_one(960 * MIB)
    slightly = WorkerMemory(pid=1, fresh=200 * MIB, latest=220 * MIB, limit=1000 * MIB, pause_fraction=0.8)
    assert slightly.would_fill_a_fresh_one(960 * MIB)
    unknown = WorkerMemory(pid=1, fresh=200 * MIB, latest=None, limit=1000 * MIB, pause_fraction=0.8)
    assert not unknown.would_fill_a_fresh_one(960 * MIB)
    assert not WorkerMemory().would_fill_a_fresh_one(960 * MIB)


def test_what_workers_say_of_themselves_may_be_anything() -> None:
    good = {"status": "paused", "last_seen": 1.0, "metrics": {"memory": 5, "cpu": 1.0, "hostlens_running": 1}}
    wrong = (None, 1, {}, {**good, "metrics": None}, {**good, "metrics": {"memory": "much"}}, {**good, "last_seen": []})
    told = {"workers": {"good": good, **{str(place): one for place, one in enumerate(wrong)}}}
    assert read_conditions(told) == {"good": Condition("paused", 1.0, 1, 1.0, 5)}
    assert read_conditions(None) == read_conditions({"workers": []}) == {}
