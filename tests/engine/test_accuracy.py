"""The report of speed against error: its front, its references, and what the committed one says of the defaults."""

from __future__ import annotations

import ast
import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import engine
from engine import (
    ACCURACY_STAGES,
    AccuracyReport,
    SpecError,
    accuracy_markdown,
    accuracy_page,
    hardest_realization,
    measure_accuracy,
    report_from_dict,
    system_names,
)
from engine.accuracy.curves import Curve, Knob, Point, Refusal, beats, by_knob, pareto_front
from engine.accuracy.deflection import shell_deflection
from engine.accuracy.importance import importance_sample
from engine.accuracy.psf import with_wavelengths
from engine.accuracy.report import accuracy_knobs
from engine.accuracy.timing import Measuring
from engine.catalogue import load_camera
from engine.errors import AccuracyError, ObservationError, PosteriorError
from engine.figures import accuracy_figure
from engine.lensing.power_law import PowerLawLens, deflection
from engine.posterior.optimum import Laplace
from tests.docs.pages import ROOT
from tests.sources import parsed

KNOB = Knob("stage", "knob", "place", "quantity", "unit", "work", "reference", "Because.")
AGAIN = "write it anew: python -m benchmarks.accuracy_report --write"
COMMITTED = ROOT / "docs" / "tables" / "speed_against_error.json"


def point(cost: float, error: float, setting: str = "", *, default: bool = False, peer: str | None = None) -> Point:
    return Point(setting or f"{cost} {error}", cost, error, default, peer)


POINTS = st.lists(st.builds(point, st.floats(1e-6, 1e3), st.floats(0.0, 1e3)), min_size=1, max_size=20)


@given(POINTS, st.floats(0.0, 10.0))
def test_nothing_beats_a_point_of_the_front_and_something_beats_any_other(points: list[Point], floor: float) -> None:
    front = pareto_front(points, floor)
    assert front
    for one in points:
        assert (one in front) != any(beats(other, one, floor) for other in points)
    assert [one.cost for one in front] == sorted(one.cost for one in front)


def test_a_point_is_beaten_by_less_cost_or_less_error_that_can_be_told_apart() -> None:
    usual = point(1.0, 1.0)
    assert beats(point(0.5, 1.0), usual, 0.0)
    assert beats(point(1.0, 0.5), usual, 0.0)
    assert not beats(point(0.95, 1.0), usual, 0.0)
    assert not beats(point(0.5, 1.01), usual, 0.0)
    # Below what the reference can tell all errors are alike.
    assert not beats(point(1.0, 0.5), usual, 2.0)
    assert beats(point(0.5, 1.9), usual, 2.0)


def test_peers_are_not_on_our_front_and_do_not_beat_us() -> None:
    curve = Curve(KNOB, 0.0, (point(1.0, 1.0, default=True), point(0.1, 0.1, peer="lenstronomy")))
    assert curve.front() == (curve.default,)
    assert curve.default_on_front


def test_a_curve_has_one_default_that_gives_an_answer() -> None:
    for points in ((), (point(1.0, 1.0),), (point(1.0, 1.0, default=True), point(2.0, 1.0, default=True))):
        with pytest.raises(AccuracyError, match="one that gives an answer"):
            Curve(KNOB, 0.0, points)


def test_a_setting_that_the_engine_refuses_is_told_and_not_measured() -> None:
    def refuse() -> tuple[float, float]:
        raise ObservationError("pixfrac: too small")

    found = Measuring(KNOB)
    found.add("usual", lambda: (1.0, 1.0), default=True)
    found.add("small", refuse)
    assert found.curve().refused == (Refusal("small", "pixfrac: too small"),)
    assert "| small |  | refused | pixfrac: too small |" in accuracy_markdown(AccuracyReport("S", "", (found.curve(),)))


def some_report(system: str) -> AccuracyReport:
    points = (point(1.0, 1.0, "a", default=True), point(0.5, 0.5, "b"), point(9.0, 0.0, "c", peer="lenstronomy"))
    curve = Curve(KNOB, 1e-3, points, (Refusal("d", "why"),))
    return AccuracyReport(system, "scene", (curve,), ("PyAutoLens",), (Refusal("draws", "no fit"),))


def test_a_report_comes_back_from_json() -> None:
    report = some_report("S")
    document = json.loads(json.dumps(report.to_dict()))
    assert report_from_dict(document) == report
    ratios = [found["ratio"] for found in document["curves"][0]["points"]]
    assert ratios == [1.0, 0.5, 9.0]


