"""Reads that several ask for at once: done once for those who wait, and never older than the question."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest

from service.api.threads import SharedReads


class Counter:
    """A read that waits until it may go on, and says the how manieth it is."""

    def __init__(self) -> None:
        self.calls = 0
        self.begun, self.may = Event(), Event()
        self.fails = False

    def read(self, _: str) -> int:
        self.calls += 1
        number = self.calls
        self.begun.set()
        assert self.may.wait(60.0)
        if self.fails:
            raise LookupError(number)
        return number


@pytest.fixture
def thread() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(1) as threads:
        yield threads


async def begun(counter: Counter) -> None:
    while not counter.begun.is_set():
        await asyncio.sleep(0.001)


def test_what_waits_is_done_once_for_all_and_what_has_begun_is_joined_by_nobody(thread: ThreadPoolExecutor) -> None:
    async def ask() -> None:
        reads, counter = SharedReads(thread), Counter()
        first = asyncio.create_task(reads.ask(counter.read, "a"))
        await begun(counter)
        # What they ask for is read after they asked: the first has begun and may have seen less.
        others = [asyncio.create_task(reads.ask(counter.read, "a")) for _ in range(9)]
        another = asyncio.create_task(reads.ask(counter.read, "b"))
        await asyncio.sleep(0)
        counter.may.set()
        assert await first == 1
        assert await asyncio.gather(*others) == [2] * 9
        assert await another == 3
        assert await reads.ask(counter.read, "a") == 4

    asyncio.run(ask())


def test_an_error_reaches_all_and_whoever_goes_away_takes_nothing_from_the_others(thread: ThreadPoolExecutor) -> None:
    async def ask() -> None:
        reads, counter = SharedReads(thread), Counter()
        first = asyncio.create_task(reads.ask(counter.read, "a"))
        await begun(counter)
        leaving, staying = (asyncio.create_task(reads.ask(counter.read, "a")) for _ in range(2))
        await asyncio.sleep(0)
        leaving.cancel()
        counter.fails = True
        counter.may.set()
        for asked in (first, staying):
            with pytest.raises(LookupError):
                await asked
        with pytest.raises(asyncio.CancelledError):
            await leaving
        counter.fails = False
        assert await reads.ask(counter.read, "a") == 3

    asyncio.run(ask())
