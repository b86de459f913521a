"""What concerns every test: one thread for each numeric library, who runs what in which order, and what is reported."""

import os
from collections.abc import Generator
from pathlib import Path

# Before anything loads them: several processes of tests share the machine, and a worker of the service has one core.
for _library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import pytest  # noqa: E402 - after the variables
from xdist.remote import Producer  # noqa: E402
from xdist.scheduler import LoadScopeScheduling  # noqa: E402

from service.runtime.process import spare_collector  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
LONG = ("tests/service/test_drills.py", "tests/service/test_migrations.py", "tests/docs/test_examples.py")
"""Files that take long and whose tests share what is costly to make: begun before all others, each by one process."""
APART = (
    "tests/test_end_to_end.py",
    "tests/service/test_stalls.py",
    "tests/service/test_clusters.py",
    "tests/service/test_foreign_clocks.py",
    "tests/service/test_processes.py",
    "tests/deploy/test_topology.py",
    "tests/service/test_signals.py",
    "tests/service/test_executor_security.py",
    "tests/service/test_queue_model.py",
)
"""Files whose tests take long and share nothing: each test goes to whoever is free, before all others, for one that is
begun last is waited for by all. The tests of another file stay together, and what they share is made once."""


class Scheduling(LoadScopeScheduling):
    """A file, or a test of those that go apart, to whoever is free."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return nodeid if file in APART else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Scheduling:
    """In the order of collection, and not the file with most tests first."""
    config.option.loadscopereorder = False
    return Scheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes longest.

    Raises
    ------
    FileNotFoundError
        A file of that list is no more.
    """
    first = LONG + APART
    for file in first:
        (ROOT / file).stat()
    place = {file: number for number, file in enumerate(first)}
    items.sort(key=lambda item: place.get(item.nodeid.partition("::")[0], len(first)))


def pytest_collection_finish() -> None:
    """Let Python's garbage collection pass over what was loaded for the tests: a fifth of the time of a figure."""
    spare_collector()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Hand on what a test has logged as text that can be sent: hostile tests log lone surrogates."""
    report = yield
    report.sections = [(name, text.encode("utf-8", "replace").decode()) for name, text in report.sections]
    return report
