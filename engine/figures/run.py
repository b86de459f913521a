"""The figure of a run: observation, model, residual; source, truth, uncertainty."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from engine.conventions import FloatArray
from engine.result import Products, RunResult


def _image_extent(products: Products) -> tuple[float, float, float, float]:
    ny, nx = products.image.shape
    half_x, half_y = 0.5 * nx * products.pixel_scale, 0.5 * ny * products.pixel_scale
    return -half_x, half_x, -half_y, half_y


def _panel(figure: Figure, axes: Axes, values: FloatArray, title: str, unit: str, **image: Any) -> None:
    shown = axes.imshow(values, origin="lower", interpolation="nearest", **image)
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=7)
    bar = figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.03)
    bar.ax.tick_params(labelsize=7)
    bar.set_label(unit, fontsize=7)


def _source_panel(
    figure: Figure, axes: Axes, products: Products, values: FloatArray, title: str, norm: Normalize
) -> None:
    """A source map on its own, possibly uneven, grid."""
    shown = axes.pcolormesh(products.source_x_edges, products.source_y_edges, values, norm=norm, cmap="inferno")
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=7)
    bar = figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.03)
    bar.ax.tick_params(labelsize=7)
    bar.set_label("e$^-$ s$^{-1}$ arcsec$^{-2}$", fontsize=7)


def run_figure(result: RunResult) -> Figure:
    """Observation, model and normalised residual; source, its uncertainty and (in a simulation) the truth.

    Raises
    ------
    ValueError
        The result comes without its arrays.
    """
    products = result.products
    if products is None:
        raise ValueError("products: got None, allowed is a result with its arrays")
    figure = Figure(figsize=(12.5, 7.6), layout=ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.08))
    axes = figure.subplots(2, 3)
    extent = _image_extent(products)
    inside = np.where(products.mask, products.model, np.nan)
    stretch = float(np.nanpercentile(inside, 99.0))
    norm = AsinhNorm(linear_width=0.05 * stretch, vmin=0.0, vmax=float(products.image.max()))
    _panel(figure, axes[0, 0], products.image, "Observation", "e$^-$ s$^{-1}$", extent=extent, norm=norm)
    _panel(figure, axes[0, 1], inside, "Model in the mask", "e$^-$ s$^{-1}$", extent=extent, norm=norm)
    fitted = np.where(products.mask, products.residual, np.nan)
    limits = Normalize(-5.0, 5.0)
    _panel(figure, axes[0, 2], fitted, "Normalised residual", r"$\sigma$", extent=extent, norm=limits, cmap="RdBu_r")
    peak = float(max(products.source.max(), 1e-12))
    norm = AsinhNorm(linear_width=0.03 * peak, vmin=0.0, vmax=peak)
    _source_panel(figure, axes[1, 0], products, products.source, "Source, reconstructed", norm)
    if products.source_truth is not None:
        _source_panel(figure, axes[1, 1], products, products.source_truth, "Source, truth", norm)
    else:
        axes[1, 1].set_axis_off()
    spread = Normalize(0.0, float(np.percentile(products.source_sd, 99.0)))
    _source_panel(figure, axes[1, 2], products, products.source_sd, "Source, standard deviation", spread)
    for panel in axes.flat:
        panel.set_xlabel("arcsec (West)", fontsize=7)
        panel.set_ylabel("arcsec (North)", fontsize=7)
    host = "no estimate"
    for found in result.estimates:
        if (found.estimator, found.index_prior) == ("image", "wide"):
            host = f"{found.magnitude.mean:.2f} +- {found.magnitude.sd:.2f} mag"
    figure.suptitle(
        f"run {result.realization_digest[:12]}   chi$^2$/dof {result.chi2 / result.degrees_of_freedom:.2f}   "
        f"host {host} (image estimator)   "
        f"chain {result.chain.status.replace('_', ' ')}",
        fontsize=10,
    )
    return figure
