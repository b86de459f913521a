"""Which plane of anybody's FITS file is the image, its noise, weight, flags or PSF: EXTNAMEs of HST, JWST and us."""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from engine.conventions import FloatArray
from engine.errors import EngineError, ObservationError

Role = Literal["image", "noise", "psf", "valid", "dq", "weight"]
Slices = tuple[slice, slice]
LIBRARY_ERRORS = (
    OSError, ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError, EOFError, MemoryError,
    RuntimeError, NameError, AssertionError, fits.VerifyError, struct.error, zlib.error,
)  # fmt: skip
"""What the libraries underneath raise at files that break a rule; those of WCS and units are ValueErrors, and Astropy
raises a NameError at a D2IMDIS that is no LOOKUP."""
NAMES: dict[Role, tuple[str, ...]] = {
    "image": ("SCI", "IMAGE"),
    "noise": ("ERR", "NOISE", "RMS", "SIGMA", "STD", "ERROR"),
    "psf": ("PSF", "DET_DIST", "DET_SAMP", "EPSF"),
    "valid": ("VALID", "MASK"),
    "dq": ("DQ", "FLAGS"),
    "weight": ("WHT", "WEIGHT"),
}
"""EXTNAMEs of each role, the likeliest first."""
_NEVER_AN_IMAGE = frozenset(name for role, names in NAMES.items() if role != "image" for name in names) | {
    "CON", "CTX", "EXP", "EXPOSURES", "COVARIANCE", "IVM", "VAR", "VAR_POISSON", "VAR_RNOISE", "VAR_FLAT", "SAMP",
    "TIME", "AREA", "MODEL", "ARC", "RESIDUAL", "D2IMARR", "WCSDVARR", "NPOLARR",
}  # fmt: skip


@contextmanager
def in_one_line(what: object) -> Iterator[None]:
    """Whatever a library raises becomes an ObservationError of one line that begins with ``what``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyWarning)
            yield
    except (EngineError, FileNotFoundError):
        raise
    except LIBRARY_ERRORS as error:
        raise ObservationError(f"{what}: {said(error)}") from error


def said(error: BaseException) -> str:
    """What an error says, in one line; its name where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def opened(path: str | Path) -> Iterator[fits.HDUList]:
    """The HDUs of a FITS file; an ObservationError where it is none."""
    with in_one_line(f"{path}: not a FITS file that can be read"):
        hdus = fits.open(path, memmap=False)
    with hdus:
        yield hdus


@dataclass(frozen=True, eq=False)
class Headers:
    """Where a plane's keywords are looked for: in its own header, then in the primary one."""

    sources: tuple[tuple[str, fits.Header], ...]

    @property
    def origin(self) -> str:
        """The plane, as ``image.fits[SCI,1]``."""
        return self.sources[0][0]

    @property
    def own(self) -> fits.Header:
        """The plane's own header."""
        return self.sources[0][1]

    def find(self, *names: str) -> tuple[Any, str] | None:
        """The value of the first of the keywords that there is, and where it stands; None without one."""
        for name in names:
            for origin, header in self.sources:
                with in_one_line(f"{name} of {origin}"):
                    value = header.get(name)
                if value is not None and not isinstance(value, fits.card.Undefined):
                    return value, f"{name} of {origin}"
        return None

    def number(self, *names: str) -> tuple[float, str] | None:
        """The same, as a finite number; an ObservationError where it is none."""
        found = self.find(*names)
        if found is None:
            return None
        value, origin = found
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = np.nan
        if isinstance(value, bool) or not np.isfinite(number):
            raise ObservationError(f"{origin}: got {value!r}, allowed is a number")
        return number, origin


