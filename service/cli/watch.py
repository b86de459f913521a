"""A grid's progress on a terminal, and as plain lines where there is none."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from service.cli.formatting import duration, grid_line
from service.domain.views import GridView

_LINE_EVERY_S = 15.0


class Show(Protocol):
    """Takes each look at a grid."""

    def __call__(self, grid: GridView) -> None:
        """Show how far it is."""


@contextmanager
def progress(console: Console) -> Iterator[Show]:
    """Something that shows how far a grid is: a bar with rate and time left, or a line now and then."""
    if console.is_terminal:
        with Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
        ) as bar:
            task = bar.add_task("runs", total=None, note="")
            yield lambda grid: bar.update(task, total=grid.n_runs, completed=grid.counts.ended, note=_note(grid))
    else:
        yield _Lines(console)


def _note(grid: GridView) -> str:
    parts = [f"{grid.counts.leased} running"]
    if grid.rate_per_s:
        parts.append(f"{60 * grid.rate_per_s:.2g} runs/min")
    if grid.eta_seconds is not None and grid.finished_at is None:
        parts.append(f"{duration(grid.eta_seconds)} left")
    return ", ".join(parts)


class _Lines:
    def __init__(self, console: Console) -> None:
        self._console = console
        self._ended = -1
        self._next = 0.0

    def __call__(self, grid: GridView) -> None:
        if grid.counts.ended != self._ended or time.monotonic() >= self._next:
            self._ended = grid.counts.ended
            self._next = time.monotonic() + _LINE_EVERY_S
            self._console.print(grid_line(grid), highlight=False, soft_wrap=True)
