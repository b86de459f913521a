"""Who runs where, and who is charged when a worker dies."""

from __future__ import annotations

from service.dispatcher.attribution import Deaths
from service.dispatcher.placement import Slots
from service.dispatcher.pool import Worker

ONE = Worker("a", 1, "e", 0.0)
FOUR = Worker("b", 4, "e", 0.0)


def test_every_thread_gets_one_run_and_the_emptiest_worker_is_first() -> None:
    slots = Slots()
    assert [worker.address for worker in slots.free([ONE, FOUR])] == ["a", "b", "b", "b", "b"]
    slots.take("b", "1", alone=False)
    slots.take("a", "2", alone=False)
    assert [worker.address for worker in slots.free([ONE, FOUR])] == ["b", "b", "b"]
    slots.release("a", "2")
    assert slots.free([ONE, FOUR])[0] == ONE


def test_a_suspect_gets_a_worker_that_nothing_else_is_on_or_comes_to() -> None:
    slots = Slots()
    for key in "12":
        slots.take("b", key, alone=False)
    # No worker is empty: this one is given nothing more until it is.
    assert slots.lane("e", [FOUR]) is None
    assert slots.free([FOUR]) == []
    slots.release("b", "1")
    assert slots.lane("e", [FOUR]) is None
    slots.release("b", "2")
    assert slots.lane("e", [FOUR]) == FOUR
    slots.take("b", "suspect", alone=True)
    assert slots.free([FOUR]) == []
    assert slots.lane("e", [FOUR, ONE]) is None, "one suspect at a time"
    slots.release("b", "suspect")
    assert len(slots.free([FOUR])) == 4


def test_a_worker_is_not_kept_empty_for_a_suspect_that_is_gone() -> None:
    slots = Slots()
    slots.take("b", "1", alone=False)
    assert slots.lane("e", [FOUR]) is None
    slots.no_suspects("e")
    assert len(slots.free([FOUR])) == 3


def test_what_waits_for_one_engine_keeps_or_frees_no_worker_of_another() -> None:
    other = Worker("c", 1, "other", 0.0)
    slots = Slots()
    for address in "bc":
        slots.take(address, address, alone=False)
    assert slots.lane("e", [FOUR]) is None
    slots.no_suspects("other")
    assert slots.free([FOUR, other]) == [], "the worker is emptied for a suspect that still waits"
    assert slots.lane("other", [other]) is None
    slots.no_suspects("e")
    slots.release("c", "c")
    assert [worker.address for worker in slots.free([FOUR, other])] == ["b", "b", "b"]
    assert slots.lane("other", [other]) == other
    # Where ports are fixed the next worker of another engine may have the address that one was kept empty at.
    assert slots.lane("e", [FOUR]) is None
    assert len(slots.free([Worker("b", 4, "other", 0.0)])) == 3


def test_no_worker_is_kept_empty_while_the_suspect_of_another_engine_is_under_way() -> None:
    other = Worker("c", 1, "other", 0.0)
    slots = Slots()
    slots.take("b", "1", alone=False)
    assert slots.lane("e", [FOUR]) is None
    slots.take("c", "suspect", alone=True)
    assert slots.lane("e", [FOUR]) is None
    assert [worker.address for worker in slots.free([FOUR, other])] == ["b", "b", "b"]
    slots.release("c", "suspect")
    slots.release("b", "1")
    assert slots.lane("e", [FOUR]) == FOUR


def test_one_run_on_a_dead_worker_did_it_and_of_several_nobody_can_tell() -> None:
    deaths: Deaths[str] = Deaths(judge_after_s=1.0)
    assert deaths.judge(0.0) is None
    deaths.add(["a"], now=0.0)
    assert deaths.judge(0.9) is None
    verdict = deaths.judge(1.1)
    assert verdict is not None
    assert (verdict.guilty, verdict.suspects) == ("a", ())
    assert deaths.judge(9.0) is None
    # A second worker within the moment: perhaps the machine failed.
    deaths.add(["a"], now=10.0)
    deaths.add(["b", "c"], now=10.8)
    assert deaths.judge(11.5) is None
    verdict = deaths.judge(11.9)
    assert verdict is not None
    assert (verdict.guilty, verdict.suspects) == (None, ("a", "b", "c"))
    deaths.add(["d"], now=20.0)
    assert deaths.take_back() == ("d",)
    assert len(deaths) == 0
