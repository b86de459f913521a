"""A service of its own for a drill: real processes in a temporary folder, all gone afterwards."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from service.runtime import installation as runtime
from service.runtime.installation import PATIENCE_S, eventually, free_port, is_worker
from service.runtime.installation import DidNotHappenError as DrillError
from service.store.migrate import upgrade

__all__ = ["PATIENCE_S", "ROOT", "DrillError", "Installation", "eventually", "free_port", "installation", "is_worker"]

ROOT = Path(__file__).resolve().parents[2]


class Installation(runtime.Installation):
    """With a brief task whose executions are counted, and a reconciliation every second, unless told otherwise."""

    def __init__(
        self, folder: Path, settings: Mapping[str, str], commands: Sequence[tuple[str, ...]] = (("service", "serve"),)
    ) -> None:
        self.cwd = folder
        self.executions = folder / "executions"
        if "HOSTLENS_DATABASE_URL" not in {**os.environ, **settings}:
            _put_database(folder / "data")
        self.executions.touch()
        # The processes are started elsewhere, and have to find the tasks of the tests.
        paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        own = {
            "PYTHONPATH": os.pathsep.join(paths),
            "HOSTLENS_DRILL_LOG": str(self.executions),
            "HOSTLENS_TASK": "service.worker.synthetic:brief",
            "HOSTLENS_RECONCILE_S": "1",
        }
        super().__init__(folder, {**own, **settings}, commands)

    def executed(self) -> list[str]:
        """Digest of each execution that came to its end."""
        return [line.split()[0] for line in self.executions.read_text().splitlines()]


def _put_database(folder: Path) -> None:
    """A database with its tables, where there is none: to make them takes a third of the supervisor's start."""
    file = folder / "hostlens.sqlite"
    if not file.exists():
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        file.write_bytes(_empty_database())


@cache
def _empty_database() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hostlens.sqlite"
        upgrade(f"sqlite:///{file}")
        return file.read_bytes()


@contextmanager
def installation(
    folder: Path,
    settings: Mapping[str, str],
    *,
    commands: Sequence[tuple[str, ...]] = (("service", "serve"),),
    ready: bool = True,
) -> Iterator[Installation]:
    """A service that computes (or, where it is not to be ``ready``, answers), and is gone afterwards in any case."""
    folder.mkdir(parents=True, exist_ok=True)
    own = Installation(folder, settings, commands)
    try:
        if ready:
            own.wait_ready()
        else:
            eventually(own.readiness, what="an answer")
        yield own
    finally:
        own.kill_all()
