"""What a figure is asked to show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from engine import Grouping, HostQuantity

FigureKind = Literal["bias", "sample", "coverage", "pull", "trends", "montage"]
FIGURE_KINDS: tuple[FigureKind, ...] = get_args(FigureKind)
OfPoints = Literal["bias", "sample", "coverage", "pull", "trends"]
FigureFormat = Literal["svg", "png"]
Prior = Literal["wide", "free", "fixed"]


@dataclass(frozen=True)
class FigureQuestion:
    """Which figure, of which answers, and how it is laid out.

    ``free`` is the prior of n that stands for "n free"; ``bias`` and ``sample`` show n fixed beside it, the others
    show ``free`` alone. ``by`` groups coverage, pulls and trends.
    """

    kind: FigureKind
    estimator: str
    free: Prior
    quantity: HostQuantity
    by: Grouping
    columns: int
    limits: Literal["bands", "data"]

    @property
    def priors(self) -> tuple[Prior, ...]:
        """Priors of n whose answers it needs."""
        if self.kind in ("bias", "sample") and self.free != "fixed":
            return (self.free, "fixed")
        return (self.free,)

    @property
    def quantities(self) -> tuple[HostQuantity, ...]:
        """Quantities that it needs."""
        own: dict[str, tuple[HostQuantity, ...]] = {"bias": ("magnitude", "r_eff", "n"), "sample": ("magnitude",)}
        return own.get(self.kind, (self.quantity,))
