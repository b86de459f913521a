"""The sample as in the paper's Fig. 13: bias of the magnitude against arc, contrast and surface brightness."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from engine.biases import TRENDS, BiasPoint, Configuration, Trend
from engine.errors import FigureError
from engine.figures.style import (
    AXIS_LABELS,
    OKABE_ITO,
    TREND_LABELS,
    Limits,
    Look,
    band_patches,
    bar,
    draw_points,
    in_order,
    legend,
    limit_biases,
    mark,
    new_figure,
    only,
    plain,
    prior_label,
    target_bands,
    tidy,
    title,
    zero_line,
)
from engine.result import IndexPrior

CONFIGURATION_MARKERS: dict[Configuration, str] = {"quad": "s", "double": "^", "other": "o"}
_FILLS: tuple[Literal["full", "left", "top", "right", "bottom"], ...] = ("full", "left", "top", "right", "bottom")
_PANEL_WIDTH, _PANEL_HEIGHT = 4.4, 2.5
_LETTERS = "abcdef"


def sample_figure(
    points: Iterable[BiasPoint],
    *,
    free: IndexPrior = "wide",
    heading: str = "",
    columns: int = 2,
    limits: Limits = "bands",
) -> Figure:
    """Bias of the magnitude across the sample: six panels with the meaning of the paper's Fig. 13.

    Rows: against the magnitude of the lensed host, against AGN minus host arc, against the host's mean surface
    brightness within R_eff. Left: n free, right: n fixed to the truth. Squares are quads, triangles doubles; systems
    differ in colour and in which part of the symbol is filled. Bars are the stated standard deviation; the bands are
    0.5 and 1.25 mag. A run without AGN has no place in the second row.

    Parameters
    ----------
    points : iterable of BiasPoint
        Of one estimator, in any order; those of other priors of n than ``free`` and ``fixed`` are not shown.
    free : "wide" or "free"
        The prior of n on the left: 0.3-8, or the paper's 1-4.
    heading : str
        What stands above, as the name of the grid.
    columns : int
        Panels beside one another: 2, or 1 for a phone.
    limits : "bands" or "data"
        Panels of the magnitude show the whole of both bands, or as near as the points are.

    Raises
    ------
    NothingToShowError
        No point has one of the two priors.
    FigureError
        Points of several estimators, or n is not free on the left.
    """
    if free not in ("wide", "free"):
        raise FigureError(f"free: got {free!r}, allowed is 'wide' or 'free'")
    if columns not in (1, 2):
        raise FigureError(f"columns: got {columns}, allowed is 1 or 2")
    priors: tuple[IndexPrior, ...] = (free, "fixed")
    ordered = in_order(point for point in points if point.index_prior in priors)
    estimator = only(ordered, "estimator")
    looks = _looks(ordered)
    entries: list[Line2D | Patch] = [*_entries(ordered, looks), *band_patches(), bar("stated standard deviation")]
    rows = len(TRENDS) * len(priors) // columns
    height = _PANEL_HEIGHT * rows + 0.8 + 0.2 * -(-len(entries) // (2 * columns))
    figure = new_figure(_PANEL_WIDTH * columns, height)
    axes = figure.subplots(rows, columns).reshape(len(TRENDS), len(priors))
    for row, against in enumerate(TRENDS):
        placed = [point for point in ordered if getattr(point, against) is not None]
        for column, prior in enumerate(priors):
            panel = axes[row, column]
            panel.set_title(f"({_LETTERS[2 * row + column]}) {prior_label(prior)}", fontsize=10, loc="left")
            panel.set_xlabel(TREND_LABELS[against], fontsize=9)
            panel.set_ylabel(AXIS_LABELS["magnitude"], fontsize=9)
            tidy(panel)
            zero_line(panel)
            target_bands(panel)
            _panel(panel, placed, [p for p in placed if p.index_prior == prior], against, looks, limits)
    runs = len({point.run_id for point in ordered})
    title(figure, plain(heading), f"{len(looks)} systems, {runs} runs: {estimator} estimator")
    legend(figure, entries, 2 * columns)
    return figure


def _looks(points: Sequence[BiasPoint]) -> dict[str, Look]:
    """Symbol of each system: fills differ among the systems of one configuration."""
    looks: dict[str, Look] = {}
    places: dict[Configuration, int] = {}
    for name, configuration in sorted({(p.system, p.configuration) for p in points}):
        place = places.get(configuration, 0)
        places[configuration] = place + 1
        colour = OKABE_ITO[len(looks) % len(OKABE_ITO)]
        look = Look(CONFIGURATION_MARKERS[configuration], colour, 6.0, plain(name), _FILLS[place % len(_FILLS)])
        looks.setdefault(name, look)
    return looks


def _panel(
    axes: Axes,
    placed: Sequence[BiasPoint],
    points: Sequence[BiasPoint],
    against: Trend,
    looks: dict[str, Look],
    limits: Limits,
) -> None:
    """One panel; ``placed`` are the points of the whole row, which share their limits."""
    if not placed:
        axes.text(0.5, 0.5, "no run with an AGN", transform=axes.transAxes, ha="center", va="bottom", fontsize=9)
        return
    values = [float(getattr(point, against)) for point in placed]
    room = 0.05 * (max(values) - min(values)) or 0.5
    axes.set_xlim(min(values) - room, max(values) + room)
    biases = [point.bias("magnitude") for point in placed]
    limit_biases(axes, "magnitude", biases, [point.sd("magnitude") for point in placed], limits)
    for name, look in looks.items():
        some = [point for point in points if point.system == name]
        if some:
            draw_points(
                axes,
                [float(getattr(point, against)) for point in some],
                [point.bias("magnitude") for point in some],
                [point.sd("magnitude") for point in some],
                replace(look, name=f"{against}-{some[0].index_prior}-{look.name}"),
            )


def _entries(points: Sequence[BiasPoint], looks: dict[str, Look]) -> list[Line2D]:
    configurations = {point.system: point.configuration for point in points}
    return [mark(f"{look.name} ({configurations[name]})", look) for name, look in looks.items()]
