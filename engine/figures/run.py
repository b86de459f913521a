"""The figure of a run: observation, model, residual; source, truth, uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from engine.conventions import FloatArray
from engine.result import ImagePlane, RunResult, SourcePlane


def _image_extent(plane: ImagePlane) -> tuple[float, float, float, float]:
    ny, nx = plane.image.shape
    half_x, half_y = 0.5 * nx * plane.pixel_scale, 0.5 * ny * plane.pixel_scale
    return -half_x, half_x, -half_y, half_y


def _panel(figure: Figure, axes: Axes, values: FloatArray, title: str, unit: str, **image: Any) -> None:
    shown = axes.imshow(values, origin="lower", interpolation="nearest", **image)
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=7)
    bar = figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.03)
    bar.ax.tick_params(labelsize=7)
    bar.set_label(unit, fontsize=7)


def _source_panel(
    figure: Figure, axes: Axes, plane: SourcePlane, values: FloatArray, title: str, norm: Normalize
) -> None:
    """A source map on its own, possibly uneven, grid."""
    shown = axes.pcolormesh(plane.source_x_edges, plane.source_y_edges, values, norm=norm, cmap="inferno")
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=7)
    bar = figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.03)
    bar.ax.tick_params(labelsize=7)
    bar.set_label("e$^-$ s$^{-1}$ arcsec$^{-2}$", fontsize=7)


def _image_row(figure: Figure, axes: Sequence[Axes], plane: ImagePlane) -> None:
    """Observation, model and normalised residual."""
    extent = _image_extent(plane)
    inside = np.where(plane.mask, plane.model, np.nan)
    stretch = float(np.nanpercentile(inside, 99.0))
    norm = AsinhNorm(linear_width=0.05 * stretch, vmin=0.0, vmax=float(plane.image.max()))
    _panel(figure, axes[0], plane.image, "Observation", "e$^-$ s$^{-1}$", extent=extent, norm=norm)
    _panel(figure, axes[1], inside, "Model where fitted", "e$^-$ s$^{-1}$", extent=extent, norm=norm)
    fitted = np.where(plane.mask, plane.residual, np.nan)
    limits = Normalize(-5.0, 5.0)
    _panel(figure, axes[2], fitted, "Normalised residual", r"$\sigma$", extent=extent, norm=limits, cmap="RdBu_r")


def _source_row(figure: Figure, axes: Sequence[Axes], plane: SourcePlane) -> None:
    """Source, truth where there is one, and standard deviation."""
    peak = float(max(plane.source.max(), 1e-12))
    norm = AsinhNorm(linear_width=0.03 * peak, vmin=0.0, vmax=peak)
    _source_panel(figure, axes[0], plane, plane.source, "Source, reconstructed", norm)
    if plane.source_truth is not None:
        _source_panel(figure, axes[1], plane, plane.source_truth, "Source, truth", norm)
    else:
        axes[1].set_axis_off()
    spread = Normalize(0.0, float(np.percentile(plane.source_sd, 99.0)))
    _source_panel(figure, axes[2], plane, plane.source_sd, "Source, standard deviation", spread)


def run_figure(result: RunResult) -> Figure:
    """Observation, model and normalised residual; where there is an inversion, source, truth and uncertainty.

    Raises
    ------
    ValueError
        The result comes without its arrays.
    """
    products = result.products
    if products is None:
        raise ValueError("products: got None, allowed is a result with its arrays")
    rows = 1 if products.source_plane is None else 2
    figure = Figure(figsize=(12.5, 3.8 * rows), layout=ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.08))
    axes = figure.subplots(rows, 3, squeeze=False)
    _image_row(figure, axes[0], products.image_plane)
    if products.source_plane is not None:
        _source_row(figure, axes[1], products.source_plane)
    for panel in axes.flat:
        panel.set_xlabel("arcsec (West)", fontsize=7)
        panel.set_ylabel("arcsec (North)", fontsize=7)
    host = "no estimate"
    for found in result.estimates:
        if (found.estimator, found.index_prior) == ("image", "wide"):
            host = f"{found.magnitude.mean:.2f} +- {found.magnitude.sd:.2f} mag"
    chain = "no chain" if result.chain is None else f"chain {result.chain.status.replace('_', ' ')}"
    figure.suptitle(
        f"run {result.realization_digest[:12]}   chi$^2$/dof {result.chi2 / result.degrees_of_freedom:.2f}   "
        f"host {host} (image estimator)   {chain}",
        fontsize=10,
    )
    return figure
