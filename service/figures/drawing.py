"""Figures of biases from stored results. Matplotlib is loaded with the first of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from engine import TRENDS, BiasPoint, coverage_curve, group_points, pull_summary, trend_series
from service.figures.question import FigureFormat, FigureQuestion

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def drawn(question: FigureQuestion, points: Sequence[BiasPoint], heading: str, kind: FigureFormat) -> bytes:
    """The figure of some points as a file; errors as :func:`draw`."""
    from engine.figures import figure_bytes  # noqa: PLC0415 - matplotlib takes a second

    return figure_bytes(draw(question, points, heading), kind)


def draw(question: FigureQuestion, points: Sequence[BiasPoint], heading: str) -> Figure:
    """The figure of some points.

    Raises
    ------
    engine.errors.FigureError
        There is nothing to show, or more than one figure can show.
    """
    from engine.figures import (  # noqa: PLC0415 - matplotlib takes a second, and most requests need none
        bias_figure,
        coverage_figure,
        pull_figure,
        sample_figure,
        trend_figure,
    )

    columns, quantity = question.columns, question.quantity
    if question.kind == "bias":
        return bias_figure(points, heading=heading, columns=columns, limits=question.limits)
    if question.kind == "sample":
        return sample_figure(points, free=question.free, heading=heading, columns=columns, limits=question.limits)
    groups = group_points(points, question.by)
    if question.kind == "coverage":
        curves = [coverage_curve(name, members, quantity) for name, members in groups.items()]
        return coverage_figure(curves, quantity, heading=heading)
    if question.kind == "pull":
        summaries = [pull_summary(name, members, quantity) for name, members in groups.items()]
        return pull_figure(summaries, quantity, heading=heading, columns=columns)
    series = [
        trend_series(name, having, quantity, against)
        for against in TRENDS
        for name, members in groups.items()
        if (having := [point for point in members if getattr(point, against) is not None])
    ]
    return trend_figure(series, heading=heading, columns=1 if columns == 1 else None, limits=question.limits)
