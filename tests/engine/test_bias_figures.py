"""Figures of biases show what was handed in: each point where its record says, with the paper's symbols and bands."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from engine import (
    serial_numbers,
    trend_series,
)
from engine.biases import TRENDS
from engine.figures import (
    bias_figure,
    sample_figure,
    trend_figure,
)
from engine.figures.style import shades
from engine.result import Quantity
from tests.engine.bias_records import (
    MAGNITUDES,
    SLOPES,
    bands,
    bars,
    lines,
    paper_grid,
    point,
    sample,
    texts,
)


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
