"""The runs of a grid at a glance: observation, model and source of each, as small as they can be told."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.errors import FigureError, NothingToShowError
from engine.figures.sky import empty_sky_noise, stretch
from engine.figures.style import new_figure, plain, title
from engine.result import Products

_PICTURES = ("observation", "model", "source")
_GAP, _LABEL = 0.12, 0.34
_INCHES = 0.78
_COLOURS = "inferno"
_LINEAR = 5.0
_SIDE = 0.97
_MARGIN = 1.15
MOST_RUNS = 400


@dataclass(frozen=True)
class Pictures:
    """Three pictures of a run, small enough to be many.

    ``observation`` and ``model`` (NaN outside the mask) are (ny, nx) in e-/s, ``noise`` is that of the empty sky [e-/s
    per pixel]; ``source`` is (my, mx) in e-/s per arcsec^2 on cells with edges ``source_x_edges`` (mx + 1,) and
    ``source_y_edges`` (my + 1,) [arcsec], all None for a run without an inversion.
    """

    observation: FloatArray
    model: FloatArray
    noise: float
    source: FloatArray | None
    source_x_edges: FloatArray | None
    source_y_edges: FloatArray | None


@dataclass(frozen=True)
class Thumbnail:
    """A run of the montage: its name, what is said of it (a bias, a state), its pictures or None where it has none."""

    name: str
    note: str
    pictures: Pictures | None


def pictures_of(products: Products) -> Pictures:
    """The pictures of a run from its arrays."""
    image, source = products.image_plane, products.source_plane
    return Pictures(
        observation=image.image,
        model=np.where(image.mask, image.model, np.nan),
        noise=empty_sky_noise(image.noise),
        source=None if source is None else source.source,
        source_x_edges=None if source is None else source.source_x_edges,
        source_y_edges=None if source is None else source.source_y_edges,
    )


def grid_figure(runs: Sequence[Thumbnail], *, heading: str = "", columns: int = 4) -> Figure:
    """Observation, model in the mask and reconstructed source of each run, ``columns`` runs to a row.

    Each run has a stretch of its own: asinh, linear within 5 times its empty-sky noise, up to its brightest pixel
    within the mask; the source up to its own peak. A run without pictures is a grey field.

    Raises
    ------
    NothingToShowError
        There is no run.
    FigureError
        More runs than a figure can hold, or no column.
    """
    if not runs:
        raise NothingToShowError("runs: got none, allowed is at least one")
    if len(runs) > MOST_RUNS:
        raise FigureError(f"runs: got {len(runs)}, allowed are {MOST_RUNS} in a figure")
    if columns < 1:
        raise FigureError(f"columns: got {columns}, allowed is 1 or more")
    columns = min(columns, len(runs))
    rows = -(-len(runs) // columns)
    wide, high = len(_PICTURES) + 2 * _GAP, 1.0 + _LABEL + _GAP
    # One panel for all: a few hundred panels would take a minute to lay out.
    figure = new_figure(_INCHES * wide * columns, _INCHES * high * rows + 0.75)
    axes = figure.subplots()
    axes.set_axis_off()
    for place, run in enumerate(runs):
        row, column = divmod(place, columns)
        _run(axes, run, column * wide, row * high, place)
    # Showing an image changes limits and aspect, so that these come last.
    axes.set(xlim=(-0.02, wide * columns - _GAP), ylim=(high * rows, -0.02), aspect="equal")
    title(figure, plain(heading), f"{len(runs)} run{'s' * (len(runs) != 1)}: observation, model, source")
    return figure


def _run(axes: Axes, run: Thumbnail, left: float, top: float, place: int) -> None:
    """One run with its upper left corner there; y grows downwards."""
    middle = top + _LABEL
    axes.text(left, middle - 0.06, plain(run.name), fontsize=7.5, ha="left", va="bottom", gid=f"run-{place}")
    axes.text(
        left + len(_PICTURES) - 1.0 + _SIDE, middle - 0.06, plain(run.note), fontsize=7.5, ha="right", va="bottom"
    )
    if run.pictures is None:
        axes.add_patch(Rectangle((left, middle), len(_PICTURES) - 1.0 + _SIDE, _SIDE, facecolor="0.85", zorder=0.0))
        return
    pictures = run.pictures
    inside = np.isfinite(pictures.model)
    if not inside.any():
        raise FigureError(f"{run.name}: got a model without a finite pixel, allowed is one with some")
    cut = _around(inside)
    peak = max(float(pictures.observation[inside].max()), 2.0 * _LINEAR * pictures.noise)
    norm = stretch(pictures.noise, peak, linear=_LINEAR)
    for column, image in enumerate((pictures.observation, pictures.model)):
        _sky(axes, image[cut], norm, left + column, middle)
    _source(axes, pictures, left + 2.0, middle)


def _around(inside: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The square about the image's centre that holds the mask and a margin."""
    ny, nx = inside.shape
    rows, columns = np.nonzero(inside)
    reach = max(np.abs(rows - 0.5 * (ny - 1)).max(), np.abs(columns - 0.5 * (nx - 1)).max())
    half = min(_MARGIN * float(reach) + 1.0, 0.5 * min(ny, nx))
    return _middle(ny, half), _middle(nx, half)


def _middle(pixels: int, half: float) -> slice:
    return slice(round(0.5 * pixels - half), round(0.5 * pixels + half))


def _sky(axes: Axes, image: FloatArray, norm: AsinhNorm, left: float, top: float) -> None:
    axes.add_patch(Rectangle((left, top), _SIDE, _SIDE, facecolor="0.6", zorder=0.0))
    axes.imshow(
        image, origin="lower", interpolation="nearest", cmap=_COLOURS, norm=norm,
        extent=(left, left + _SIDE, top + _SIDE, top),
    )  # fmt: skip


def _source(axes: Axes, pictures: Pictures, left: float, top: float) -> None:
    """The source on its own, possibly uneven, grid, as large as the panel; a grey field where there is none."""
    x, y, source = pictures.source_x_edges, pictures.source_y_edges, pictures.source
    axes.add_patch(Rectangle((left, top), _SIDE, _SIDE, facecolor="0.6", zorder=0.0))
    if x is None or y is None or source is None:
        return
    reach = max(float(np.ptp(x)), float(np.ptp(y)))
    if not (math.isfinite(reach) and reach > 0.0):
        raise FigureError(f"source edges: got a width of {reach}, allowed is a positive one")
    # North is up, and y of the panel grows downwards.
    along = top + 0.5 * _SIDE - _SIDE * (y - 0.5 * (y[0] + y[-1])) / reach
    across = left + 0.5 * _SIDE + _SIDE * (x - 0.5 * (x[0] + x[-1])) / reach
    peak = max(float(source.max()), 1e-12)
    axes.pcolormesh(
        across, along, source, cmap=_COLOURS, rasterized=True,
        norm=AsinhNorm(linear_width=0.03 * peak, vmin=0.0, vmax=peak),
    )  # fmt: skip
