"""The client and the commands built on it, before a real service with results of a synthetic task."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from astropy import units
from typer.testing import CliRunner

from service.cli.app import app
from service.client import AnswerError, ApiError, Client, RequestError
from service.domain.views import GridView
from tests.service.service_process import ROOT, Serving, serving

BODY = {
    "name": "two systems", "systems": ["HE0435", "RXJ1131"], "n": [2, 4], "r_eff": [0.39], "magnitude": [20.5, 21.5],
    "l_eta": [1.0], "replicates": 3,
}  # fmt: skip
N_RUNS = 24
GRID = "g_06h05zns0sxqesvz1qxk4a1s56"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with serving(tmp_path_factory.mktemp("service"), HOSTLENS_DRILL_SLEEP="0") as found:
        yield found


@pytest.fixture(scope="module")
def client(service: Serving) -> Iterator[Client]:
    with Client(f"http://127.0.0.1:{service.port}") as found:
        yield found


@pytest.fixture(scope="module")
def grid(client: Client) -> GridView:
    """Two systems, two indices, two magnitudes, three seeds: all stored."""
    submitted = client.submit(BODY)
    ended = client.wait(submitted.id, timeout_s=300)
    assert ended.counts.done == ended.n_runs == N_RUNS
    return ended


def hostlens(client: Client, *arguments: str, code: int = 0) -> str:
    """What a command writes to standard output."""
    said = CliRunner().invoke(app, list(arguments), env={"HOSTLENS_URL": client.url, "COLUMNS": "80"})
    assert said.exit_code == code, said.output
    return said.stdout


class TestAnswers:
    def test_a_summary_is_that_of_the_rows_it_is_made_from(self, client: Client, grid: GridView) -> None:
        found = client.summary(grid.id, group_by=["system", "n"])
        rows = list(client.results(grid.id))
        assert len(rows) == N_RUNS
        assert [tuple(row.group.values()) for row in found.rows] == [
            (system, n) for system in ("HE0435", "RXJ1131") for n in (2.0, 4.0)
        ]
        for group in found.rows:
            biases = [row["magnitude_bias"] for row in rows if (row["system"], row["n"]) == tuple(group.group.values())]
            assert group.bias is not None
            assert (group.stored, group.bias.runs, group.bias.inputs) == (6, 6, 2)
            # Six significant digits.
            assert group.bias.mean == pytest.approx(np.mean(biases), rel=1e-5, abs=1e-9)
        assert found.question.recommended

    def test_filters_and_the_other_questions_are_passed_on(self, client: Client, grid: GridView) -> None:
        assert {row["n"] for row in client.results(grid.id, n=4)} == {4.0}
        assert {row["system"] for row in client.results(system=["HE0435", "none-such"], grid=grid.id)} == {"HE0435"}
        assert {row["magnitude"] for row in client.results(grid.id, magnitude="21..")} == {21.5}
        found = client.summary(grid.id, group_by="n", quantity="r_eff", estimator="paper", index_prior="free")
        assert (found.question.unit, found.question.recommended) == ("arcsec", False)
        assert [row.group for row in client.summary(grid.id, group_by="").rows] == [{}]
        assert client.trends(grid.id, against="arc_magnitude", bins=3).series[0].bins[0].bias.runs == N_RUNS
        pairs = client.comparison(grid.id, compare="estimator", left="image", right="projected", group_by="system")
        assert [row.pairs for row in pairs.rows] == [N_RUNS // 2] * 2
        assert next(iter(client.results(grid.id, estimator="all"))).keys() >= {"image_wide_n_mean", "paper_free_n_mean"}

    def test_pages_are_followed_to_the_last(
        self, client: Client, grid: GridView, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        whole = list(client.results(grid.id)), client.summary(grid.id, group_by="system,n,magnitude").rows
        monkeypatch.setattr("service.client._PAGE", 5)
        assert (list(client.results(grid.id)), client.summary(grid.id, group_by="system,n,magnitude").rows) == whole
        assert len(list(client.runs(grid.id))) == N_RUNS
        assert len(client.table(grid.id)) == N_RUNS

    def test_a_table_has_units_and_the_same_numbers(self, client: Client, grid: GridView) -> None:
        table = client.table(grid.id)
        rows = {row["run_id"]: row for row in client.results(grid.id)}
        assert (table["magnitude_bias"].unit, table["r_eff_mean"].unit) == (units.mag, units.arcsec)
        assert table["surface_brightness"].unit == units.mag / units.arcsec**2
        assert (table["r_eff_mean"].to_value("mas") > 100).all()
        for name in ("magnitude_mean", "n_sd", "chi2"):
            expected = [rows[run][name] for run in table["run_id"]]
            assert list(getattr(table[name], "value", table[name])) == expected
        assert table["magnitude_bias"].info.description
        assert table["stored_at"].min().datetime.year >= 2026
        # Nothing in it is of the paper's 48, and nobody is told that it were.
        assert table["paper_run"].mask.all()

    def test_a_table_of_nothing_has_the_columns(self, client: Client, grid: GridView) -> None:
        empty, full = client.table(grid.id, system="none-such"), client.table(grid.id)
        assert (len(empty), empty.colnames, empty["r_eff"].unit) == (0, full.colnames, units.arcsec)
        assert len(client.to_pandas(grid.id, system="none-such")) == 0

    def test_a_frame_has_the_same_numbers_and_its_units_beside(self, client: Client, grid: GridView) -> None:
        frame = client.to_pandas(grid.id)
        table = client.table(grid.id)
        assert list(frame.columns) == table.colnames
        assert (frame["magnitude_bias"].to_numpy() == table["magnitude_bias"].value).all()
        assert frame.attrs["units"]["r_eff_mean"] == "arcsec"
        assert str(frame["stored_at"].dtype).endswith("UTC]")
        assert frame["paper_run"].isna().all()

    def test_a_run_has_a_picture(self, client: Client, grid: GridView) -> None:
        run = next(client.runs(grid.id, state="done"))
        assert client.run_figure(run.id).startswith(b"\x89PNG")
        with pytest.raises(ApiError) as refused:
            client.run_figure(f"{run.id[:-7]}9999999")
        assert refused.value.status == 404


class TestGrids:
    def test_fields_may_be_keywords_and_a_dry_run_stores_nothing(self, client: Client, grid: GridView) -> None:
        newest = client.grids(limit=1).items[0].id
        assert client.dry_run(BODY, replicates=2).n_runs == 16
        assert client.grids(limit=1).items[0].id == newest
        again = client.submit(preset="h0licow-vi/HE0435", n=[2], magnitude=[20.5], key="the-same")
        same = client.submit(preset="h0licow-vi/HE0435", n=[2], magnitude=[20.5], key="the-same")
        assert again.id == same.id
        client.wait(again.id, timeout_s=300)

    def test_several_grids_are_waited_for_and_given_back_in_order(self, client: Client) -> None:
        ids = [client.submit(BODY, replicates=1, seed=seed).id for seed in (10, 11)]
        seen: list[str] = []
        ended = client.wait_all(ids, lambda found: seen.append(found.id), every_s=0.05, timeout_s=300)
        assert [found.id for found in ended] == ids
        assert all(found.finished_at for found in ended)
        assert set(seen) == set(ids)
        with pytest.raises(ApiError):
            client.wait(GRID, timeout_s=1)

    def test_some_of_what_was_cancelled_is_tried_again(self, client: Client) -> None:
        paused = client.submit(BODY, replicates=20, seed=100)
        client.pause(paused.id)
        client.cancel(paused.id)
        before = client.wait(paused.id, timeout_s=300).counts.cancelled
        assert before
        wanted = sum(run.inputs["system"] == "HE0435" for run in client.runs(paused.id, state="cancelled"))
        assert client.retry(paused.id, system="HE0435").retried == wanted
        left = client.wait(paused.id, timeout_s=300).counts
        assert left.cancelled == before - wanted
        said = hostlens(client, "retry", paused.id, "--where", "n=4", "--where", "system=RXJ1131")
        assert "queued again" in said
        client.wait(paused.id, timeout_s=300)
        assert hostlens(client, "retry", paused.id, "--failed").startswith("0 runs queued again\n")
        assert "n: got 'four'" in refused(client, "retry", paused.id, "--where", "n=four")

    def test_a_refusal_of_each_method_is_an_api_error(self, client: Client) -> None:
        asked = (
            client.status, client.cancel, client.pause, client.resume, client.retry, client.grid_summary,
            client.events, lambda one: list(client.runs(one)), client.run, client.run_figure, client.products,
            client.record, client.figure,
        )  # fmt: skip
        for ask in asked:
            for odd in (GRID, "../../healthz", "a/b?c#d", "", "\x00", "é", "x" * 3000):
                with pytest.raises(ApiError) as refusal:
                    ask(odd)
                assert 400 <= refusal.value.status < 500
        for wrong in ({"system": [""]}, {"color": "red"}, {"estimator": "best"}, {"n": "two"}):
            with pytest.raises(ApiError):
                client.summary(**wrong)
            with pytest.raises(ApiError):
                list(client.results(**wrong))


def refused(client: Client, *arguments: str, code: int = 1) -> str:
    said = CliRunner().invoke(app, list(arguments), env={"HOSTLENS_URL": client.url})
    assert (said.exit_code, said.stdout) == (code, "")
    return said.stderr


class TestCommands:
    def test_results_are_a_table_of_eighty_columns(self, client: Client, grid: GridView) -> None:
        table = hostlens(client, "results", grid.id, "--group-by", "system,n,r_eff,magnitude,l_eta")
        assert max(map(len, table.splitlines())) <= 80
        assert "recommended" in table
        assert sum("HE0435" in line for line in table.splitlines()) == 4
        first = client.summary(grid.id, group_by="system").rows[0].bias
        assert first is not None
        assert f"{first.mean:+.3f} +- {first.standard_error:.3f}" in hostlens(
            client, "results", grid.id, "--group-by", "system"
        )

    def test_results_are_csv_and_json_for_programs(self, client: Client, grid: GridView) -> None:
        asked = ("results", grid.id, "--group-by", "system", "--where", "n=2", "--quantity", "r_eff")
        asked = (*asked, "--estimator", "paper", "--index-prior", "free")
        (one, other) = csv.DictReader(io.StringIO(hostlens(client, *asked, "--format", "csv")))
        found = json.loads(hostlens(client, *asked, "--format", "json"))
        assert found["question"]["filter"] == {"grid": [grid.id], "n": ["2"]}
        for row, told in zip((one, other), found["rows"], strict=True):
            assert row["system"] == told["group"]["system"]
            assert float(row["mean"]) == told["bias"]["mean"]
            assert float(row["coverage_68_low"]) == told["bias"]["coverage"]["68"]["low"]
            assert (row["quantity"], row["unit"], row["estimator"]) == ("r_eff", "arcsec", "paper")
        nothing = hostlens(client, "results", "--where", "system=none-such", "--format", "csv")
        assert nothing.strip() == ""

    def test_every_field_of_a_request_has_an_option(self, client: Client, tmp_path: Path) -> None:
        options = (
            "--system", str(ROOT / "docs/examples/my_system.toml"), "--n", "2", "--r-eff", "0.35", "--magnitude", "21",
            "--l-eta", "1", "--seed", "7", "--replicates", "2", "--camera", "WFC3-IR_F160W",
            "--mass-model", "recommended", "--noise-level", "handbook", "--defocus-nm", "3", "--jitter", "0.004",
            "--profile", "draft", "--estimator", "image", "--estimator", "paper", "--analysis", "draws=12",
            "--analysis", "regularisation=gradient", "--name", "all of them", "--key", "every-option",
        )  # fmt: skip
        assert hostlens(client, "submit", *options, "--dry-run").startswith("2 runs\nmy-quad")
        grid_id = hostlens(client, "submit", *options).strip()
        request = client.status(grid_id).request
        assert request.pop("systems")[0]["name"] == "my-quad"
        assert request == {
            "n": [2.0], "r_eff": [0.35], "magnitude": [21.0], "l_eta": [1.0], "seed": 7, "replicates": 2,
            "camera": "WFC3-IR_F160W", "mass_model": "recommended", "noise_level": "handbook",
            "optics": {"defocus_nm": 3.0, "jitter": 0.004}, "name": "all of them",
            "analysis": {"profile": "draft", "estimators": ["paper", "image"], "draws": 12,
                         "regularisation": "gradient"},
        }  # fmt: skip
        schema = client_schema(client)
        # What goes with none of these has tests of its own: test_until, test_hosts.
        others = {"until": "--until", "hosts": "--host", "deflectors": "--deflector"}
        assert set(request) | {"systems", "preset", *others} == set(schema["GridRequest"]["properties"])
        assert set(others.values()) <= set(hostlens(client, "submit", "--help").split())
        assert "(all of them)" in hostlens(client, "status", grid_id, "--wait")

    def test_options_override_a_file(self, client: Client, tmp_path: Path) -> None:
        file = tmp_path / "body.toml"
        file.write_text('preset = "h0licow-vi/HE0435"\nn = [2]\n[analysis]\nprofile = "draft"\ndraws = 9\n')
        grid_id = hostlens(client, "submit", "--file", str(file), "--n", "4", "--profile", "standard").strip()
        request = client.status(grid_id).request
        assert request["n"] == [4.0]
        assert request["analysis"] == {"profile": "standard", "draws": 9}
        client.cancel(grid_id)


def client_schema(client: Client) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = httpx.get(f"{client.url}/openapi.json").json()["components"]["schemas"]
    return found


class Refusing(httpx.BaseTransport):
    """Connections that fail for so many times, and then reach a service that refuses everything."""

    def __init__(self, failures: int) -> None:
        self.failures, self.asked = failures, 0

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        self.asked += 1
        if self.asked <= self.failures:
            raise httpx.ConnectError("refused")
        return httpx.Response(503, json={"detail": "away"}, headers={"content-type": "application/problem+json"})


class TestConnections:
    def test_only_what_may_be_done_twice_is_repeated(self) -> None:
        for ask in (
            lambda client: client.grids(),
            lambda client: client.cancel(GRID),
            lambda client: client.submit(BODY, key="k"),
        ):
            transport = Refusing(2)
            with Client("http://h", transport, retries=2) as client, pytest.raises(ApiError, match="away"):
                ask(client)
            assert transport.asked == 3
            with Client("http://h", Refusing(9), retries=1) as client, pytest.raises(httpx.ConnectError):
                ask(client)
        for ask in (lambda client: client.submit(BODY), lambda client: client.retry(GRID)):
            transport = Refusing(1)
            with Client("http://h", transport) as client, pytest.raises(httpx.ConnectError):
                ask(client)
            assert transport.asked == 1

    def test_a_token_is_sent_and_never_told(self) -> None:
        sent: list[str | None] = []

        def answer(request: httpx.Request) -> httpx.Response:
            sent.append(request.headers.get("authorization"))
            return httpx.Response(200, json={})

        for token, expected in (("secret", "Bearer secret"), (None, None)):
            with Client("http://h", httpx.MockTransport(answer), token=token) as client:
                with pytest.raises(AnswerError):
                    client.grids()
                assert "secret" not in repr(client)
            assert sent.pop() == expected
        with pytest.raises(RequestError) as refusal:
            Client("http://h", token="sécret")  # noqa: S106
        assert "cret" not in str(refusal.value)

    def test_what_cannot_be_sent_is_told_before_it_is(self) -> None:
        with Client("http://h", Refusing(0)) as client:
            for wrong in ({"n": [float("nan")]}, {"name": "\udcff"}, {"n": {1}}, {"n": np.float32}):
                with pytest.raises(RequestError):
                    client.submit(wrong)
            with pytest.raises(RequestError, match="twice"):
                client.summary(GRID, grid=GRID)
            for odd in ("\udcff",):
                with pytest.raises(RequestError):
                    client.status(odd)
                with pytest.raises(RequestError):
                    client.summary(system=odd)

    def test_the_client_needs_neither_astropy_nor_pandas_nor_the_engine(self) -> None:
        code = (
            "import sys, service.client; "
            "sys.exit(any(name in sys.modules for name in ('engine', 'numpy', 'astropy', 'pandas', 'sqlalchemy')))"
        )
        assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_an_error_names_the_place_once() -> None:
    for pointer, message, told in (
        ("/n", "n: got 3.0, allowed is 2", "n: got 3.0, allowed is 2"),
        ("/systems/0/agn", "systems[0].agn: got 1", "systems[0].agn: got 1"),
        ("group_by", "group_by: got 'seed'", "group_by: got 'seed'"),
        ("/n", "no number", "/n: no number"),
        ("/image", "not a FITS file; allowed is: one", "/image: not a FITS file; allowed is: one"),
    ):
        assert str(ApiError(422, {"errors": [{"pointer": pointer, "message": message}]})) == told
