"""Many who wait for a grid's events: asked for once, told in order, missed by nobody."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest
from sqlalchemy.exc import OperationalError

from service.api import hub as hub_module
from service.api.hub import Feed, FullError, Hub, News
from service.domain.identifiers import utc_now
from service.domain.views import EventPage
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leases import add_event
from service.store.outbox import EventStore
from tests.service.plans import submit


class Counted(EventStore):
    """Counts the looks at the database."""

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        self.looks = 0

    def page(self, grid_id: str, after: int, limit: int) -> EventPage:
        self.looks += 1
        return super().page(grid_id, after, limit)


@pytest.fixture(autouse=True)
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_module, "_LOOK_S", 0.02)


@pytest.fixture
def grid(database: Database) -> str:
    return submit(GridStore(database), 1)


def happen(database: Database, grid_id: str, events: int, first: int = 0) -> None:
    with database.write() as connection:
        for number in range(first, first + events):
            add_event(connection, grid_id, "grid_paused", utc_now(), runs=number)


async def told(feed: Feed, events: int, after: int, pause_s: float = 0.0, limit: int = 100) -> list[int]:
    """What the data of so many events say, as one follower is told them."""
    seen: list[int] = []
    while len(seen) < events:
        news = await feed.next(after, limit, 120.0)
        assert news.told, "nothing came in two minutes"
        after = news.told[-1].number
        seen += [one.view.detail["runs"] for one in news.told]
        await asyncio.sleep(pause_s)
    return seen


def test_the_database_is_asked_once_for_all_who_follow_a_grid(database: Database, grid: str) -> None:
    events = Counted(database)

    async def follow() -> None:
        hub = Hub(events, most=100)
        after = events.latest(grid)

        async def one() -> list[int]:
            with hub.follow(grid) as feed:
                return await told(feed, 30, after)

        followers = [asyncio.create_task(one()) for _ in range(100)]
        for number in range(30):
            await asyncio.to_thread(happen, database, grid, 1, number)
        assert [await found for found in followers] == [list(range(30))] * 100
        looks = events.looks
        await asyncio.sleep(0.2)
        # Nobody follows any more: at most the look that was under way.
        assert events.looks <= looks + 1

    asyncio.run(follow())
    # One look may see nothing and one each event; a look of each follower's own would be three thousand.
    assert events.looks < 300


def test_who_falls_behind_what_is_kept_misses_nothing(
    database: Database, grid: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub_module, "_KEPT", 20)

    async def follow() -> None:
        events = EventStore(database)
        hub = Hub(events, most=2)
        after = events.latest(grid)
        with hub.follow(grid) as feed, hub.follow(grid) as same:
            assert same is feed
            slow = asyncio.create_task(told(feed, 300, after, pause_s=0.005, limit=7))
            fast = asyncio.create_task(told(same, 300, after))
            for number in range(30):
                await asyncio.to_thread(happen, database, grid, 10, 10 * number)
            assert await slow == await fast == list(range(300))

    asyncio.run(follow())


def test_a_resumed_follower_is_told_what_lies_between(database: Database, grid: str) -> None:
    events = EventStore(database)
    after = events.latest(grid)
    happen(database, grid, 250)

    async def follow() -> None:
        hub = Hub(events, most=1)
        with hub.follow(grid) as feed:
            assert await told(feed, 250, after) == list(range(250))
            assert (await feed.next(events.latest(grid), 100, 0.05)) == News((), ended=False)

    asyncio.run(follow())


class Failing(Counted):
    """Fails as it is told to."""

    error: Exception | None = None

    def page(self, grid_id: str, after: int, limit: int) -> EventPage:
        if self.error is not None:
            self.looks += 1
            raise self.error
        return super().page(grid_id, after, limit)


@pytest.mark.parametrize("behind", [False, True])
def test_followers_wait_through_an_absence_of_the_database(database: Database, grid: str, behind: bool) -> None:
    """Also who is behind what is kept, and asks the database by himself."""

    async def follow() -> None:
        events = Failing(database)
        hub = Hub(events, most=1)
        after = events.latest(grid)
        if behind:
            happen(database, grid, 5)
        with hub.follow(grid) as feed:
            await until(lambda: events.looks > 0)
            events.error = OperationalError("SELECT", {}, Exception("the database is away"))
            waiting = asyncio.create_task(told(feed, 5, after))
            looks = events.looks
            if not behind:
                await asyncio.to_thread(happen, database, grid, 5)
            await until(lambda: events.looks > looks + 4)
            assert not waiting.done()
            events.error = None
            assert await waiting == list(range(5))

    asyncio.run(follow())


def test_a_feed_that_cannot_be_read_lets_its_followers_go_and_the_next_begins_anew(
    database: Database, grid: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def follow() -> None:
        events = Failing(database)
        hub = Hub(events, most=2)
        after = events.latest(grid)
        with hub.follow(grid) as feed:
            events.error = ValueError("a mistake of ours")
            assert await feed.next(after, 100, 120.0) == News((), ended=False)
            assert feed.closed
            events.error = None
            with hub.follow(grid) as other:
                await asyncio.to_thread(happen, database, grid, 1)
                assert await told(other, 1, after) == [0]

    asyncio.run(follow())
    assert "a mistake of ours" in caplog.text


def test_as_many_follow_as_may_and_a_place_that_is_left_is_free(database: Database, grid: str) -> None:
    async def follow() -> None:
        hub = Hub(EventStore(database), most=2)
        with hub.follow(grid):
            with hub.follow(grid), pytest.raises(FullError, match="2 streams"), hub.follow(grid):
                pass
            with hub.follow(grid):
                pass

    asyncio.run(follow())


def test_the_end_of_a_grid_is_told_and_a_grid_that_goes_on_is_followed_again(database: Database, grid: str) -> None:
    grids = GridStore(database)

    async def follow() -> None:
        events = EventStore(database)
        hub = Hub(events, most=2)
        after = events.latest(grid)
        with hub.follow(grid) as feed:
            await asyncio.to_thread(grids.cancel, grid)
            kinds: list[str] = []
            while True:
                news = await feed.next(after, 1, 120.0)
                # The end may be told together with the last event or after it.
                after = news.told[-1].number if news.told else after
                kinds += [one.view.kind for one in news.told]
                if news.ended:
                    break
            assert kinds == ["grid_cancelled", "grid_finished"]
            assert await feed.next(after, 1, 120.0) == News([], ended=True)
            await until(lambda: feed.is_over)
            await asyncio.to_thread(grids.revive, grid)
            with hub.follow(grid) as other:
                assert [one.view.kind for one in (await other.next(after, 9, 120.0)).told] == ["grid_revived"]

    asyncio.run(follow())


def test_a_hub_that_is_closed_lets_everybody_go_at_once(database: Database, grid: str) -> None:
    async def follow() -> None:
        hub = Hub(EventStore(database), most=2)
        after = EventStore(database).latest(grid)
        with hub.follow(grid) as feed:
            waiting = asyncio.create_task(feed.next(after, 100, 30.0))
            await asyncio.sleep(0.1)
            hub.close()
            assert await asyncio.wait_for(waiting, 25.0) == News((), ended=False)
        with hub.follow(grid) as late:
            assert late.closed

    asyncio.run(follow())


async def until(look: Callable[[], bool]) -> None:
    async with asyncio.timeout(120.0):
        while not look():
            await asyncio.sleep(0.01)
