"""What every picture of the sky needs: field, stretch, scale bar, compass."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.offsetbox import AnchoredText
from matplotlib.patheffects import withStroke

from engine.conventions import NORTH_UP, FloatArray, Orientation

_STROKE = [withStroke(linewidth=1.6, foreground="black", alpha=0.7)]
_SIGMA_LINEAR = 3.0
_SIGMA_BELOW = 3.0


def stretch(sky_noise: float, peak: float, *, linear: float = _SIGMA_LINEAR) -> AsinhNorm:
    """An asinh stretch from 3 sigma of the sky noise below zero to the peak, linear within ``linear`` sigma."""
    return AsinhNorm(linear_width=linear * sky_noise, vmin=-_SIGMA_BELOW * sky_noise, vmax=peak)


def stretch_ticks(norm: AsinhNorm) -> list[float]:
    """Zero and the powers of ten above the linear part."""
    first = math.ceil(math.log10(norm.linear_width))
    last = math.floor(math.log10(float(norm.vmax or norm.linear_width)))
    return [0.0, *(10.0**power for power in range(first, last + 1))]


def show(axes: Axes, image: FloatArray, pixel_scale: float, norm: AsinhNorm, half_width: float) -> AxesImage:
    """An image centred on the target, cut to ``half_width`` [arcsec], without ticks."""
    ny, nx = image.shape
    x, y = 0.5 * nx * pixel_scale, 0.5 * ny * pixel_scale
    shown = axes.imshow(
        image, origin="lower", interpolation="nearest", cmap="inferno", norm=norm, extent=(-x, x, -y, y)
    )
    axes.set(xlim=(-half_width, half_width), ylim=(-half_width, half_width), xticks=[], yticks=[])
    return shown


def colour_bar(figure: Figure, shown: AxesImage, axes: list[Axes], norm: AsinhNorm, label: str) -> None:
    """One colour bar for panels that share a stretch."""
    bar = figure.colorbar(shown, ax=axes, fraction=0.025, pad=0.015, aspect=40)
    ticks = stretch_ticks(norm)
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=8)
    bar.set_label(label, fontsize=9)


def panel_bar(figure: Figure, axes: Axes, shown: object, label: str) -> None:
    """A colour bar of one panel."""
    bar = figure.colorbar(shown, ax=axes, fraction=0.046, pad=0.02)  # type: ignore[arg-type]
    if isinstance(bar.norm, AsinhNorm):
        ticks = stretch_ticks(bar.norm)
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
        bar.minorticks_off()
    bar.ax.tick_params(labelsize=7)
    bar.set_label(label, fontsize=8)


def scale_bar(axes: Axes, half_width: float, *, fontsize: float = 8.0) -> None:
    """A bar of 1, 2 or 5 arcsec times a power of ten, about a fifth of the field long, at the lower left."""
    target = 0.4 * half_width
    power = 10.0 ** math.floor(math.log10(target))
    length = max(step * power for step in (1.0, 2.0, 5.0) if step * power <= target)
    left, low = -0.92 * half_width, -0.88 * half_width
    axes.plot([left, left + length], [low, low], color="white", linewidth=1.8, path_effects=_STROKE)
    axes.text(
        left, low + 0.04 * half_width, f"{length:g}″", color="white", fontsize=fontsize,
        ha="left", va="bottom", path_effects=_STROKE,
    )  # fmt: skip


def compass(axes: Axes, half_width: float, *, fontsize: float = 8.0, orientation: Orientation = NORTH_UP) -> None:
    """Arrows to the North and the East, at the lower right: up and left, where the image is not turned."""
    length = 0.26 * half_width
    east = orientation.north + (-0.5 if orientation.mirrored else 0.5) * math.pi
    arrows = [
        (length * math.cos(angle), length * math.sin(angle), name)
        for angle, name in ((orientation.north, "N"), (east, "E"))
    ]
    # Both arrows stay within the corner.
    x = 0.88 * half_width - 1.3 * max(0.0, *(dx for dx, _, _ in arrows))
    y = -0.88 * half_width - 1.3 * min(0.0, *(dy for _, dy, _ in arrows))
    for dx, dy, name in arrows:
        axes.annotate(
            "", (x + dx, y + dy), (x, y),
            arrowprops={"arrowstyle": "-|>", "color": "white", "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip
        axes.text(
            x + 1.3 * dx, y + 1.3 * dy, name, color="white", fontsize=fontsize, fontweight="bold",
            ha="center", va="center", path_effects=_STROKE,
        )  # fmt: skip


def corner_label(axes: Axes, text: str, *, fontsize: float = 8.0) -> None:
    """Text in the upper left corner, legible on any picture."""
    label = AnchoredText(
        text, loc="upper left", pad=0.0, borderpad=0.35, frameon=False,
        prop={"color": "white", "size": fontsize, "path_effects": _STROKE},
    )  # fmt: skip
    axes.add_artist(label)


def name_points(axes: Axes, points: list[tuple[str, float, float]], half_width: float) -> None:
    """Names beside points, each pushed away from the centre of the picture."""
    for name, x, y in points:
        r = max(math.hypot(x, y), 1e-9)
        axes.text(
            x + 0.17 * half_width * x / r, y + 0.17 * half_width * y / r, name, color="white", fontsize=8,
            ha="center", va="center", path_effects=_STROKE,
        )  # fmt: skip


def half_field(image: FloatArray, pixel_scale: float) -> float:
    """Half of an image's shorter side [arcsec]."""
    return 0.5 * float(min(image.shape)) * pixel_scale


def empty_sky_noise(noise: FloatArray) -> float:
    """Noise of the emptiest pixels of a noise map: its first percentile."""
    return float(np.percentile(noise[np.isfinite(noise)], 1.0))