def test_a_page_of_several_systems_says_where_the_default_is_beaten_and_why() -> None:
    page = accuracy_page([some_report("S1"), some_report("S2")])
    assert "| **a** | 1 | 1 | 1 | 0 of 2 |" in page
    assert "| b | 0.5 | 0.5 | 0.5 | 2 of 2 |" in page
    assert "off the front in S1, S2. Because." in page
    assert "Not measured in S2: draws: no fit." in page
    assert "PyAutoLens is not installed here." in accuracy_markdown(some_report("S1"))


@pytest.mark.parametrize("systems", [("S1",), ("S1", "S2")])
def test_the_figure_circles_each_default_and_shows_peers(systems: tuple[str, ...]) -> None:
    figure = accuracy_figure([some_report(system) for system in systems])
    (axes,) = [found for found in figure.axes if found.has_data()]
    circles = [line for line in axes.lines if line.get_markersize() == 11]
    assert [line.get_xydata().tolist() for line in circles] == [[[1.0, 1.0]]] * len(systems)
    peers = [line.get_xydata().tolist() for line in axes.lines if line.get_marker() == "P"]
    # An error of nothing is drawn at what the reference can tell.
    assert peers == [[[9.0, 1e-3]]] * len(systems)


@pytest.mark.parametrize(("q", "slope"), [(0.85, 2.0), (0.3, 1.3), (0.6, 2.7), (1.0, 2.2)])
def test_the_integral_over_shells_is_the_deflection(q: float, slope: float) -> None:
    """Two ways that share no formula agree to rounding of the quadrature."""
    lens = PowerLawLens(1.3, q, 0.4, slope, 0.02, -0.03, 0.05, -0.02)
    x, y = np.random.default_rng(0).uniform(-2.5, 2.5, (2, 20))
    for theirs, ours in zip(shell_deflection(lens, x, y), deflection(lens, x, y), strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-12)


class Normal:
    """A target that is the normal density of a mean and standard deviations."""

    mean, sd = np.array([1.0, -2.0]), np.array([0.5, 3.0])

    def many(self, points: np.ndarray) -> np.ndarray:
        return -0.5 * (((points - self.mean) / self.sd) ** 2).sum(axis=1)


def test_importance_sampling_finds_a_posterior_from_an_approximation_that_is_off() -> None:
    target: Any = Normal()
    # One deviation beside the mean, and twice as narrow.
    start = Laplace(target.mean + target.sd, np.diag((0.5 * target.sd) ** 2), 0.0, 1)
    found = importance_sample(target, start)
    assert found.effective > 500.0
    # Four standard errors of 500 independent draws.
    assert np.abs((found.mean - target.mean) / target.sd).max() < 4.0 / math.sqrt(500.0)
    assert np.abs(found.sd / target.sd - 1.0).max() < 4.0 / math.sqrt(1000.0)
    exact = np.random.default_rng(1).normal(target.mean, target.sd, (100_000, 2))
    assert found.distance(exact) < 3.0 * found.error
    assert found.distance(exact + target.sd) > 0.5
    drawn = found.draws(2000, np.random.default_rng(0))
    assert np.abs((drawn.mean(axis=0) - target.mean) / target.sd).max() < 0.2


def test_importance_sampling_far_from_the_posterior_is_no_reference() -> None:
    target: Any = Normal()
    with pytest.raises((AccuracyError, PosteriorError)):
        importance_sample(target, Laplace(target.mean + 60.0 * target.sd, np.diag((1e-3 * target.sd) ** 2), 0.0, 1))


def test_other_wavelengths_cover_the_same_band() -> None:
    camera = load_camera("WFC3-UVIS_F814W")
    table = np.asarray(camera.wavelength_nm)
    width = float(np.gradient(table).sum())
    for number in (2, 10, 100):
        step = np.diff(with_wavelengths(camera, number).wavelength_nm).mean()
        assert number * step == pytest.approx(width, rel=1e-9)


def test_a_stage_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(SpecError, match="stage: got 'none', allowed is one of deflection, rendering"):
        measure_accuracy(hardest_realization("HE0435"), ["none"])


def test_one_stage_is_measured_alone_with_the_same_errors_again() -> None:
    told: list[str] = []
    realization = hardest_realization("HE0435")
    first = measure_accuracy(realization, ["deflection"], told.append)
    assert told == ["deflection"]
    (curve,) = first.curves
    assert curve.default.error < 1e-14
    again = measure_accuracy(realization, ["deflection"]).curves[0]
    assert [found.error for found in again.points] == [found.error for found in curve.points]
    ours = [found.error for found in curve.points if found.peer is None]
    assert ours == sorted(ours, reverse=True)
    assert [found.peer for found in curve.points if found.peer] == ["lenstronomy"] * 2


