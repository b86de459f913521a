"""The biases of one lens system as in the paper's Figs. 5-12: magnitude, radius, index by serial number; summary."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from engine.biases import BiasPoint, HostQuantity, Setting, mean_bias, serial_numbers
from engine.errors import FigureError
from engine.figures.style import (
    AXIS_LABELS,
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
    prior_markers,
    shades,
    target_bands,
    tidy,
    title,
    zero_line,
)
from engine.result import IndexPrior

PRIOR_COLOURS: dict[IndexPrior, str] = {"wide": "#0072B2", "free": "#009E73", "fixed": "#D55E00"}
_PANELS: tuple[tuple[HostQuantity, str], ...] = (
    ("magnitude", "(a) magnitude"),
    ("r_eff", "(b) effective radius"),
    ("n", "(c) Sérsic index, n free"),
)
_PRIOR_FILLS: dict[IndexPrior, Literal["full", "left"]] = {"wide": "full", "free": "full", "fixed": "left"}
_SLOT = 0.8
_PANEL_WIDTH, _PANEL_HEIGHT = 4.4, 2.75
_MOST_LISTED = 24
_WIDE = 6
"""Letters from which on the name of a host is written small."""
_LISTED_AN_INCH, _BLOCK_HEIGHT = 2.4, 0.72


class _Mean(NamedTuple):
    """All seeds of one input as one point."""

    magnitude: float
    setting: Setting
    prior: IndexPrior
    bias: float
    error: float


def _means(points: Sequence[BiasPoint], quantity: HostQuantity) -> list[_Mean]:
    """One point for all seeds of an input: their mean, with their scatter as its bar."""
    groups: dict[tuple[IndexPrior, float, Setting], list[BiasPoint]] = {}
    for point in points:
        groups.setdefault((point.index_prior, point.magnitude, point.setting), []).append(point)
    found = []
    for (prior, magnitude, setting), members in groups.items():
        all_of_them = mean_bias(members, quantity)
        found.append(_Mean(magnitude, setting, prior, all_of_them.mean, all_of_them.scatter))
    return found


def bias_figure(
    points: Iterable[BiasPoint], *, heading: str = "", columns: int = 2, limits: Limits = "bands"
) -> Figure:
    """Biases of one system: four panels with the meaning of the paper's Figs. 5-12.

    (a), (b), (c): bias of magnitude, R_eff and n against the serial number; colours are the hosts' magnitudes,
    bright ones to the left within a number; circles are n free, stars n fixed to the truth, which (c) leaves out.
    Bars are the standard deviation that the run states, and with several seeds of an input the scatter among them.
    (d): mean bias of the magnitude over all numbers of a slope against the host's magnitude, with the scatter;
    shapes are slopes, colours priors of n. (a) and (d) have the bands of 0.5 and 1.25 mag.

    Parameters
    ----------
    points : iterable of BiasPoint
        Of one system and one estimator, in any order.
    heading : str
        What stands above, as the name of the grid.
    columns : int
        Panels beside one another: 2, or 1 for a phone.
    limits : "bands" or "data"
        Panels of the magnitude show the whole of both bands, or as near as the points are.

    Raises
    ------
    NothingToShowError
        There are no points.
    FigureError
        Points of several systems or estimators, or other columns.
    """
    if columns not in (1, 2):
        raise FigureError(f"columns: got {columns}, allowed is 1 or 2")
    ordered = in_order(points)
    system, estimator = only(ordered, "system"), only(ordered, "estimator")
    numbers = serial_numbers(ordered)
    magnitudes = sorted({point.magnitude for point in ordered})
    priors = prior_markers(point.index_prior for point in ordered)
    shapes = _slope_markers(sorted({point.l_eta for point in ordered}))
    rows, width = 4 // columns, _PANEL_WIDTH * columns
    blocks = -(-len(numbers) // int(_LISTED_AN_INCH * (width - 0.7))) if len(numbers) <= _MOST_LISTED else 0
    entries = _entries(ordered, magnitudes, priors)
    legend_columns = 2 * columns - 1
    below, legend_rows = max(_BLOCK_HEIGHT * blocks, 0.25), -(-len(entries) // legend_columns) + 1
    figure = new_figure(width, _PANEL_HEIGHT * rows + 0.7 + below + 0.2 * legend_rows)
    cells = figure.add_gridspec(rows + 1, columns, height_ratios=[*[_PANEL_HEIGHT] * rows, below])
    panels = [figure.add_subplot(cells[divmod(place, columns)]) for place in range(4)]
    for axes, (quantity, name) in zip(panels, _PANELS, strict=False):
        axes.set_title(name, fontsize=10, loc="left")
        _serial_panel(axes, ordered, quantity, numbers, magnitudes, priors, limits)
    _summary_panel(panels[3], ordered, magnitudes, shapes, limits)
    figure.align_ylabels(panels)
    key = figure.add_subplot(cells[rows, :])
    _list_numbers(key, numbers, blocks) if blocks else _tell_numbers(key, numbers)
    runs = len({point.run_id for point in ordered})
    title(figure, plain(heading), f"{plain(system)}: {estimator} estimator, {runs} run{'s' * (runs != 1)}")
    legend(figure, entries, legend_columns, side="left", name="(a) to (c)")
    legend(figure, _summary_entries(priors, shapes), columns, side="right", name="(d)")
    return figure


def _serial_panel(
    axes: Axes,
    points: Sequence[BiasPoint],
    quantity: HostQuantity,
    numbers: dict[Setting, int],
    magnitudes: list[float],
    priors: dict[IndexPrior, str],
    limits: Limits,
) -> None:
    # An index that is fixed to the truth has no bias to show, and one of a host that has none has no truth.
    shown = [p for p in points if p.has_truth(quantity) and (quantity != "n" or p.index_prior != "fixed")]
    axes.set_xlim(0.5, len(numbers) + 0.5)
    axes.set_xlabel("serial number of the configuration", fontsize=9)
    axes.set_ylabel(AXIS_LABELS[quantity], fontsize=9)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=13, integer=True, steps=[1, 2, 5, 10]))
    tidy(axes)
    zero_line(axes)
    if quantity == "magnitude":
        target_bands(axes)
    for number in range(2, len(numbers) + 1):
        axes.axvline(number - 0.5, color="0.75", linewidth=0.4, zorder=0.3)
    if not shown:
        axes.text(
            0.5, 0.5, "no run with n free and a truth", transform=axes.transAxes, ha="center", va="bottom", fontsize=9
        )
        return
    means = _means(shown, quantity)
    limit_biases(axes, quantity, [m.bias for m in means], [m.error for m in means], limits)
    step = _SLOT / len(magnitudes)
    for rank, (magnitude, colour) in enumerate(zip(magnitudes, shades(len(magnitudes)), strict=True)):
        for place, (prior, marker) in enumerate(priors.items()):
            some = [m for m in means if m.magnitude == magnitude and m.prior == prior]
            if not some:
                continue
            shift = (rank + (place + 0.5) / len(priors)) * step - 0.5 * _SLOT
            draw_points(
                axes,
                [numbers[m.setting] + shift for m in some],
                [m.bias for m in some],
                [m.error for m in some],
                Look(marker, colour, 9.0 if marker == "*" else 5.5, f"{quantity}-{prior}-{magnitude:g}"),
            )


def _summary_panel(
    axes: Axes, points: Sequence[BiasPoint], magnitudes: list[float], shapes: dict[float, str], limits: Limits
) -> None:
    axes.set_title("(d) magnitude, mean over n and radius", fontsize=10, loc="left")
    axes.set_xlabel("magnitude of the host, true [AB mag]", fontsize=9)
    axes.set_ylabel(AXIS_LABELS["magnitude"], fontsize=9)
    tidy(axes)
    zero_line(axes)
    target_bands(axes)
    groups: dict[tuple[IndexPrior, float], list[tuple[float, float, float]]] = {}
    for prior in prior_markers(point.index_prior for point in points):
        for slope in shapes:
            for magnitude in magnitudes:
                some = [p for p in points if (p.index_prior, p.l_eta, p.magnitude) == (prior, slope, magnitude)]
                if some:
                    found = mean_bias(some, "magnitude")
                    groups.setdefault((prior, slope), []).append((magnitude, found.mean, found.scatter))
    everything = [item for series in groups.values() for item in series]
    limit_biases(axes, "magnitude", [item[1] for item in everything], [item[2] for item in everything], limits)
    gap = min(np.diff(magnitudes), default=0.5)
    axes.set_xlim(magnitudes[0] - 0.6 * gap, magnitudes[-1] + 0.6 * gap)
    if len(magnitudes) <= 8:
        axes.set_xticks(magnitudes)
    for place, ((prior, slope), series) in enumerate(groups.items()):
        shift = 0.7 * gap * ((place + 0.5) / len(groups) - 0.5)
        values, bias, error = zip(*series, strict=True)
        look = Look(shapes[slope], PRIOR_COLOURS[prior], 6.0, f"summary-{prior}-{slope:g}", _PRIOR_FILLS[prior])
        draw_points(axes, [value + shift for value in values], bias, error, look)


def _entries(
    points: Sequence[BiasPoint], magnitudes: list[float], priors: dict[IndexPrior, str]
) -> list[Line2D | Patch]:
    several = len(points) > len({(p.index_prior, p.magnitude, p.setting) for p in points})
    return [
        *(
            mark(f"{m:g} mag", Look("o", shade, 7.0, ""))
            for m, shade in zip(magnitudes, shades(len(magnitudes)), strict=True)
        ),
        *(mark(prior_label(prior), Look(marker, "0.5", 7.0, "")) for prior, marker in priors.items()),
        *band_patches(),
        bar("scatter among seeds" if several else "stated standard deviation"),
    ]


def _summary_entries(priors: dict[IndexPrior, str], shapes: dict[float, str]) -> list[Line2D | Patch]:
    return [
        *(mark(f"$l_\\eta$ {slope:g}", Look(shape, "0.5", 7.0, "")) for slope, shape in shapes.items()),
        *(mark(prior_label(prior), Look("s", PRIOR_COLOURS[prior], 7.0, "", _PRIOR_FILLS[prior])) for prior in priors),
    ]


def _slope_markers(slopes: Sequence[float]) -> dict[float, str]:
    """Down, square, up: shallow, isothermal, steep where there are three."""
    shapes = {1: "s", 2: "v^"}.get(len(slopes), "vs^DPX")
    return {slope: shapes[rank % len(shapes)] for rank, slope in enumerate(slopes)}


def _list_numbers(axes: Axes, numbers: dict[Setting, int], blocks: int) -> None:
    """The meaning of each serial number: the paper's Table 3 on its side, in so many blocks below one another."""
    names = ("No.", "n", "radius [″]", r"$l_\eta$")
    in_block, step = -(-len(numbers) // blocks), len(names) + 0.6
    axes.set_axis_off()
    axes.set(xlim=(-0.2 * in_block, in_block), ylim=(step * blocks - 0.6, 0.0))
    for block in range(blocks):
        for row, name in enumerate(names):
            axes.text(-0.2 * in_block, block * step + row + 0.5, name, fontsize=8.5, ha="left", va="center")
    for setting, number in numbers.items():
        block, column = divmod(number - 1, in_block)
        index = setting.host if setting.n is None else f"{setting.n:g}"
        cells = (f"{number}", index, f"{setting.r_eff:g}", f"{setting.l_eta:g}")
        for row, cell in enumerate(cells):
            axes.text(
                column + 0.5, block * step + row + 0.5, cell, fontsize=8.5 if len(cell) < _WIDE else 5.0, ha="center",
                va="center", fontweight="bold" if row == 0 else "normal", gid=f"serial-{number}-{row}",
            )  # fmt: skip


def _tell_numbers(axes: Axes, numbers: dict[Setting, int]) -> None:
    axes.set_axis_off()
    axes.text(
        0.5, 0.5, f"1–{len(numbers)}: by $l_\\eta$, within it by radius, within that by n",  # noqa: RUF001
        fontsize=8.5, ha="center", va="center", transform=axes.transAxes,
    )  # fmt: skip
