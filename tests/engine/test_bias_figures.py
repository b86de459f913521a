"""Figures of biases show what was handed in: each point where its record says, with the paper's symbols and bands."""

import hashlib
import io
import itertools
import random
import subprocess
import sys
import threading
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from scipy.stats import binomtest, norm

from engine import (
    BiasPoint,
    FigureError,
    Grid,
    Host,
    NothingToShowError,
    Realization,
    bias_points,
    configuration_of,
    coverage_curve,
    expand,
    group_points,
    mean_bias,
    pull_summary,
    serial_numbers,
    trend_series,
)
from engine.biases import ONE_SIGMA, TRENDS, pulls
from engine.figures import (
    Pictures,
    Thumbnail,
    bias_figure,
    coverage_figure,
    figure_bytes,
    grid_figure,
    pull_figure,
    sample_figure,
    trend_figure,
)
from engine.figures.style import shades
from engine.result import ChainSummary, Estimate, Quantity, RunResult

MAGNITUDES = (21.0, 21.5, 22.0, 22.5)
SLOPES, RADII, INDICES = (0.8, 1.0, 1.2), (0.39, 0.78), (2.0, 4.0)


def point(bias=0.1, sd=0.05, **changes) -> BiasPoint:
    """A point whose magnitude, radius and index are off by ``bias``, a tenth and twice of it."""
    given = {
        "run_id": "r1", "system": "HE1104", "configuration": "double", "n": 2.0, "r_eff": 0.39, "magnitude": 21.0,
        "l_eta": 1.0, "seed": 0, "estimator": "paper", "index_prior": "free", "arc_magnitude": 19.0,
        "agn_contrast": -2.0, "surface_brightness": 21.0, **changes,
    }  # fmt: skip
    fixed = given["index_prior"] == "fixed"
    recovered = {
        "magnitude": Quantity(given["magnitude"] + bias, sd, given["magnitude"]),
        "r_eff": Quantity(given["r_eff"] + 0.1 * bias, 0.1 * sd, given["r_eff"]),
        "n": Quantity(given["n"] + (0.0 if fixed else 2.0 * bias), 0.0 if fixed else 2.0 * sd, given["n"]),
    }
    return BiasPoint(recovered=recovered, **given)


def paper_grid(priors=("free", "fixed"), seeds=1) -> list[BiasPoint]:
    """A system's 48 inputs with biases drawn once and for all."""
    rng = np.random.default_rng(4)
    return [
        point(
            float(rng.normal(0.2, 0.2)), 0.05, run_id=f"r{number}s{seed}", magnitude=m, l_eta=slope, r_eff=r, n=n,
            index_prior=prior, seed=seed, arc_magnitude=m - 2.0,
        )
        for number, (m, slope, r, n) in enumerate(itertools.product(MAGNITUDES, SLOPES, RADII, INDICES))
        for seed in range(seeds)
        for prior in priors
    ]  # fmt: skip


def lines(axes) -> dict:
    return {line.get_gid(): line for line in axes.lines if line.get_gid()}


def bars(axes) -> dict:
    """Half-lengths of the error bars of each named series."""
    return {
        container.lines[0].get_gid(): np.array([np.ptp(s[:, 1]) / 2 for s in container.lines[2][0].get_segments()])
        for container in axes.containers
    }


def bands(axes) -> dict:
    spans = [patch for patch in axes.patches if (patch.get_gid() or "").startswith("band-")]
    return {
        patch.get_gid(): (patch.get_y(), patch.get_y() + patch.get_height(), patch.get_facecolor()) for patch in spans
    }


def texts(figure) -> list[str]:
    root = ET.fromstring(figure_bytes(figure, "svg"))  # noqa: S314 - our own
    return ["".join(node.itertext()) for node in root.iter("{http://www.w3.org/2000/svg}text")]


def test_serial_numbers_of_a_whole_grid_are_those_of_the_papers_table():
    runs = expand(Grid(preset="h0licow-vi/RXJ1131"))
    points = [
        point(n=r.realization.host.n, r_eff=r.realization.host.r_eff, l_eta=r.realization.l_eta,
              magnitude=r.realization.host.magnitude)
        for r in runs
    ]  # fmt: skip
    numbers = serial_numbers(points)
    assert [numbers[p.setting] for p in points] == [(run.paper_run - 1) % 12 + 1 for run in runs]


