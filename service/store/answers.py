"""Answers over results of any grids: biases by group, along an axis, and of one analysis against another."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, Select, and_, func, literal_column, select

from service.domain.states import RunState
from service.store.numbers import read_numbers
from service.store.result_filter import AXES, ResultFilter, axes_of_run, profile_of_spec
from service.store.statistics import FloatArray, IntArray, Moments, Share, moments, share
from service.store.tables import estimate, grid, input_group, result, run

TRENDS = {
    "arc_magnitude": (result.c.arc_magnitude, "AB mag", "Magnitude of the lensed host in the image"),
    "agn_contrast": (result.c.agn_contrast, "mag", "Magnitude of the AGN less that of the lensed host"),
    "surface_brightness": (result.c.surface_brightness, "mag arcsec-2", "Mean of the host within its r_eff"),
}
"""What a trend may be against: column, unit, description."""
ANALYSES = ("estimator", "index_prior", "profile", "noise_treatment", "regularisation", "engine")
"""What two analyses of one observation may differ in."""
NOMINAL = {"68": 0.9944578832097535, "95": 1.959963984540054}
"""Half-widths in sd of the intervals whose coverage is told, after the percentage that they should hold."""
WITHIN_MAG = (0.5, 1.25)
"""Bands of the paper's figures [mag]."""
SHOWN_RUNS = 10


@dataclass(frozen=True)
class Question:
    """Which results, and which quantity by which estimator."""

    where: ResultFilter
    quantity: str
    estimator: str
    index_prior: str

    def answers(self) -> ColumnElement[bool]:
        """On rows of the table ``estimate``."""
        mine = (estimate.c.estimator == self.estimator) & (estimate.c.index_prior == self.index_prior)
        inputs = self.where.inputs()
        return mine if inputs is None else mine & estimate.c.input_id.in_(inputs)


@dataclass(frozen=True)
class Biases:
    """Recovered minus input in each group, and how far the stated errors hold.

    ``pull`` is of bias / sd; ``coverage`` by the percentage of NOMINAL, ``within`` by the bands of WITHIN_MAG.
    """

    bias: Moments
    sd: FloatArray
    pull: Moments
    coverage: dict[str, Share]
    within: dict[float, Share]


@dataclass(frozen=True)
class Grouping:
    """Inputs in groups: what each group has in common, and for each input id the group (-1: not meant) and cluster.

    Seeds of one input are a cluster, in whatever grids.
    """

    axes: tuple[str, ...]
    values: list[tuple[Any, ...]]
    inputs: list[list[int]]
    runs: IntArray
    cpu_s: FloatArray
    group_of: IntArray
    cluster_of: IntArray


def grouped(connection: Connection, where: ResultFilter, axes: Sequence[str]) -> Grouping:
    """The inputs that are meant, by what they have in common on ``axes``, in the order of these values."""
    names = ("id", "digest", "runs", "cpu_s")
    wanted = select(*(input_group.c[name] for name in names), *(AXES[axis].column for axis in axes))
    condition = where.conditions()
    rows = connection.execute(wanted if condition is None else wanted.where(condition)).all()
    members: defaultdict[tuple[Any, ...], list[int]] = defaultdict(list)
    for place, row in enumerate(rows):
        members[tuple(row)[len(names) :]].append(place)
    values = sorted(members, key=lambda group: [(value is None, value) for value in group])
    ids = np.array([row.id for row in rows], dtype=np.intp)
    group_of = np.full(int(ids.max(initial=0)) + 1, -1, dtype=np.intp)
    cluster_of = np.zeros_like(group_of)
    for number, group in enumerate(values):
        group_of[ids[members[group]]] = number
    digests = {digest: number for number, digest in enumerate({row.digest for row in rows})}
    cluster_of[ids] = [digests[row.digest] for row in rows]
    groups = group_of[ids]
    return Grouping(
        tuple(axes),
        values,
        [sorted(ids[members[group]].tolist()) for group in values],
        np.bincount(groups, weights=[row.runs for row in rows], minlength=len(values)).astype(np.intp),
        np.bincount(groups, weights=[row.cpu_s for row in rows], minlength=len(values)).astype(float),
        group_of,
        cluster_of,
    )


