"""Thumbnails of a grid's runs, from the arrays that each has left in the artefact store."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from engine import ImagePlane, Products, SourcePlane
from service.store.artefacts import ArtefactDamagedError, ArtefactGoneError, ArtefactStore
from service.store.bias_rows import MontageRun

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def montage(runs: Iterable[MontageRun], store: ArtefactStore, heading: str, columns: int) -> Figure:
    """Observation, model and source of each run; a grey field where its arrays are no more."""
    from engine.figures import Thumbnail, grid_figure, pictures_of  # noqa: PLC0415 - matplotlib takes a second

    thumbnails = []
    for run in runs:
        products = None if run.products is None else _products(store, run.products)
        note = "" if run.bias is None else f"{run.bias:+.2f} mag".replace("-", "\N{MINUS SIGN}")
        thumbnails.append(Thumbnail(run.label, note, None if products is None else pictures_of(products)))
    return grid_figure(thumbnails, heading=heading, columns=columns)


def _products(store: ArtefactStore, key: str) -> Products | None:
    """The arrays of a run as the engine had them; None where they are gone or damaged."""
    try:
        data = store.read(key)
    except (ArtefactGoneError, ArtefactDamagedError):
        return None
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        image = ImagePlane(**{**_of(ImagePlane, arrays), "pixel_scale": float(arrays["pixel_scale"])})
        source = SourcePlane(**_of(SourcePlane, arrays)) if "source" in arrays else None
    return Products(image, source)


def _of(kind: type, arrays: Any) -> dict[str, Any]:
    return {field.name: arrays[field.name] for field in fields(kind) if field.name in arrays}
