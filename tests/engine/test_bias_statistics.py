"""What many biases say together: numbers, coverage, pulls and trends, and that their figures show them."""

import numpy as np
import pytest
from scipy.stats import binomtest, norm

from engine import (
    Grid,
    Host,
    Realization,
    bias_points,
    configuration_of,
    coverage_curve,
    expand,
    group_points,
    pull_summary,
    serial_numbers,
    trend_series,
)
from engine.biases import ONE_SIGMA, TRENDS, pulls
from engine.figures import (
    coverage_figure,
    pull_figure,
    trend_figure,
)
from engine.result import ChainSummary, Estimate, Quantity, RunResult
from engine.work import Work
from tests.engine.bias_records import (
    bands,
    bars,
    lines,
    paper_grid,
    point,
    sample,
    texts,
)


def test_serial_numbers_of_a_whole_grid_are_those_of_the_papers_table():
    runs = expand(Grid(preset="h0licow-vi/RXJ1131"))
    points = [
        point(n=r.realization.host.n, r_eff=r.realization.host.r_eff, l_eta=r.realization.l_eta,
              magnitude=r.realization.host.magnitude)
        for r in runs
    ]  # fmt: skip
    numbers = serial_numbers(points)
    assert [numbers[p.setting] for p in points] == [(run.paper_run - 1) % 12 + 1 for run in runs]


def test_a_pull_is_the_bias_over_what_the_run_states():
    some = [point(0.1, 0.05), point(-0.3, 0.1), point(0.2, 0.0), point(-0.2, 0.0), point(0.0, 0.0)]
    np.testing.assert_allclose(pulls(some, "magnitude"), [2.0, -3.0, np.inf, -np.inf, 0.0], rtol=1e-9)
    found = pull_summary("x", some, "magnitude")
    assert (found.below, found.above, found.counts.sum(), found.count) == (1, 1, 3, 5)


def test_stated_errors_that_are_right_are_covered_as_claimed_and_wrong_ones_are_not():
    rng = np.random.default_rng(11)
    right = [point(float(x), 0.1) for x in rng.normal(0.0, 0.1, 4000)]
    curve = coverage_curve("right", right, "magnitude")
    # Four deviations of a binomial, at eleven levels that go together.
    assert np.all(np.abs(curve.actual - curve.claimed) < 4 * np.sqrt(curve.claimed * (1 - curve.claimed) / 4000))
    small = coverage_curve("small", [point(float(x), 0.05) for x in rng.normal(0.0, 0.1, 4000)], "magnitude")
    level = int(np.argmin(np.abs(small.claimed - ONE_SIGMA)))
    assert small.actual[level] == pytest.approx(2 * norm.cdf(0.5) - 1, abs=0.03)  # half a deviation
    summary = pull_summary("right", right, "magnitude")
    np.testing.assert_allclose((summary.low, summary.median, summary.high), (-1.0, 0.0, 1.0), atol=0.08)


def test_binomial_errors_are_wilsons():
    curve = coverage_curve("x", [point(0.1 * k, 0.1) for k in range(7)], "magnitude")
    for inside, low, high in zip(curve.inside, *curve.interval, strict=True):
        expected = binomtest(int(inside), 7).proportion_ci(ONE_SIGMA, method="wilson")
        assert (low, high) == (pytest.approx(expected.low, abs=1e-9), pytest.approx(expected.high, abs=1e-9))


def test_coverage_is_drawn_at_its_claims_with_binomial_bars_beside_the_diagonal():
    curves = [
        coverage_curve(name, paper_grid((prior,)), "magnitude") for name, prior in (("a", "free"), ("b", "fixed"))
    ]
    figure = coverage_figure(curves, "magnitude", heading="My grid")
    axes = figure.axes[0]
    for place, curve in enumerate(curves):
        line = lines(axes)[f"coverage-{place}"]
        np.testing.assert_allclose(line.get_xdata(), curve.claimed, atol=0.01)
        np.testing.assert_array_equal(line.get_ydata(), curve.actual)
        np.testing.assert_allclose(bars(axes)[line.get_gid()], np.ptp(curve.interval, axis=0) / 2, atol=1e-9)
    looks = {(line.get_color(), line.get_marker(), line.get_linestyle()) for line in lines(axes).values()}
    assert len(looks) == 2
    assert any(np.array_equal(line.get_xydata(), [[0, 0], [1, 1]]) for line in axes.lines)
    assert {"a, 48 runs", "b, 48 runs", "as claimed", "My grid"} <= set(texts(figure))


def test_pulls_are_a_histogram_of_all_beside_the_unit_normal_and_the_middle_of_each_group():
    groups = [pull_summary(k, v, "magnitude") for k, v in group_points(sample(), "system").items()]
    figure = pull_figure(groups, "magnitude")
    left, right = figure.axes
    [steps] = [patch for patch in left.patches if patch.get_gid() == "pulls"]
    np.testing.assert_array_equal(steps.get_data().values, np.sum([g.counts for g in groups], axis=0))
    x, y = lines(left)["unit-normal"].get_data()
    # As many runs, in bins of half a unit; 3e-7 of a normal lies beyond five deviations.
    assert np.trapezoid(y, x) == pytest.approx(0.5 * sum(g.count for g in groups), rel=1e-4)
    for place, group in enumerate(groups):
        np.testing.assert_allclose(lines(right)[f"range-{place}"].get_xdata(), np.clip((group.low, group.high), -5, 5))
        assert lines(right)[f"median-{place}"].get_xdata()[0] == pytest.approx(np.clip(group.median, -5, 5))
    assert [label.get_text() for label in right.get_yticklabels()] == [f"{g.name} ({g.count})" for g in groups]


