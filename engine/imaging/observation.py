"""The Observation: everything that the inversion may know of an image, whoever made it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy import units
from astropy.nddata import NDData
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from engine.conventions import NORTH_UP, FloatArray, Orientation
from engine.errors import ObservationError
from engine.imaging.optics.exposed import ExposedOptics
from engine.imaging.optics.interface import ImageOptics
from engine.imaging.optics.stamp import StampOptics

Provenance = Mapping[str, str | float | int]


@dataclass(frozen=True, eq=False)
class Observation:
    """An image with its noise and PSF. Immutable: arrays are copied in and read-only.

    Attributes
    ----------
    image
        (ny, nx) [e-/s per pixel].
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
    centre
        (RA, Dec) [deg, ICRS] of the middle of the image, where it is known.
    orientation
        How the image stands on the sky; North up and East left where nothing else is known.
    notes
        What was odd about it when it was read; a measurement repeats them as warnings.
    """

    image: FloatArray
    noise: FloatArray
    psf: FloatArray
    pixel_scale: float
    zero_point: float
    covariance: sparse.csr_matrix | None = None
    valid: NDArray[np.bool_] = None  # type: ignore[assignment]  # never None after __post_init__
    provenance: Provenance = field(default_factory=dict)
    response: ExposedOptics | None = None
    centre: tuple[float, float] | None = None
    orientation: Orientation = NORTH_UP
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Copy, freeze and check; an ObservationError names what is wrong."""
        for name in ("image", "noise", "psf"):
            object.__setattr__(self, name, image_array(name, getattr(self, name)))
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
        if self.centre is not None:
            ra, dec = (float(angle) for angle in self.centre)
            if not (0.0 <= ra < 360.0 and -90.0 <= dec <= 90.0):
                raise ObservationError(
                    f"centre: got {self.centre}, allowed are RA in [0, 360) and Dec in [-90, 90] deg"
                )
            object.__setattr__(self, "centre", (ra, dec))

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild from the fields, so that it can be pickled and copied: a read-only mapping cannot."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return _rebuilt, (values | {"provenance": dict(self.provenance)},)

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

    @property
    def optics(self) -> ImageOptics:
        """What light becomes in this image: through its exposures where they are known, through the stamp otherwise."""
        return self.response or StampOptics(self.psf, self.shape, self.pixel_scale)

    def point_source(self, x: float, y: float) -> FloatArray:
        """Image (ny, nx) of a point source of unit flux at (x, y) [arcsec, image frame]."""
        return self.optics.point_source(x, y)


def _rebuilt(values: dict[str, Any]) -> Observation:
    return Observation(**values)


def image_array(name: str, values: ArrayLike) -> FloatArray:
    """A read-only two-dimensional float64 copy; an ObservationError names what could not be one.

    A mask or a unit would be lost here, so that arrays with one are refused:
    :func:`~engine.imaging.external.observation_from_arrays` understands them.
    """
    masked = np.ma.getmaskarray(values).any() if isinstance(values, np.ma.MaskedArray) else False
    if masked or isinstance(values, units.Quantity | NDData):
        raise ObservationError(f"{name}: got a {type(values).__name__}, whose mask or unit would be lost")
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