def test_no_result_depends_on_the_report() -> None:
    """The digest of the engine leaves the package out, so that nothing that computes may import it."""
    root = Path(engine.__file__).parent
    for path in root.rglob("*.py"):
        if path.parts[-2] in ("accuracy", "figures") or path == root / "__init__.py":
            continue
        for node in ast.walk(parsed(path)):
            assert not (isinstance(node, ast.ImportFrom) and str(node.module).startswith("engine.accuracy")), path


# What the committed report says.


def committed() -> list[AccuracyReport]:
    return [report_from_dict(entry) for entry in json.loads(COMMITTED.read_text())["systems"]]


def test_the_report_has_every_knob_of_every_stage_in_every_system() -> None:
    reports = committed()
    measured = [report.system for report in reports]
    left = [system for system in system_names() if system not in measured]
    assert measured == [system for system in system_names() if system not in left]
    told = COMMITTED.with_suffix(".md").read_text()
    assert (f"Not measured yet: {', '.join(left)}." in told) == bool(left)
    wanted = Counter((knob.stage, knob.name) for knob in accuracy_knobs())
    for report in reports:
        assert Counter((curve.knob.stage, curve.knob.name) for curve in report.curves) == wanted, report.system
    assert tuple(dict.fromkeys(knob.stage for knob in accuracy_knobs())) == ACCURACY_STAGES


@pytest.mark.parametrize("knob", accuracy_knobs(), ids=lambda knob: f"{knob.stage}: {knob.name}")
def test_each_default_is_on_the_front_or_has_its_sentence(knob: Knob) -> None:
    """And no sentence stands where none is needed."""
    found = by_knob(committed())[knob.stage, knob.name]
    off = [system for system, curve in found if not curve.default_on_front]
    assert bool(off) == bool(knob.why_off_front), (off, knob.why_off_front)
    assert knob.why_off_front == "" or knob.why_off_front.endswith(".")


def test_the_page_is_made_of_the_data() -> None:
    """Sentences and descriptions are those of the code, numbers those of the data."""
    described = {(knob.stage, knob.name): knob for knob in accuracy_knobs()}
    for report in committed():
        for curve in report.curves:
            assert curve.knob == described[curve.knob.stage, curve.knob.name], AGAIN
    assert COMMITTED.with_suffix(".md").read_text().endswith(accuracy_page(committed())), AGAIN


def error_of(curve: Curve, setting: str, peer: str | None = None) -> float:
    return next(found.error for found in curve.points if (found.setting, found.peer) == (setting, peer))


def measured(name: str) -> dict[str, Curve]:
    return {report.system: curve for report in committed() for curve in report.curves if curve.knob.name == name}


def test_rendering_and_psf_are_as_the_documentation_says() -> None:
    """docs/explanation/accuracy.md, speed against error."""
    for curve in measured("pixel integration").values():
        assert curve.default.error < 3e-3
        theirs = [found for found in curve.points if found.peer and found.setting == "4 x 4"]
        assert theirs
        for found in theirs:
            assert found.error > 10 * curve.default.error
            assert curve.ratio(found) > 5
    waves = {system: curve.default.error for system, curve in measured("PSF wavelengths").items()}
    assert waves["HE0435"] == pytest.approx(0.05, abs=0.01)
    assert waves["HS2209"] == pytest.approx(0.5, abs=0.05)
    assert max(waves.values()) == waves["HS2209"]
    assert max(curve.default.error for curve in measured("PSF pupil grid").values()) < 0.12
    assert max(curve.default.error for curve in measured("PSF stamp").values()) < 0.012


def test_inversion_and_chain_are_as_the_documentation_says() -> None:
    for curve in measured("noise covariance band").values():
        assert error_of(curve, "diagonal") > 0.2
        assert curve.default.error < 1e-9
    grids = measured("source grid")
    for system, curve in grids.items():
        assert curve.default.error < error_of(curve, "15 x 15") * (1.02 if system == "SDSS0246" else 1.0)
        thirds = error_of(curve, "30 x 30") < 0.4 * curve.default.error
        assert thirds == (system in ("HE1104", "SDSS1206", "RXJ1131")), system
    for curve in measured("ray margin").values():
        assert error_of(curve, "2") < 1.015 * curve.default.error
    for curve in measured("chain length").values():
        assert curve.default.error < 0.06
        assert error_of(curve, "30 tau") < 0.08
    for curve in measured("draws").values():
        assert curve.default.error < 0.03
