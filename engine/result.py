"""What an analysis and a run return: typed numbers for the database, and arrays for figures and files."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.spec.analysis import EstimatorName
from engine.work import Work

IndexPrior = Literal["wide", "free", "fixed"]
INDEX_PRIORS: tuple[IndexPrior, ...] = get_args(IndexPrior)
INDEX_RANGES: dict[IndexPrior, tuple[float, float]] = {"wide": (0.3, 8.0), "free": (1.0, 4.0)}
"""Flat priors of n; ``free`` is the paper's section 4.2, 'we constrain n to be in the range 1-4'."""
ChainStatus = Literal["converged", "not_converged"]
_NORMAL_95 = 1.959963985
"""Standard deviations on either side of the mean that hold 95 % of a normal distribution."""


@dataclass(frozen=True)
class Quantity:
    """A recovered quantity: mean, standard deviation, and the truth where there is one.

    It is normally distributed, or its logarithm is where it is ``log_normal``: a radius does not reach below zero.
    """

    mean: float
    sd: float
    truth: float | None = None
    log_normal: bool = False

    @property
    def bias(self) -> float | None:
        """Recovered mean minus truth, None without a truth."""
        return None if self.truth is None else self.mean - self.truth

    @property
    def interval95(self) -> tuple[float, float]:
        """The interval that holds it with 95 %."""
        if not self.log_normal:
            return self.mean - _NORMAL_95 * self.sd, self.mean + _NORMAL_95 * self.sd
        variance = math.log1p((self.sd / self.mean) ** 2)
        middle, reach = math.log(self.mean) - 0.5 * variance, _NORMAL_95 * math.sqrt(variance)
        return math.exp(middle - reach), math.exp(middle + reach)

    def beside(self, truth: float, period: float | None = None) -> Quantity:
        """The same beside its truth; a quantity with a period moves by as many of them as bring it nearest."""
        mean = self.mean if period is None else truth + math.remainder(self.mean - truth, period)
        return replace(self, mean=mean, truth=truth)


@dataclass(frozen=True)
class NumericalError:
    """How far a quantity is expected to be from what a converged computation on the same data would say.

    Each part is what one stage costs in accuracy, in units of the quantity: ``rendering`` of the host's light (and
    what the search for a minimum leaves), the ``psf`` as it is cut or moved, the source ``grid``, the ``sampling`` of
    the posterior by a chain of finite length, and the ``draws`` of it that are fitted.
    """

    rendering: float
    psf: float
    grid: float
    sampling: float
    draws: float

    @property
    def total(self) -> float:
        """Root of the sum of their squares: the stages err on their own."""
        return math.sqrt(sum(getattr(self, stage) ** 2 for stage in ERROR_STAGES))


ERROR_STAGES: tuple[str, ...] = tuple(field.name for field in fields(NumericalError))


@dataclass(frozen=True)
class ErrorBudget:
    """The numerical error of an estimate: magnitude [mag], r_eff [arcsec], n."""

    magnitude: NumericalError
    r_eff: NumericalError
    n: NumericalError


BUDGETED: tuple[str, ...] = tuple(field.name for field in fields(ErrorBudget))


@dataclass(frozen=True)
class Estimate:
    """One estimator's answer from ``draws`` fits: one to each drawn source, or the one to the image itself.

    Total magnitude [AB], r_eff [arcsec, intermediate axis], n, q, position angle [deg], centre x, y [arcsec, source
    plane in the image frame]; ``r_eff_galfit`` is GALFIT's radius, on the major axis: r_eff / sqrt(q).

    ``at_bound`` counts the fits that ended at a bound of n or of r_eff, ``n_at_bound`` and ``r_eff_at_bound`` those of
    each; ``failed`` counts those that did not succeed and are left out of the means. ``budget`` is the numerical error
    of the means beside their statistical one, None where it could not be predicted.
    """

    estimator: EstimatorName
    index_prior: IndexPrior
    magnitude: Quantity
    r_eff: Quantity
    r_eff_galfit: Quantity
    n: Quantity
    q: Quantity
    position_angle: Quantity
    x: Quantity
    y: Quantity
    draws: int
    at_bound: int
    n_at_bound: int
    r_eff_at_bound: int
    failed: int
    budget: ErrorBudget | None = None


@dataclass(frozen=True)
class Aperture:
    """AB magnitude of the drawn source maps within ``radius`` [arcsec] of the host's centre, without a profile.

    The centre is that of the ``paper`` fit to the same map, n in the wide range. ``coverage`` is the share of the
    circle that the source grid covers, in the mean: light beyond it is not seen. ``failed`` counts the draws without
    a centre or without light.
    """

    radius: float
    magnitude: Quantity
    coverage: float
    draws: int
    failed: int


