"""What was put in and what came out, run by run, and what many runs say together: the numbers behind the figures.

Nothing is plotted here. A bias is recovered minus true; a pull is a bias in units of the standard deviation that the
run states.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from engine.catalogue import resolve_system
from engine.conventions import FloatArray
from engine.errors import FigureError, NothingToShowError
from engine.result import IndexPrior, Quantity, RunResult
from engine.spec.analysis import EstimatorName
from engine.spec.deflector import USUAL_DEFLECTOR
from engine.spec.realization import Realization

HostQuantity = Literal["magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y"]
Configuration = Literal["quad", "double", "other"]
Trend = Literal["arc_magnitude", "agn_contrast", "surface_brightness"]
Grouping = Literal[
    "configuration", "system", "estimator", "index_prior", "n", "r_eff", "magnitude", "l_eta", "host_kind",
    "host_label", "deflector",
]  # fmt: skip
HOST_QUANTITIES: tuple[HostQuantity, ...] = get_args(HostQuantity)
TRENDS: tuple[Trend, ...] = get_args(Trend)
GROUPINGS: tuple[Grouping, ...] = get_args(Grouping)
ONE_SIGMA = 0.6826894921370859
"""Probability of a normal deviate within one standard deviation."""
_LOW, _HIGH = 0.5 - 0.5 * ONE_SIGMA, 0.5 + 0.5 * ONE_SIGMA
CLAIMED = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, ONE_SIGMA, 0.8, 0.9, 0.95, 0.99)
PULL_EDGES = tuple(0.5 * step for step in range(-10, 11))
BIN_WIDTH = 0.5


class Setting(NamedTuple):
    """What the paper's serial number stands for (Table 3), in the order in which it counts; and what it had not."""

    l_eta: float
    r_eff: float
    n: float | None
    host: str = "sersic"
    deflector: str = "plain"

    def order(self) -> tuple[float, float, float, str, str]:
        """What settings are sorted by: hosts without an index come last, by their names."""
        return self.l_eta, self.r_eff, math.inf if self.n is None else self.n, self.host, self.deflector


@dataclass(frozen=True)
class BiasPoint:
    """One estimate of the host of one simulated run, beside what was put in.

    ``n`` (None of a host that is no Sersic profile), ``r_eff`` [arcsec], ``magnitude`` [AB] and ``l_eta`` are the
    input, ``seed`` that of the noise.
    ``host_kind``, ``host_label`` and ``deflector`` tell hosts and deflectors apart that are not the usual ones.
    ``recovered`` holds each quantity with its truth. ``arc_magnitude``, ``agn_contrast`` (None without AGN) and
    ``surface_brightness`` as in :class:`~engine.result.RunResult`.
    """

    run_id: str
    system: str
    configuration: Configuration
    n: float | None
    r_eff: float
    magnitude: float
    l_eta: float
    seed: int
    estimator: EstimatorName
    index_prior: IndexPrior
    recovered: Mapping[HostQuantity, Quantity]
    arc_magnitude: float
    agn_contrast: float | None
    surface_brightness: float
    host_kind: str = "sersic"
    host_label: str = "sersic"
    deflector: str = "plain"

    @property
    def setting(self) -> Setting:
        """Slope, radius, index, host and deflector that were put in."""
        return Setting(self.l_eta, self.r_eff, self.n, self.host_label, self.deflector)

    def bias(self, quantity: HostQuantity) -> float:
        """Recovered minus true; a FigureError where the quantity or its truth is missing."""
        found = self.recovered.get(quantity)
        if found is None or found.bias is None:
            raise FigureError(f"{quantity}: run {self.run_id} has none with a truth, allowed are results that have")
        return found.bias

    def has_truth(self, quantity: HostQuantity) -> bool:
        """Whether there is a bias: an older result may lack the quantity, a host that is no profile has no index."""
        found = self.recovered.get(quantity)
        return found is not None and found.bias is not None

    def sd(self, quantity: HostQuantity) -> float:
        """The standard deviation that the run states."""
        self.bias(quantity)
        return self.recovered[quantity].sd


def configuration_of(agn_images: int) -> Configuration:
    """Quad or double by the number of AGN images (SDSS1206, whose host alone has four, is a double); or other."""
    known: dict[int, Configuration] = {2: "double", 4: "quad"}
    return known.get(agn_images, "other")


