"""The Observation: everything that the inversion may know of an image, whoever made it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.blurring import place_stamp
from engine.imaging.response import PointResponse

Provenance = Mapping[str, str | float | int]


@dataclass(frozen=True, eq=False)
class Observation:
    """An image with its noise and PSF. Immutable: arrays are copied in and read-only.

    Attributes
    ----------
    image
        (ny, nx) [e-/s per pixel], North up, East left.
    noise
        1 sigma of each pixel [e-/s], same shape; positive and finite where ``valid``.
    psf
        Odd square on the image's pixels, centred on its middle pixel; its sum is the fraction of a point
        source's flux inside it.
    pixel_scale
        [arcsec].
    zero_point
        AB magnitude of 1 e-/s.
    covariance
        Covariance of the pixels in row-major order [(e-/s)^2], sparse (ny nx, ny nx); None where only the
        noise map is known.
    valid
        Pixels that may be used, same shape as the image; all where None is given.
    provenance
        Where it comes from: names to text or numbers.
    response
        The exposures behind the image, where they are known: point sources are then exact, not shifted stamps.
    """

    image: FloatArray
    noise: FloatArray
    psf: FloatArray
    pixel_scale: float
    zero_point: float
    covariance: sparse.csr_matrix | None = None
    valid: NDArray[np.bool_] = None  # type: ignore[assignment]  # never None after __post_init__
    provenance: Provenance = field(default_factory=dict)
    response: PointResponse | None = None

    def __post_init__(self) -> None:
        """Copy, freeze and check; an ObservationError names what is wrong."""
        for name in ("image", "noise", "psf"):
            object.__setattr__(self, name, _frozen(name, getattr(self, name)))
        valid = np.ones(self.image.shape, dtype=bool) if self.valid is None else np.array(self.valid)
        if valid.dtype != bool:
            raise ObservationError(f"valid: got an array of {valid.dtype}, allowed is bool")
        valid.setflags(write=False)
        object.__setattr__(self, "valid", valid)
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        self._check_image(valid)
        _check_psf(self.psf)
        for name in ("pixel_scale", "zero_point"):
            value = float(getattr(self, name))
            if not np.isfinite(value) or (name == "pixel_scale" and value <= 0):
                raise ObservationError(f"{name}: got {value}, allowed is a finite number, positive for a scale")
            object.__setattr__(self, name, value)
        for key, entry in self.provenance.items():
            if not isinstance(entry, str | float | int) or isinstance(entry, bool):
                raise ObservationError(f"provenance {key!r}: got {entry!r}, allowed are text and numbers")
        if self.covariance is not None:
            self._check_covariance(valid)

    def _check_image(self, valid: NDArray[np.bool_]) -> None:
        for name, array in (("noise", self.noise), ("valid", valid)):
            if array.shape != self.image.shape:
                raise ObservationError(f"{name}: got shape {array.shape}, allowed is the image's {self.image.shape}")
        if not valid.any():
            raise ObservationError("valid: no pixel is left")
        if not np.isfinite(self.image[valid]).all():
            raise ObservationError("image: not finite in some valid pixels")
        noise = self.noise[valid]
        if not (np.isfinite(noise).all() and (noise > 0).all()):
            raise ObservationError("noise: zero, negative or not finite in some valid pixels")

    def _check_covariance(self, valid: NDArray[np.bool_]) -> None:
        covariance = sparse.csr_matrix(self.covariance, dtype=np.float64, copy=True)
        n = self.image.size
        if covariance.shape != (n, n):
            raise ObservationError(f"covariance: got shape {covariance.shape}, allowed is {(n, n)}")
        if not np.isfinite(covariance.data).all():
            raise ObservationError("covariance: not finite everywhere")
        if abs(covariance - covariance.T).max() > 1e-12 * abs(covariance).max():
            raise ObservationError("covariance: not symmetric")
        if not (covariance.diagonal()[valid.ravel()] > 0).all():
            raise ObservationError("covariance: a valid pixel has no positive variance")
        covariance.sum_duplicates()  # sorts as well
        for part in (covariance.data, covariance.indices, covariance.indptr):
            part.setflags(write=False)
        object.__setattr__(self, "covariance", covariance)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx) of the image."""
        ny, nx = self.image.shape
        return ny, nx

    def point_source(self, x: float, y: float) -> FloatArray:
        """Image (ny, nx) of a point source of unit flux at (x, y) [arcsec, image frame]."""
        if self.response is not None:
            return self.response.image(x, y)
        ny, nx = self.shape
        column, row = x / self.pixel_scale + (nx - 1) / 2.0, y / self.pixel_scale + (ny - 1) / 2.0
        return place_stamp(self.psf, self.shape, column, row)


