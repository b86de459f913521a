"""Simulated runs that come with hostlens: the paper's study, and lenses that were drawn for ``image`` to measure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from engine import PREDICTED, Host, LensTraits, Predictor, Realization, SimulatedRun, Study, read_study, traits_of

DRAWN = "drawn.parquet"
"""Made by ``python -m benchmarks.strangers --table``."""
_IMAGE = "image_wide"


@cache
def shipped_runs() -> tuple[SimulatedRun, ...]:
    """All of them, read once."""
    return (*study_runs(read_study()), *_drawn_runs())


@cache
def shipped_predictor() -> Predictor:
    """A predictor of them alone."""
    return Predictor(shipped_runs())


def study_runs(study: Study) -> Iterable[SimulatedRun]:
    """The runs of a study of the catalogue's systems, with the answers of all estimators."""
    rows: dict[str, list[Mapping[str, Any]]] = {}
    for row in study.table.to_pylist():
        rows.setdefault(row["run_id"], []).append(row)
    for run_id, answers in rows.items():
        first = answers[0]
        realization = Realization(
            system=first["system"],
            l_eta=first["l_eta"],
            host=Host(n=first["n"], r_eff=first["r_eff"], magnitude=first["magnitude"]),
            mass_model=first["mass_model"],
            noise_level=first["noise_level"],
        )
        yield SimulatedRun(
            run_id=run_id,
            lens=first["system"],
            traits=traits_of(realization, first["arc_magnitude"]),
            found={f"{row['estimator']}_{row['index_prior']}": _found(row) for row in answers},
            cpu_s=first["cpu_s"],
        )


def _drawn_runs() -> Iterable[SimulatedRun]:
    with as_file(files("service.predictions").joinpath(DRAWN)) as path:
        yield from read_drawn(path)


def read_drawn(path: Path) -> Iterable[SimulatedRun]:
    """Runs of drawn lenses in a file of ``benchmarks.strangers``: each the answer of ``image``, n in 0.3-8."""
    from pyarrow import parquet  # noqa: PLC0415 - takes a while, and help needs none

    for row in parquet.read_table(path).to_pylist():
        yield SimulatedRun(
            run_id=row["run_id"],
            lens=row["lens"],
            traits=LensTraits(**{name: row[f"traits_{name}"] for name in LensTraits.__dataclass_fields__}),
            found={_IMAGE: _found(row)},
        )


def _found(row: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    return {name: (row[f"{name}_bias"], row[f"{name}_sd"]) for name in PREDICTED if row[f"{name}_bias"] is not None}