def biases_by_group(connection: Connection, question: Question, groups: Grouping) -> tuple[Biases, IntArray]:
    """Statistics of each group, and how many results in it have an answer of the estimator, with a truth or without."""
    columns = (estimate.c.input_id, *_bias_and_sd(question.quantity))
    found = read_numbers(connection, select(*columns).where(question.answers()))
    inputs = found[:, 0].astype(np.intp)
    group = groups.group_of[inputs]
    answered = np.bincount(group, minlength=len(groups.values))
    known = ~np.isnan(found[:, 1])
    bias, sd = found[known, 1], found[known, 2]
    clusters = groups.cluster_of[inputs[known]]
    return biases(bias, sd, group[known], len(groups.values), clusters, question.quantity), answered


def biases(
    bias: FloatArray, sd: FloatArray, group: IntArray, n_groups: int, clusters: IntArray, quantity: str
) -> Biases:
    """Statistics of biases and their stated errors, each in one of ``n_groups`` groups."""
    of_bias = moments(bias, group, n_groups, clusters)
    number = of_bias.number
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_sd = np.bincount(group, weights=sd, minlength=n_groups) / number
    stated = sd > 0.0
    return Biases(
        of_bias,
        mean_sd,
        moments(bias[stated] / sd[stated], group[stated], n_groups, clusters[stated]),
        {name: share(np.abs(bias) <= width * sd, group, number) for name, width in NOMINAL.items()},
        {band: share(np.abs(bias) < band, group, number) for band in WITHIN_MAG} if quantity == "magnitude" else {},
    )


# By grid, because an index of the runs has it in front: few grids are looked into, however many runs there are.
_FAILED: tuple[ColumnElement[bool], ...] = (
    run.c.grid_id.in_(select(grid.c.id).where(grid.c.state != "done")),
    run.c.state.in_([literal_column(f"'{state}'") for state in (RunState.FAILED, RunState.QUARANTINED)]),
)


def failures_digest(connection: Connection) -> str:
    """A digest that changes with the runs that failed or were quarantined: their index is read, and none of them."""
    failed = select(run.c.grid_id, run.c.ordinal).where(*_FAILED).order_by(run.c.grid_id, run.c.ordinal)
    digest = hashlib.sha256()
    for grid_id, ordinal in connection.execute(failed):
        digest.update(f"{grid_id} {ordinal}\n".encode())
    return digest.hexdigest()


def failures_by_group(connection: Connection, where: ResultFilter, groups: Grouping) -> tuple[IntArray, int]:
    """Runs that failed or were quarantined in each group, and those that would be in a group without any result."""
    analysis = run.c.spec["analysis"]
    failed = (
        select(
            run.c.grid_id,
            run.c.inputs,
            profile_of_spec(),
            analysis["regularisation"].as_string(),
            grid.c.engine_digest,
        )
        .join(grid, grid.c.id == run.c.grid_id)
        .where(*_FAILED)
    )
    places = {values: number for number, values in enumerate(groups.values)}
    counted = np.zeros(len(groups.values), dtype=np.intp)
    elsewhere = 0
    for grid_id, inputs, profile, regularisation, engine in connection.execute(failed):
        known = axes_of_run(inputs, grid_id, profile, regularisation, engine)
        if where.accepts(known):
            place = places.get(tuple(known[axis] for axis in groups.axes))
            if place is None:
                elsewhere += 1
            else:
                counted[place] += 1
    return counted, elsewhere


def first_runs(connection: Connection, inputs: Sequence[int]) -> list[str]:
    """The first runs with a result among those of some inputs; ten at most, and of the first inputs."""
    wanted = select(result.c.run_id).where(result.c.input_id.in_(inputs[:SHOWN_RUNS]))
    return list(connection.scalars(wanted.order_by(result.c.input_id, result.c.run_id).limit(SHOWN_RUNS)))


@dataclass(frozen=True)
class Series:
    """Biases along an axis, for each group in ``n_bins`` bins of equal width between ``edges``.

    Bins of a group are consecutive: the statistics of group g and bin b are at ``g * n_bins + b``.
    """

    edges: FloatArray
    centre: FloatArray
    biases: Biases