@dataclass(frozen=True)
class LensParameter:
    """Posterior of one lens parameter (theta_E, q, phi, slope, x, y, gamma1, gamma2, ln_lambda)."""

    name: str
    value: Quantity


@dataclass(frozen=True)
class ChainSummary:
    """How well the posterior is sampled.

    ``tau`` is the integrated autocorrelation time in steps, largest over the parameters; ``effective_samples`` the
    number of independent samples that it leaves; ``burn_in`` the steps of all walkers that the evaluations before the
    first sample would have made; ``r_hat`` the split R-hat (:mod:`engine.posterior.convergence`), None
    where it was not computed.
    """

    status: ChainStatus
    walkers: int
    steps: int
    burn_in: int
    tau: float
    effective_samples: float
    acceptance: float
    evaluations: int
    r_hat: float | None = None


@dataclass(frozen=True)
class StageTime:
    """Wall and CPU seconds of one stage of the run."""

    stage: str
    wall_s: float
    cpu_s: float


@dataclass(frozen=True)
class ImagePlane:
    """Maps on the pixels of an observation.

    ``image``, ``noise``, ``model`` and ``arc_model`` (the lensed host) are (ny, nx) in e-/s, ``residual`` in units of
    the noise; ``mask`` is True where fitted; ``pixel_scale`` in arcsec.
    """

    image: FloatArray
    noise: FloatArray
    model: FloatArray
    arc_model: FloatArray
    residual: FloatArray
    mask: NDArray[np.bool_]
    pixel_scale: float


@dataclass(frozen=True)
class SourcePlane:
    """Maps of an inversion on its source grid, and the samples that it is one of.

    ``source``, ``source_sd`` and ``source_truth`` (None where it is not known) are (ny, nx) in e-/s per arcsec^2 on
    cells with edges ``source_x_edges`` (nx + 1,) and ``source_y_edges`` (ny + 1,) [arcsec]; ``chain`` is (samples,
    parameters) in the order of ``parameter_names``.
    """

    source: FloatArray
    source_sd: FloatArray
    source_x_edges: FloatArray
    source_y_edges: FloatArray
    chain: FloatArray
    parameter_names: tuple[str, ...]
    source_truth: FloatArray | None = None


@dataclass(frozen=True)
class Products:
    """Arrays of a run for figures and files; ``source_plane`` is None where there was no inversion."""

    image_plane: ImagePlane
    source_plane: SourcePlane | None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Every array and number by its name."""
        values = vars(self.image_plane) | ({} if self.source_plane is None else vars(self.source_plane))
        return {name: np.asarray(value) for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class RunResult:
    """The outcome of one run.

    ``profile`` names the analysis profile, None where the run chose its settings (``max_error``). An estimator that
    could not fit a single draw is not among the ``estimates``, and a warning says why; ``aperture`` is None likewise.
    ``chain``, ``ln_evidence``, ``condition_number`` and ``aperture`` are None where no estimator needed an inversion;
    ``lens``, ``chi2`` and ``degrees_of_freedom`` are then those of the parametric fit. With one,
    ``degrees_of_freedom`` are the fitted pixels less the amplitudes and the source parameters that the data determine.
    ``arc_magnitude`` is the AB magnitude of the lensed host in the image plane, ``agn_contrast`` AGN minus arc
    magnitude, ``surface_brightness`` the host's mean surface brightness inside r_eff [mag arcsec^-2] (the paper's
    section 5). ``work`` counts what simulation and analysis computed: the same for the same specification, wherever.
    """

    realization_digest: str
    engine_digest: str
    versions: dict[str, str]
    seed: int
    noise_level: str
    noise_treatment: str
    regularisation: str
    estimates: tuple[Estimate, ...]
    aperture: Aperture | None
    lens: tuple[LensParameter, ...]
    chain: ChainSummary | None
    ln_evidence: float | None
    chi2: float
    degrees_of_freedom: int
    condition_number: float | None
    arc_magnitude: float
    agn_contrast: float | None
    surface_brightness: float
    stages: tuple[StageTime, ...]
    work: Work
    warnings: tuple[str, ...] = ()
    profile: str | None = None
    products: Products | None = field(default=None, repr=False, compare=False)

    def estimate(self, estimator: EstimatorName, index_prior: IndexPrior) -> Estimate:
        """The answer of one estimator; KeyError where the run has none."""
        for found in self.estimates:
            if (found.estimator, found.index_prior) == (estimator, index_prior):
                return found
        raise KeyError((estimator, index_prior))