def test_a_median_beyond_the_panel_stands_at_its_edge_with_its_value():
    figure = pull_figure([pull_summary("x", [point(2.0, 0.1)] * 3, "magnitude")], "magnitude")
    assert lines(figure.axes[1])["median-0"].get_xdata()[0] == 5.0
    assert "median 20" in texts(figure)
    endless = pull_figure([pull_summary("x", [point(2.0, 0.0)] * 3, "magnitude")], "magnitude")
    assert "median ∞" in texts(endless)


def test_trends_are_means_of_bins_with_the_error_of_the_mean():
    placed = [(18.1, 0.1), (18.4, 0.3), (18.3, 0.2), (19.7, 0.5)]
    some = [point(bias, 0.07, arc_magnitude=x) for x, bias in placed]
    series = trend_series("x", some, "magnitude", "arc_magnitude")
    assert [(b.lower, b.upper, b.spread.count) for b in series.bins] == [(18.0, 18.5, 3), (19.5, 20.0, 1)]
    first, second = series.bins
    assert (first.centre, first.spread.mean) == (pytest.approx(54.8 / 3), pytest.approx(0.2))
    assert first.spread.error == pytest.approx(0.1 / np.sqrt(3))
    assert second.spread.error == pytest.approx(0.07)  # a single run has only what it states
    figure = trend_figure([series])
    line = lines(figure.axes[0])["trend-arc_magnitude-0"]
    np.testing.assert_allclose(line.get_xydata(), [(54.8 / 3, 0.2), (19.7, 0.5)])
    np.testing.assert_allclose(bars(figure.axes[0])[line.get_gid()], [0.1 / np.sqrt(3), 0.07])
    assert [text.get_text() for text in figure.axes[0].texts] == ["3", "1"]


def test_trends_have_a_panel_for_each_abscissa_and_leave_out_what_has_none():
    series = [
        trend_series(name, some, "magnitude", against)
        for against in TRENDS
        for name, some in group_points(sample(), "configuration").items()
    ]
    figure = trend_figure(series, heading="My grid")
    assert [axes.get_xlabel() for axes in figure.axes] == [
        "host arc in the image plane [AB mag]",
        "AGN \N{MINUS SIGN} host arc [mag]",
        "host surface brightness [mag arcsec⁻²]",
    ]
    quads = [one for one in series if one.name == "quad"]
    counts = {one.against: sum(b.spread.count for b in one.bins) for one in quads}
    assert counts == {"arc_magnitude": 24, "agn_contrast": 12, "surface_brightness": 24}
    assert all(set(bands(axes)) == {"band-0.5", "band-1.25"} for axes in figure.axes)
    assert not bands(trend_figure([trend_series("x", sample(), "n", "arc_magnitude")]).axes[0])


@pytest.mark.parametrize(("images", "name"), [(2, "double"), (4, "quad"), (3, "other"), (0, "other")])
def test_a_lens_is_a_quad_or_double_by_its_agn_images(images, name):
    assert configuration_of(images) == name


def test_points_of_a_result_have_every_estimate_with_its_truth():
    spec = Realization(system="HE0435", l_eta=1.2, host=Host(n=4.0, r_eff=0.39, magnitude=21.5), seed=3)
    known = Quantity(1.1, 0.1, 1.0)
    names = ("magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y")
    counts = dict.fromkeys(("at_bound", "n_at_bound", "r_eff_at_bound", "failed"), 0)
    estimates = tuple(
        Estimate(estimator, prior, **dict.fromkeys(names, known), draws=30, **counts)
        for estimator, prior in (("image", "wide"), ("paper", "free"))
    )
    result = RunResult(
        realization_digest="d", engine_digest="e", versions={}, seed=3, noise_level="author", noise_treatment="boost",
        regularisation="curvature", estimates=estimates, aperture=None, lens=(),
        chain=ChainSummary("converged", 8, 10, 1, 1.0, 10.0, 0.3, 80), ln_evidence=0.0, chi2=1.0,
        degrees_of_freedom=1, condition_number=1.0, arc_magnitude=18.5, agn_contrast=-1.5, surface_brightness=20.5,
        stages=(), work=Work(),
    )  # fmt: skip
    first, second = bias_points("r7", spec, result)
    assert (first.system, first.configuration, first.setting[:3], first.magnitude) == (
        "HE0435",
        "quad",
        (1.2, 0.39, 4.0),
        21.5,
    )
    assert (first.estimator, first.index_prior, first.seed, first.run_id) == ("image", "wide", 3, "r7")
    assert (second.estimator, second.index_prior) == ("paper", "free")
    assert first.bias("position_angle") == pytest.approx(0.1)
    assert (first.arc_magnitude, first.agn_contrast, first.surface_brightness) == (18.5, -1.5, 20.5)
