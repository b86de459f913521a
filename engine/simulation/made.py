"""Galaxies that are made up: spirals, irregular galaxies, mergers, and sums of Sersic profiles.

What is irregular in them is a field of log-normal brightness whose logarithm has the power spectrum of galaxies: a
power law in wave number of exponent -2.8, as is found in the light and gas of discs (Elmegreen et al. 2003; -2.6 to
-3). They are drawn with NumPy's PCG64 from their seed: the same on every machine to rounding, the same bits on one.

All are made in proportion: half-light radius of the main galaxy 1, its nucleus at the origin, angles and axis ratio as
on the sky; :func:`engine.light.galaxy.galaxy_of` gives them size and brightness.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from engine.conventions import FloatArray
from engine.light.galaxy import Component
from engine.light.pixels import PixelLight
from engine.light.sersic import SersicProfile
from engine.spec.host import MadeGalaxy

_SIDE = 128
_PER_RADIUS = 18.0
"""Pixels to a half-light radius: 3.5 of them from nucleus to border, beyond which a disc has 2 % of its light."""
_BEGINS, _ENDS = 2.5, 3.4
"""Half-light radii from nucleus to where an image begins to fade, and to where it is dark: it has no edge."""
_MERGER = 1.5
"""Half-light radii of a merger's first galaxy in one of the whole."""
_SPECTRUM = -2.8
_DISC_SCALES = 1.67835
"""Half-light radius of an exponential disc in its scale lengths."""


def made_components(made: MadeGalaxy, q: float, phi: float) -> tuple[Component, ...]:
    """A made-up galaxy whose disc has the axis ratio q and the angle phi [rad], total flux 1."""
    rng = np.random.default_rng(np.random.SeedSequence([made.seed, _KINDS.index(made.kind)]))
    return _MAKERS[made.kind](made, q, phi, rng)


def _bulge(share: float, size: float, q: float, phi: float) -> SersicProfile:
    """A de Vaucouleurs bulge, half as flat as the disc."""
    return SersicProfile(share, size, 4.0, 0.5 * (1.0 + q), phi)


def _bulge_disc(made: MadeGalaxy, q: float, phi: float, _: np.random.Generator) -> tuple[Component, ...]:
    share = made.value("share")
    return SersicProfile(1.0 - share, 1.0, 1.0, q, phi), _bulge(share, made.value("size"), q, phi)


def _clumpy(made: MadeGalaxy, q: float, phi: float, rng: np.random.Generator) -> tuple[Component, ...]:
    """A disc with five to ten Gaussian clumps, of a luminosity function dN/dL ~ 1/L over a decade, in its plane."""
    share, size = made.value("share"), made.value("size")
    number = int(rng.integers(5, 11))
    light = 10.0 ** rng.uniform(0.0, 1.0, number)
    radius, angle = rng.uniform(0.3, 1.8, number), rng.uniform(0.0, 2.0 * math.pi, number)
    sizes = size * 10.0 ** rng.uniform(-0.2, 0.2, number)
    clumps = (
        SersicProfile(share * part, r, 0.5, 1.0, 0.0, *_in_plane(a * math.cos(b), a * math.sin(b), q, phi))
        for part, r, a, b in zip(*(one.tolist() for one in (light / light.sum(), sizes, radius, angle)), strict=True)
    )
    return (SersicProfile(1.0 - share, 1.0, 1.0, q, phi), *clumps)


def _companion(made: MadeGalaxy, q: float, phi: float, rng: np.random.Generator) -> tuple[Component, ...]:
    """A galaxy of n = 2 with a smaller one of n = 1 to 2.5 beside it."""
    share, angle = made.value("share"), rng.uniform(0.0, 2.0 * math.pi)
    away, n, flat, turned = (
        made.value("distance"),
        rng.uniform(1.0, 2.5),
        rng.uniform(0.5, 0.9),
        rng.uniform(0, math.pi),
    )
    other = SersicProfile(
        share, made.value("size"), n, flat, turned, away * math.cos(angle), away * math.sin(angle)
    )  # fmt: skip
    return SersicProfile(1.0 - share, 1.0, 2.0, q, phi), other


def _spiral(made: MadeGalaxy, q: float, phi: float, rng: np.random.Generator) -> tuple[Component, ...]:
    """A disc with two to four logarithmic arms that its star formation is in, and a bulge."""
    share = made.value("share")
    x, y = _plane()
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    arms, pitch, begin = int(rng.integers(2, 5)), math.radians(rng.uniform(12.0, 28.0)), rng.uniform(0.0, 2.0 * math.pi)
    wound = arms * (angle - begin) - arms / math.tan(pitch) * np.log(np.maximum(radius, 0.05))
    # Arms begin outside the bulge; their crests are narrower than the troughs between them.
    strength = rng.uniform(1.0, 1.6) * (1.0 - np.exp(-((radius / 0.45) ** 2)))
    ridge = strength * (np.cos(wound) - 0.3 * np.cos(wound) ** 2)
    rough = _noise(rng) * np.clip(0.35 + 0.35 * ridge, 0.1, None)
    disc = np.exp(-_DISC_SCALES * radius + ridge + rough)
    return _image(disc, 1.0 - share, q, phi), _bulge(share, made.value("size"), q, phi)