def trend(connection: Connection, question: Question, groups: Grouping, against: str, n_bins: int) -> Series:
    """How the bias goes with a property of the observation; results without it are left out."""
    axis = TRENDS[against][0]
    columns = (estimate.c.input_id, *_bias_and_sd(question.quantity), axis)
    joined = select(*columns).join_from(estimate, result, result.c.run_id == estimate.c.run_id)
    found = read_numbers(connection, joined.where(question.answers()))
    found = found[~np.isnan(found).any(axis=1)]
    inputs, bias, sd, x = found[:, 0].astype(np.intp), found[:, 1], found[:, 2], found[:, 3]
    edges = np.linspace(x.min(), x.max(), n_bins + 1) if len(x) else np.zeros(n_bins + 1)
    # The last bin holds its upper edge, too.
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, n_bins - 1)
    cell = groups.group_of[inputs] * n_bins + place
    n_cells = len(groups.values) * n_bins
    of_cells = biases(bias, sd, cell, n_cells, groups.cluster_of[inputs], question.quantity)
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = np.bincount(cell, weights=x, minlength=n_cells) / of_cells.bias.number
    return Series(edges, centre, of_cells)


@dataclass(frozen=True)
class Differences:
    """Left minus right over pairs of one observation, in each group; ``closer``: how often left is nearer the truth."""

    difference: Moments
    closer: Share


def compare(
    connection: Connection, question: Question, by: str, left: str | None, right: str | None, axes: Sequence[str]
) -> tuple[Grouping, Differences]:
    """Two analyses of the same observations, which differ in ``by``; grouped by ``axes`` of the left one.

    Where one side has an observation several times (in several grids) its mean counts, once.
    """
    groups = grouped(connection, question.where, axes)
    one, other = result.alias("left"), result.alias("right")
    of_one, of_other = estimate.alias("left_estimate"), estimate.alias("right_estimate")
    mean, bias = f"{question.quantity}_mean", f"{question.quantity}_bias"
    pairs = (
        select(
            func.min(one.c.input_id),
            func.avg(of_one.c[mean]) - func.avg(of_other.c[mean]),
            func.avg(func.abs(of_one.c[bias])) - func.avg(func.abs(of_other.c[bias])),
        )
        .join_from(one, of_one, of_one.c.run_id == one.c.run_id)
        .join(other, other.c.observation_digest == one.c.observation_digest)
        .join(of_other, of_other.c.run_id == other.c.run_id)
        .where(_side(question, one, of_one, by, left), _side(question, other, of_other, by, right))
        .group_by(one.c.observation_digest)
    )
    found = read_numbers(connection, pairs)
    inputs = found[:, 0].astype(np.intp)
    group, clusters = groups.group_of[inputs], groups.cluster_of[inputs]
    differences = moments(found[:, 1], group, len(groups.values), clusters)
    known: NDArray[np.bool_] = ~np.isnan(found[:, 2])
    judged = np.bincount(group[known], minlength=len(groups.values))
    return groups, Differences(differences, share(found[known, 2] < 0.0, group[known], judged))


def _side(question: Question, of: Any, answer: Any, by: str, value: str | None) -> ColumnElement[bool]:
    """Results and answers of one side of a comparison."""
    estimator, prior = question.estimator, question.index_prior
    if by == "estimator":
        estimator = value or ""
    elif by == "index_prior":
        prior = value or ""
    parts = [answer.c.estimator == estimator, answer.c.index_prior == prior]
    inputs: Select[Any] | None = question.where.inputs()
    if inputs is not None:
        parts.append(of.c.input_id.in_(inputs))
    if by in AXES:
        column = of.c[AXES[by].column.name]
        parts.append(column.is_(None) if value is None else column == value)
    return and_(*parts)


def _bias_and_sd(quantity: str) -> tuple[ColumnElement[float], ColumnElement[float]]:
    return estimate.c[f"{quantity}_bias"], estimate.c[f"{quantity}_sd"]
