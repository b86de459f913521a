"""Exported results as the file of a study: a row for each run, estimator and prior of n, small enough to be shipped."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, BinaryIO

from engine import STUDY_FORMAT, STUDY_METADATA_KEY
from service.domain.payload import ESTIMATES, estimator_and_prior

if TYPE_CHECKING:
    import pyarrow

_OF_RUN = (
    "run_id", "label", "paper_run", "system", "camera", "configuration", "mass_model", "l_eta", "n", "r_eff",
    "magnitude", "seed", "noise_level", "noise_treatment", "profile",
)  # fmt: skip
_OF_ESTIMATE = (
    *(f"{quantity}_{part}" for quantity in ("magnitude", "r_eff", "n", "q") for part in ("bias", "sd")),
    "magnitude_error", "r_eff_error", "n_error", "draws", "at_bound", "failed",
)  # fmt: skip
_MEASURED = (
    "arc_magnitude", "agn_contrast", "surface_brightness", "aperture_magnitude_bias", "aperture_magnitude_sd",
    "lens_theta_e_mean", "lens_theta_e_sd", "lens_theta_e_truth", "lens_slope_mean", "lens_slope_sd",
    "lens_slope_truth", "chain_status", "effective_samples", "r_hat", "evaluations", "chi2", "degrees_of_freedom",
    "wall_s", "cpu_s", "realization_digest", "payload_digest", "engine_digest",
)  # fmt: skip
_SINGLE = frozenset({*_OF_ESTIMATE, *_MEASURED})
"""Numbers whose seven digits are enough; what was put in stays as it is."""


def study_table(exported: pyarrow.Table, provenance: Mapping[str, Any]) -> pyarrow.Table:
    """An export of all estimators (``estimator=all``) as the table of a study, in the order of inputs."""
    import pyarrow  # noqa: PLC0415 - takes a while

    parts = []
    for name in ESTIMATES:
        estimator, prior = estimator_and_prior(name)
        own = [f"{name}_{column}" for column in _OF_ESTIMATE]
        part = exported.select([*_OF_RUN, *own, *_MEASURED]).rename_columns([*_OF_RUN, *_OF_ESTIMATE, *_MEASURED])
        fields = [field.with_metadata(_of_all(field.metadata, name)) for field in part.schema]
        part = pyarrow.table(part.columns, schema=pyarrow.schema(fields))
        for place, (column, value, told) in enumerate(
            (("estimator", estimator, "who recovered"), ("index_prior", prior, "prior of n: wide 0.3-8, free 1-4"))
        ):
            field = pyarrow.field(column, pyarrow.string(), metadata={"description": told})
            part = part.add_column(len(_OF_RUN) + place, field, pyarrow.array([value] * part.num_rows))
        parts.append(part.filter(part["magnitude_bias"].is_valid()))
    table = pyarrow.concat_tables(parts)
    order = [(name, "ascending") for name in ("system", "paper_run", "seed", "run_id", "estimator", "index_prior")]
    table = _narrow(table.sort_by(order))
    return table.replace_schema_metadata({STUDY_METADATA_KEY: json.dumps({"format": STUDY_FORMAT, **provenance})})


def write_study(table: pyarrow.Table, sink: BinaryIO) -> None:
    """The table as Parquet, as small as it gets: biases hardly repeat, what was put in does."""
    from pyarrow import parquet, types  # noqa: PLC0415 - as above

    split = [field.name for field in table.schema if types.is_floating(field.type) and field.name in _OF_ESTIMATE]
    repeated = [name for name in table.column_names if name not in split]
    parquet.write_table(
        table, sink, compression="zstd", compression_level=19, use_dictionary=repeated, use_byte_stream_split=split,
        write_statistics=False,
    )  # fmt: skip


def _of_all(metadata: Mapping[bytes, bytes] | None, estimate: str) -> dict[str, str]:
    """What is said of a column, without the estimator that the row names."""
    told = {key.decode(): value.decode() for key, value in (metadata or {}).items()}
    return {key: value.replace(f" by {estimate}", "").replace(f", {estimate}", "") for key, value in told.items()}


def _narrow(table: pyarrow.Table) -> pyarrow.Table:
    import pyarrow  # noqa: PLC0415 - as above

    smaller = {pyarrow.float64(): pyarrow.float32(), pyarrow.int64(): pyarrow.int32()}
    fields = [
        field.with_type(smaller.get(field.type, field.type)) if field.name in _SINGLE else field
        for field in table.schema
    ]
    return table.cast(pyarrow.schema(fields))