def _irregular(_: MadeGalaxy, q: float, phi: float, rng: np.random.Generator) -> tuple[Component, ...]:
    """A disc whose light is as uneven as that of a dwarf irregular: 0.9 rms in its logarithm."""
    x, y = _plane()
    return (_image(np.exp(-_DISC_SCALES * np.hypot(x, y) + 0.9 * _noise(rng)), 1.0, q, phi),)


def _merger(made: MadeGalaxy, q: float, phi: float, rng: np.random.Generator) -> tuple[Component, ...]:
    """Two uneven discs with their nuclei, and a tidal tail of each that bends away from the other."""
    share, size, away = made.value("share"), made.value("size"), made.value("distance")
    x, y = (_MERGER * axis for axis in _plane())
    direction = rng.uniform(0.0, 2.0 * math.pi)
    place = away * math.cos(direction), away * math.sin(direction)
    light = np.zeros_like(x)
    for part, r, (cx, cy), turn in ((1.0 - share, 1.0, (0.0, 0.0), math.pi), (share, size, place, 0.0)):
        flat, angle = rng.uniform(0.5, 0.9), rng.uniform(0.0, math.pi)
        c, s = math.cos(angle), math.sin(angle)
        u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
        disc = np.exp(-_DISC_SCALES * np.sqrt(flat * u * u + v * v / flat) / r)
        tail = _tail(x - cx, y - cy, r, direction + turn, rng)
        light += part * (0.8 * disc / disc.sum() + 0.2 * tail / tail.sum())
    nuclei = tuple(
        SersicProfile(0.1 * part, 0.25 * r / _MERGER, 2.5, 0.8, phi, *_in_plane(cx / _MERGER, cy / _MERGER, q, phi))
        for part, r, (cx, cy) in ((1.0 - share, 1.0, (0.0, 0.0)), (share, size, place))
    )
    return (_image(light * np.exp(0.4 * _noise(rng)), 0.9, q, phi), *nuclei)


def _tail(x: FloatArray, y: FloatArray, size: float, direction: float, rng: np.random.Generator) -> FloatArray:
    """A curved tail that leaves a galaxy at (0, 0) of half-light radius ``size`` in a direction [rad]."""
    bend, hand = rng.uniform(0.5, 0.9), rng.choice([-1.0, 1.0])
    total = np.zeros_like(x)
    for along in np.linspace(0.5, 2.6, 36):
        angle = direction + hand * bend * (along - 0.5)
        px, py = size * along * math.cos(angle), size * along * math.sin(angle)
        width = size * (0.12 + 0.08 * along)
        total += np.exp(-0.7 * along) / width**2 * np.exp(-0.5 * ((x - px) ** 2 + (y - py) ** 2) / width**2)
    return total


def _plane() -> tuple[FloatArray, FloatArray]:
    """Coordinates (rows, columns) of the pixels in half-light radii, with the nucleus in the middle."""
    axis = (np.arange(_SIDE) - 0.5 * (_SIDE - 1)) / _PER_RADIUS
    x, y = np.meshgrid(axis, axis)
    return x, y


def _noise(rng: np.random.Generator) -> FloatArray:
    """A Gaussian field of mean 0 and variance 1 with a galaxy's power spectrum, on twice the field, so that it ends."""
    white = np.fft.rfft2(rng.standard_normal((2 * _SIDE, 2 * _SIDE)))
    k = np.hypot(np.fft.fftfreq(2 * _SIDE)[:, None], np.fft.rfftfreq(2 * _SIDE)[None, :])
    k[0, 0] = np.inf
    # Waves longer than the galaxy would only make one half of it brighter.
    amplitude = k ** (0.5 * _SPECTRUM) * (k * _PER_RADIUS > 0.25)
    field = np.fft.irfft2(white * amplitude)[:_SIDE, :_SIDE]
    return np.asarray((field - field.mean()) / field.std())


def _image(light: FloatArray, share: float, q: float, phi: float) -> PixelLight:
    """A face-on image as part of a galaxy that is inclined; in 32-bit numbers, which hide the rounding of a machine."""
    t = np.clip((np.hypot(*_plane()) - _BEGINS) / (_ENDS - _BEGINS), 0.0, 1.0)
    faded = light * (1.0 - t**2 * (3.0 - 2.0 * t))
    values = (faded / faded.sum()).astype(np.float32).astype(np.float64) * (share * _PER_RADIUS**2)
    middle = 0.5 * (_SIDE - 1)
    return PixelLight(values, 1.0 / _PER_RADIUS, middle, middle, q, phi)


def _in_plane(x: float, y: float, q: float, phi: float) -> tuple[float, float]:
    """A place of the face-on plane as it is seen, as :class:`~engine.light.pixels.PixelLight` has it."""
    u, v = x / math.sqrt(q), y * math.sqrt(q)
    return math.cos(phi) * u - math.sin(phi) * v, math.sin(phi) * u + math.cos(phi) * v


_Maker = Callable[[MadeGalaxy, float, float, np.random.Generator], tuple[Component, ...]]
_MAKERS: dict[str, _Maker] = {
    "bulge_disc": _bulge_disc,
    "clumpy": _clumpy,
    "companion": _companion,
    "spiral": _spiral,
    "irregular": _irregular,
    "merger": _merger,
}
_KINDS = list(_MAKERS)
