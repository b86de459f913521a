"""The drills, small: each claim is made of real processes and real signals, and each must hold."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

from service.store.database import Database
from service.store.grids import GridStore
from tests.drills import postgres
from tests.drills.__main__ import DRILLS, app
from tests.drills.drill import THROW_AWAY, Drill, Ground, OccupiedError, ground
from tests.drills.kills import DispatcherKills
from tests.drills.outages import DiskFull, PostgresKills, SqliteLock
from tests.drills.report import Report, quantile
from tests.drills.rivals import StoppedWorker, TwoDispatchers
from tests.drills.stores import StoreAway
from tests.drills.volume import Listing, Submission
from tests.service.plans import submit

OF_ONE_DATABASE = {"sqlite-lock", "disk-full", "postgres"}


def unmet(report: Report) -> list[str]:
    return [claim.text for claim in report.claims if not claim.holds]


def nobody_left(folder: Path) -> bool:
    return not [process for process in psutil.process_iter() if _is_at(process, folder)]


def _is_at(process: psutil.Process, folder: Path) -> bool:
    try:
        return str(folder) in process.environ().get("HOSTLENS_DATA_DIR", "")
    except psutil.Error:
        return False


@pytest.fixture(autouse=True)
def one_api_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each takes seconds to start."""
    monkeypatch.setenv("HOSTLENS_API_PROCESSES", "1")


@pytest.mark.parametrize(
    "drill",
    [
        DispatcherKills(runs=16, kills=1),
        pytest.param(PostgresKills(runs=24, every_s=1.5), marks=pytest.mark.postgres),
        # Long enough for a read on a busy machine to end before half of it has gone.
        SqliteLock(runs=8, lock_s=6.0),
        DiskFull(runs=8, full_s=1.5),
        StoreAway(runs=12, away_s=2.0),
        StoppedWorker(runs=6),
        TwoDispatchers(runs=20),
    ],
    ids=lambda drill: drill.name,
)
def test_what_the_drill_claims_holds_and_nobody_is_left(drill: Drill, tmp_path: Path) -> None:
    """Those that are not here have their small version elsewhere among the tests, or only measure."""
    report = drill.run(Ground(tmp_path))
    assert unmet(report) == []
    assert nobody_left(tmp_path)


@pytest.mark.long
@pytest.mark.timeout(4 * 3600)
@pytest.mark.parametrize(
    ("name", "database"),
    [
        *((name, None) for name in DRILLS),
        *(pytest.param(name, THROW_AWAY, marks=pytest.mark.postgres) for name in DRILLS if name not in OF_ONE_DATABASE),
    ],
)
def test_what_the_drill_claims_holds_at_its_full_size(
    name: str, database: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HOSTLENS_API_PROCESSES")
    with ground(database) as place:
        report = DRILLS[name]().run(place)
    print(report.to_json())
    assert unmet(report) == []


def test_drills_of_volume_measure_what_they_say(tmp_path: Path) -> None:
    """That the figures come out and nothing is lost; how fast it is depends on who else is at the machine."""
    assert "every run is queued" not in unmet(Submission(runs=500).run(Ground(tmp_path / "submission")))
    listing = Listing(large=480, copies=2, papers=1, requests=2).run(Ground(tmp_path / "listing"))
    assert listing.value("stored results") == 2 * 480 * 2 + 384 + 240 // 2
    assert nobody_left(tmp_path)


def test_the_command_shows_writes_and_ends_as_the_claims_say(tmp_path: Path) -> None:
    run = CliRunner()
    listed = run.invoke(app, ["list"])
    assert listed.exit_code == 0
    assert all(name in listed.output for name in DRILLS)
    file = tmp_path / "report.json"
    done = run.invoke(app, ["idempotency", "clients=20", "runs=20", "--json", str(file)])
    assert done.exit_code == 0, done.output
    document = json.loads(file.read_text())
    assert document["holds"]
    assert {figure["name"]: figure["value"] for figure in document["figures"]}["grids"] == 1
    for wrong in (["nonsense"], ["cancel", "days=3"], ["cancel", "runs=many"]):
        assert run.invoke(app, [*wrong]).exit_code == 2
    assert run.invoke(app, ["cancel", "fast"]).exit_code == 2


@pytest.mark.postgres
def test_a_drill_on_postgresql_brings_its_own_server_and_leaves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "report.json"
    # Whoever runs the server has to reach it, and the name of its socket has to be short.
    room = Path(tempfile.mkdtemp(prefix="hostlens-room-"))
    room.chmod(0o755)
    monkeypatch.setattr(tempfile, "tempdir", str(room))
    wanted = ["throughput", "runs=300", "--database", "postgresql", "--json", str(file)]
    CliRunner().invoke(app, wanted)
    document = json.loads(file.read_text())
    assert document["claims"][0] == {"text": "300 runs done, each stored once", "holds": True}
    assert document["conditions"].endswith("all processes on one core, PostgreSQL")
    # The server's work is counted: a run cannot be stored for nothing.
    spent = {figure["name"]: figure["value"] for figure in document["figures"]}
    assert spent["CPU a run, PostgreSQL"] > 0.05
    room.rmdir()  # which it would not be if anything were left there


def test_a_drill_says_what_postgresql_lacks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with monkeypatch.context() as without_driver:
        without_driver.setitem(sys.modules, "psycopg", None)
        for database in ("postgresql", "postgresql://nobody@/nothing"):
            said = CliRunner().invoke(app, ["idempotency", "--database", database])
            assert (said.exit_code, "extra postgres" in said.output) == (2, True), said.output
    monkeypatch.delenv("PG_BIN", raising=False)
    monkeypatch.setattr(postgres, "_DEBIAN", tmp_path)
    monkeypatch.setattr(postgres, "find_spec", lambda _: None)
    said = CliRunner().invoke(app, ["idempotency", "--database", "postgresql"])
    assert (said.exit_code, "set PG_BIN" in said.output) == (2, True), said.output


def test_a_drill_refuses_a_database_with_grids(sqlite_url: str) -> None:
    database = Database(sqlite_url)
    submit(GridStore(database), 1)
    database.close()
    with pytest.raises(OccupiedError, match="holds grids"), ground(sqlite_url):
        pass


def test_quantiles_are_of_the_nearest_rank() -> None:
    assert quantile([3.0, 1.0, 2.0], 0.5) == 2.0
    assert quantile([1.0, 2.0], 0.99) == 2.0
    with pytest.raises(ValueError, match="no values"):
        quantile([], 0.5)
