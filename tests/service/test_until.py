"""Replicates are added until the mean bias of their point is known to an error, and no further."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from scipy.stats import chi2, norm
from sqlalchemy import select
from typer.testing import CliRunner

from service.api.app import create_app
from service.cli.app import app
from service.cli.formatting import grid_line
from service.domain.payload import ResultPayload
from service.domain.precision import Until, standard_error, upper_limit
from service.domain.requests import GridRequest, plan
from service.domain.states import GridState, RunState
from service.domain.views import Summary
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Lease, Outcome
from service.store.outbox import EventStore
from service.store.queue import Failure, RunQueue
from service.store.tables import point
from tests.service.crashes import PERMANENT
from tests.service.plans import BODY, body_until, planned_until, result_of, submit, submit_until, until

# The rule.


def test_the_upper_limit_is_that_of_chi_squared() -> None:
    """Within 0.5 %: the quantile is an approximation, and a replicate more or less changes it by more."""
    for runs in (3, 4, 5, 10, 30, 100, 1000):
        exact = math.sqrt((runs - 1) / chi2.ppf(norm.sf(1.0), runs - 1))
        assert upper_limit(0.1, runs) == pytest.approx(0.1 * exact, rel=0.005)
    assert upper_limit(0.1, 2) is upper_limit(None, 1) is None


def test_the_standard_error_is_the_sample_s() -> None:
    biases = np.random.default_rng(1).normal(-0.2, 0.1, 9)
    assert standard_error(biases.tolist()) == pytest.approx(biases.std(ddof=1) / 3.0, rel=1e-12)
    assert standard_error([0.1]) is None


def test_nothing_is_known_before_at_least_so_many_have_an_answer() -> None:
    rule = Until(error=1.0, at_least=5)
    assert not rule.is_kept(0.0, 4)
    assert rule.is_kept(0.0, 5)
    assert not rule.is_kept(None, 1)


def test_what_is_wanted_is_the_first_number_that_would_do() -> None:
    rule = Until(error=0.02, at_most=400)
    wanted = rule.wanted(0.1 / math.sqrt(12), 12)
    assert rule.is_kept(0.1 / math.sqrt(wanted), wanted)
    assert not rule.is_kept(0.1 / math.sqrt(wanted - 1), wanted - 1)
    assert rule.wanted(None, 1) == rule.wanted(10.0, 50) == 400
    assert rule.wanted(0.0, 20) == 10


DICE = {
    "normal": lambda dice, shape: dice.standard_normal(shape),
    "with tails": lambda dice, shape: dice.standard_t(4, shape) / math.sqrt(2.0),
    "skew": lambda dice, shape: (dice.gamma(2.0, 1.0, shape) - 2.0) / math.sqrt(2.0),
    "outliers": lambda dice, shape: (
        dice.standard_normal(shape) * np.where(dice.random(shape) < 0.05, 5.0, 1.0) / math.sqrt(0.95 + 0.05 * 25.0)
    ),
}


@pytest.mark.parametrize("kind", DICE)
@pytest.mark.parametrize("ratio", [3.0, 5.0, 8.0])
def test_means_that_are_said_to_be_known_are_off_by_no_more(kind: str, ratio: float) -> None:
    """Root mean square of mean less truth over 3,000 points that were stopped, with a scatter of ``ratio`` errors.

    1.1 of the error: a skew scatter gives 1.05. Stopping where s / sqrt(n) itself is small gives up to 1.3. No
    more than 1.5 times the replicates that one would take who knew the scatter, or those that are the least.
    """
    runs = int(4 * ratio**2) + 60
    values = DICE[kind](np.random.default_rng(7), (3000, runs))
    numbers = np.arange(1, runs + 1)
    means = np.cumsum(values, axis=1) / numbers
    with np.errstate(invalid="ignore", divide="ignore"):
        scatter = np.sqrt((np.cumsum(values**2, axis=1) - numbers * means**2) / (numbers - 1))
    # A scatter of one, of which the error is a part.
    factor = np.array([upper_limit(1.0, number) or np.inf for number in numbers.tolist()])
    kept = (factor * scatter / np.sqrt(numbers) <= 1.0 / ratio) & (numbers >= 10)
    kept[:, -1] = True
    stops = kept.argmax(axis=1)
    off = means[np.arange(3000), stops] * ratio
    assert math.sqrt(np.mean(off**2)) < 1.1
    assert np.mean(stops + 1) < 1.5 * max(ratio**2, 10.0)
    if kind != "skew":
        assert abs(off.mean()) < 4.0 * off.std() / math.sqrt(3000)  # stopping moves no mean of an even scatter


# The queue.


class Scene:
    """A grid store, and a dispatcher that does what it is told."""

    def __init__(self, database: Database) -> None:
        self.grids, self.queue = GridStore(database), RunQueue(database, retry_delay_s=0.0)
        generation = Leadership(database).take("test")
        assert generation is not None
        self.generation = generation

    def claim(self, number: int) -> list[Lease]:
        return self.queue.claim(self.generation, number)

    def store(self, *results: tuple[Lease, float]) -> None:
        self.queue.store_all([(lease, found(lease, bias)) for lease, bias in results])

    def states(self, grid_id: str) -> list[str]:
        return [run.state for run in self.grids.runs(grid_id, 1000).items]

    def precision(self, grid_id: str) -> list[Any]:
        return [row.precision for row in Summary.model_validate(self.grids.summary(grid_id, 100)).rows]


def found(lease: Lease, bias: float) -> ResultPayload:
    """A result whose magnitude by ``image`` is off by so much."""
    payload = result_of(lease)
    estimate = payload.estimates["image_wide"]
    assert estimate is not None
    truth = estimate.magnitude.truth
    assert truth is not None
    magnitude = estimate.magnitude.model_copy(update={"mean": truth + bias})
    changed = {**payload.estimates, "image_wide": estimate.model_copy(update={"magnitude": magnitude})}
    return payload.model_copy(update={"estimates": changed})


@pytest.fixture
def scene(database: Database) -> Scene:
    return Scene(database)


RULE = until(0.1, at_most=6)


def test_a_point_that_is_known_well_enough_ends_its_waiting_replicates_and_no_others(
    scene: Scene, database: Database
) -> None:
    grid_id = submit_until(scene.grids, 2, RULE)
    other = submit_until(scene.grids, 2, until(0.1, at_most=5))
    leases = scene.claim(7)  # three replicates of both points, and the fourth of the first
    # Of the first point one value, of the second a scatter that three replicates are too few for.
    scene.store(*((lease, -0.2) for lease in leases[0:6:2]))
    scene.store(*((lease, bias) for lease, bias in zip(leases[1:6:2], (-0.4, 0.1, 0.4), strict=True)))
    assert scene.states(grid_id) == ["done"] * 6 + ["leased", *["queued", "not_needed"] * 2, "queued"]
    assert set(scene.states(other)) == {"queued"}
    shown = scene.grids.grid(grid_id)
    assert (shown.until and (shown.until.points, shown.until.reached)) == (2, 1)
    assert (shown.counts.not_needed, shown.counts.ended, shown.state) == (2, 8, GridState.RUNNING)
    # What is running goes on to its end, is stored, and is part of the mean.
    scene.store((leases[6], -0.6))
    first, second = scene.precision(grid_id)
    assert (first.reached, first.runs) == (True, 4)
    assert first.standard_error == pytest.approx(0.1, rel=1e-9)
    assert first.upper_limit == upper_limit(first.standard_error, 4)
    assert (second.reached, second.runs) == (False, 3)
    (told,) = [event for event in EventStore(database).page(grid_id, 0, 100).items if event.kind == "point_reached"]
    assert told.detail == {"place": 0, "runs": 3, "standard_error": 0.0, "not_needed": 2}
    # The second ends where no replicate is left.
    rest = [lease for lease in scene.claim(100) if lease.grid_id == grid_id]
    assert len(rest) == 3
    scene.store(*((lease, bias) for lease, bias in zip(rest, (-5.0, 5.0, 5.0), strict=True)))
    shown = scene.grids.grid(grid_id)
    assert (shown.state, shown.counts.done, shown.counts.not_needed) == (GridState.DONE, 10, 2)
    assert (shown.until and shown.until.reached, shown.progress, shown.eta_seconds) == (1, 1.0, 0.0)
    assert [one.reached for one in scene.precision(grid_id)] == [True, False]


def test_the_first_replicates_of_all_points_come_before_the_second_of_any() -> None:
    runs = planned_until(2, RULE)
    assert [(run.inputs["n"], run.inputs["seed"]) for run in runs[:4]] == [(2.0, 0), (4.0, 0), (2.0, 1), (4.0, 1)]
    fixed = plan(GridRequest.model_validate({**BODY, "n": [2, 4], "replicates": 6}), 100)
    assert {run.digest for run in runs} == {run.digest for run in fixed}
    assert {run.label for run in runs} == {run.label for run in fixed}


def test_a_retry_leaves_alone_what_is_not_needed(scene: Scene) -> None:
    grid_id = submit_until(scene.grids, 1, RULE)
    leases = scene.claim(4)
    scene.queue.fail(leases[3], PERMANENT)
    scene.store(*((lease, 0.1) for lease in leases[:3]))
    assert scene.states(grid_id) == ["done"] * 3 + ["failed"] + ["not_needed"] * 2
    assert scene.grids.grid(grid_id).state is GridState.FAILED
    # Nor is a failed one done once more of which nothing depends.
    assert scene.grids.revive(grid_id) == 1
    assert scene.states(grid_id) == ["done"] * 3 + ["not_needed"] * 3
    assert scene.grids.grid(grid_id).state is GridState.DONE
    assert scene.grids.revive(grid_id) == 0


def test_a_replicate_that_is_given_back_after_its_point_was_reached_is_not_needed(scene: Scene) -> None:
    grid_id = submit_until(scene.grids, 1, RULE)
    leases = scene.claim(5)
    scene.store(*((lease, 0.1) for lease in leases[:3]))
    assert scene.queue.fail(leases[3], Failure(Outcome.ERROR, "error", "broken", retries=2)) is RunState.NOT_NEEDED
    assert scene.grids.grid(grid_id).finished_at is None
    assert scene.queue.hand_back([leases[4]]) == 0
    shown = scene.grids.grid(grid_id)
    assert (shown.state, shown.counts.not_needed) == (GridState.DONE, 3)


def test_a_paused_grid_needs_no_more_of_a_reached_point_either(scene: Scene) -> None:
    grid_id = submit_until(scene.grids, 2, RULE)
    leases = scene.claim(6)
    scene.grids.pause(grid_id)
    scene.store(*((lease, 0.1) for lease in leases[0::2]))
    assert Counter(scene.states(grid_id)) == {"done": 3, "leased": 3, "paused": 3, "not_needed": 3}
    scene.grids.resume(grid_id)
    assert Counter(scene.states(grid_id)) == {"done": 3, "leased": 3, "queued": 3, "not_needed": 3}


def test_what_was_cancelled_comes_back_by_a_retry_only_where_it_is_needed(scene: Scene) -> None:
    grid_id = submit_until(scene.grids, 2, RULE)
    leases = scene.claim(6)
    scene.grids.cancel(grid_id)
    scene.store(*((lease, 0.1) for lease in leases[0::2]))
    assert scene.grids.revive(grid_id) == 6
    assert Counter(scene.states(grid_id)) == {"done": 3, "leased": 3, "queued": 3, "not_needed": 3}


def test_a_point_whose_replicates_fail_ends_where_none_is_left(scene: Scene) -> None:
    grid_id = submit_until(scene.grids, 1, RULE)
    for lease in scene.claim(6):
        scene.queue.fail(lease, PERMANENT)
    shown = scene.grids.grid(grid_id)
    assert (shown.state, shown.counts.failed, shown.until and shown.until.reached) == (GridState.FAILED, 6, 0)


def test_replicates_without_an_answer_do_not_count(scene: Scene) -> None:
    grid_id = submit_until(scene.grids, 1, RULE)
    leases = scene.claim(4)
    for lease in leases[:3]:
        payload = found(lease, 0.1)
        silent = payload.model_copy(update={"estimates": {**payload.estimates, "image_wide": None}})
        scene.queue.store(lease, silent)
    (known,) = scene.precision(grid_id)
    assert (known.reached, known.runs, known.standard_error, known.upper_limit) == (False, 0, None, None)


def test_results_that_come_together_are_judged_together_and_each_point_by_itself(
    scene: Scene, database: Database
) -> None:
    first, second = submit_until(scene.grids, 2, RULE), submit_until(scene.grids, 1, until(0.1, at_most=7))
    submit(scene.grids, 3)
    scene.store(*((lease, 0.0) for lease in scene.claim(12 + 3)))
    assert Counter(scene.states(first)) == {"done": 12}
    assert Counter(scene.states(second)) == {"done": 3, "not_needed": 4}
    with database.read() as connection:
        rows = sorted(map(tuple, connection.execute(select(point.c.grid_id, point.c.place, point.c.runs))))
    assert rows == [(first, 0, 6), (first, 1, 6), (second, 0, 3)]


def test_the_time_left_is_that_of_the_replicates_that_it_should_take(scene: Scene) -> None:
    # A scatter of 0.1 needs five of them, of a hundred.
    grid_id = submit_until(scene.grids, 1, until(0.075, at_most=100))
    before = scene.grids.grid(grid_id)
    scene.store(*zip(scene.claim(3), (-0.1, 0.0, 0.1), strict=True))
    shown = scene.grids.grid(grid_id)
    assert before.eta_seconds is None
    assert shown.counts.queued == 97
    assert shown.rate_per_s is not None
    assert shown.eta_seconds is not None
    assert shown.eta_seconds <= 1.01 * 2 / shown.rate_per_s
    assert scene.grids.grids(10).items[0].until == shown.until


# The doors.


@pytest.fixture
def api(sqlite_url: str, tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(create_app(Settings(database_url=sqlite_url, data_dir=tmp_path, max_grid_runs=500))) as client:
        yield client


REFUSED: dict[str, tuple[dict[str, Any], str, str]] = {
    "no error": ({"until": {"at_most": 10}}, "/until/error", "required"),
    "error of nothing": ({"until": {"error": 0}}, "/until/error", "above 0"),
    "negative error": ({"until": {"error": -0.1}}, "/until/error", "above 0"),
    "text": ({"until": {"error": "0.1"}}, "/until/error", "number"),
    "more than at most": ({"until": {"error": 0.1, "at_most": 5, "at_least": 6}}, "/until/at_least", "at most"),
    "too few": ({"until": {"error": 0.1, "at_least": 2}}, "/until/at_least", "3"),
    "replicates too": ({"until": {"error": 0.1}, "replicates": 3}, "/replicates", "at_most"),
    "unknown estimator": ({"until": {"error": 0.1, "estimator": "best"}}, "/until/estimator", "image"),
    "unknown quantity": ({"until": {"error": 0.1, "quantity": "q"}}, "/until/quantity", "r_eff"),
    "not computed": (
        {"until": {"error": 0.1, "estimator": "paper"}, "analysis": {"estimators": ["image"]}},
        "/until/estimator",
        "image",
    ),
    "n that is given": (
        {"until": {"error": 0.1, "quantity": "n", "index_prior": "fixed"}},
        "/until/index_prior",
        "wide",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_rule_that_cannot_be_is_refused_by_its_field(api: TestClient, case: str) -> None:
    wrong, pointer, told = REFUSED[case]
    answer = api.post("/v1/grids", json={**BODY, **wrong})
    assert answer.status_code == 422
    places = {place["pointer"]: place["message"] for place in answer.json()["errors"]}
    assert told in places[pointer], places
    assert len(places) == 1


def test_as_many_runs_as_it_may_take_count_against_the_limit(api: TestClient) -> None:
    assert api.post("/v1/grids", json={**BODY, "until": {"error": 0.1, "at_most": 501}}).status_code == 422
    told = api.post("/v1/grids?dry_run=true", json={**BODY, "until": {"error": 0.1, "at_most": 500}}).json()
    assert (told["least_runs"], told["n_runs"]) == (10, 500)
    few = api.post("/v1/grids?dry_run=true", json={**BODY, "until": {"error": 0.1, "at_most": 5}}).json()
    assert few["least_runs"] == few["n_runs"] == 5


def test_the_api_and_the_pages_say_what_is_known_and_what_is_not_needed(api: TestClient, sqlite_url: str) -> None:
    asked = body_until(1, RULE)
    made = api.post("/v1/grids", json=asked, headers={"Idempotency-Key": "k"}).json()
    assert api.post("/v1/grids", json=asked, headers={"Idempotency-Key": "k"}).json()["id"] == made["id"]
    assert made["until"] == {
        "quantity": "magnitude", "estimator": "image", "index_prior": "wide", "error": 0.1,
        "at_most": 6, "at_least": 3, "points": 1, "reached": 0,
    }  # fmt: skip
    database = Database(sqlite_url)
    dispatcher = Scene(database)
    dispatcher.store(*((lease, 0.1) for lease in dispatcher.claim(3)))
    shown = api.get(f"/v1/grids/{made['id']}").json()
    assert (shown["until"]["reached"], shown["counts"]["not_needed"], shown["state"]) == (1, 3, "done")
    (row,) = api.get(f"/v1/grids/{made['id']}/summary").json()["rows"]
    assert row["precision"]["reached"]
    spared = api.get(f"/v1/grids/{made['id']}/runs?state=not_needed").json()["items"]
    assert [run["uws_phase"] for run in spared] == ["ABORTED"] * 3
    assert api.get(f"/v1/runs/{spared[0]['id']}").json()["result"] is None
    assert api.post(f"/v1/grids/{made['id']}/retry").json()["retried"] == 0
    page = api.get(f"/grids/{made['id']}").text
    assert "1 of 1 points" in page
    assert "<b>3</b> not needed" in page
    assert "Try again" not in page
    assert api.get(f"/runs/{spared[0]['id']}").status_code == 200
    line = grid_line(dispatcher.grids.grid(made["id"]))
    assert "3 not needed, 1 of 1 points known to 0.1 in magnitude" in line
    database.close()


def test_a_word_that_is_no_error_is_refused_by_the_command() -> None:
    for given in ("magnitude", "magnitude=fine"):
        refused = CliRunner().invoke(app, ["submit", "--until", given])
        assert refused.exit_code == 2
        assert "QUANTITY=ERROR" in refused.output or "NAME=VALUE" in refused.output
