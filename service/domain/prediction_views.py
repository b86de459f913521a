"""What POST /v1/predictions answers. Free of the engine, as all that the client reads; six significant digits."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict

from service.domain.payload import EstimateName
from service.domain.views import Interval


class _Answer(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class ExpectedView(_Answer):
    """A number with the interval that holds it with the probability ``level``."""

    expected: float
    low: float
    high: float


class PredictedQuantity(_Answer):
    """Recovered minus true: its mean, its scatter, and both together."""

    unit: str | None
    bias: ExpectedView
    """Mean over many images of this lens."""
    scatter: ExpectedView
    """Standard deviation of one measurement about that mean."""
    measurement: ExpectedView
    """What a single image will show."""


class NearestRun(_Answer):
    """The simulated run that is most like the lens."""

    lens: str
    run_id: str
    distance: float
    """In large differences: 1 is two images against four, or S/N by 3.2, or 1.5 in n, ..."""
    differences: dict[str, float]
    """The same, by feature: this lens less that one."""


class PredictedEstimator(_Answer):
    """What is expected of one estimator."""

    magnitude: PredictedQuantity | None
    r_eff: PredictedQuantity | None
    n: PredictedQuantity | None
    """Null where the estimator holds it fixed."""
    runs: int
    """Behind the numbers."""
    lenses: int
    run_ids: list[str]
    """The nearest ten, the nearest first."""
    extrapolating: bool
    """No run is nearer than a distance of 1.5."""
    nearest: NearestRun


class PredictedDepth(_Answer):
    """What is expected after so many times the exposures of the lens."""

    exposures: float
    depth: float
    """One sigma of empty sky in a square arcsec [AB mag]."""
    arc_snr: float
    """Half the arc's light over the sky's noise under it."""
    estimates: dict[EstimateName, PredictedEstimator]


class GridOffer(_Answer):
    """A grid that would settle what is predicted."""

    what: str
    request: dict[str, Any]
    """A body of POST /v1/grids."""
    n_runs: int
    cpu_s: Interval | None
    """Of all of its runs; null where no run of such a camera is stored."""
    cost_from: str
    """Which runs that was taken from."""


class PredictionAnswer(_Answer):
    """Bias and scatter that are to be expected in a lens, from runs of other lenses."""

    lens: dict[str, float | str | None]
    """What the prediction was made from."""
    level: float
    """Probability of the intervals."""
    extrapolating: bool
    """For one of the estimators at least, no simulated lens is near."""
    told: str
    """The same in words, and what else is to be known."""
    predictions: list[PredictedDepth]
    to_know: list[GridOffer]
    """Grids that would settle it: none of a lens that is known by its traits alone."""
