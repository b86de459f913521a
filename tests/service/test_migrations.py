"""One tree of migrations makes the tables of the code, on both databases, up and down and up again."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import inspect

from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.migrate import differences, downgrade, upgrade
from service.store.queue import RunQueue, Stored
from service.store.tables import metadata
from tests.service.conftest import new_database
from tests.service.plans import result_of, submit


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def empty_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'new.sqlite'}"
    return new_database(request.getfixturevalue("postgres_server"), f"new_{tmp_path.name}")


def test_migrated_databases_are_what_the_code_expects(empty_url: str) -> None:
    assert differences(empty_url) is not None
    upgrade(empty_url)
    assert differences(empty_url) is None
    upgrade(empty_url)
    database = Database(empty_url)
    grids = GridStore(database)
    grid_id = submit(grids, 2)
    upgrade(empty_url)
    assert grids.grid(grid_id).n_runs == 2
    # Down one revision and up again with runs that other tables refer to, one of them paused.
    generation = Leadership(database).take("test")
    assert generation == 1
    queue = RunQueue(database)
    (lease,) = queue.claim(generation, 1)
    assert queue.store(lease, result_of(lease)) is Stored.STORED
    grids.pause(grid_id)
    database.close()
    downgrade(empty_url, "0001")
    upgrade(empty_url)
    assert differences(empty_url) is None
    again = grids.grid(grid_id)
    assert (again.counts.done, again.counts.queued, again.state) == (1, 1, "running")
    assert grids.run(lease.run_id).result is not None
    downgrade(empty_url, "base")
    assert set(inspect(database.engine).get_table_names()) <= {"alembic_version"}
    upgrade(empty_url)
    assert differences(empty_url) is None
    database.close()


def test_every_constraint_has_a_name_that_postgresql_keeps() -> None:
    for table in metadata.sorted_tables:
        for constraint in table.constraints:
            assert constraint.name, table.name
            assert len(str(constraint.name)) < 64


def test_no_column_is_named_like_an_attribute_of_a_row() -> None:
    for table in metadata.sorted_tables:
        assert not {"t", "count", "index"} & set(table.columns.keys())