def test_every_run_has_its_point_at_its_serial_number_and_bias():
    points = paper_grid()
    figure = bias_figure(points)
    numbers = serial_numbers(points)
    for axes, quantity in zip(figure.axes, ("magnitude", "r_eff", "n"), strict=False):
        shown = lines(axes)
        priors = ("free",) if quantity == "n" else ("free", "fixed")
        assert set(shown) == {f"{quantity}-{prior}-{m:g}" for prior in priors for m in MAGNITUDES}
        for prior, magnitude in itertools.product(priors, MAGNITUDES):
            name = f"{quantity}-{prior}-{magnitude:g}"
            some = [p for p in points if (p.index_prior, p.magnitude) == (prior, magnitude)]
            x, y = shown[name].get_data()
            assert len(x) == len(some) == 12
            found = dict(zip(np.round(x).astype(int).tolist(), y, strict=True))
            assert found == pytest.approx({numbers[p.setting]: p.bias(quantity) for p in some})
            assert np.abs(x - np.round(x)).max() < 0.45  # within the number's own slot
            np.testing.assert_allclose(bars(axes)[name], [p.sd(quantity) for p in some], rtol=1e-9)


def test_within_a_number_bright_hosts_stand_left_of_faint_ones():
    axes = bias_figure(paper_grid()).axes[0]
    places = [lines(axes)[f"magnitude-free-{m:g}"].get_xdata()[0] for m in MAGNITUDES]
    assert places == sorted(places)


def test_circles_are_free_and_stars_fixed_both_filled_with_the_colour_of_the_magnitude():
    figure = bias_figure(paper_grid())
    for axes, quantity in zip(figure.axes, ("magnitude", "r_eff"), strict=False):
        for prior, marker in (("free", "o"), ("fixed", "*")):
            colours = []
            for magnitude in MAGNITUDES:
                line = lines(axes)[f"{quantity}-{prior}-{magnitude:g}"]
                assert (line.get_marker(), line.get_fillstyle()) == (marker, "full")
                assert line.get_markerfacecolor() == line.get_color()
                colours.append(line.get_color())
            assert colours == shades(4)


def test_the_papers_range_of_n_is_a_diamond_where_the_wide_one_is_there_too():
    both = lines(bias_figure(paper_grid(("wide", "free", "fixed"))).axes[0])
    markers = {prior: both[f"magnitude-{prior}-21"].get_marker() for prior in ("wide", "free", "fixed")}
    assert markers == {"wide": "o", "free": "D", "fixed": "*"}
    assert lines(bias_figure(paper_grid(("wide",))).axes[0])["magnitude-wide-21"].get_marker() == "o"


@pytest.mark.parametrize("count", [2, 4, 8])
def test_colours_of_magnitudes_grow_lighter_so_that_grey_tells_them_apart(count):
    lightness = [np.dot((0.2126, 0.7152, 0.0722), to_rgb(colour)) for colour in shades(count)]
    assert np.diff(lightness).min() > 0.4 / count


def test_bands_of_half_and_one_and_a_quarter_magnitude_lie_under_magnitudes_alone():
    panels = bias_figure(paper_grid()).axes[:4]
    for axes in (panels[0], panels[3]):
        found = bands(axes)
        assert {name: ends[:2] for name, ends in found.items()} == {"band-0.5": (-0.5, 0.5), "band-1.25": (-1.25, 1.25)}
        assert found["band-0.5"][2] != found["band-1.25"][2]
        low, high = axes.get_ylim()
        assert low < -1.25
        assert high > 1.25
    assert not bands(panels[1])
    assert not bands(panels[2])


def test_seeds_of_an_input_are_one_point_at_their_mean_with_their_scatter():
    points = paper_grid(seeds=4)
    figure = bias_figure(points)
    axes = figure.axes[0]
    some = [p for p in points if (p.index_prior, p.magnitude) == ("free", 22.0)]
    numbers, (x, y) = serial_numbers(points), lines(axes)["magnitude-free-22"].get_data()
    assert len(x) == 12
    for number, mean, bar in zip(np.round(x), y, bars(axes)["magnitude-free-22"], strict=True):
        biases = [p.bias("magnitude") for p in some if numbers[p.setting] == number]
        assert len(biases) == 4
        assert (mean, bar) == (pytest.approx(np.mean(biases)), pytest.approx(np.std(biases, ddof=1)))
    assert "scatter among seeds" in texts(figure)
    assert "stated standard deviation" in texts(bias_figure(paper_grid()))