def _frozen(name: str, values: ArrayLike) -> FloatArray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ObservationError(f"{name}: not an array of numbers ({error})") from error
    if array.ndim != 2 or array.size == 0:
        raise ObservationError(f"{name}: got shape {array.shape}, allowed is a two-dimensional image")
    array.setflags(write=False)
    return array


def _check_psf(psf: FloatArray) -> None:
    if psf.shape[0] != psf.shape[1] or psf.shape[0] % 2 == 0:
        raise ObservationError(f"psf: got shape {psf.shape}, allowed is an odd square (see recentre_psf)")
    if not np.isfinite(psf).all():
        raise ObservationError("psf: not finite everywhere")
    if not psf.sum() > 0:
        raise ObservationError(f"psf: got the sum {psf.sum()}, allowed is a positive one")


def observation_from_arrays(
    image: ArrayLike,
    noise: ArrayLike,
    psf: ArrayLike,
    pixel_scale: float,
    zero_point: float,
    *,
    recentre_psf: bool = False,
    normalise_psf: bool = False,
    valid: NDArray[np.bool_] | None = None,
    provenance: Provenance | None = None,
) -> Observation:
    """Make an Observation from arrays that somebody else made.

    Pixels whose noise is zero, negative, NaN or infinite, or whose image is not finite, become invalid (and
    hold 0 in the image and infinity in the noise map); the provenance records how many, and what was done to
    the PSF. The PSF is changed on request alone.

    Parameters
    ----------
    image, noise
        (ny, nx) [e-/s], 1 sigma.
    psf
        PSF on the image's pixels.
    recentre_psf
        Cut or pad the PSF with zeros to the odd square about its brightest pixel that loses nothing.
    normalise_psf
        Divide the PSF by its sum.
    valid
        Pixels that may be used, in addition to the rule above.

    Raises
    ------
    ObservationError
        For shapes that do not fit, a PSF that is not an odd square, and all that Observation refuses.
    """
    pixels, sigma, stamp = (
        np.array(_frozen(name, values)) for name, values in (("image", image), ("noise", noise), ("psf", psf))
    )
    if sigma.shape != pixels.shape:
        raise ObservationError(f"noise: got shape {sigma.shape}, allowed is the image's {pixels.shape}")
    usable = np.isfinite(pixels) & np.isfinite(sigma) & (sigma > 0)
    if valid is not None and np.shape(valid) != pixels.shape:
        raise ObservationError(f"valid: got shape {np.shape(valid)}, allowed is the image's {pixels.shape}")
    record: dict[str, str | float | int] = dict(provenance or {})
    if not usable.all():
        record["unusable_pixels"] = int(np.count_nonzero(~usable))
    pixels[~usable], sigma[~usable] = 0.0, np.inf
    if recentre_psf:
        stamp, peak = _recentred(stamp)
        record["psf_peak_was_at_row"], record["psf_peak_was_at_column"] = peak
    if normalise_psf:
        total = float(stamp.sum())
        if not (np.isfinite(total) and total > 0):
            raise ObservationError(f"psf: got the sum {total}, allowed is a positive one")
        record["psf_divided_by"] = total
        stamp = stamp / total
    allowed = usable if valid is None else usable & np.asarray(valid, dtype=bool)
    return Observation(pixels, sigma, stamp, pixel_scale, zero_point, valid=allowed, provenance=record)


def _recentred(psf: FloatArray) -> tuple[FloatArray, tuple[int, int]]:
    """Put the PSF on the smallest odd square centred on its peak that holds it; say where that was."""
    if not np.isfinite(psf).all():
        raise ObservationError("psf: not finite everywhere, so it has no peak to be centred on")
    row, column = (int(index) for index in np.unravel_index(np.argmax(psf), psf.shape))
    ny, nx = psf.shape
    half = max(row, ny - 1 - row, column, nx - 1 - column)
    centred = np.zeros((2 * half + 1, 2 * half + 1))
    centred[half - row : half - row + ny, half - column : half - column + nx] = psf
    return centred, (row, column)
