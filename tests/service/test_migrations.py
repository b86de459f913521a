"""One tree of migrations makes the tables of the code, on both databases, from every revision, and keeps the rows."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, inspect, make_url, select, text
from typer.testing import CliRunner

from service.cli.app import app
from service.domain.views import Summary
from service.store.database import Database
from service.store.faults import MigrationError
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.migrate import (
    current,
    differences,
    downgrade,
    migrations_folder,
    revisions,
    upgrade,
)
from service.store.queue import RunQueue, Stored
from service.store.sums import input_digest
from service.store.tables import (
    GROUP_COLUMNS,
    KEY_COLUMNS,
    estimate,
    grid_moments,
    input_group,
    input_moments,
    metadata,
    result,
)
from tests.service import history
from tests.service.conftest import new_database
from tests.service.plans import result_of, submit, submit_until, until
from tests.service.service_process import ROOT

REVISIONS = revisions()
HEAD = REVISIONS[-1]
OFTEN = frozenset({REVISIONS[0], "0003", "0007", *REVISIONS[-3:-1]})
"""Revisions whose rows ``make test`` migrates: the first, those before results were taken apart, and the newest ones.

From each there, back and there again takes a time that grows with the square of their number, and steps that have been
released do not change: the others are for ``make check-long``.
"""


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


class Empties:
    """Databases of one kind without rows, as many as a test wants."""

    def __init__(self, folder: Path, server: str | None) -> None:
        self._folder, self._server = folder, server
        self._made = 0
        self._migrated: dict[str, str] = {}

    def __call__(self, like: str = "template1") -> str:
        self._made += 1
        if self._server is not None:
            return new_database(self._server, f"migrations_{self._folder.name}_{self._made}", like)
        file = self._folder / f"{self._made}.sqlite"
        file.touch()
        return f"sqlite:///{file}"

    def at(self, revision: str) -> str:
        """One that has been brought to a revision: what that takes is done once for each, from the one before."""
        if revision not in self._migrated:
            place = REVISIONS.index(revision)
            url = self.at(REVISIONS[place - 1]) if place else self()
            upgrade(url, revision)
            self._migrated[revision] = url
        return self._copy(self._migrated[revision])

    def _copy(self, template: str) -> str:
        if self._server is not None:
            return self(like=str(make_url(template).database))
        url = self()
        shutil.copy(template.removeprefix("sqlite:///"), url.removeprefix("sqlite:///"))
        return url


@pytest.fixture(scope="module")
def empties(backend: str, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Empties:
    server = request.getfixturevalue("postgres_server") if backend == "postgresql" else None
    return Empties(tmp_path_factory.mktemp("migrations"), server)


@pytest.fixture(scope="module")
def lived(empties: Empties) -> history.Rows:
    """What a service of today leaves in its database."""
    database = Database(empties.at(HEAD), pooled=False)
    history.live(database)
    with database.read() as connection:
        rows = history.typed(connection)
    database.close()
    return rows


def test_the_tree_is_one_line() -> None:
    assert len(REVISIONS) == len(set(REVISIONS)) >= 1


@pytest.mark.parametrize(
    "revision", [one if one in OFTEN else pytest.param(one, marks=pytest.mark.long) for one in REVISIONS]
)
def test_rows_of_every_revision_outlive_the_upgrade_the_downgrade_and_the_next_upgrade(
    revision: str, empties: Empties, lived: history.Rows
) -> None:
    url = empties.at(revision)
    assert current(url) == revision
    database, before = _filled(url, lived)
    upgrade(url)
    assert differences(url) is None
    _assert_kept(database, before)
    _assert_readable(database, lived)
    _assert_working(database)
    with database.read() as connection:
        newest = history.read(connection)
    downgrade(url, revision)
    _assert_kept(database, {name: rows for name, rows in newest.items() if name in before})
    upgrade(url)
    assert differences(url) is None
    _assert_kept(database, {name: rows for name, rows in newest.items() if name in before}, before)
    database.close()


def _filled(url: str, lived: history.Rows) -> tuple[Database, history.Rows]:
    """A database with rows in each of its tables, whatever its revision, and those rows."""
    database = Database(url, pooled=False)
    with database.write() as connection:
        history.write(connection, lived)
        before = history.read(connection)
    assert all(before.values()), f"a table without rows: {before.keys()}"
    return database, before


def _assert_kept(database: Database, before: history.Rows, columns_of: history.Rows | None = None) -> None:
    """Each row is there, the same in every column that both revisions have."""
    with database.read() as connection:
        after = history.read(connection)
    for name, rows in before.items():
        if name not in after:
            continue
        shared = set(rows[0]) & set(after[name][0]) & set((columns_of or before)[name][0])
        assert shared, name
        assert _cut(after[name], shared) == _cut(rows, shared), name


def _cut(rows: list[dict[str, Any]], columns: set[str]) -> list[dict[str, Any]]:
    return history.in_order([{column: row[column] for column in columns} for row in rows])


def _assert_readable(database: Database, lived: history.Rows) -> None:
    grids = GridStore(database)
    found = grids.grids(100).items
    assert {grid.id for grid in found} == {row["id"] for row in lived["grid"]}
    assert sorted(grid.state for grid in found) == ["cancelled", "done", "failed", "queued", "running"]
    stored = 0
    for grid in found:
        for run in grids.runs(grid.id, 100).items:
            detail = grids.run(run.id)
            stored += detail.result is not None
            assert (detail.result is not None) == (detail.state == "done")
        assert Summary.model_validate(GridStore(database).summary(grid.id, 100)).n_runs == grid.n_runs
    assert stored == len(lived["result"]) == 3


def _assert_working(database: Database) -> None:
    """The queue goes on where it stood: the one leased run comes back to it, and can be stored."""
    generation = Leadership(database).take("there|2|2.00", lambda _: True)
    assert generation == 2
    queue = RunQueue(database)
    leases = queue.claim(generation, 100)
    assert leases
    assert queue.store(leases[0], result_of(leases[0])) is Stored.STORED
    queue.hand_back(leases[1:])


def test_migrated_tables_are_the_code_s_to_the_last_constraint(empties: Empties) -> None:
    # alembic check compares neither check constraints nor the conditions of partial indices.
    migrated, created = empties.at(HEAD), empties()
    assert differences(created) is not None
    assert differences(migrated) is None
    database = Database(created, pooled=False)
    with database.write() as connection:
        metadata.create_all(connection)
        wanted = _described(connection)
    with Database(migrated, pooled=False).read() as connection:
        found = _described(connection)
    for table, description in wanted.items():
        assert found[table] == description
    assert set(found) == set(wanted)


def _described(connection: Connection) -> dict[str, Any]:
    look = inspect(connection)
    return {
        table: {
            "columns": {
                column["name"]: (str(column["type"]), column["nullable"], column["default"])
                for column in look.get_columns(table)
            },
            "primary key": look.get_pk_constraint(table),
            "unique": sorted(look.get_unique_constraints(table), key=str),
            "checks": sorted(look.get_check_constraints(table), key=str),
            "foreign keys": sorted(look.get_foreign_keys(table), key=str),
            "indices": sorted(
                (index["name"], index["column_names"], bool(index["unique"]), _conditions(index))
                for index in look.get_indexes(table)
            ),
        }
        for table in look.get_table_names()
        if table != "alembic_version"
    }


def _conditions(index: Any) -> str:
    return str({name: str(value) for name, value in index.get("dialect_options", {}).items()})


@pytest.mark.postgres
def test_postgresql_looks_only_at_columns_that_rows_are_looked_for_by(migrated_postgres: str) -> None:
    """A column that a migration adds to these tables needs its statistics turned off: see revision 0008."""
    for table in (result, estimate, input_moments, grid_moments):
        kept = (
            "select attname from pg_attribute where attrelid = cast(:table as regclass) and attnum > 0 "
            "and not attisdropped and coalesce(attstattarget, -1) <> 0"
        )
        with Database(migrated_postgres, pooled=False).read() as connection:
            found = set(connection.scalars(text(kept), {"table": table.name}))
        keys = {"run_id", "grid_id", "input_id", "estimator", "index_prior", "observation_digest"}
        assert found == {*keys, *GROUP_COLUMNS} & set(table.c.keys())


def test_base_leaves_no_table_and_can_be_upgraded_again(empties: Empties) -> None:
    url = empties.at(HEAD)
    upgrade(url)
    downgrade(url, "base")
    database = Database(url, pooled=False)
    assert set(inspect(database.engine).get_table_names()) <= {"alembic_version"}
    database.close()
    assert current(url) is None
    upgrade(url)
    assert differences(url) is None


def test_paused_runs_wait_in_the_queue_of_a_code_that_knows_no_pause(empties: Empties) -> None:
    url = empties.at(HEAD)
    database = Database(url, pooled=False)
    grids, queue = GridStore(database), RunQueue(database)
    grid_id = submit(grids, 2)
    generation = Leadership(database).take("test")
    assert generation == 1
    (lease,) = queue.claim(generation, 1)
    assert queue.store(lease, result_of(lease)) is Stored.STORED
    grids.pause(grid_id)
    downgrade(url, "0001")
    upgrade(url)
    again = grids.grid(grid_id)
    assert (again.counts.done, again.counts.queued, again.state) == (1, 1, "running")


def test_what_is_not_needed_is_cancelled_to_a_code_that_knows_no_such_state(empties: Empties) -> None:
    url = empties.at(HEAD)
    database = Database(url, pooled=False)
    grids, queue = GridStore(database), RunQueue(database)
    grid_id = submit_until(grids, 1, until(1.0, at_most=5))
    generation = Leadership(database).take("test")
    assert generation == 1
    queue.store_all([(lease, result_of(lease)) for lease in queue.claim(generation, 3)])
    assert (grids.grid(grid_id).counts.not_needed, grids.grid(grid_id).state) == (2, "done")
    downgrade(url, "0011")
    upgrade(url)
    again = grids.grid(grid_id)
    assert (again.counts.done, again.counts.cancelled, again.state, again.until) == (3, 2, "cancelled", None)


def test_what_older_results_did_not_hold_is_null_after_the_upgrade(empties: Empties, lived: history.Rows) -> None:
    url = empties.at("0003")
    database = Database(url, pooled=False)
    with database.write() as connection:
        history.write(connection, lived)
    upgrade(url)
    grids = GridStore(database)
    details = [grids.run(row["run_id"]).result for row in lived["result"]]
    for found in details:
        assert found is not None
        present = {name for name, estimate in found.estimates.items() if estimate is not None}
        assert present == {"paper_free", "paper_fixed", "projected_free", "projected_fixed"}
        old = found.estimates["paper_free"]
        assert old is not None
        assert (old.r_eff_galfit, old.x, old.y, old.n_at_bound, old.r_eff_at_bound) == (None,) * 5
        assert (found.aperture, found.chain.r_hat, found.profile) == (None, None, None)
        assert found.regularisation == "curvature"


def test_results_of_spoilt_optics_say_so_after_the_upgrade(empties: Empties, lived: history.Rows) -> None:
    url = empties.at("0013")
    database, before = _filled(url, lived)
    grid_id = before["input"][0]["grid_id"]
    request = next(row["request"] for row in lived["grid"] if row["id"] == grid_id)
    spoilt = json.dumps({**request, "optics": {"defocus_nm": 20, "jitter": 0.004}})
    with database.write() as connection:
        asked = text("update grid set request = :request where id = :id")
        connection.execute(asked, {"request": spoilt, "id": grid_id})
    upgrade(url)
    with database.read() as connection:
        groups = connection.execute(input_group.select()).mappings().all()
        runs = metadata.tables["run"]
        found = connection.execute(select(runs.c.grid_id, result).join_from(result, runs)).mappings().all()
    database.close()
    assert found
    for row in (*groups, *found):
        wanted = (20.0, 0.004) if row["grid_id"] == grid_id else (0.0, 0.0)
        assert (row["defocus_nm"], row["jitter"], row["coarse"]) == (*wanted, 1.0)
    for row in groups:
        # What is stored from now on of the same input finds its row.
        assert row["digest"] == input_digest(row[name] for name in KEY_COLUMNS)


def test_results_that_an_older_revision_cannot_hold_stop_the_downgrade(empties: Empties) -> None:
    url = empties.at(HEAD)
    database = Database(url, pooled=False)
    grids, queue = GridStore(database), RunQueue(database)
    submit(grids, 1)
    generation = Leadership(database).take("test")
    assert generation == 1
    (lease,) = queue.claim(generation, 1)
    payload = result_of(lease)
    lacking = payload.model_copy(update={"estimates": {**payload.estimates, "paper_fixed": None}, "aperture": None})
    assert queue.store(lease, lacking) is Stored.STORED
    shown = grids.run(lease.run_id).result
    assert shown is not None
    assert shown.estimates["paper_fixed"] is None
    assert shown.aperture is None
    assert shown.estimates["image_wide"] is not None
    with pytest.raises(MigrationError, match="1 results lack an estimate"):
        downgrade(url, "0003")
    assert current(url) == HEAD
    assert grids.run(lease.run_id).result == shown


def test_processes_that_upgrade_at_once_take_turns(empties: Empties) -> None:
    url = empties()
    command = [sys.executable, "-c", f"from service.store.migrate import upgrade; upgrade({url!r})"]
    started = [subprocess.Popen(command, cwd=ROOT) for _ in range(3)]
    assert [process.wait(timeout=120) for process in started] == [0, 0, 0]
    assert differences(url) is None


NEXT = """
import sqlalchemy as sa
from alembic import op

