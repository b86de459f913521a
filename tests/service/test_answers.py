"""Answers over results of several grids are those that plain numpy gives of the payloads that were stored."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from service.api.app import create_app
from service.domain.answers import ComparisonAnswer, ResultPage, SummaryAnswer, TrendAnswer
from service.domain.payload import ESTIMATES, EstimateName, QuantityPayload, ResultPayload
from service.domain.requests import GridRequest, plan
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.leases import Lease, Outcome
from service.store.migrate import upgrade
from service.store.numbers import read_numbers
from service.store.queue import Failure, RunQueue
from service.store.result_filter import AXES, ResultFilter
from service.store.result_rows import result_columns, result_rows
from service.store.statistics import moments, share
from service.store.tables import estimate
from tests.service.conftest import empty
from tests.service.plans import result_of

Ask = Callable[..., Any]
CUT = {"n": [2, 4], "l_eta": [1.0], "r_eff": [0.39]}
GRIDS = (
    {"preset": "h0licow-vi/HE0435", **CUT, "replicates": 3, "analysis": {"profile": "draft"}},
    {"preset": "h0licow-vi/HE0435", **CUT, "replicates": 2, "analysis": {"profile": "standard"}},
    {"preset": "h0licow-vi/HE1104", "n": [2], "replicates": 2, "analysis": {"profile": "draft"}},
)


@dataclass(frozen=True)
class Known:
    """What was stored of one run, and who it is."""

    lease: Lease
    inputs: dict[str, Any]
    payload: ResultPayload

    def value(self, quantity: str = "magnitude", name: EstimateName = "image_wide") -> QuantityPayload | None:
        found = self.payload.estimates[name]
        return None if found is None else getattr(found, quantity)


@dataclass(frozen=True)
class Stored:
    """Three grids in a database behind an API, and what is in them."""

    ask: Ask
    database: Database
    known: list[Known]
    failed: list[Lease]
    grids: list[str]


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def stored(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stored]:
    folder = tmp_path_factory.mktemp("answers")
    if request.param == "sqlite":
        url = f"sqlite:///{folder / 'answers.sqlite'}"
        upgrade(url)
    else:
        url = request.getfixturevalue("migrated_postgres")
        empty(url)
    database = Database(url)
    grids = [_create(database, body) for body in GRIDS]
    known, failed = _work(database)
    with TestClient(create_app(Settings(database_url=url, data_dir=folder))) as client:

        def ask(address: str, status: int = 200, **query: Any) -> Any:
            answer = client.get(address, params=query or None)
            assert answer.status_code == status, answer.text
            return answer.json()

        yield Stored(ask, database, known, failed, grids)
    database.close()


def _create(database: Database, body: dict[str, Any]) -> str:
    request = GridRequest.model_validate(body)
    return GridStore(database).create(request.canonical(), lambda: plan(request, 1000)).grid.id


def _work(database: Database) -> tuple[list[Known], list[Lease]]:
    """Store a result for each run but the first of each grid; some without an answer, some without a truth."""
    queue, known, failed = RunQueue(database), [], []
    generation = Leadership(database).take("test", lambda _: True)
    assert generation is not None
    seen: set[str] = set()
    for place, lease in enumerate(queue.claim(generation, 1000)):
        if lease.grid_id not in seen:
            seen.add(lease.grid_id)
            queue.fail(lease, Failure(Outcome.ERROR, "error", "on purpose", 0))
            failed.append(lease)
            continue
        payload = _payload(lease, place)
        queue.store(lease, payload)
        known.append(Known(lease, GridStore(database).run(lease.run_id).inputs, payload))
    return known, failed


def _payload(lease: Lease, place: int) -> ResultPayload:
    payload = result_of(lease)
    estimates = dict(payload.estimates)
    if place % 7 == 3:
        estimates["image_wide"] = None
    wide = estimates["image_wide"]
    if place % 11 == 5 and wide is not None:
        unknown = wide.magnitude.model_copy(update={"truth": None})
        estimates["image_wide"] = wide.model_copy(update={"magnitude": unknown})
    changes = {
        "estimates": estimates,
        "profile": lease.spec["analysis"]["profile"],
        "arc_magnitude": 18.0 + 0.37 * place,
        "agn_contrast": None if place % 5 == 0 else -1.5 - 0.01 * place,
    }
    return payload.model_copy(update=changes)


def biases(known: list[Known], quantity: str = "magnitude", name: EstimateName = "image_wide") -> Any:
    """Bias, sd and input of each run that has them."""
    values = [(one, one.value(quantity, name)) for one in known]
    rows = [
        (value.mean - value.truth, value.sd, str([*sorted((one.inputs | {"seed": 0}).items()), one.payload.profile]))
        for one, value in values
        if value is not None and value.truth is not None
    ]
    return np.array([row[0] for row in rows]), np.array([row[1] for row in rows]), [row[2] for row in rows]


def standard_error(bias: Any, inputs: list[str]) -> float:
    """By inputs, written as a loop."""
    if len(set(inputs)) == 1:
        return float(np.std(bias, ddof=1) / math.sqrt(len(bias)))
    off = bias - bias.mean()
    sums = [off[[other == one for other in inputs]].sum() for one in set(inputs)]
    k = len(sums)
    return math.sqrt(k / (k - 1) * sum(total**2 for total in sums)) / len(bias)


def wilson(hits: int, runs: int) -> tuple[float, float]:
    """The two solutions p of |hits / runs - p| = sqrt(p (1 - p) / runs)."""
    low, high = sorted(np.roots([1.0 + 1.0 / runs, -(2.0 * hits + 1.0) / runs, (hits / runs) ** 2]).real)
    return low, high


def assert_statistics(found: dict[str, Any], known: list[Known], quantity: str, name: EstimateName) -> None:
    bias, sd, inputs = biases(known, quantity, name)
    close = {"rel": 6e-6, "abs": 1e-12}
    assert found["runs"] == len(bias)
    assert found["inputs"] == len(set(inputs))
    expected = {
        "mean": bias.mean(),
        "median": np.median(bias),
        "p16": np.percentile(bias, 16),
        "p84": np.percentile(bias, 84),
        "rmse": np.sqrt(np.mean(bias**2)),
        "stated_sd": sd.mean(),
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, **close)
    if len(bias) > 1:
        assert found["scatter"] == pytest.approx(np.std(bias, ddof=1), **close)
        assert found["standard_error"] == pytest.approx(standard_error(bias, inputs), **close)
        assert found["pull"]["scatter"] == pytest.approx(np.std(bias / sd, ddof=1), **close)
    else:
        assert found["scatter"] is found["standard_error"] is None
    assert found["pull"]["mean"] == pytest.approx(np.mean(bias / sd), **close)
    shares = [
        (found["coverage"]["68"], np.abs(bias) <= 0.994457883 * sd),
        (found["coverage"]["95"], np.abs(bias) <= 1.959963985 * sd),
    ]
    if quantity == "magnitude":
        shares += [(found["within"]["0.5"], np.abs(bias) < 0.5), (found["within"]["1.25"], np.abs(bias) < 1.25)]
    else:
        assert found["within"] == {}
    for told, holds in shares:
        low, high = wilson(int(holds.sum()), len(holds))
        assert told == pytest.approx({"fraction": holds.mean(), "low": low, "high": high}, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("quantity", ["magnitude", "r_eff", "n", "q", "x"])
@pytest.mark.parametrize("name", ["image_wide", "paper_free"])
def test_a_summary_by_system_and_index_is_numpy_s(stored: Stored, quantity: str, name: EstimateName) -> None:
    estimator, prior = name.split("_")
    query = {"group_by": "system,n", "quantity": quantity, "estimator": estimator, "index_prior": prior}
    answer = stored.ask("/v1/summary", **query)
    SummaryAnswer.model_validate(answer)
    assert answer["question"]["recommended"] == (name == "image_wide")
    assert [tuple(row["group"].values()) for row in answer["rows"]] == [
        ("HE0435", 2.0), ("HE0435", 4.0), ("HE1104", 2.0)
    ]  # fmt: skip
    for row in answer["rows"]:
        mine = [one for one in stored.known if (one.inputs["system"], one.inputs["n"]) == tuple(row["group"].values())]
        assert row["stored"] == len(mine)
        assert row["answered"] == sum(one.value(quantity, name) is not None for one in mine)
        assert row["cpu_s"] == pytest.approx(sum(one.payload.cpu_s for one in mine))
        assert_statistics(row["bias"], mine, quantity, name)
        ids = {one.lease.run_id for one in mine}
        assert 0 < len(row["run_ids"]) <= 10
        assert set(row["run_ids"]) <= ids
        behind = stored.ask(row["links"]["results"] + "&limit=1000")
        assert {item["run_id"] for item in behind["items"]} == ids
    assert sum(row["failed"] for row in answer["rows"]) == len(stored.failed) == 3


@pytest.mark.parametrize("axis", sorted(AXES))
def test_every_axis_groups_and_filters(stored: Stored, axis: str) -> None:
    def of(one: Known) -> Any:
        other = {
            "grid": one.lease.grid_id,
            "profile": one.payload.profile,
            "regularisation": one.payload.regularisation,
            "engine": one.payload.engine_digest,
        }
        return (one.inputs | other)[axis]

    answer = stored.ask("/v1/summary", group_by=axis)
    values = sorted({of(one) for one in stored.known})
    assert [row["group"][axis] for row in answer["rows"]] == values
    for row, value in zip(answer["rows"], values, strict=True):
        mine = [one for one in stored.known if of(one) == value]
        assert_statistics(row["bias"], mine, "magnitude", "image_wide")
        (alone,) = stored.ask("/v1/summary", **{"group_by": "", axis: value})["rows"]
        assert {**alone, "group": None, "links": None} == {**row, "group": None, "links": None}


def test_several_grids_and_ranges_are_filters(stored: Stored) -> None:
    first = stored.grids[0]
    answer = stored.ask("/v1/summary", grid=stored.grids[:2], magnitude=["20..21", "23.0"], group_by="grid")
    assert [row["group"]["grid"] for row in answer["rows"]] == stored.grids[:2]
    for row in answer["rows"]:
        mine = [
            one
            for one in stored.known
            if one.lease.grid_id == row["group"]["grid"]
            and (20.0 <= one.inputs["magnitude"] <= 21.0 or one.inputs["magnitude"] == 23.0)
        ]
        assert_statistics(row["bias"], mine, "magnitude", "image_wide")
    assert answer["question"]["filter"] == {"grid": stored.grids[:2], "magnitude": ["20..21", "23.0"]}
    nothing = stored.ask("/v1/summary", grid=first, system="HE1104")
    assert nothing["rows"] == []


def test_groups_come_in_pages(stored: Stored) -> None:
    whole = stored.ask("/v1/summary", group_by="magnitude,n", grid=stored.grids[:2])["rows"]
    found, address = [], f"/v1/summary?group_by=magnitude,n&limit=2&grid={stored.grids[0]}&grid={stored.grids[1]}"
    while address:
        page = stored.ask(address)
        found += page["rows"]
        address = page["next"]
    assert found == whole
    assert len(found) > 2


def test_numbers_have_six_digits(stored: Stored) -> None:
    for row in stored.ask("/v1/summary")["rows"]:
        for value in (row["bias"]["mean"], row["bias"]["standard_error"], row["bias"]["pull"]["scatter"]):
            assert value == float(f"{value:.6g}")


@pytest.mark.parametrize("against", ["arc_magnitude", "agn_contrast"])
def test_a_trend_is_numpy_s_in_each_bin(stored: Stored, against: str) -> None:
    answer = stored.ask("/v1/trends", against=against, bins=3, group_by="system")
    TrendAnswer.model_validate(answer)
    usable = [
        one
        for one in stored.known
        if getattr(one.payload, against) is not None and (value := one.value()) is not None and value.truth is not None
    ]
    x = np.array([getattr(one.payload, against) for one in usable])
    edges = np.linspace(x.min(), x.max(), 4)
    seen = 0
    for series in answer["series"]:
        for found in series["bins"]:
            (number,) = np.flatnonzero(np.isclose(edges[:-1], found["low"], rtol=1e-5))
            last = number == 2
            inside = (x >= edges[number]) & ((x < edges[number + 1]) | last)
            mine = [
                one
                for one, within in zip(usable, inside, strict=True)
                if within and one.inputs["system"] == series["group"]["system"]
            ]
            assert_statistics(found["bias"], mine, "magnitude", "image_wide")
            assert found["centre"] == pytest.approx(np.mean([getattr(one.payload, against) for one in mine]), rel=1e-5)
            seen += len(mine)
    assert seen == len(usable)


def observation(one: Known) -> str:
    return str(sorted((name, value) for name, value in one.lease.spec.items() if name != "analysis"))


def assert_differences(row: dict[str, Any], pairs: list[tuple[float, float, float | None, str]]) -> None:
    off = np.array([left - right for left, right, _, _ in pairs])
    judged = [abs(left - truth) < abs(right - truth) for left, right, truth, _ in pairs if truth is not None]
    assert row["pairs"] == len(pairs) > 1
    assert row["mean"] == pytest.approx(off.mean(), rel=6e-6, abs=1e-12)
    assert row["standard_error"] == pytest.approx(standard_error(off, [pair[3] for pair in pairs]), rel=6e-6)
    assert row["scatter"] == pytest.approx(np.std(off, ddof=1), rel=6e-6)
    assert row["left_closer"]["fraction"] == pytest.approx(np.mean(judged), rel=1e-5)


def test_profiles_are_compared_on_the_same_observations(stored: Stored) -> None:
    answer = stored.ask("/v1/comparison", compare="profile", left="draft", right="standard")
    ComparisonAnswer.model_validate(answer)
    sides: dict[str, dict[str, Known]] = {"draft": {}, "standard": {}}
    for one in stored.known:
        if one.value() is not None:
            sides[str(one.payload.profile)][observation(one)] = one
    pairs = []
    for key in sides["draft"].keys() & sides["standard"].keys():
        left, right = (sides[name][key].value() for name in ("draft", "standard"))
        assert left is not None
        assert right is not None
        truth = None if left.truth is None or right.truth is None else left.truth
        who = str(sorted((sides["draft"][key].inputs | {"seed": 0}).items()))
        pairs.append((left.mean, right.mean, truth, who))
    (row,) = answer["rows"]
    assert_differences(row, pairs)


def test_estimators_are_compared_run_by_run(stored: Stored) -> None:
    query = {"compare": "estimator", "left": "image", "right": "paper", "group_by": "system", "profile": "draft"}
    answer = stored.ask("/v1/comparison", **query)
    assert [row["group"]["system"] for row in answer["rows"]] == ["HE0435", "HE1104"]
    for row in answer["rows"]:
        pairs = []
        for one in stored.known:
            left, right = one.value(), one.value(name="paper_wide")
            is_mine = one.payload.profile == "draft" and one.inputs["system"] == row["group"]["system"]
            if is_mine and left is not None and right is not None:
                pairs.append((left.mean, right.mean, left.truth, str(sorted((one.inputs | {"seed": 0}).items()))))
        assert_differences(row, pairs)


def test_results_page_through_all_grids_with_every_number(stored: Stored) -> None:
    found, address = {}, "/v1/results?limit=4&estimator=all"
    while address:
        page = stored.ask(address)
        ResultPage.model_validate(page)
        found |= {item["run_id"]: item for item in page["items"]}
        address = page["next"]
    assert list(found) == sorted(one.lease.run_id for one in stored.known)
    for one in stored.known:
        item = found[one.lease.run_id]
        assert set(item) == set(page["columns"])
        assert item["realization_digest"] == one.lease.digest
        assert {name: item[name] for name in one.inputs} == one.inputs
        assert (item["arc_magnitude"], item["chi2"]) == (one.payload.arc_magnitude, one.payload.chi2)
        for name in ESTIMATES:
            value = one.value("r_eff", name)
            expected = (None, None, None) if value is None else (value.mean, value.sd, value.bias)
            assert tuple(item[f"{name}_r_eff_{part}"] for part in ("mean", "sd", "bias")) == expected


def test_one_estimator_s_columns_have_no_prefix(stored: Stored) -> None:
    page = stored.ask("/v1/results", estimator="paper", index_prior="fixed", system="HE1104")
    assert len(page["items"]) == sum(one.inputs["system"] == "HE1104" for one in stored.known)
    by_id = {one.lease.run_id: one for one in stored.known}
    for item in page["items"]:
        value = by_id[item["run_id"]].value("magnitude", "paper_fixed")
        assert value is not None
        assert (item["magnitude_mean"], item["magnitude_bias"]) == (value.mean, value.bias)
    assert page["columns"]["r_eff_mean"]["unit"] == "arcsec"
    assert all(column["description"] for column in page["columns"].values())


def test_a_stream_of_rows_begins_after_a_run_and_has_the_types_it_says(stored: Stored) -> None:
    columns = result_columns(("image_wide",))
    ids = sorted(one.lease.run_id for one in stored.known)
    with stored.database.read() as connection:
        rows = list(result_rows(connection, ResultFilter(), ("image_wide",), columns, after=ids[2]))
    assert [row[0] for row in rows] == ids[3:]
    for row in rows:
        for column, value in zip(columns, row, strict=True):
            assert value is None or type(value) is column.kind, column.name
    assert {column.name for column in columns} >= {"magnitude_mean", "lens_theta_e_truth", "cpu_s"}


@pytest.mark.parametrize(
    ("address", "parameter", "told"),
    [
        ("/v1/summary?group_by=taste", "group_by", "configuration"),
        ("/v1/summary?group_by=system,system", "group_by", "each once"),
        ("/v1/summary?taste=sweet", "taste", "known are"),
        ("/v1/summary?quantity=colour", "quantity", "magnitude"),
        ("/v1/summary?estimator=colour", "estimator", "image"),
        ("/v1/summary?magnitude=bright", "magnitude", "20..22"),
        ("/v1/summary?magnitude=22..20", "magnitude", "20..22"),
        ("/v1/summary?magnitude=..", "magnitude", "20..22"),
        ("/v1/summary?magnitude=nan", "magnitude", "20..22"),
        ("/v1/summary?estimator=image&estimator=paper", "estimator", "more than once"),
        ("/v1/trends?against=colour", "against", "arc_magnitude"),
        ("/v1/trends?against=arc_magnitude&bins=0", "bins", "1"),
        ("/v1/comparison?compare=colour&left=a&right=b", "compare", "profile"),
        ("/v1/comparison?compare=estimator&left=a&right=image", "left", "covariance"),
        ("/v1/comparison?compare=profile&left=a&right=b&profile=c", "profile", "no filter"),
        ("/v1/results?cursor=r_1", "cursor", "r_"),
        ("/v1/results?limit=1_0", "limit", "plain digits"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_what_can(stored: Stored, address: str, parameter: str, told: str) -> None:
    problem = stored.ask(address, status=422)
    (place,) = problem["errors"]
    assert (place["in"], place["pointer"]) == ("query", parameter)
    assert told in place["message"]


def test_without_results_every_answer_is_empty(sqlite_url: str, tmp_path: Path) -> None:
    with TestClient(create_app(Settings(database_url=sqlite_url, data_dir=tmp_path))) as client:
        assert client.get("/v1/summary").json()["rows"] == []
        assert client.get("/v1/trends?against=arc_magnitude").json()["series"] == []
        assert client.get("/v1/comparison?compare=profile&left=draft&right=paper").json()["rows"] == []
        assert client.get("/v1/results").json()["items"] == []


def test_numbers_are_read_as_they_are_stored(stored: Stored) -> None:
    from sqlalchemy import select

    columns = (estimate.c.input_id, estimate.c.magnitude_bias, estimate.c.r_eff_sd)
    with stored.database.read() as connection:
        plain = [
            tuple(math.nan if value is None else value for value in row) for row in connection.execute(select(*columns))
        ]
        found = read_numbers(connection, select(*columns))
    assert np.isnan(found).any()
    assert np.array_equal(np.sort(np.array(plain), axis=0), np.sort(found, axis=0), equal_nan=True)


finite = st.floats(-1e3, 1e3)


@given(st.lists(st.tuples(finite, st.integers(0, 3), st.integers(0, 2)), max_size=60))
def test_moments_of_groups_are_numpy_s(rows: list[tuple[float, int, int]]) -> None:
    values = np.array([row[0] for row in rows], dtype=float)
    groups, clusters = (np.array([row[part] for row in rows], dtype=np.intp) for part in (1, 2))
    found = moments(values, groups, 4, clusters)
    inside = share(values > 0.0, groups, found.number)
    for group in range(4):
        mine = values[groups == group]
        assert found.number[group] == len(mine)
        if not len(mine):
            assert np.isnan([found.mean[group], found.median[group], inside.fraction[group], inside.low[group]]).all()
            continue
        # Rounding of sums of numbers up to a thousand.
        close = {"rel": 1e-9, "abs": 1e-9}
        assert found.mean[group] == pytest.approx(mine.mean(), **close)
        assert [found.median[group], found.p16[group], found.p84[group]] == pytest.approx(
            np.percentile(mine, [50, 16, 84]), **close
        )
        if len(mine) > 1:
            assert found.scatter[group] == pytest.approx(np.std(mine, ddof=1), **close)
            names = [str(one) for one in clusters[groups == group]]
            assert found.error[group] == pytest.approx(standard_error(mine, names), rel=1e-6, abs=1e-6)
        low, high = wilson(int((mine > 0.0).sum()), len(mine))
        assert (inside.low[group], inside.high[group]) == pytest.approx((low, high), rel=1e-6, abs=1e-6)
        assert 0.0 <= inside.low[group] <= inside.fraction[group] <= inside.high[group] <= 1.0


numbers = st.sampled_from([1.0, 2.0, 20.5, 22.0])
ranges = st.one_of(numbers.map(str), st.tuples(numbers, numbers).map(lambda two: f"{min(two)}..{max(two)}"))


@given(
    magnitude=st.lists(ranges, max_size=3),
    profile=st.lists(st.sampled_from(["draft", "standard", "none"]), max_size=3),
)
def test_a_filter_takes_of_failed_runs_what_it_takes_of_results(magnitude: list[str], profile: list[str]) -> None:
    from sqlalchemy import create_engine, insert, select

    from service.store.tables import input_group

    where = ResultFilter.read({"magnitude": magnitude, "profile": profile})
    values = [
        {"magnitude": bright, "profile": name} for bright in (1.0, 2.0, 20.5, 21.0) for name in ("draft", "paper", None)
    ]
    engine = create_engine("sqlite://")
    rest = {
        column.name: "x" if str(column.type).startswith("VARCHAR") else 1.0
        for column in input_group.columns
        if column.name not in {"id", "magnitude", "profile"}
    }
    with engine.begin() as connection:
        input_group.create(connection)
        rows = [{**rest, **one, "id": place, "digest": str(place)} for place, one in enumerate(values)]
        connection.execute(insert(input_group), rows)
        condition = where.conditions()
        wanted = select(input_group.c.id)
        found = set(connection.scalars(wanted if condition is None else wanted.where(condition)))
    assert found == {place for place, one in enumerate(values) if where.accepts(one)}


def test_a_link_to_results_repeats_the_question(stored: Stored) -> None:
    answer = stored.ask("/v1/summary", group_by="r_eff", system=["HE0435", "HE1104"], profile="draft")
    link = urlsplit(answer["rows"][0]["links"]["results"])
    assert set(parse_qsl(link.query)) >= {("system", "HE0435"), ("system", "HE1104"), ("profile", "draft")}
