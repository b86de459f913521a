"""The stages of a run, told as they begin and timed as they end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from engine.result import StageTime

Progress = Callable[[str, float], None]
"""Called with a stage of :data:`STAGES` and the part of it that is done."""
STAGES = ("simulate", "parametric", "prepare", "optimum", "chain", "draws", "refit", "errors")
"""In their order; where no estimator needs a chain the run ends with ``parametric``."""


@dataclass
class Stopwatch:
    """Wall and CPU time of each stage, told to ``progress`` as they begin."""

    progress: Progress | None = None
    stages: list[StageTime] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is done within; a stage that is done again adds to its time."""
        self.tell(name, 0.0)
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        taken = StageTime(name, time.perf_counter() - wall, time.process_time() - cpu)
        for place, before in enumerate(self.stages):
            if before.stage == name:
                self.stages[place] = StageTime(name, before.wall_s + taken.wall_s, before.cpu_s + taken.cpu_s)
                return
        self.stages.append(taken)

    def tell(self, name: str, done: float) -> None:
        """Say how far a stage is."""
        if self.progress is not None:
            self.progress(name, done)