revision, down_revision, branch_labels, depends_on = "next", "{head}", None, None


def upgrade():
    with op.batch_alter_table("run") as table:
        table.add_column(sa.Column("colour", sa.String(16), nullable=False, server_default="red"))
    {more}


def downgrade():
    with op.batch_alter_table("run") as table:
        table.drop_column("colour")
"""


def _with_next(folder: Path, more: str = "") -> Path:
    shutil.copytree(migrations_folder(), folder)
    text = NEXT.format(head=HEAD, more=more)
    (folder / "versions" / "next.py").write_text(text, encoding="utf-8")
    return folder


def test_a_table_that_others_refer_to_can_be_copied_without_losing_their_rows(
    empties: Empties, lived: history.Rows, tmp_path: Path
) -> None:
    url = empties.at(HEAD)
    database = Database(url, pooled=False)
    with database.write() as connection:
        history.write(connection, lived)
        before = history.read(connection)
    folder = _with_next(tmp_path / "tree")
    upgrade(url, folder=folder)
    _assert_kept(database, before)
    downgrade(url, HEAD, folder)
    with database.read() as connection:
        assert history.read(connection) == before
    assert differences(url) is None


def test_a_migration_that_leaves_rows_without_their_run_changes_nothing(
    empties: Empties, backend: str, lived: history.Rows, tmp_path: Path
) -> None:
    url = empties.at(HEAD)
    database = Database(url, pooled=False)
    with database.write() as connection:
        history.write(connection, lived)
        before = history.read(connection)
    folder = _with_next(tmp_path / "tree", """op.execute("delete from run where state = 'done'")""")
    with pytest.raises(Exception, match=r"refer to nothing|violates foreign key"):
        upgrade(url, folder=folder)
    with database.read() as connection:
        assert history.read(connection) == before
    assert current(url) == HEAD


def test_a_database_of_a_newer_hostlens_is_refused(empties: Empties, tmp_path: Path) -> None:
    url = empties()
    upgrade(url, folder=_with_next(tmp_path / "tree"))
    assert current(url) == "next"
    with pytest.raises(MigrationError, match="next"):
        upgrade(url)


def test_the_command_line_migrates(empties: Empties, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOSTLENS_DATABASE_URL", empties())
    monkeypatch.setenv("HOSTLENS_DATA_DIR", str(tmp_path / "data"))
    run = CliRunner()
    assert run.invoke(app, ["db", "current"]).output == f"database base, code {HEAD}\n"
    assert run.invoke(app, ["db", "check"]).exit_code == 1
    assert run.invoke(app, ["db", "upgrade"]).output == f"the database is at revision {HEAD}\n"
    assert run.invoke(app, ["db", "current"]).output == f"database {HEAD}, code {HEAD}\n"
    assert run.invoke(app, ["db", "check"]).exit_code == 0
    assert run.invoke(app, ["db", "downgrade", "base"], input="n\n").exit_code == 1
    assert run.invoke(app, ["db", "check"]).exit_code == 0
    assert run.invoke(app, ["db", "downgrade", "base", "--yes"]).exit_code == 0
    assert run.invoke(app, ["db", "current"]).output == f"database base, code {HEAD}\n"
    refused = run.invoke(app, ["db", "upgrade", "9999"])
    assert refused.exit_code == 2
    assert "9999" in refused.output


def test_every_constraint_has_a_name_that_postgresql_keeps() -> None:
    for table in metadata.sorted_tables:
        for constraint in table.constraints:
            assert constraint.name, table.name
            assert len(str(constraint.name)) < 64


def test_no_column_is_named_like_an_attribute_of_a_row() -> None:
    for table in metadata.sorted_tables:
        assert not {"t", "count", "index"} & set(table.columns.keys())
