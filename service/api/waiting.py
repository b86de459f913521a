"""Who waits for a grid: told as soon as there is what is waited for, and at the latest when the time is up."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated

from fastapi import Query

from service.api.context import Context
from service.api.threads import QUICK, run_in
from service.domain.views import GridView

_BATCH = 100
GridWait = Annotated[float, Query(ge=0.0, le=30.0, description="Seconds to wait until the grid has ended or differs")]


async def await_grid(service: Context, grid_id: str, wait_s: float, is_awaited: Callable[[GridView], bool]) -> GridView:
    """The grid once it is as it is awaited, or as it is when the time is up.

    It is looked at again with each event, of which the hub reads once for all who wait.

    Raises
    ------
    service.api.hub.FullError
        As many as may are waiting already.
    """
    until = time.monotonic() + wait_s
    grid = await service.reads.ask(service.grids.grid, grid_id)
    if not wait_s or is_awaited(grid):
        return grid
    with service.hub.follow(grid_id) as feed:
        # The number first: what comes between the two is told, and looked at once more.
        after = await run_in(QUICK, service.events.latest, grid_id)
        grid = await service.reads.ask(service.grids.grid, grid_id)
        while not is_awaited(grid) and (left := until - time.monotonic()) > 0.0:
            news = await feed.next(after, _BATCH, left)
            if not news.told:
                # The time is up, the server stops, or nothing will follow.
                break
            after = news.told[-1].number
            grid = await service.reads.ask(service.grids.grid, grid_id)
    return grid
