"""Every figure of biases can be read and is the same bytes again; what cannot be drawn is refused by name."""

import hashlib
import itertools
import random
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from engine import (
    FigureError,
    NothingToShowError,
    coverage_curve,
    group_points,
    mean_bias,
    trend_series,
)
from engine.figures import (
    bias_figure,
    coverage_figure,
    figure_bytes,
    grid_figure,
    pull_figure,
    sample_figure,
    trend_figure,
)
from tests.engine.bias_records import (
    figures,
    paper_grid,
    point,
    texts,
)

ROOT = Path(__file__).resolve().parents[2]


def _boxes(figure):
    """Boxes [pixels] of panels with their labels, legends and title of a figure that was laid out."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    named = [axes.get_tightbbox(renderer) for axes in figure.axes]
    return [*named, *(found.get_window_extent(renderer) for found in (*figure.legends, figure._suptitle))]


@pytest.mark.parametrize("columns", [1, 2])
def test_nothing_lies_on_anything_else_or_beyond_the_edge(columns):
    for figure in figures(columns):
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
    for figure in figures(columns=1):
        # On a screen 360 pixels (3.75 inches) wide, no text is smaller than 6 points.
        scale = min(1.0, 3.75 / figure.get_figwidth())
        sizes = [
            text.get_fontsize() for text in figure.findobj(lambda a: hasattr(a, "get_fontsize")) if text.get_text()
        ]
        assert min(sizes) * scale > 6.0


def test_the_same_points_in_any_order_are_the_same_bytes():
    points = paper_grid(seeds=2)[::4]
    shuffled = random.Random(3).sample(points, len(points))
    for kind, start in (("svg", b"<?xml"), ("png", b"\x89PNG")):
        first, second = (figure_bytes(bias_figure(some, heading="x"), kind) for some in (points, shuffled))
        assert first == second
        assert first.startswith(start)
        assert b"dc:date" not in first


def test_another_process_writes_the_same_bytes():
    ours = figure_bytes(next(figures()), "svg")
    script = (
        "import hashlib; from tests.engine.bias_records import figure_bytes, figures\n"
        "print(hashlib.sha256(figure_bytes(next(figures()), 'svg')).hexdigest())"
    )
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.split() == [hashlib.sha256(ours).hexdigest()]


def test_figures_drawn_at_once_are_those_drawn_alone():
    figures = [bias_figure(paper_grid()[::12]) for _ in range(3)]
    alone, found = figure_bytes(bias_figure(paper_grid()[::12]), "svg"), {}
    threads = [
        threading.Thread(target=lambda i=i: found.update({i: figure_bytes(figures[i], "svg")})) for i in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [found[i] for i in range(3)] == [alone] * 3


@pytest.mark.parametrize("name", ["a $x_{$ b <b>&amp;", "$5 ends\x07here\nin two lines"])
def test_names_are_shown_as_they_stand_whatever_is_in_them(name):
    some = [replace(p, system=name) for p in paper_grid()[::12]]
    shown = "".join(c if c.isprintable() else " " for c in name)
    for figure in (bias_figure(some, heading=name), sample_figure([replace(p, index_prior="wide") for p in some])):
        assert any(shown in text for text in texts(figure))


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
