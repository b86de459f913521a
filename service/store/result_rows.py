"""Results as flat rows, one after the other: what lists and exports are made of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, and_, select
from sqlalchemy.sql.selectable import FromClause

from service.domain.payload import (
    COUNTS,
    ERROR_PARTS,
    ESTIMATES,
    LENS_PARAMETERS,
    QUANTITIES,
    EstimateName,
    estimator_and_prior,
)
from service.store.result_filter import ResultFilter
from service.store.tables import estimate, result, run

_AT_ONCE = 1000
_ARCSEC, _DEGREE, _MAG = "arcsec", "deg", "AB mag"
QUANTITY_UNITS: dict[str, str | None] = {
    "magnitude": _MAG, "r_eff": _ARCSEC, "r_eff_galfit": _ARCSEC, "n": None,
    "q": None, "position_angle": _DEGREE, "x": _ARCSEC, "y": _ARCSEC,
}  # fmt: skip
_QUANTITY_NAMES = {
    "magnitude": "total magnitude of the host",
    "r_eff": "half-light radius of the host on the intermediate axis",
    "r_eff_galfit": "half-light radius of the host on the major axis, as GALFIT's",
    "n": "Sersic index of the host",
    "q": "axis ratio of the host",
    "position_angle": "position angle of the host, from the x axis",
    "x": "x of the host's centre in the source plane",
    "y": "y of the host's centre in the source plane",
}
_COUNT_NAMES = {
    "draws": "draws of the posterior that were fitted",
    "at_bound": "draws whose fit ended at a bound of n or r_eff",
    "n_at_bound": "draws whose fit ended at a bound of n",
    "r_eff_at_bound": "draws whose fit ended at a bound of r_eff",
    "failed": "draws that could not be fitted",
}
_LENS_UNITS = {"theta_E": _ARCSEC, "phi": "rad", "x": _ARCSEC, "y": _ARCSEC}
_PARTS = {
    "mean": "mean over the draws",
    "sd": "standard deviation over the draws",
    "bias": "recovered minus true, null without a truth",
    "truth": "the truth, null without one",
}


@dataclass(frozen=True)
class ResultColumn:
    """A column of flat results; ``kind`` is the type of its values that are not null."""

    name: str
    kind: type
    description: str
    unit: str | None
    expression: ColumnElement[Any]


_PLAIN: tuple[tuple[Any, type, str, str | None], ...] = (
    (result.c.run_id, str, "the run", None),
    (result.c.grid_id, str, "the grid that the run belongs to", None),
    (run.c.label, str, "the run's name within its grid", None),
    (run.c.paper_run, int, "serial number in the paper's Table 3", None),
    (result.c.system, str, "lens system", None),
    (result.c.camera, str, "camera", None),
    (result.c.configuration, str, "quad, double or other, by the number of AGN images", None),
    (result.c.mass_model, str, "mass model of the system", None),
    (result.c.l_eta, float, "slope of the deflector's mass, less 1", None),
    (result.c.host_kind, str, "kind of the host that was put in", None),
    (result.c.host_label, str, "name of the host that was put in", None),
    (result.c.deflector, str, "what the deflector has beside one profile and one power law", None),
    (result.c.n, float, "Sersic index that was put in, null where the host has none", None),
    (result.c.r_eff, float, "half-light radius that was put in", _ARCSEC),
    (result.c.magnitude, float, "magnitude that was put in", _MAG),
    (result.c.defocus_nm, float, "focus error of the telescope, rms of wavefront", "nm"),
    (result.c.jitter, float, "pointing jitter of the telescope, rms an axis", _ARCSEC),
    (result.c.colour, float, "how much bluer the sky is than the star of the PSF", None),
    (result.c.residual, float, "random error of the PSF, as a part of its light", None),
    (result.c.coarse, float, "sub-pixels a side on which the PSF is known", None),
    (result.c.seed, int, "seed of the realization", None),
    (result.c.noise_level, str, "noise of the simulation", None),
    (result.c.noise_treatment, str, "noise as the analysis takes it", None),
    (result.c.regularisation, str, "regularisation of the source", None),
    (result.c.profile, str, "profile of the analysis", None),
)
_MEASURES: tuple[tuple[Any, type, str, str | None], ...] = (
    (result.c.aperture_radius, float, "radius of the aperture round the host", _ARCSEC),
    *(
        (result.c[f"aperture_magnitude_{part}"], float, f"magnitude within the aperture: {_PARTS[part]}", _MAG)
        for part in ("mean", "sd", "bias")
    ),
    (result.c.aperture_coverage, float, "share of the aperture that the source grid covers", None),
    (result.c.aperture_draws, int, "draws with a magnitude within the aperture", None),
    (result.c.aperture_failed, int, "draws without one", None),
    *(
        (
            result.c[f"lens_{name.lower()}_{part}"],
            float,
            f"lens parameter {name}: {_PARTS[part]}",
            _LENS_UNITS.get(name),
        )
        for name in LENS_PARAMETERS
        for part in ("mean", "sd", "truth")
    ),
    (result.c.arc_magnitude, float, "magnitude of the lensed host in the image", _MAG),
    (result.c.agn_contrast, float, "magnitude of the AGN less that of the lensed host", "mag"),
    (result.c.surface_brightness, float, "mean surface brightness of the host within its r_eff", "mag arcsec-2"),
    (result.c.chain_status, str, "whether the chain converged", None),
    (result.c.walkers, int, "walkers of the chain", None),
    (result.c.steps, int, "steps of the chain", None),
    (result.c.burn_in, int, "steps that were left out", None),
    (result.c.tau, float, "autocorrelation time in steps", None),
    (result.c.effective_samples, float, "independent samples of the posterior", None),
    (result.c.acceptance, float, "share of the proposals that were accepted", None),
    (result.c.evaluations, int, "evaluations of the evidence", None),
    (result.c.r_hat, float, "split R-hat", None),
    (result.c.ln_evidence, float, "natural logarithm of the evidence", None),
    (result.c.chi2, float, "chi-squared of the fitted pixels", None),
    (result.c.degrees_of_freedom, int, "fitted pixels less what was fitted to them", None),
    (result.c.condition_number, float, "condition number of the inversion", None),
    (result.c.wall_s, float, "wall time of the run", "s"),
    (result.c.cpu_s, float, "CPU time of the run", "s"),
    (result.c.pixels_rendered, int, "pixels onto which light or a derivative of it was laid", None),
    (result.c.rays_traced, int, "rays traced through the lens", None),
    (result.c.columns_solved, int, "unknowns of the linear systems that were solved", None),
    (result.c.parameters_sampled, int, "dimensions of the chain, 0 without one", None),
    (result.c.stored_at, datetime, "when the result was stored, UTC", None),
    (run.c.digest, str, "SHA-256 of the realization", None),
    (result.c.observation_digest, str, "SHA-256 of what was observed: of the realization without its analysis", None),
    (result.c.payload_digest, str, "SHA-256 of what the run found", None),
    (result.c.engine_digest, str, "digest of the engine", None),
    (result.c.figure, str, "key of the figure in the artefact store", None),
    (result.c.products, str, "key of the arrays in the artefact store", None),
)
_TABLES = {name: estimate.alias(name) for name in ESTIMATES}
_NAMES = {run.c.digest: "realization_digest"}


def result_columns(estimates: Sequence[EstimateName]) -> tuple[ResultColumn, ...]:
    """All columns of flat results with the answers of some estimators: who, what was put in, what came out, how.

    Of one estimator the columns are named as ``magnitude_mean``, of several as ``image_wide_magnitude_mean``.
    """
    columns = [_column(*plain) for plain in _PLAIN]
    for name in estimates:
        prefix = "" if len(estimates) == 1 else f"{name}_"
        table = _TABLES[name]
        for quantity in QUANTITIES:
            for part in ("mean", "sd", "bias"):
                told = f"{_QUANTITY_NAMES[quantity]} by {name}: {_PARTS[part]}"
                column = f"{quantity}_{part}"
                columns.append(ResultColumn(prefix + column, float, told, QUANTITY_UNITS[quantity], table.c[column]))
        columns += [
            ResultColumn(prefix + part, int, f"{_COUNT_NAMES[part]}, {name}", None, table.c[part]) for part in COUNTS
        ]
        for quantity, whole, stages in ERROR_PARTS:
            unit = "mag" if quantity == "magnitude" else QUANTITY_UNITS[quantity]
            told = f"predicted numerical error of {_QUANTITY_NAMES[quantity]} by {name}"
            columns.append(ResultColumn(prefix + whole, float, told, unit, table.c[whole]))
            columns += [
                ResultColumn(prefix + column, float, f"{told}: {stage}", unit, table.c[column])
                for stage, column in stages
            ]
    return (*columns, *(_column(*measure) for measure in _MEASURES))


def result_rows(
    connection: Connection,
    where: ResultFilter,
    estimates: Sequence[EstimateName],
    columns: Sequence[ResultColumn] | None = None,
    *,
    after: str | None = None,
    limit: int | None = None,
) -> Iterator[tuple[Any, ...]]:
    """The results that are meant, in the order of their runs' ids: each the values of ``columns``, in their order.

    ``columns`` are some of those of :func:`result_columns` for the same ``estimates``; all of them where None. Rows are
    read as they are taken, in constant memory, and all are of one picture of the database if ``connection`` is one of
    :meth:`service.store.database.Database.read`. ``after`` is the id of the run after which to begin.
    """
    wanted = result_statement(where, estimates, result_columns(estimates) if columns is None else columns)
    if after is not None:
        wanted = wanted.where(result.c.run_id > after)
    if limit is not None:
        wanted = wanted.limit(limit)
    with connection.execution_options(yield_per=_AT_ONCE).execute(wanted) as rows:
        for row in rows:
            yield tuple(row)


def result_statement(
    where: ResultFilter, estimates: Sequence[EstimateName], columns: Sequence[ResultColumn]
) -> Select[Any]:
    """What reads the results that are meant, by their runs' ids: to be narrowed, or counted."""
    source: FromClause = result.join(run, run.c.id == result.c.run_id)
    for name in estimates:
        table, (estimator, prior) = _TABLES[name], estimator_and_prior(name)
        mine = and_(table.c.run_id == result.c.run_id, table.c.estimator == estimator, table.c.index_prior == prior)
        source = source.outerjoin(table, mine)
    wanted = select(*(column.expression.label(column.name) for column in columns)).select_from(source)
    inputs = where.inputs()
    if inputs is not None:
        wanted = wanted.where(result.c.input_id.in_(inputs))
    return wanted.order_by(result.c.run_id)


def _column(column: Any, kind: type, description: str, unit: str | None) -> ResultColumn:
    return ResultColumn(_NAMES.get(column, column.name), kind, description, unit, column)
