"""What the API answers over results of any grids. Numbers derived from many runs have six significant digits."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict


class _Answer(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class ShareView(_Answer):
    """Part of the runs, with its 68.3 % interval after Wilson."""

    fraction: float
    low: float
    high: float


class PullView(_Answer):
    """Of bias / sd, where the sd is not zero: 0 and 1 if the stated errors are right and there is no bias."""

    runs: int
    mean: float | None
    scatter: float | None


class BiasView(_Answer):
    """Recovered minus input over some runs."""

    runs: int
    """With an answer of the estimator, and a truth to compare it with."""
    inputs: int
    """Different inputs among them; runs of one input differ in their seed."""
    mean: float
    standard_error: float | None
    """Of the mean. Seeds of one input count as one measure of it; of one input alone it is scatter / sqrt(runs)."""
    median: float
    p16: float
    p84: float
    rmse: float
    scatter: float | None
    stated_sd: float
    """Mean of the standard deviations that the runs state."""
    pull: PullView
    coverage: dict[str, ShareView]
    """Part of the runs whose 68 % and 95 % interval holds the truth."""
    within: dict[str, ShareView]
    """Part of the runs with a bias below so many magnitudes; for the magnitude alone."""


class QuestionView(_Answer):
    """What was asked, with what was taken where nothing was said."""

    quantity: str
    unit: str | None
    estimator: str
    index_prior: str
    recommended: bool
    """The estimator and prior to quote where there is no reason for another: image, n in 0.3-8."""
    group_by: list[str]
    filter: dict[str, list[str]]


class GroupView(_Answer):
    """Runs that agree in what they were grouped by."""

    group: dict[str, Any]
    stored: int
    """Runs with a result."""
    answered: int
    """Those of them in which the estimator has an answer."""
    failed: int
    """Runs that failed or were quarantined, and have no result."""
    cpu_s: float
    """Of all runs with a result."""
    bias: BiasView | None
    run_ids: list[str]
    """The first runs; all of them are at ``links.results``."""
    links: dict[str, str]


class SummaryAnswer(_Answer):
    """Biases by group."""

    question: QuestionView
    rows: list[GroupView]
    failed_elsewhere: int
    """Runs that failed and would be in a group of which there is no result yet."""
    next: str | None


class BinView(_Answer):
    """Runs within a bin of the axis."""

    low: float
    high: float
    centre: float
    """Mean of the axis over the runs."""
    bias: BiasView


class SeriesView(_Answer):
    """One group's biases along the axis; bins without a run are left out."""

    group: dict[str, Any]
    bins: list[BinView]
    links: dict[str, str]


class TrendAnswer(_Answer):
    """Biases along an axis, in bins of equal width."""

    question: QuestionView
    against: str
    against_unit: str
    series: list[SeriesView]


class DifferenceView(_Answer):
    """Left minus right, over observations that both have an answer for."""

    group: dict[str, Any]
    pairs: int
    inputs: int
    mean: float
    standard_error: float | None
    median: float
    p16: float
    p84: float
    scatter: float | None
    left_closer: ShareView | None
    """How often the left answer is nearer to the truth."""
    links: dict[str, str]


class ComparisonAnswer(_Answer):
    """Two analyses of the same observations."""

    question: QuestionView
    compare: str
    left: str
    right: str
    rows: list[DifferenceView]


class ResultPage(_Answer):
    """Results as flat rows, by run id; what the columns mean is said in ``columns``."""

    columns: dict[str, dict[str, str | None]]
    items: list[dict[str, Any]]
    next: str | None


class ProfileErrorView(_Answer):
    """What stored runs of one profile predict of their numerical error, and what they took."""

    profile: str
    stored: int
    """With an answer of the estimator; the newest 20,000 are looked at."""
    with_error: int
    """Of which so many have a predicted error: the others are older, or it could not be predicted."""
    kept: bool
    """Whether ``kept_by`` of them predict no more than ``max_error``."""
    keeps: ShareView | None
    """How many do."""
    median_error: float | None
    p95_error: float | None
    cpu_s: float | None
    """Expected of a run: the mean over those with a predicted error."""
    cpu_s_scatter: float | None
    run_ids: list[str]
    """The newest of them, ten at most."""
    links: dict[str, str]


class FrontierAnswer(_Answer):
    """The cheapest profile that keeps a numerical error, by what stored runs predict of themselves."""

    quantity: str
    unit: str | None
    max_error: float
    estimator: str
    index_prior: str
    filter: dict[str, list[str]]
    kept_by: float
    """Part of the stored runs of a profile that must predict no more for the profile to keep the error."""
    cheapest: str | None
    told: str
    """The same in words; where no stored run tells, that."""
    profiles: list[ProfileErrorView]
    """The cheapest first."""
    to_know: list[dict[str, Any]]
    """Bodies of POST /v1/grids for the profiles of which fewer than 30 stored runs tell."""
