"""The picture of a measurement: data, model, residual; lensed host, Sersic host, inverted host."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine

from engine.conventions import FloatArray
from engine.figures.sky import (
    compass,
    corner_label,
    empty_sky_noise,
    name_points,
    panel_bar,
    scale_bar,
    show,
    stretch,
)
from engine.light.sersic import surface_brightness
from engine.measure import ImageMeasurement

_RESIDUAL_LIMIT = 5.0
_HOST_RADII = 4.0
_HOST_PIXELS = 200
_FIELD_RADII = 3.0
_DATA_UNIT = "e$^-$ s$^{-1}$ per pixel, asinh"
_SOURCE_UNIT = "e$^-$ s$^{-1}$ arcsec$^{-2}$, asinh"


def _sky(axes: Axes, image: FloatArray, scale: float, norm: AsinhNorm, half: float, title: str) -> AxesImage:
    axes.set_title(title, fontsize=10)
    axes.set_facecolor("0.6")
    return show(axes, image, scale, norm, half)


def _host_panel(figure: Figure, axes: Axes, found: ImageMeasurement, half: float, norm: AsinhNorm) -> None:
    host = found.fit.host
    axis = np.linspace(-half, half, _HOST_PIXELS)
    image = surface_brightness(host, host.x + axis[None, :], host.y + axis[:, None])
    extent = (host.x - half, host.x + half, host.y - half, host.y + half)
    shown = axes.imshow(image, origin="lower", extent=extent, cmap="inferno", norm=norm)
    axes.set_title("host behind the lens: Sersic fit", fontsize=10)
    axes.tick_params(labelsize=7)
    corner_label(axes, f"n {host.n:.2f}, R {host.r_eff:.3f}″")
    panel_bar(figure, axes, shown, _SOURCE_UNIT)


def _source_panel(figure: Figure, axes: Axes, found: ImageMeasurement, half: float, norm: AsinhNorm) -> None:
    host = found.fit.host
    if found.inversion is None:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no inversion", ha="center", va="center", transform=axes.transAxes, fontsize=9)
        return
    plane = found.inversion.source_plane
    shown = axes.pcolormesh(
        plane.source_x_edges, plane.source_y_edges, plane.source, norm=norm, cmap="inferno", rasterized=True
    )
    axes.set(xlim=(host.x - half, host.x + half), ylim=(host.y - half, host.y + half))
    axes.set_aspect("equal")
    axes.set_facecolor("black")
    axes.tick_params(labelsize=7)
    axes.set_title("host behind the lens: inversion", fontsize=10)
    panel_bar(figure, axes, shown, _SOURCE_UNIT)


def measurement_figure(found: ImageMeasurement) -> Figure:
    """Image, parametric model and normalised residual; image less AGN and deflector, Sersic host, inverted host."""
    fit, observation = found.fit, found.observation
    scale, valid = observation.pixel_scale, observation.valid
    image = np.where(valid, observation.image, np.nan)
    half = min(0.5 * min(observation.shape) * scale, max(_FIELD_RADII * fit.lens.theta_E, 1.0))
    sky = empty_sky_noise(observation.noise[valid]) * min(found.noise_scale, 1.0)
    norm = stretch(sky, float(np.nanmax(image)))
    figure = Figure(figsize=(12.4, 7.9), layout=ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06))
    axes = figure.subplots(2, 3)
    shown = _sky(axes[0, 0], image, scale, norm, half, "image (grey: not used)")
    panel_bar(figure, axes[0, 0], shown, _DATA_UNIT)
    name_points(axes[0, 0], [(str(k + 1), agn.x, agn.y) for k, agn in enumerate(fit.agn)], half)
    scale_bar(axes[0, 0], half)
    compass(axes[0, 0], half, orientation=observation.orientation)
    shown = _sky(axes[0, 1], fit.model, scale, norm, half, "parametric model")
    panel_bar(figure, axes[0, 1], shown, _DATA_UNIT)
    used = np.isfinite(fit.sigma)
    variance = np.where(used, fit.sigma, 1.0) ** 2
    variance += np.where(used, (found.noise_scale**2 - 1.0) * observation.noise**2, 0.0)
    residual = np.where(used, (observation.image - fit.model) / np.sqrt(variance), np.nan)
    limits = Normalize(-_RESIDUAL_LIMIT, _RESIDUAL_LIMIT)
    panel = axes[0, 2]
    extent = [side * n * scale / 2 for n in observation.shape[::-1] for side in (-1, 1)]
    drawn = panel.imshow(residual, origin="lower", extent=extent, cmap="RdBu_r", norm=limits, interpolation="nearest")
    panel.set(xlim=(-half, half), ylim=(-half, half), xticks=[], yticks=[], facecolor="0.6")
    panel.set_title("residual", fontsize=10)
    corner_label(panel, f"chi$^2$/dof {found.chi2_per_dof:.2f}")
    panel_bar(figure, panel, drawn, "sigma, error of the PSF included")
    arc = np.where(valid, image - fit.model + fit.arc, np.nan)
    inner = np.where(used, fit.arc, 0.0)
    shown = _sky(
        axes[1, 0], arc, scale, stretch(sky, 1.3 * float(inner.max())), half, "image less AGN, deflector, background"
    )
    panel_bar(figure, axes[1, 0], shown, _DATA_UNIT)
    reach = min(_HOST_RADII * fit.host.r_eff, 1.2 * fit.lens.theta_E)
    peak = float(surface_brightness(fit.host, np.array(fit.host.x + 0.1 * fit.host.r_eff), np.array(fit.host.y)))
    bright = AsinhNorm(linear_width=0.01 * peak, vmin=0.0, vmax=peak)
    _host_panel(figure, axes[1, 1], found, reach, bright)
    _source_panel(figure, axes[1, 2], found, reach, bright)
    host = found.host
    figure.suptitle(
        f"host {host.magnitude.mean:.2f} ± {host.magnitude.sd:.2f} mag, R {host.r_eff.mean:.3f} ± "
        f"{host.r_eff.sd:.3f}″, n {host.n.mean:.2f} ± {host.n.sd:.2f} ({found.estimator});   "
        f"$\\theta_E$ {fit.lens.theta_E:.3f}″, q {fit.lens.q:.2f}, slope {fit.lens.slope:.2f}, shear "
        f"{math.hypot(fit.lens.gamma1, fit.lens.gamma2):.3f};   status {found.status}",
        fontsize=10.5,
    )
    return figure
