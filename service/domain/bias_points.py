"""Stored estimates as the engine's records of biases: what figures are drawn from and statistics are made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from engine import BiasPoint, HostQuantity, Quantity

_PLAIN = (
    "run_id", "system", "configuration", "n", "r_eff", "magnitude", "l_eta", "seed", "estimator", "index_prior",
    "arc_magnitude", "agn_contrast", "surface_brightness", "host_kind", "host_label", "deflector",
)  # fmt: skip


def point_columns(quantities: Sequence[HostQuantity]) -> tuple[str, ...]:
    """Names of the columns that a point needs, of an estimate and of the result that it belongs to."""
    return (*_PLAIN, *(f"{name}_{part}" for name in quantities for part in ("mean", "sd", "bias")))


def bias_point(row: Mapping[str, Any], quantities: Sequence[HostQuantity]) -> BiasPoint:
    """The point of one row with the columns :func:`point_columns`.

    A quantity that the estimate is older than is left out; one without a bias has no truth.
    """
    recovered: dict[HostQuantity, Quantity] = {}
    for name in quantities:
        mean, sd, bias = (row[f"{name}_{part}"] for part in ("mean", "sd", "bias"))
        if mean is not None:
            recovered[name] = Quantity(mean, sd, None if bias is None else mean - bias)
    return BiasPoint(recovered=recovered, **{name: row[name] for name in _PLAIN})
