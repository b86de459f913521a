"""Statistics of one group as the plain data that the API writes, with six significant digits."""

from __future__ import annotations

import math
from typing import Any

from service.store.answers import Biases, Differences
from service.store.statistics import Moments, Share


def six(value: float) -> float | None:
    """A number with six significant digits; None for one that is not known."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def bias_view(found: Biases, place: int) -> dict[str, Any] | None:
    """A :class:`service.domain.answers.BiasView`; None for a group without a run that could be compared."""
    if not found.bias.number[place]:
        return None
    return {
        **_moments(found.bias, place, "runs"),
        "rmse": six(found.bias.rmse[place]),
        "stated_sd": six(found.sd[place]),
        "pull": {
            "runs": int(found.pull.number[place]),
            "mean": six(found.pull.mean[place]),
            "scatter": six(found.pull.scatter[place]),
        },
        "coverage": {name: share_view(one, place) for name, one in found.coverage.items()},
        "within": {f"{band:g}": share_view(one, place) for band, one in found.within.items()},
    }


def difference_view(found: Differences, place: int) -> dict[str, Any]:
    """What a :class:`service.domain.answers.DifferenceView` says of the pairs."""
    is_known = math.isfinite(found.closer.fraction[place])
    return {
        **_moments(found.difference, place, "pairs"),
        "left_closer": share_view(found.closer, place) if is_known else None,
    }


def _moments(found: Moments, place: int, counted: str) -> dict[str, Any]:
    return {
        counted: int(found.number[place]),
        "inputs": int(found.clusters[place]),
        "mean": six(found.mean[place]),
        "standard_error": six(found.error[place]),
        "median": six(found.median[place]),
        "p16": six(found.p16[place]),
        "p84": six(found.p84[place]),
        "scatter": six(found.scatter[place]),
    }


def share_view(found: Share, place: int) -> dict[str, float | None]:
    """A :class:`service.domain.answers.ShareView` as plain data."""
    return {"fraction": six(found.fraction[place]), "low": six(found.low[place]), "high": six(found.high[place])}