def bias_points(run_id: str, realization: Realization, result: RunResult) -> tuple[BiasPoint, ...]:
    """Every estimate of one run as a point."""
    host, agn_images = realization.host, len(resolve_system(realization).agn)
    return tuple(
        BiasPoint(
            run_id=run_id,
            system=realization.system_name,
            configuration=configuration_of(agn_images),
            n=host.n,
            r_eff=host.r_eff,
            magnitude=host.magnitude,
            l_eta=realization.l_eta,
            seed=realization.seed,
            estimator=found.estimator,
            index_prior=found.index_prior,
            recovered={name: getattr(found, name) for name in HOST_QUANTITIES},
            arc_magnitude=result.arc_magnitude,
            agn_contrast=result.agn_contrast,
            surface_brightness=result.surface_brightness,
            host_kind=host.kind,
            host_label=host.label,
            deflector=USUAL_DEFLECTOR if realization.deflector is None else realization.deflector.label,
        )
        for found in result.estimates
    )


def serial_numbers(points: Iterable[BiasPoint]) -> dict[Setting, int]:
    """Serial numbers from 1: by slope, within it by radius, within that by index.

    Of one system's whole grid of the paper these are the numbers of its Table 3.
    """
    return {
        setting: number
        for number, setting in enumerate(sorted({point.setting for point in points}, key=Setting.order), 1)
    }


def group_points(points: Iterable[BiasPoint], by: Grouping) -> dict[str, tuple[BiasPoint, ...]]:
    """Points by the value that they share, smallest value first; a text of each value is its key.

    Raises
    ------
    FigureError
        Nothing is known to group by under that name.
    """
    if by not in GROUPINGS:
        raise FigureError(f"group by: got {by!r}, allowed is one of {list(GROUPINGS)}")
    groups: dict[str | float | None, list[BiasPoint]] = {}
    for point in points:
        groups.setdefault(getattr(point, by), []).append(point)
    return {
        key if isinstance(key, str) else f"{by} none" if key is None else f"{by} {key:g}": tuple(groups[key])
        # Of one kind, a column is text or numbers; what has no number comes last.
        for key in sorted(groups, key=lambda key: (key is None, key))
    }


def _arrays(points: Sequence[BiasPoint], quantity: HostQuantity) -> tuple[FloatArray, FloatArray]:
    """Biases and stated deviations, (points,) each."""
    if not points:
        raise NothingToShowError("points: got none, allowed is at least one result")
    return np.array([p.bias(quantity) for p in points]), np.array([p.sd(quantity) for p in points])


@dataclass(frozen=True)
class Spread:
    """Mean bias of ``count`` runs, and an error bar.

    ``scatter`` is the standard deviation among the runs; of a single run it is the deviation that the run states.
    ``error`` is that of the mean, scatter / sqrt(count).
    """

    count: int
    mean: float
    scatter: float

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return self.scatter / math.sqrt(self.count)


def mean_bias(points: Sequence[BiasPoint], quantity: HostQuantity) -> Spread:
    """Mean and scatter of the biases; a NothingToShowError without points."""
    bias, sd = _arrays(points, quantity)
    scatter = bias.std(ddof=1) if len(bias) > 1 else sd[0]
    return Spread(len(bias), float(bias.mean()), float(scatter))


def pulls(points: Sequence[BiasPoint], quantity: HostQuantity) -> FloatArray:
    """Bias in units of the stated deviation, (points,): infinite where a wrong answer states none."""
    bias, sd = _arrays(points, quantity)
    stated = sd > 0.0
    safe = np.where(stated, sd, 1.0)
    return np.where(stated, bias / safe, np.where(bias == 0.0, 0.0, np.copysign(np.inf, bias)))


@dataclass(frozen=True)
class CoverageCurve:
    """How often the truth lies in intervals that claim to hold it.

    ``inside`` of ``count`` runs have their truth within the central interval of probability ``claimed`` (levels,) of
    a normal with the stated mean and deviation.
    """

    name: str
    claimed: FloatArray
    inside: NDArray[np.int64]
    count: int

    @property
    def actual(self) -> FloatArray:
        """Share of the runs, (levels,)."""
        return np.asarray(self.inside / self.count)

    @property
    def interval(self) -> FloatArray:
        """Lower and upper end of Wilson's binomial 68 % interval of the share, (2, levels)."""
        from astropy.stats import binom_conf_interval  # noqa: PLC0415 - who draws no coverage need not load it

        ends = binom_conf_interval(self.inside, np.full(self.inside.shape, self.count), ONE_SIGMA, interval="wilson")
        return np.asarray(ends)