@dataclass(frozen=True, eq=False)
class Plane:
    """A two-dimensional plane of an open file, not yet read."""

    hdu: Any
    headers: Headers
    shape: tuple[int, int]
    others: int
    """Planes of the same file that could have been meant as well."""

    @property
    def origin(self) -> str:
        """As of :class:`Headers`."""
        return self.headers.origin

    def values(self, where: Slices | None = None) -> FloatArray:
        """Its pixels, or those of a part of it, as float64 in native byte order [its own unit]."""
        rows, columns = where or (slice(None), slice(None))
        with in_one_line(f"{self.origin}: cannot be read"):
            leading = (0,) * (len(self.hdu.shape) - 2)
            return np.asarray(self.hdu.section[(*leading, rows, columns)], dtype=np.float64)


def find_plane(hdus: fits.HDUList, path: str | Path, role: Role, extension: str | int | None = None) -> Plane | None:
    """The plane of a role; None where no plane can have it.

    A plane is known by its EXTNAME. Where none is named after the role, it is the first that is not named after another
    one. ``extension`` is a name or number that overrules this.

    Raises
    ------
    ObservationError
        ``extension`` is no two-dimensional image.
    """
    with in_one_line(f"{path}: not a FITS file that can be read"):
        planes = [(k, hdu) for k, hdu in enumerate(hdus) if _is_plane(hdu)]
    if extension is not None:
        named = str(extension).upper()
        chosen = [(k, hdu) for k, hdu in planes if named in (str(k), hdu.name.upper(), f"{hdu.name.upper()},{hdu.ver}")]
        if not chosen:
            there = ", ".join(f"{k} {hdu.name}".strip() for k, hdu in planes) or "none"
            raise ObservationError(f"{path}: extension {extension!r} is no image; allowed are {there}")
    else:
        chosen = next(([(k, h) for k, h in planes if h.name.upper() == name] for name in NAMES[role]
                       if any(h.name.upper() == name for _, h in planes)), [])  # fmt: skip
        chosen = chosen or [(k, hdu) for k, hdu in planes if _may_be(hdu.name.upper(), role)]
    if not chosen:
        return None
    index, hdu = chosen[0]
    label = f"{hdu.name},{hdu.ver}" if hdu.name and index else str(index)
    sources = [(f"{Path(path).name}[{label}]", hdu.header)]
    sources += [(f"{Path(path).name}[0]", hdus[0].header)] if index else []
    return Plane(hdu, Headers(tuple(sources)), (hdu.shape[-2], hdu.shape[-1]), len(chosen) - 1)


def companion(hdus: fits.HDUList, path: str | Path, image: Plane, role: Role) -> Plane | None:
    """The plane of a role that belongs to an image in the same file: of the same shape and EXTVER; None without one."""
    for name in NAMES[role]:
        for index, hdu in enumerate(hdus):
            same = hdu is not image.hdu and _is_plane(hdu) and tuple(hdu.shape[-2:]) == image.shape
            if same and hdu.name.upper() == name and hdu.ver == image.hdu.ver:
                return find_plane(hdus, path, role, index)
    return None


def require_plane(hdus: fits.HDUList, path: str | Path, role: Role, extension: str | int | None = None) -> Plane:
    """The plane of a role; an ObservationError says what the file has instead."""
    plane = find_plane(hdus, path, role, extension)
    if plane is not None:
        return plane
    there = ", ".join(hdu.name or str(k) for k, hdu in enumerate(hdus) if _is_plane(hdu))
    if not there:
        raise ObservationError(f"{path}: holds no two-dimensional image")
    raise ObservationError(f"{path}: holds no {role} plane but {there}; allowed are {', '.join(NAMES[role])}")


def _is_plane(hdu: Any) -> bool:
    """An image whose axes but the last two have one pixel each."""
    shape = hdu.shape if getattr(hdu, "is_image", False) else ()
    return len(shape) >= 2 and all(n == 1 for n in shape[:-2]) and min(shape[-2:]) > 0


def _may_be(name: str, role: Role) -> bool:
    """Whether a plane of that EXTNAME may have a role after which it is not named."""
    if role == "image":
        return name not in _NEVER_AN_IMAGE
    # A star cut out of an image makes a PSF; a noise map or a mask under a name of its own is taken, an image is not.
    return name not in _NEVER_AN_IMAGE and (role in ("psf", "valid", "dq") or name not in NAMES["image"])
