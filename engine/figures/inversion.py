"""The figure of an inversion: image, model, source, how well it is known, and the evidence along each parameter."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from engine.conventions import FloatArray
from engine.figures.sky import compass, empty_sky_noise, panel_bar, scale_bar, show, stretch
from engine.inspection import InversionView
from engine.posterior.traces import EvidenceTrace
from engine.result import ImagePlane, SourcePlane

_RESIDUAL_LIMIT = 5.0
_TRACE_ROWS = 2
_LOWEST = -6.0
_RATE = "e$^-$ s$^{-1}$ per pixel, asinh"
_BRIGHTNESS = "e$^-$ s$^{-1}$ arcsec$^{-2}$"
_LABELS = {
    "theta_E": (r"$\theta_E$", "″"),
    "q": ("$q$", ""),
    "phi": (r"$\phi$", " rad"),
    "slope": (r"$\gamma'$", ""),
    "x": ("$x$", "″"),
    "y": ("$y$", "″"),
    "gamma1": (r"$\gamma_1$", ""),
    "gamma2": (r"$\gamma_2$", ""),
    "ln_lambda": (r"$\ln\lambda$", ""),
}


def _images(figure: Figure, axes: list[Axes], plane: ImagePlane) -> None:
    """Data, model and normalised residual."""
    scale, rows_columns = plane.pixel_scale, np.argwhere(plane.mask)
    ny, nx = plane.image.shape
    reach = np.abs(rows_columns - 0.5 * (np.array([ny, nx]) - 1.0)).max()
    half = min(0.5 * min(ny, nx) * scale, 1.08 * float(reach) * scale)
    norm = stretch(empty_sky_noise(plane.noise), float(plane.image.max()))
    inside = np.where(plane.mask, plane.model, np.nan)
    residual = np.where(plane.mask, plane.residual, np.nan)
    for panel, values, title in zip(axes, (plane.image, inside, residual), ("data", "model", "residual"), strict=True):
        shown = show(panel, values, scale, norm, half)
        panel.set_facecolor("0.6")
        panel.set_title(title, fontsize=10)
        if title == "residual":
            shown.set(cmap="RdBu_r", norm=Normalize(-_RESIDUAL_LIMIT, _RESIDUAL_LIMIT))
            panel.set_title("(data - model) / noise", fontsize=10)
        panel_bar(figure, panel, shown, r"$\sigma$" if title == "residual" else _RATE)
    scale_bar(axes[0], half)
    compass(axes[0], half)


def _source(
    figure: Figure,
    axes: Axes,
    plane: SourcePlane,
    values: FloatArray,
    title: str,
    norm: Normalize,
    label: str,
    cmap: str,
) -> None:
    shown = axes.pcolormesh(plane.source_x_edges, plane.source_y_edges, values, norm=norm, cmap=cmap, rasterized=True)
    axes.set_aspect("equal")
    axes.set_facecolor("0.6")
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=7)
    axes.set_xlabel("arcsec (West)", fontsize=7)
    panel_bar(figure, axes, shown, label)


def _sources(figure: Figure, axes: list[Axes], view: InversionView) -> None:
    """Truth, source, its deviation, the share of the data and the width of the resolution."""
    plane, resolution = view.source_plane, view.resolution
    truth_panel, source_panel, sd_panel, share_panel, width_panel = axes
    norm = stretch(float(np.median(plane.source_sd)), float(plane.source.max()))
    if plane.source_truth is None:
        truth_panel.set_axis_off()
    else:
        _source(
            figure,
            truth_panel,
            plane,
            plane.source_truth,
            "source, truth",
            norm,
            f"{_BRIGHTNESS}, asinh",
            "inferno",
        )
    _source(figure, source_panel, plane, plane.source, "source", norm, f"{_BRIGHTNESS}, asinh", "inferno")
    spread = Normalize(0.0, float(plane.source_sd.max()))
    _source(figure, sd_panel, plane, plane.source_sd, "its standard deviation", spread, _BRIGHTNESS, "viridis")
    share = Normalize(0.0, 1.0)
    _source(
        figure, share_panel, plane, resolution.data_share, "share of the data", share, "1: data, 0: prior", "viridis"
    )
    width = np.where(np.isfinite(resolution.width), resolution.width, np.nan)
    limits = Normalize(0.0, float(np.nanpercentile(width, 98.0)))
    _source(figure, width_panel, plane, width, "resolution", limits, "FWHM [arcsec]", "viridis_r")


def _trace(axes: Axes, trace: EvidenceTrace) -> None:
    """Ln Z along one parameter, with the parabola of the Gaussian approximation and the truth."""
    name, unit = _LABELS[trace.name]
    t = trace.offsets
    fine = np.linspace(float(t.min()), float(t.max()), 101)
    axes.plot(fine, -0.5 * fine**2, color="0.6", linewidth=1.0)
    axes.plot(
        t, np.where(np.isfinite(trace.ln_evidence), trace.ln_evidence, np.nan), "k.-", markersize=3, linewidth=0.8
    )
    axes.set(xlim=(t.min() - 0.3, t.max() + 0.3))
    known = trace.ln_evidence[np.isfinite(trace.ln_evidence)]
    axes.set_ylim(min(_LOWEST, float(known.min(initial=0.0)) - 0.5), max(0.8, float(known.max(initial=0.0)) + 0.5))
    told = ""
    if trace.truth is not None:
        told = f", truth at {trace.truth:+.1f} sd"
        low, high = axes.get_xlim()
        if low < trace.truth < high:
            axes.axvline(trace.truth, color="tab:red", linewidth=1.2)
        else:
            at = 0.02 if trace.truth < low else 0.98
            arrow = "<" if trace.truth < low else ">"
            axes.plot([at], [0.5], marker=arrow, color="tab:red", transform=axes.transAxes, clip_on=False)
    digits = max(0, 1 - math.floor(math.log10(trace.sd)))
    axes.set_title(f"{name} {trace.centre:.{digits}f} ± {trace.sd:.{digits}f}{unit}{told}", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.set_xlabel("standard deviations", fontsize=7)


def inversion_figure(view: InversionView) -> Figure:
    """Image, model, residual and true source; source, deviation, resolution; ln Z along each parameter.

    In the traces the grey parabola is -t^2 / 2 and the red line (or arrow, beyond the panel) the truth.
    """
    figure = Figure(figsize=(16.0, 11.6), layout=ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.05))
    halves = figure.add_gridspec(2, 1, height_ratios=(7.0, 4.2))
    maps, below = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
    axes = maps.subplots(2, 4)
    _images(figure, [axes[0, 0], axes[0, 1], axes[0, 2]], view.image_plane)
    _sources(figure, [axes[0, 3], *axes[1]], view)
    panels = below.subplots(_TRACE_ROWS, -(-len(view.traces) // _TRACE_ROWS), squeeze=False)
    for panel in panels.flat[len(view.traces) :]:
        panel.set_axis_off()
    for panel, trace in zip(panels.flat, view.traces, strict=False):
        _trace(panel, trace)
    for row in range(_TRACE_ROWS):
        panels[row, 0].set_ylabel(r"$\Delta\ln Z$", fontsize=8)
    found = view.inversion
    maps.suptitle(
        f"ln Z {found.ln_evidence:.1f}, chi$^2$/dof {view.chi2 / view.degrees_of_freedom:.2f}, "
        f"{view.effective_parameters:.0f} of {found.source.size} source pixels decided by the data, "
        f"condition number {found.condition_number:.0e}",
        fontsize=11,
    )
    return figure
