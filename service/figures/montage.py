"""Thumbnails of a grid's runs, from the arrays that each has left in the artefact store."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from engine import ImagePlane, Products, SourcePlane
from service.figures.question import FigureFormat
from service.store.artefacts import ArtefactDamagedError, ArtefactGoneError, ArtefactStore
from service.store.bias_rows import MontageRun


def read_arrays(runs: Sequence[MontageRun], store: ArtefactStore) -> list[bytes | None]:
    """What each run has left, as NPZ; None where that is gone or damaged."""
    found: list[bytes | None] = []
    for run in runs:
        try:
            found.append(None if run.products is None else store.read(run.products))
        except (ArtefactGoneError, ArtefactDamagedError):
            found.append(None)
    return found


def montage(
    runs: Sequence[MontageRun], arrays: Sequence[bytes | None], heading: str, columns: int, kind: FigureFormat
) -> bytes:
    """Observation, model and source of each run as a file; a grey field where its arrays are no more."""
    from engine.figures import Thumbnail, figure_bytes, grid_figure, pictures_of  # noqa: PLC0415 - takes a second

    thumbnails = []
    for run, data in zip(runs, arrays, strict=True):
        note = "" if run.bias is None else f"{run.bias:+.2f} mag".replace("-", "\N{MINUS SIGN}")
        thumbnails.append(Thumbnail(run.label, note, None if data is None else pictures_of(_products(data))))
    return figure_bytes(grid_figure(thumbnails, heading=heading, columns=columns), kind)


def _products(data: bytes) -> Products:
    """The arrays of a run as the engine had them."""
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        image = ImagePlane(**{**_of(ImagePlane, arrays), "pixel_scale": float(arrays["pixel_scale"])})
        source = SourcePlane(**_of(SourcePlane, arrays)) if "source" in arrays else None
    return Products(image, source)


def _of(kind: type, arrays: Any) -> dict[str, Any]:
    return {field.name: arrays[field.name] for field in fields(kind) if field.name in arrays}
