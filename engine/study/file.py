"""The paper's 384 runs as computed with this engine: shipped with the package, and read from a file of the same kind.

Not numeric: a file becomes arrays and records of biases.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from engine.biases import BiasPoint, HostQuantity
from engine.errors import StudyError
from engine.result import IndexPrior, Quantity
from engine.spec.analysis import EstimatorName

if TYPE_CHECKING:
    import pyarrow

STUDY_FORMAT = "hostlens study 1"
STUDY_METADATA_KEY = b"hostlens"
SHIPPED = "h0licow_vi.parquet"
TRUE_QUANTITIES: tuple[HostQuantity, ...] = ("magnitude", "r_eff", "n")
"""Those whose truth stands beside them in each row."""
_POINT = (
    "run_id", "system", "configuration", "n", "r_eff", "magnitude", "l_eta", "seed", "estimator", "index_prior",
    "arc_magnitude", "agn_contrast", "surface_brightness",
)  # fmt: skip


@dataclass(frozen=True)
class Study:
    """Runs of a study.

    ``table`` has a row for each run, estimator and prior of n: what was put in (``system``, ``camera``,
    ``configuration``, ``n``, ``r_eff`` [arcsec], ``magnitude`` [AB], ``l_eta``, ``seed``), ``arc_magnitude``,
    ``agn_contrast`` and ``surface_brightness`` as in :class:`~engine.result.RunResult`, bias and stated standard
    deviation of each quantity (``magnitude_bias``, ``magnitude_sd``), predicted numerical errors, the lens's slope, how
    the chain went, and the digests. Its fields say unit and meaning. ``provenance`` says who computed it: ``profile``,
    ``seeds``, ``engines`` (digests), ``service``, ``grids``, ``runs`` and ``without_result``.
    """

    table: pyarrow.Table
    provenance: Mapping[str, Any]

    def points(self, estimator: EstimatorName, *priors: IndexPrior) -> tuple[BiasPoint, ...]:
        """Answers of one estimator under some priors of n, with magnitude, radius and index."""
        wanted = [*_POINT, *(f"{name}_{part}" for name in TRUE_QUANTITIES for part in ("bias", "sd"))]
        return tuple(
            _point(row)
            for row in self.table.select(wanted).to_pylist()
            if row["estimator"] == estimator and row["index_prior"] in priors and row["magnitude_bias"] is not None
        )


def _point(row: Mapping[str, Any]) -> BiasPoint:
    recovered = {
        name: Quantity(row[name] + row[f"{name}_bias"], row[f"{name}_sd"], row[name]) for name in TRUE_QUANTITIES
    }
    return BiasPoint(recovered=recovered, **{name: row[name] for name in _POINT})


def read_study(path: Path | None = None) -> Study:
    """A study's Parquet file; the one of the paper's 384 runs that comes with the package where none is named.

    Raises
    ------
    StudyError
        The file is none of a study, or is of another format.
    """
    if path is not None:
        return _read(path)
    with as_file(files("engine.catalogue").joinpath(SHIPPED)) as shipped:
        return _read(shipped)


def _read(path: Path) -> Study:
    import pyarrow  # noqa: PLC0415 - only here, and takes a while
    from pyarrow import parquet  # noqa: PLC0415

    try:
        table = parquet.read_table(path)
    except pyarrow.ArrowInvalid as error:
        raise StudyError(f"{path}: is no Parquet file ({error})") from error
    said = (table.schema.metadata or {}).get(STUDY_METADATA_KEY)
    provenance = {} if said is None else json.loads(said)
    if provenance.get("format") != STUDY_FORMAT:
        raise StudyError(f"{path}: has format {provenance.get('format')!r}, allowed is {STUDY_FORMAT!r}")
    return Study(table, provenance)
