"""Time against error on logarithmic axes: a panel for each knob, the default circled, peers beside it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from engine.accuracy.curves import AccuracyReport, Curve, by_knob
from engine.errors import NothingToShowError
from engine.figures.style import INK, MARKERS, OKABE_ITO, legend, new_figure, plain, tidy, title

_WIDTH, _HEIGHT, _COLUMNS = 3.1, 2.7, 4
_LABELLED = 16
"""Characters of a setting that stand beside its point where one system alone is shown."""
_FEW_DECADES = 1.6
_ROOM = (0.4, 0.06)
"""Width and height of a label as parts of a panel."""
_PEER_MARKS = {"lenstronomy": "P", "PyAutoLens": "X"}


def accuracy_figure(reports: Sequence[AccuracyReport], *, columns: int = _COLUMNS) -> Figure:
    """Every knob of one or several reports: points, the Pareto front as a line, the default circled.

    CPU time is in units of the default's. Errors that are below that of the reference are drawn at it.

    Raises
    ------
    NothingToShowError
        The reports have no curve.
    """
    knobs = by_knob(reports)
    if not knobs:
        raise NothingToShowError("reports: got none with a curve, allowed is at least one")
    columns = min(columns, len(knobs))
    rows = -(-len(knobs) // columns)
    figure = new_figure(max(_WIDTH * columns, 4.5), _HEIGHT * rows + 0.9)
    panels = figure.subplots(rows, columns, squeeze=False)
    for panel in panels.flat[len(knobs) :]:
        panel.set_axis_off()
    systems = [report.system for report in reports]
    for panel, ((stage, name), found) in zip(panels.flat, knobs.items(), strict=False):
        _panel(panel, [(systems.index(system), curve) for system, curve in found], alone=len(systems) == 1)
        panel.set_title(plain(name if name.startswith(stage) else f"{stage}: {name}"), fontsize=9)
    heading = systems[0] if len(systems) == 1 else f"{len(systems)} systems"
    title(figure, plain(f"Speed against error, {heading}"), "lines: Pareto fronts; circled: the default")
    legend(figure, _entries(reports), columns)
    return figure


def _shown(error: float, floor: float) -> float:
    """An error as it is drawn: not below what the reference can tell, and not zero."""
    return max(error, floor, 1e-16)


def _panel(axes: Axes, curves: Sequence[tuple[int, Curve]], *, alone: bool) -> None:
    tidy(axes)
    axes.set_xscale("log")
    axes.set_yscale("log")
    for place, curve in curves:
        colour, marker = OKABE_ITO[place % len(OKABE_ITO)], MARKERS[place % len(MARKERS)]
        points = [(curve.ratio(p), _shown(p.error, curve.floor), p) for p in curve.points]
        ours = [(x, y) for x, y, point in points if point.peer is None]
        axes.plot(*zip(*ours, strict=True), marker=marker, color=colour, markersize=4, linestyle="none", alpha=0.7)
        front = [(curve.ratio(p), _shown(p.error, curve.floor)) for p in curve.front()]
        axes.plot(*zip(*front, strict=True), color=colour, linewidth=1.0)
        axes.plot(
            curve.ratio(curve.default), _shown(curve.default.error, curve.floor), marker="o", markersize=11,
            markerfacecolor="none", markeredgecolor=colour, markeredgewidth=1.4, linestyle="none",
        )  # fmt: skip
        for x, y, point in points:
            if point.peer is not None:
                axes.plot(
                    x, y, marker=_PEER_MARKS.get(point.peer, "X"), color=colour, markersize=6, linestyle="none",
                    markeredgecolor=INK, markeredgewidth=0.5,
                )  # fmt: skip
    axes.margins(0.15)
    _whole_decade(axes)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        few = math.log10(high / low) < _FEW_DECADES
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=6))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=7)
    if alone:
        _label(axes, curves[0][1])
    axes.set_xlabel("CPU, of the default's", fontsize=8)
    axes.set_ylabel(f"error [{curves[0][1].knob.unit}]", fontsize=8)


def _label(axes: Axes, curve: Curve) -> None:
    """Settings beside the points of default, front and peers, where there is room."""
    shown = [point for point in curve.points if point.default or point.peer is not None or point in curve.front()]
    taken: list[tuple[float, float]] = []
    for point in sorted(shown, key=lambda found: not found.default):
        at = (curve.ratio(point), _shown(point.error, curve.floor))
        x, y = axes.transAxes.inverted().transform(axes.transData.transform(at))
        if any(abs(x - left) < _ROOM[0] and abs(y - low) < _ROOM[1] for left, low in taken):
            continue
        taken.append((x, y))
        axes.annotate(plain(point.setting[:_LABELLED]), at, xytext=(5, 5), textcoords="offset points", fontsize=6)


def _whole_decade(axes: Axes) -> None:
    """Axes of one decade at least, so that there is a tick to read and noise does not fill the panel."""
    for limits, set_limits in ((axes.get_xlim, axes.set_xlim), (axes.get_ylim, axes.set_ylim)):
        low, high = limits()
        missing = 1.0 - math.log10(high / low)
        if missing > 0:
            set_limits(low * 10 ** (-0.5 * missing), high * 10 ** (0.5 * missing))


def _entries(reports: Sequence[AccuracyReport]) -> list[Line2D]:
    entries = []
    if len(reports) > 1:
        entries += [
            Line2D(
                [],
                [],
                marker=MARKERS[k % len(MARKERS)],
                color=OKABE_ITO[k % len(OKABE_ITO)],
                label=report.system,
                markersize=5,
                linewidth=1.0,
            )
            for k, report in enumerate(reports)
        ]
    there = {point.peer for report in reports for curve in report.curves for point in curve.points if point.peer}
    entries += [
        Line2D([], [], marker=mark, color="0.5", linestyle="none", markersize=6, markeredgecolor=INK, label=peer)
        for peer, mark in _PEER_MARKS.items()
        if peer in there
    ]
    entries.append(
        Line2D([], [], marker="o", color=INK, linestyle="none", markersize=10, markerfacecolor="none", label="default")
    )
    return entries
