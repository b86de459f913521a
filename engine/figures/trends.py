"""Trends across many runs: binned bias against the arc's magnitude, the AGN's contrast, the surface brightness."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from engine.biases import TRENDS, TrendSeries
from engine.errors import FigureError, NothingToShowError
from engine.figures.style import (
    AXIS_LABELS,
    INK,
    LINES,
    MARKERS,
    NAMES,
    OKABE_ITO,
    TREND_LABELS,
    Limits,
    Look,
    band_patches,
    bar,
    legend,
    limit_biases,
    mark,
    new_figure,
    plain,
    target_bands,
    tidy,
    title,
    within,
    zero_line,
)

_PANEL_WIDTH, _PANEL_HEIGHT = 4.4, 2.9


def trend_figure(
    series: Sequence[TrendSeries], *, heading: str = "", columns: int | None = None, limits: Limits = "bands"
) -> Figure:
    """Mean bias in bins: a panel for each abscissa, a line for each name.

    Bars are the error of the mean (of one run its stated deviation), shaded is where 68 % of the runs lie, numbers at
    the foot count the runs of each bin. Panels of the magnitude have the bands of 0.5 and 1.25 mag.

    Parameters
    ----------
    series : sequence of TrendSeries
        Of one quantity.
    heading : str
        What stands above, as the name of the grid.
    columns : int, optional
        Panels beside one another; all of them where not given, 1 for a phone.
    limits : "bands" or "data"
        Panels of the magnitude show the whole of both bands, or as near as the points are.

    Raises
    ------
    NothingToShowError
        There is no series with a bin.
    FigureError
        Series of several quantities, or more names than can be told apart.
    """
    shown = [one for one in series if one.bins]
    if not shown:
        raise NothingToShowError("series: got none with a result, allowed is at least one")
    quantities = sorted({one.quantity for one in shown})
    if len(quantities) > 1:
        raise FigureError(f"quantity: got {', '.join(quantities)}, allowed is one of them in a figure")
    names = list(dict.fromkeys(one.name for one in shown))
    if len(names) > len(OKABE_ITO):
        raise FigureError(f"series: got {len(names)} names, allowed are {len(OKABE_ITO)} in a figure")
    axes_of = [against for against in TRENDS if any(one.against == against for one in shown)]
    columns = len(axes_of) if columns is None else columns
    if not 1 <= columns <= len(TRENDS):
        raise FigureError(f"columns: got {columns}, allowed is 1 to {len(TRENDS)}")
    rows = -(-len(axes_of) // columns)
    quantity = shown[0].quantity
    figure = new_figure(_PANEL_WIDTH * columns, _PANEL_HEIGHT * rows + 0.9 + 0.2 * -(-len(names) // columns))
    panels = figure.subplots(rows, columns, squeeze=False)
    for panel in panels.flat[len(axes_of) :]:
        panel.set_axis_off()
    for panel, against in zip(panels.flat, axes_of, strict=False):
        _panel(panel, [one for one in shown if one.against == against], names, limits)
        panel.set_xlabel(TREND_LABELS[against], fontsize=9)
        panel.set_ylabel(AXIS_LABELS[quantity], fontsize=9)
    title(figure, plain(heading), f"Mean bias of the {NAMES[quantity]} in bins")
    entries = [
        mark(plain(name), Look(MARKERS[place], OKABE_ITO[place], 7.0, ""), line=LINES[place % len(LINES)])
        for place, name in enumerate(names)
    ]
    bands = band_patches() if quantity == "magnitude" else []
    legend(figure, [*entries, *bands, bar("error of the mean")], 2 * columns)
    return figure


def _panel(axes: Axes, series: Sequence[TrendSeries], names: list[str], limits: Limits) -> None:
    tidy(axes)
    zero_line(axes)
    quantity = series[0].quantity
    if quantity == "magnitude":
        target_bands(axes)
    everything = [one_bin for one in series for one_bin in one.bins]
    limit_biases(axes, quantity, [b.spread.mean for b in everything], [b.spread.error for b in everything], limits)
    room = 0.5 * (everything[0].upper - everything[0].lower)
    axes.set_xlim(min(b.lower for b in everything) - room, max(b.upper for b in everything) + room)
    for one in series:
        place = names.index(one.name)
        colour = OKABE_ITO[place]
        centres = np.array([b.centre for b in one.bins])
        means = within(axes, [b.spread.mean for b in one.bins])
        axes.fill_between(
            centres, [b.low for b in one.bins], [b.high for b in one.bins], color=colour, alpha=0.18, linewidth=0.0
        )
        container = axes.errorbar(
            centres, means, yerr=[b.spread.error for b in one.bins], color=colour, marker=MARKERS[place],
            linestyle=LINES[place % len(LINES)], linewidth=1.0, markersize=6, markeredgecolor=INK, markeredgewidth=0.4,
        )  # fmt: skip
        container.lines[0].set_gid(f"trend-{one.against}-{place}")
    _count_runs(axes, series)


def _count_runs(axes: Axes, series: Sequence[TrendSeries]) -> None:
    """How many runs each bin has, a row a series, at the foot; one row where all have the same."""
    counts = [[(one_bin.lower, one_bin.spread.count) for one_bin in one.bins] for one in series]
    rows = series[:1] if all(row == counts[0] for row in counts) else series
    for row, one in enumerate(rows):
        for one_bin in one.bins:
            axes.annotate(
                f"{one_bin.spread.count}", (one_bin.centre, 0.0), xycoords=("data", "axes fraction"),
                xytext=(0, 3 + 9 * (len(rows) - 1 - row)), textcoords="offset points", fontsize=7.5, color=INK,
                ha="center",
            )  # fmt: skip
