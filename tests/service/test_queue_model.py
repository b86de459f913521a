"""The state machine of :mod:`tests.service.queue_model` on both databases: five hundred steps on each, or 100,000."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.service.queue_model import check

EXAMPLES, LEAST = 30, 500


def test_the_queue_holds_its_promises_on_sqlite(migrated_sqlite: Path, tmp_path: Path) -> None:
    file = shutil.copy(migrated_sqlite, tmp_path / "model.sqlite")
    assert check(f"sqlite:///{file}", EXAMPLES) >= LEAST


@pytest.mark.postgres
def test_the_queue_holds_its_promises_on_postgresql(migrated_postgres: str) -> None:
    assert check(migrated_postgres, EXAMPLES) >= LEAST


@pytest.mark.long
@pytest.mark.timeout(4 * 3600)
def test_the_queue_holds_its_promises_for_a_hundred_thousand_steps(url: str) -> None:
    done = 0
    while done < 100_000:
        done += check(url, 50, steps=100)