def coverage_curve(
    name: str, points: Sequence[BiasPoint], quantity: HostQuantity, claimed: Sequence[float] = CLAIMED
) -> CoverageCurve:
    """Coverage of the points' stated intervals; a NothingToShowError without points."""
    levels = np.asarray(claimed, dtype=float)
    if levels.size == 0 or not np.all((levels > 0.0) & (levels < 1.0)):
        raise FigureError(f"claimed: got {list(claimed)}, allowed are probabilities between 0 and 1")
    reach = np.array([NormalDist().inv_cdf(0.5 + 0.5 * level) for level in levels])
    inside = (np.abs(pulls(points, quantity))[None, :] <= reach[:, None]).sum(axis=1)
    return CoverageCurve(name, levels, inside.astype(np.int64), len(points))


@dataclass(frozen=True)
class PullSummary:
    """Pulls of one group: a histogram over ``edges`` (bins + 1,), what lies beyond them, and the middle of all.

    ``low`` and ``high`` are the 15.87 and 84.13 percentiles, at -1 and +1 where deviations are stated rightly.
    """

    name: str
    edges: FloatArray
    counts: NDArray[np.int64]
    below: int
    above: int
    count: int
    median: float
    low: float
    high: float


def pull_summary(
    name: str, points: Sequence[BiasPoint], quantity: HostQuantity, edges: Sequence[float] = PULL_EDGES
) -> PullSummary:
    """Histogram and percentiles of the points' pulls; a NothingToShowError without points."""
    values, bounds = pulls(points, quantity), np.asarray(edges, dtype=float)
    counts, _ = np.histogram(values[np.isfinite(values)], bounds)
    # No interpolation: between an infinite pull and a finite one there is nothing.
    low, median, high = np.quantile(values, (_LOW, 0.5, _HIGH), method="closest_observation")
    return PullSummary(
        name=name,
        edges=bounds,
        counts=counts.astype(np.int64),
        below=int((values < bounds[0]).sum()),
        above=int((values > bounds[-1]).sum()),
        count=len(values),
        median=float(median),
        low=float(low),
        high=float(high),
    )


@dataclass(frozen=True)
class TrendBin:
    """Biases of the runs between ``lower`` and ``upper``: at their mean ``centre``, their spread, 16 and 84 %."""

    lower: float
    upper: float
    centre: float
    spread: Spread
    low: float
    high: float


@dataclass(frozen=True)
class TrendSeries:
    """A series of bins, those without a run left out."""

    name: str
    quantity: HostQuantity
    against: Trend
    bins: tuple[TrendBin, ...]


def trend_series(
    name: str, points: Sequence[BiasPoint], quantity: HostQuantity, against: Trend, width: float = BIN_WIDTH
) -> TrendSeries:
    """Bias against arc magnitude, AGN contrast or surface brightness in bins of ``width`` magnitudes from zero on.

    Points without the abscissa (a contrast without AGN) are in no bin; a NothingToShowError where none has it.
    """
    if against not in TRENDS:
        raise FigureError(f"against: got {against!r}, allowed is one of {list(TRENDS)}")
    if not (math.isfinite(width) and width > 0.0):
        raise FigureError(f"width: got {width!r}, allowed is a positive number of magnitudes")
    members: dict[int, list[tuple[float, BiasPoint]]] = {}
    for point in points:
        value = getattr(point, against)
        if value is not None:
            members.setdefault(math.floor(value / width), []).append((value, point))
    if not members:
        raise NothingToShowError(f"points: got none with {against}, allowed is at least one result that has it")
    return TrendSeries(
        name, quantity, against, tuple(_bin(index, width, members[index], quantity) for index in sorted(members))
    )


def _bin(index: int, width: float, members: list[tuple[float, BiasPoint]], quantity: HostQuantity) -> TrendBin:
    values, inside = zip(*members, strict=True)
    low, high = np.quantile([point.bias(quantity) for point in inside], (_LOW, _HIGH))
    return TrendBin(
        lower=index * width,
        upper=(index + 1) * width,
        centre=float(np.mean(values)),
        spread=mean_bias(inside, quantity),
        low=float(low),
        high=float(high),
    )
