"""The smaller parts: payload, worker, endings, settings, artefacts, names of processes, the command line."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import KilledWorker
from fastapi.testclient import TestClient
from matplotlib.figure import Figure
from pydantic import ValidationError
from typer.testing import CliRunner

import engine.figures
from engine.result import (
    INDEX_PRIORS,
    Aperture,
    ChainSummary,
    Estimate,
    ImagePlane,
    LensParameter,
    Products,
    Quantity,
    RunResult,
    SourcePlane,
    StageTime,
)
from engine.spec.analysis import ESTIMATORS, Analysis
from engine.work import Work
from service.api.app import create_app
from service.cli.app import app
from service.dispatcher.identity import is_dead, own_name
from service.dispatcher.outcomes import OtherEngine, clean, judge_answer, read_exception
from service.dispatcher.pickle_guard import read_error
from service.domain.identifiers import utc_now
from service.domain.payload import (
    ESTIMATES,
    InvalidResultError,
    ResultPayload,
    WorkPayload,
    read_payload,
    result_payload,
)
from service.domain.requests import AnalysisRequest
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.leases import Lease, Outcome
from service.store.queue import Failure
from service.worker.answers import LIMIT_BYTES, NotPlainError, read_answer, to_bytes
from service.worker.tasks import answer_run, call_task, execute
from tests.service.plans import planned
from tests.service.tasks import PNG, synthetic_payload

SPEC = planned(1)[0].spec


def lease() -> Lease:
    run = planned(1)[0]
    return Lease("r", "g", 1, "token", 1, run.digest, run.spec, utc_now())


def engine_result(**changes: Any) -> RunResult:
    one = Quantity(1.0, 0.1, 1.1)
    pairs = [(estimator, prior) for estimator in ESTIMATORS for prior in INDEX_PRIORS]
    whole: dict[str, Any] = {
        "realization_digest": "a" * 64,
        "engine_digest": "b" * 64,
        "versions": {"numpy": "2"},
        "seed": 0,
        "noise_level": "author",
        "noise_treatment": "diagonal",
        "estimates": tuple(Estimate(*pair, *[one] * 8, 30, 1, 1, 0, 0) for pair in pairs),
        "regularisation": "curvature",
        "aperture": Aperture(1.0, one, 0.8, 30, 0),
        "lens": (LensParameter("theta_E", one), LensParameter("ln_lambda", Quantity(2.0, 0.2))),
        "chain": ChainSummary("converged", 24, 400, 100, 30.0, 240.0, 0.4, 9600),
        "ln_evidence": -10.0,
        "chi2": 5.0,
        "degrees_of_freedom": 4,
        "condition_number": 100.0,
        "arc_magnitude": 18.0,
        "agn_contrast": None,
        "surface_brightness": 20.0,
        "stages": (StageTime("forward", 1.0, 0.5), StageTime("posterior", 2.0, 2.0)),
        "work": Work(3_000_000_000, 2_000_000, 40_000, 9, 9600),
    }
    return RunResult(**(whole | changes))


def test_a_result_without_a_chain_is_a_payload_too() -> None:
    image = [found for found in engine_result().estimates if found.estimator == "image"]
    lone = engine_result(
        estimates=tuple(image), chain=None, ln_evidence=None, condition_number=None, aperture=None,
        work=Work(16_000_000, 3_000_000, 434),
    )  # fmt: skip
    payload = ResultPayload.model_validate_json(result_payload(lone).model_dump_json())
    assert (payload.chain, payload.ln_evidence, payload.condition_number, payload.aperture) == (None,) * 4
    assert {name for name, found in payload.estimates.items() if found} == {"image_wide", "image_free", "image_fixed"}
    assert payload.chi2 == 5.0


def test_an_engine_result_becomes_a_payload_that_survives_json() -> None:
    payload = result_payload(engine_result())
    assert set(payload.estimates) == set(ESTIMATES)
    found = payload.estimates["paper_free"]
    assert found is not None
    assert found.n.bias == pytest.approx(-0.1)
    assert (payload.wall_s, payload.cpu_s) == (3.0, 2.5)
    again = ResultPayload.model_validate_json(payload.model_dump_json())
    assert again == payload
    assert again.digest == payload.digest


def test_what_was_computed_is_in_the_payload_whatever_its_size_and_part_of_what_was_found() -> None:
    payload = result_payload(engine_result())
    assert payload.work == WorkPayload(
        pixels_rendered=3_000_000_000, rays_traced=2_000_000, columns_solved=40_000, parameters_sampled=9,
        evidence_evaluations=9600,
    )  # fmt: skip
    more = result_payload(engine_result(work=Work(3_000_000_001, 2_000_000, 40_000, 9, 9600)))
    assert more.digest != payload.digest
    # What a worker of an older version sends is stored all the same.
    older = payload.model_dump(mode="json", exclude={"work"})
    assert read_payload(older).work is None


def test_evaluations_that_are_not_those_of_the_chain_are_no_result() -> None:
    with pytest.raises(InvalidResultError, match="9599 evaluations counted, 9600 in the chain"):
        result_payload(engine_result(work=Work(1, 1, 1, 9, 9599)))


def test_the_digest_is_of_what_was_found_and_not_of_how_long_it_took() -> None:
    slow = result_payload(engine_result(stages=(StageTime("forward", 9.0, 9.0),)))
    assert slow.digest == result_payload(engine_result()).digest
    assert result_payload(engine_result(chi2=6.0)).digest != slow.digest


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_is_no_result(bad: float) -> None:
    with pytest.raises(InvalidResultError, match="ln_evidence"):
        result_payload(engine_result(ln_evidence=bad))
    with pytest.raises(InvalidResultError, match="theta_E"):
        result_payload(engine_result(lens=(LensParameter("theta_E", Quantity(bad, 0.1)),)))


def test_an_estimator_without_an_answer_is_null_and_one_that_is_not_named_no_result() -> None:
    payload = result_payload(engine_result(estimates=engine_result().estimates[:3], aperture=None))
    assert [name for name, found in payload.estimates.items() if found is not None] == list(ESTIMATES[:3])
    assert payload.aperture is None
    document = payload.model_dump(mode="json")
    assert document["estimates"]["image_fixed"] is None
    del document["estimates"]["image_fixed"]
    with pytest.raises(InvalidResultError, match="image_fixed"):
        read_payload(document)


def test_analysis_overrides_follow_the_engine() -> None:
    assert list(AnalysisRequest.model_fields) == [field.name for field in dataclasses.fields(Analysis)]


def test_a_worker_answers_with_data_whatever_happens() -> None:
    assert call_task("tests.service.tasks:synthetic_payload_of", {}, "x")["error"]["code"] == "error"
    refused = call_task("tests.service.tasks:moody", {**SPEC, "seed": 3}, "x")["error"]
    assert (refused["code"], refused["permanent"]) == ("invalid_spec", True)
    broken = call_task("tests.service.tasks:moody", {**SPEC, "seed": 1}, "x")["error"]
    assert (broken["code"], broken["permanent"]) == ("error", False)


def test_answers_are_judged() -> None:
    good = {"payload": synthetic_payload(SPEC)}
    assert judge_answer(lease(), good) == read_payload(good["payload"])
    for answer in (None, {}, {"payload": {}}, {"payload": {**good["payload"], "realization_digest": "0" * 64}}):
        ending = judge_answer(lease(), answer)
        assert isinstance(ending, Failure)
        assert (ending.code, ending.retries) == ("invalid_result", 0)
    assert read_exception(ValueError("x")).outcome is Outcome.ERROR
    mine = dataclasses.replace(lease(), engine="e" * 64)
    assert judge_answer(mine, {**good, "engine": "e" * 64}) == read_payload(good["payload"])
    assert judge_answer(mine, {**good, "engine": "f" * 64}) == OtherEngine("f" * 64)
    assert judge_answer(mine, good) == OtherEngine("None")
    assert clean("a\x00b\ud800") == "a\ufffdb?"


def test_artefacts_are_named_by_their_content_and_keys_cannot_escape(tmp_path: Path) -> None:
    store = ArtefactStore(str(tmp_path / "new" / "store"))
    first, again = store.put(PNG, "png"), store.put(PNG, "png")
    assert first == again
    assert store.read(first.key) == Path(store.path(first.key)).read_bytes() == PNG
    assert len([file for file in tmp_path.rglob("*") if file.is_file()]) == 1
    with pytest.raises(ValueError, match="not an artefact key"):
        store.read("../../etc/passwd")


def test_a_process_is_known_to_be_dead_only_on_its_own_machine() -> None:
    mine = own_name()
    assert not is_dead(mine)
    place, pid, created = mine.split("|")
    assert is_dead(f"{place}|{pid}|1.00")
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert is_dead(f"{place}|{child.pid}|{created}")
    assert not is_dead(f"elsewhere/0/|{child.pid}|{created}")
    assert not is_dead("something else")
    assert str(os.getpid()) == pid


def test_settings_are_checked_at_the_door(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValidationError, match="LEADER_TTL"):
        Settings(leader_ttl_s=5, heartbeat_s=5)
    monkeypatch.setenv("HOSTLENS_PORT", "99999")
    outcome = CliRunner().invoke(app, ["status"])
    assert outcome.exit_code == 2
    assert "HOSTLENS_PORT: got '99999'" in outcome.output


def test_the_command_line_speaks_to_the_api(tmp_path: Path, sqlite_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(database_url=sqlite_url, data_dir=tmp_path)
    with TestClient(create_app(settings)) as api:
        monkeypatch.setattr("service.client.httpx.Client", lambda **_: api)
        monkeypatch.setattr(api, "close", lambda: None)
        run = CliRunner()
        options = ["--preset", "h0licow-vi/HE0435", "--n", "2", "--n", "4", "--l-eta", "1", "--magnitude", "20.5"]
        made = run.invoke(app, ["submit", *options])
        assert made.exit_code == 0, made.output
        grid = made.output.strip()
        assert grid.startswith("g_")
        assert "queued: 0/4 stored" in run.invoke(app, ["status", grid]).output
        assert grid in run.invoke(app, ["status"]).output
        assert "queued" in run.invoke(app, ["status", grid, "--runs"]).output
        assert json.loads(run.invoke(app, ["results", grid, "--format", "json"]).output)["rows"] == []
        assert run.invoke(app, ["results", grid]).exit_code == 0
        assert "paused: 0/4 stored, 4 paused" in run.invoke(app, ["pause", grid]).output
        assert "queued: 0/4 stored" in run.invoke(app, ["resume", grid]).output
        assert "4 cancelled" in run.invoke(app, ["cancel", grid]).output
        assert "queued: 0/4 stored" in run.invoke(app, ["retry", grid]).output
        refused = run.invoke(app, ["submit", "--preset", "other"])
        assert refused.exit_code == 1
        assert "preset: got 'other'" in refused.output


def test_the_command_line_says_so_when_there_is_no_service() -> None:
    outcome = CliRunner().invoke(app, ["status", "--url", "http://127.0.0.1:1"])
    assert outcome.exit_code == 1
    assert "does not answer" in outcome.output


def test_the_worker_runs_the_engine_and_keeps_figure_and_arrays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flat = np.zeros((4, 5))
    image = ImagePlane(flat, flat, flat, flat, flat, flat > 0, 0.08)
    edges, samples = np.arange(6.0), np.zeros((2, 1))
    products = Products(image, SourcePlane(flat, flat, edges, edges[:5], samples, ("theta_E",)))
    digest = planned(1)[0].digest
    monkeypatch.setattr(
        engine, "run", lambda realization: engine_result(realization_digest=realization.digest, products=products)
    )
    monkeypatch.setattr(engine.figures, "run_figure", lambda _: Figure())
    payload = read_payload(execute(SPEC, str(tmp_path)))
    assert payload.realization_digest == digest
    store = ArtefactStore(str(tmp_path))
    assert payload.figure is not None
    assert payload.products is not None
    assert store.read(payload.figure.key).startswith(b"\x89PNG")
    with np.load(store.path(payload.products.key), allow_pickle=False) as arrays:
        assert {"image", "model", "mask", "pixel_scale", "source", "chain", "parameter_names"} <= set(arrays)
        assert not {"source_truth", "source_plane"} & set(arrays)
        assert arrays["image"].shape == (4, 5)


def test_a_worker_is_greeted_with_its_engine_one_thread_and_warm_kernels() -> None:
    """In a process of its own, as a worker started elsewhere is: without any of the variables that pin threads."""
    code = (
        "from service.worker.tasks import greet; from service.worker.answers import read_greeting; "
        "said = read_greeting(greet('service.worker:execute')); "
        "print(said.engine, set(said.threads.values()), f'{said.warm_s:.1f}')"
    )
    plain = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", code], env=plain, capture_output=True, text=True, check=True)
    print(f"warm after {done.stdout.split()[-1]} s")
    assert done.stdout.split()[:2] == [engine.engine_digest(), "{1}"]


def test_answers_of_workers_are_plain_data_of_a_bounded_size_and_nothing_else() -> None:
    good = {"answer": {"payload": {}, "engine": "e"}, "memory": 7}
    assert read_answer(to_bytes(good)).memory == 7
    wrong: tuple[object, ...] = (
        good,
        to_bytes(good).decode(),
        pickle.dumps(good),
        b"",
        b"[" * 100_000,
        b'{"answer":' + b"9" * 10_000 + b"}",
        to_bytes({"memory": 7}),
        to_bytes({**good, "answer": [1, 2]}),
        to_bytes({**good, "more": 1}),
        to_bytes({**good, "memory": -1}),
        b" " * (2 * LIMIT_BYTES + 1),
    )
    for said in wrong:
        with pytest.raises(NotPlainError):
            read_answer(said)


def test_what_a_task_answers_leaves_the_worker_as_plain_data_or_as_an_error_that_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: dict[str, Any] = {"object": object(), "huge": "x" * LIMIT_BYTES, "well": 1}
    monkeypatch.setattr("tests.service.tasks.fast", lambda spec, _: answers[spec])
    task = "tests.service.tasks:fast"
    said = [read_answer(answer_run(task, spec, str(tmp_path))) for spec in answers]  # type: ignore[arg-type]
    assert [one.answer.get("error", {}).get("code") for one in said] == ["invalid_result"] * 2 + [None]
    assert all(one.memory > 0 for one in said)
    monkeypatch.setattr("tests.service.tasks.fast", _no_memory)
    answer = read_answer(answer_run(task, {}, str(tmp_path))).answer
    assert answer["error"]["code"] == "memory"


def _no_memory(*_: Any) -> Any:
    raise MemoryError


def test_an_exception_that_was_not_unpickled_is_told_by_the_text_that_is_in_it() -> None:
    error = read_error(Exception(pickle.dumps(OSError(28, "no space"))))
    assert "no space" in str(error)
    assert isinstance(read_error(Exception(pickle.dumps(KilledWorker("key", None, 0)))), KilledWorker)  # type: ignore[arg-type]
    assert str(read_error(Exception(b"\x80\x04\xff"))) == "an exception without a text"
    plain = ValueError("as it is")
    assert read_error(plain) is plain


def test_no_pickle_names_a_class_or_a_function_while_a_client_of_workers_is_open() -> None:
    code = """
import os, pickle, sys
from service.dispatcher.pickle_guard import only_plain_data
class Harm:
    def __reduce__(self):
        return os.mkdir, (sys.argv[1],)
harm, data = pickle.dumps(Harm()), pickle.dumps([1, b"2", {"three": (4.0, None)}])
with only_plain_data():
    assert pickle.loads(data) == [1, b"2", {"three": (4.0, None)}]
    assert pickle.loads(pickle.dumps(bytes)) is bytes
    for loads in (pickle.loads, pickle._loads):
        try:
            loads(harm)
        except TypeError as error:
            assert "mkdir" in str(error)
        else:
            raise AssertionError
"""
    subprocess.run([sys.executable, "-c", code, "harmed"], check=True, cwd=Path(__file__).parents[2])
    assert not Path("harmed").exists()