def test_the_fourth_panel_has_the_mean_over_numbers_by_magnitude_slope_and_prior():
    points = paper_grid()
    axes = bias_figure(points).axes[3]
    shown = lines(axes)
    assert set(shown) == {f"summary-{prior}-{slope:g}" for prior in ("free", "fixed") for slope in SLOPES}
    for prior, slope in itertools.product(("free", "fixed"), SLOPES):
        line = shown[f"summary-{prior}-{slope:g}"]
        biases = [
            [p.bias("magnitude") for p in points if (p.index_prior, p.l_eta, p.magnitude) == (prior, slope, m)]
            for m in MAGNITUDES
        ]
        np.testing.assert_allclose(line.get_xdata(), MAGNITUDES, atol=0.25)  # beside one another, within half a step
        np.testing.assert_allclose(line.get_ydata(), [np.mean(b) for b in biases], rtol=1e-12)
        np.testing.assert_allclose(bars(axes)[line.get_gid()], [np.std(b, ddof=1) for b in biases], rtol=1e-9)
    by_slope = [shown[f"summary-free-{slope:g}"].get_marker() for slope in SLOPES]
    by_prior = [shown[f"summary-{prior}-1"] for prior in ("free", "fixed")]
    assert len(set(by_slope)) == 3
    assert by_prior[0].get_color() != by_prior[1].get_color()
    assert [line.get_fillstyle() for line in by_prior] == ["full", "left"]


def test_titles_axes_and_legend_name_things_with_their_units():
    figure = bias_figure(paper_grid(), heading="My grid")
    told = texts(figure)
    assert {"My grid", "HE1104: paper estimator, 48 runs"} <= set(told)
    assert [axes.get_xlabel() for axes in figure.axes[:4]] == [
        *["serial number of the configuration"] * 3, "magnitude of the host, true [AB mag]",
    ]  # fmt: skip
    assert [axes.get_ylabel().rpartition(" ")[2] for axes in figure.axes[:4]] == ["[mag]", "[arcsec]", "true", "[mag]"]
    assert {"21 mag", "21.5 mag", "22 mag", "22.5 mag", "±0.5 mag", "±1.25 mag"} <= set(told)
    assert told.count("n fixed to the truth") == told.count("n free in 1–4") == 2  # noqa: RUF001


@pytest.mark.parametrize("columns", [1, 2])
def test_the_table_under_the_panels_says_what_each_number_stands_for(columns):
    figure = bias_figure(paper_grid(), columns=columns)
    cells = {text.get_gid(): text.get_text() for text in figure.axes[4].texts if text.get_gid()}
    # The paper's Table 3: 6 is n 4, the small radius, l_eta 1; 11 is n 2, the large one, 1.2.
    assert [cells[f"serial-6-{row}"] for row in range(4)] == ["6", "4", "0.39", "1"]
    assert [cells[f"serial-11-{row}"] for row in range(4)] == ["11", "2", "0.78", "1.2"]
    assert len(cells) == 48


def test_a_grid_of_many_numbers_tells_their_order_instead_of_a_table():
    many = [point(n=n, l_eta=slope) for n in np.linspace(1.0, 4.0, 10) for slope in SLOPES]
    [told] = [text.get_text() for text in bias_figure(many).axes[4].texts]
    assert told.startswith("1–30: by")  # noqa: RUF001


