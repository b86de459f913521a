"""Whether stated errors are right: claimed against actual coverage, and pulls against the unit normal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from engine.biases import ONE_SIGMA, CoverageCurve, HostQuantity, PullSummary
from engine.errors import FigureError, NothingToShowError
from engine.figures.style import (
    INK,
    LINES,
    MARKERS,
    MINUS,
    NAMES,
    OKABE_ITO,
    Look,
    legend,
    mark,
    new_figure,
    plain,
    tidy,
    title,
)

_MOST_GROUPS = len(OKABE_ITO)
_PANEL = 4.4
_SPREAD = 0.012
_EDGE = [withStroke(linewidth=3.4, foreground=INK)]


def coverage_figure(curves: Sequence[CoverageCurve], quantity: HostQuantity, *, heading: str = "") -> Figure:
    """Share of runs whose truth lies in the interval that claims to hold it, against the claim.

    On the diagonal errors are stated rightly, below it too small, above it too large. Bars are binomial (Wilson,
    68 %). Curves lie a little beside one another, so that their bars can be told apart.

    Raises
    ------
    NothingToShowError, FigureError
        No curve, or more than eight.
    """
    _require(len(curves))
    figure = new_figure(_PANEL + 0.3, _PANEL + 0.65 + 0.2 * (len(curves) + 1))
    axes = figure.subplots()
    tidy(axes)
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.35", linewidth=0.8, zorder=0.5)
    entries = []
    for place, curve in enumerate(curves):
        colour, marker, line = _look(place)
        shift = _SPREAD * (place - 0.5 * (len(curves) - 1))
        low, high = curve.interval
        error = np.maximum([curve.actual - low, high - curve.actual], 0.0)
        container = axes.errorbar(
            curve.claimed + shift, curve.actual, yerr=error, color=colour, marker=marker, linestyle=line,
            markersize=5.5, linewidth=1.0, elinewidth=0.9, markeredgecolor=INK, markeredgewidth=0.4,
        )  # fmt: skip
        container.lines[0].set_gid(f"coverage-{place}")
        entries.append(mark(f"{plain(curve.name)}, {_runs(curve.count)}", Look(marker, colour, 7.0, ""), line=line))
    axes.set(xlim=(0.0, 1.03), ylim=(-0.02, 1.03), aspect="equal")
    axes.axvline(ONE_SIGMA, color="0.75", linewidth=0.6, zorder=0.3)
    axes.text(ONE_SIGMA - 0.01, 0.99, "1 sd", fontsize=8.5, color="0.35", ha="right", va="top")
    axes.set_title("above the line stated errors are too large, below too small", fontsize=9, loc="left")
    axes.set_xlabel("probability that the interval claims", fontsize=9)
    axes.set_ylabel("share of runs with the truth inside", fontsize=9)
    title(figure, plain(heading), f"Coverage of the {NAMES[quantity]}")
    legend(figure, [*entries, Line2D([], [], color="0.35", linewidth=0.8, label="as claimed")], 1)
    return figure


def pull_figure(
    summaries: Sequence[PullSummary], quantity: HostQuantity, *, heading: str = "", columns: int = 2
) -> Figure:
    """Pulls, (found - true) / stated deviation: a histogram of all groups together, and the middle of each.

    Left: all pulls with the unit normal of as many runs; those beyond the edges are counted at the side. Right: for
    each group the median, with a bar from the 16th to the 84th percentile, which is -1 to 1 where errors are right.

    Raises
    ------
    NothingToShowError, FigureError
        No group, more than eight, groups with other edges, or other columns than 2, or 1 for a phone.
    """
    if columns not in (1, 2):
        raise FigureError(f"columns: got {columns}, allowed is 1 or 2")
    _require(len(summaries))
    edges = summaries[0].edges
    if any(not np.array_equal(group.edges, edges) for group in summaries):
        raise FigureError("edges: got groups with different ones, allowed are the same in all")
    rows, height = 2 // columns, max(2.7, 1.1 + 0.28 * len(summaries))
    figure = new_figure(_PANEL * columns, height * rows + 0.7)
    left, right = figure.subplots(rows, columns).flat
    _histogram(left, summaries)
    _middles(right, summaries)
    title(figure, plain(heading), f"Pulls of the {NAMES[quantity]}: (found {MINUS} true) / stated deviation")
    return figure


def _histogram(axes: Axes, summaries: Sequence[PullSummary]) -> None:
    edges = summaries[0].edges
    counts = np.sum([group.counts for group in summaries], axis=0)
    total = sum(group.count for group in summaries)
    axes.stairs(counts, edges, fill=True, color=OKABE_ITO[4], edgecolor=INK, linewidth=0.6, gid="pulls")
    fine = np.linspace(edges[0], edges[-1], 201)
    density = np.exp(-0.5 * fine**2) / np.sqrt(2.0 * np.pi)
    axes.plot(fine, total * float(edges[1] - edges[0]) * density, color=OKABE_ITO[1], linewidth=1.6, gid="unit-normal")
    top = 1.28 * max(float(counts.max()), total * float(edges[1] - edges[0]) / np.sqrt(2.0 * np.pi))
    axes.set(xlim=(edges[0], edges[-1]), ylim=(0.0, top))
    tidy(axes)
    axes.set_title(f"(a) {_runs(total)}, and the unit normal", fontsize=10, loc="left")
    axes.set_xlabel("pull", fontsize=9)
    axes.set_ylabel(f"runs per {edges[1] - edges[0]:g}", fontsize=9)
    beyond = ((0.01, "left", "←", "below"), (0.99, "right", "→", "above"))
    for place, side, arrow, end in beyond:
        number = sum(getattr(group, end) for group in summaries)
        if number:
            told = f"{arrow} {number}" if side == "left" else f"{number} {arrow}"
            axes.text(place, 0.97, told, transform=axes.transAxes, ha=side, va="top", fontsize=9)


def _middles(axes: Axes, summaries: Sequence[PullSummary]) -> None:
    reach = float(summaries[0].edges[-1])
    axes.axvspan(-1.0, 1.0, color="0.9", zorder=0.1)
    axes.axvline(0.0, color="0.35", linewidth=0.8, zorder=0.5)
    for place, group in enumerate(summaries):
        colour, marker, _ = _look(place)
        low, median, high = np.clip((group.low, group.median, group.high), -reach, reach)
        axes.plot(
            [low, high], [place, place], color=colour, linewidth=2.4, solid_capstyle="butt", path_effects=_EDGE,
            gid=f"range-{place}",
        )  # fmt: skip
        axes.plot(
            [median], [place], marker=marker, color=colour, markersize=7, markeredgecolor=INK, markeredgewidth=0.5,
            clip_on=False, zorder=3, gid=f"median-{place}",
        )  # fmt: skip
        if abs(group.median) > reach:
            side, toward = ("right", -8) if group.median > 0.0 else ("left", 8)
            axes.annotate(
                f"median {group.median:.3g}".replace("inf", "∞"), (median, place), xytext=(toward, 9),
                textcoords="offset points", ha=side, va="center", fontsize=8.5,
            )  # fmt: skip
    axes.set(xlim=(-reach, reach), ylim=(len(summaries) - 0.5, -0.5))
    tidy(axes)
    axes.set_yticks(range(len(summaries)), [f"{plain(group.name)} ({group.count})" for group in summaries], fontsize=9)
    axes.set_title("(b) median, 16 to 84 % (runs)", fontsize=10, loc="left")
    axes.set_xlabel("pull (shaded: where 68 % should lie)", fontsize=9)


def _look(place: int) -> tuple[str, str, str]:
    return OKABE_ITO[place], MARKERS[place], LINES[place % len(LINES)]


def _runs(count: int) -> str:
    return f"{count} run{'s' * (count != 1)}"


def _require(groups: int) -> None:
    if not groups:
        raise NothingToShowError("groups: got none, allowed is at least one with results")
    if groups > _MOST_GROUPS:
        raise FigureError(f"groups: got {groups}, allowed are {_MOST_GROUPS} in a figure")