def _boxes(figure):
    """Boxes [pixels] of panels with their labels, legends and title of a figure that was laid out."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    named = [axes.get_tightbbox(renderer) for axes in figure.axes]
    return [*named, *(found.get_window_extent(renderer) for found in (*figure.legends, figure._suptitle))]


def _figures(columns=2):
    points, long = paper_grid(("wide", "free", "fixed"), seeds=2), "A grid of a name that is long enough for two lines"
    image = [replace(p, estimator="image", index_prior="wide") for p in paper_grid(("wide",))]
    groups = group_points(points, "index_prior").items()
    trends = [trend_series(k, v, "magnitude", against) for against in TRENDS for k, v in groups]
    yield bias_figure(points, heading=long, columns=columns)
    yield sample_figure(points, heading=long, columns=columns)
    yield coverage_figure([coverage_curve(k, v, "magnitude") for k, v in groups], "magnitude", heading=long)
    yield pull_figure([pull_summary(k, v, "magnitude") for k, v in groups], "magnitude", heading=long, columns=columns)
    yield trend_figure(trends, heading=long, columns=columns)
    yield bias_figure(image, heading=long, columns=columns)


@pytest.mark.parametrize("columns", [1, 2])
def test_nothing_lies_on_anything_else_or_beyond_the_edge(columns):
    for figure in _figures(columns):
        boxes, edge = _boxes(figure), figure.bbox
        for box in boxes:
            # A pixel of rounding.
            assert box.x0 > edge.x0 - 1
            assert box.x1 < edge.x1 + 1
            assert box.y0 > edge.y0 - 1
            assert box.y1 < edge.y1 + 1
        for one, other in itertools.combinations(boxes, 2):
            width = min(one.x1, other.x1) - max(one.x0, other.x0)
            height = min(one.y1, other.y1) - max(one.y0, other.y0)
            assert min(width, height) < 1.5


def test_for_a_phone_the_figure_is_narrow_and_its_text_large():
    for figure in _figures(columns=1):
        # On a screen 360 pixels (3.75 inches) wide, no text is smaller than 6 points.
        scale = min(1.0, 3.75 / figure.get_figwidth())
        sizes = [
            text.get_fontsize() for text in figure.findobj(lambda a: hasattr(a, "get_fontsize")) if text.get_text()
        ]
        assert min(sizes) * scale > 6.0


def test_the_same_points_in_any_order_are_the_same_bytes():
    points = paper_grid(seeds=2)
    shuffled = random.Random(3).sample(points, len(points))
    for kind, start in (("svg", b"<?xml"), ("png", b"\x89PNG")):
        first, second = (figure_bytes(bias_figure(some, heading="x"), kind) for some in (points, shuffled))
        assert first == second
        assert first.startswith(start)
        assert b"dc:date" not in first


def test_another_process_writes_the_same_bytes():
    ours = [figure_bytes(figure, "svg") for figure in _figures()]
    script = (
        "import sys, hashlib; from tests.engine.test_bias_figures import _figures, figure_bytes\n"
        "for f in _figures(): print(hashlib.sha256(figure_bytes(f, 'svg')).hexdigest())"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert found.stdout.split() == [hashlib.sha256(data).hexdigest() for data in ours]


def test_figures_drawn_at_once_are_those_drawn_alone():
    figures = [bias_figure(paper_grid()) for _ in range(4)]
    alone, found = figure_bytes(bias_figure(paper_grid()), "svg"), {}
    threads = [
        threading.Thread(target=lambda i=i: found.update({i: figure_bytes(figures[i], "svg")})) for i in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [found[i] for i in range(4)] == [alone] * 4


@pytest.mark.parametrize("name", ["a $x_{$ b", "$5", "<b>&amp;", "ends\x07here", "two\nlines"])
def test_names_are_shown_as_they_stand_whatever_is_in_them(name):
    some = [replace(p, system=name) for p in paper_grid()]
    shown = "".join(c if c.isprintable() else " " for c in name)
    for figure in (bias_figure(some, heading=name), sample_figure([replace(p, index_prior="wide") for p in some])):
        assert any(shown in text for text in texts(figure))


def test_far_outliers_stand_at_the_edge_and_are_counted():
    points = [*paper_grid(("free",)), point(40.0, run_id="far", magnitude=21.0), point(-40.0, run_id="f", magnitude=22)]
    points = [p for p in points if (p.magnitude, *p.setting) not in {(21.0, 1.0, 0.39, 2.0), (22.0, 1.0, 0.39, 2.0)} or
              p.run_id.startswith("f")]  # fmt: skip
    figure = bias_figure(points)
    axes = figure.axes[0]
    low, high = axes.get_ylim()
    assert high < 10.0
    assert low < lines(axes)["magnitude-free-22-beyond"].get_ydata()[0] < 0.9 * low
    assert 0.9 * high < lines(axes)["magnitude-free-21-beyond"].get_ydata()[0] < high
    assert len(lines(axes)["magnitude-free-21"].get_xdata()) == 11
    assert "2 beyond, at the edge" in texts(figure)


def test_small_biases_are_seen_with_limits_of_the_data_and_bands_with_those_of_the_bands():
    small = [replace(p, recovered={k: Quantity(v.truth + 0.02, 0.01, v.truth) for k, v in p.recovered.items()})
             for p in paper_grid(("wide", "fixed"))]  # fmt: skip
    series = [trend_series("x", small, "magnitude", "arc_magnitude")]
    for draw in (
        lambda limits: bias_figure(small, limits=limits).axes[0],
        lambda limits: bias_figure(small, limits=limits).axes[3],
        lambda limits: sample_figure(small, limits=limits).axes[1],
        lambda limits: trend_figure(series, limits=limits).axes[0],
    ):
        low, high = draw("data").get_ylim()
        assert 0.02 < high < 0.05
        assert -0.05 < low < 0.0
        low, high = draw("bands").get_ylim()
        assert low < -1.25
        assert high > 1.25


def test_nothing_to_show_is_an_error_that_says_so():
    for draw in (
        bias_figure, sample_figure, trend_figure, grid_figure,
        lambda groups: coverage_figure(groups, "n"), lambda groups: pull_figure(groups, "n"),
        lambda points: mean_bias(points, "n"), lambda points: trend_series("x", points, "n", "arc_magnitude"),
    ):  # fmt: skip
        with pytest.raises(NothingToShowError, match=r"got none.*allowed is at least one"):
            draw([])
    with pytest.raises(NothingToShowError, match="agn_contrast"):
        trend_series("x", [point(agn_contrast=None)], "magnitude", "agn_contrast")


def test_what_does_not_belong_together_is_refused_by_name():
    two = [point(), point(system="HE0435")]
    for bad, words in (
        (lambda: bias_figure(two), "system: got HE0435, HE1104"),
        (lambda: bias_figure([point(), point(estimator="image")]), "estimator: got image, paper"),
        (lambda: bias_figure([point()], columns=3), "columns: got 3, allowed is 1 or 2"),
        (lambda: bias_figure([point()], limits="all"), "limits: got 'all', allowed is one of"),
        (lambda: sample_figure([point()], free="fixed"), "free: got 'fixed'"),
        (lambda: sample_figure([point(), point(estimator="image")], free="free"), "estimator: got"),
        (lambda: figure_bytes(bias_figure([point()]), "pdf"), "format: got 'pdf'"),
        (lambda: point().bias("q"), "q: run r1 has none"),
        (lambda: group_points(two, "seed"), "group by: got 'seed'"),
        (lambda: coverage_curve("x", two, "n", (0.5, 1.0)), "claimed: got"),
        (lambda: trend_series("x", two, "n", "n"), "against: got 'n'"),
        (lambda: trend_series("x", two, "n", "arc_magnitude", 0.0), "width: got 0.0"),
        (lambda: coverage_figure([coverage_curve("x", two, "n")] * 9, "n"), "groups: got 9, allowed are 8"),
    ):
        with pytest.raises(FigureError, match=words):
            bad()


def sample() -> list[BiasPoint]:
    rng = np.random.default_rng(8)
    return [
        point(
            float(rng.normal(0.0, 0.3)), 0.1, run_id=f"{name}{m}{prior}", system=name, configuration=configuration,
            magnitude=m, index_prior=prior, arc_magnitude=m - shift, agn_contrast=contrast and contrast - m,
            surface_brightness=m + 0.3 * shift,
        )
        for name, configuration, shift, contrast in (
            ("HE0435", "quad", 2.0, 18.0), ("HE1104", "double", 1.5, 17.0), ("HE0047", "double", 1.0, 17.0),
            ("bare", "quad", 1.2, None),
        )
        for m in MAGNITUDES
        for prior in ("wide", "free", "fixed")
    ]  # fmt: skip


@pytest.mark.parametrize("free", ["wide", "free"])
def test_the_sample_has_arc_contrast_and_brightness_below_one_another_n_free_left_and_fixed_right(free):
    points = sample()
    figure = sample_figure(points, free=free)
    assert len(figure.axes) == 6
    for place, axes in enumerate(figure.axes):
        against, prior = TRENDS[place // 2], (free, "fixed")[place % 2]
        names = {p.system for p in points if getattr(p, against) is not None}
        assert set(lines(axes)) == {f"{against}-{prior}-{name}" for name in names}
        for name in names:
            some = [p for p in points if (p.system, p.index_prior) == (name, prior)]
            line = lines(axes)[f"{against}-{prior}-{name}"]
            np.testing.assert_allclose(line.get_xdata(), [getattr(p, against) for p in some])
            np.testing.assert_allclose(line.get_ydata(), [p.bias("magnitude") for p in some])
            np.testing.assert_allclose(bars(axes)[line.get_gid()], 0.1)
            assert line.get_marker() == ("s" if some[0].configuration == "quad" else "^")
        assert set(bands(axes)) == {"band-0.5", "band-1.25"}
        assert ("fixed" if place % 2 else "free in") in axes.get_title("left")
    for left, right in zip(figure.axes[::2], figure.axes[1::2], strict=True):
        assert left.get_ylim() == right.get_ylim()
        assert left.get_xlim() == right.get_xlim()
        assert left.get_xlabel() == right.get_xlabel()
    told = texts(figure)
    assert {"HE0435 (quad)", "HE1104 (double)", "HE0047 (double)", "bare (quad)"} <= set(told)
    assert "4 systems, 32 runs: paper estimator" in told


def test_systems_of_the_sample_differ_without_colour():
    found = lines(sample_figure(sample()).axes[0]).values()
    assert len({(line.get_marker(), line.get_fillstyle()) for line in found}) == 4
    assert len({line.get_color() for line in found}) == 4


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


def _pictures(peak=1.0, edges=None) -> Pictures:
    image = np.zeros((21, 21))
    image[17, 10] = 9.0  # North of the centre
    source = np.full((4, 4), 0.1)
    source[3, 2] = 5.0
    edges = np.array([-1.0, -0.9, 0.0, 0.5, 1.0]) if edges is None else edges
    mask = np.hypot(*(np.mgrid[:21, :21] - 10.0)) < 8.0
    return Pictures(peak * image, np.where(mask, image, np.nan), 0.1, source, edges, edges)


def test_the_montage_has_three_pictures_a_run_and_says_which_have_none():
    runs = [Thumbnail(f"HE0435/{k:02d}", f"{0.01 * k:+.2f} mag", _pictures()) for k in range(6)]
    runs.append(Thumbnail("HE0435/06", "failed", None))
    figure = grid_figure(runs, heading="My grid")
    axes = figure.axes[0]
    assert len(axes.images) == 12
    assert len(axes.collections) == 6
    # Both pictures are cut to the mask's surroundings: 8 pixels and a margin.
    assert all(image.get_array().shape == (19, 19) for image in axes.images)
    np.testing.assert_array_equal(axes.images[0].get_array(), runs[0].pictures.observation[1:20, 1:20])
    np.testing.assert_array_equal(axes.collections[0].get_array(), runs[0].pictures.source)
    assert {"My grid", "7 runs: observation, model, source", "HE0435/03", "+0.03 mag", "failed"} <= set(texts(figure))


def test_in_the_montage_north_is_up():
    figure = grid_figure([Thumbnail("a", "", _pictures(edges=np.linspace(-1.0, 1.0, 5)))])
    shown = imread(io.BytesIO(figure_bytes(figure, "png", dpi=100)))[..., 0]
    axes = figure.axes[0]
    for left in (0.0, 1.0, 2.0):  # the bright pixel, white in red light, is in the upper half of each picture
        ends = axes.transData.transform([(left + 0.02, 1.29), (left + 0.95, 0.36)]) * 100 / figure.dpi
        (x0, y0), (x1, y1) = np.round(ends).astype(int)
        rows = shown[shown.shape[0] - y1 : shown.shape[0] - y0, x0:x1]
        bright = np.argwhere(rows > 0.97).mean(axis=0)
        assert bright[0] < 0.45 * rows.shape[0]


def test_a_montage_refuses_what_it_cannot_hold():
    empty = replace(_pictures(), model=np.full((21, 21), np.nan))
    flat = replace(_pictures(), source_x_edges=np.zeros(5), source_y_edges=np.zeros(5))
    for runs, words in (
        ([Thumbnail("a", "", None)] * 401, "runs: got 401, allowed are 400"),
        ([Thumbnail("a", "", empty)], "a: got a model without a finite pixel"),
        ([Thumbnail("a", "", flat)], "source edges: got a width of 0.0"),
    ):
        with pytest.raises(FigureError, match=words):
            grid_figure(runs)


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
        stages=(),
    )  # fmt: skip
    first, second = bias_points("r7", spec, result)
    assert (first.system, first.configuration, first.setting, first.magnitude) == (
        "HE0435",
        "quad",
        (1.2, 0.39, 4.0),
        21.5,
    )
    assert (first.estimator, first.index_prior, first.seed, first.run_id) == ("image", "wide", 3, "r7")
    assert (second.estimator, second.index_prior) == ("paper", "free")
    assert first.bias("position_angle") == pytest.approx(0.1)
    assert (first.arc_magnitude, first.agn_contrast, first.surface_brightness) == (18.5, -1.5, 20.5)
