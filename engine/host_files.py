"""Images of galaxies from FITS files, as hosts: the one place where a host meets a file."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Literal

import numpy as np
from astropy.io import fits
from pydantic import ValidationError
from scipy.ndimage import binary_dilation, gaussian_filter, label, uniform_filter

from engine.conventions import FloatArray
from engine.errors import SpecError
from engine.spec.host import LEAST_SIDE, MOST_SIDE, HostImage, border_of
from engine.spec.validation import spec_error

_SMOOTHING, _NOISES = 2.0, 2.0
_MAD = 1.4826
"""Standard deviation of normal deviates over their median distance from the median."""
Background = Literal["border", "none"]


def read_host_image(
    path: str | Path,
    *,
    extension: str | int | None = None,
    background: Background = "border",
    isolate: bool = True,
    nucleus: tuple[float, float] | None = None,
) -> HostImage:
    """The galaxy in a FITS image, as a host.

    Its pixels are taken as they are: what their PSF has smoothed stays smooth (deconvolve it before, or take a galaxy
    that is much larger than its PSF), and noise within the galaxy is light of it to a simulation. Of more than 128
    pixels along a side so many are added up that no more are left.

    Parameters
    ----------
    path
        The file; its rows run from the South, West on the right.
    extension
        Name or number of the image in it; not needed where there is one alone.
    background
        ``border`` subtracts the median of the outermost pixels, ``none`` nothing.
    isolate
        Make dark what is not part of the galaxy: the noise of the sky, and other galaxies. It ends where the image,
        smoothed over 2 pixels, falls below twice the noise that the outermost pixels have when they are smoothed.
    nucleus
        Where the AGN stands: (column, row), counted from the centre of the first pixel. The brightest place of the
        inner half where None.

    Raises
    ------
    SpecError
        There is no such image, or it is no galaxy: it names the field, the value and what is allowed.
    OSError
        The file cannot be read.
    """
    values = _read(Path(path), extension)
    finite = np.isfinite(values)
    if not finite.all():
        raise SpecError("pixels", f"{np.count_nonzero(~finite)} not finite", "finite values")
    if min(values.shape) < LEAST_SIDE:
        raise SpecError("shape", values.shape, f"{LEAST_SIDE} pixels at least along each side")
    if background == "border":
        values = values - float(np.median(border_of(values)))
    if isolate:
        values = values * _galaxy(values, _brightest(values) if nucleus is None else nucleus)
    factor = -(-max(values.shape) // MOST_SIDE)
    rows, columns = (size // factor for size in values.shape)
    # What does not fill a pixel is left over at the upper and right edge.
    binned = values[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor).sum(axis=(1, 3))
    place = _brightest(binned) if nucleus is None else tuple((at + 0.5) / factor - 0.5 for at in nucleus)
    total = float(binned.sum())
    return host_image(binned / total if total > 0.0 else binned, (float(place[0]), float(place[1])))


def host_image(values: FloatArray, nucleus: tuple[float, float]) -> HostImage:
    """Pixels (rows, columns), from the South, as a host; a SpecError where they are no galaxy."""
    pixels = base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()
    rows, columns = values.shape
    try:
        return HostImage(pixels=pixels, shape=(rows, columns), nucleus=nucleus)
    except ValidationError as error:
        raise spec_error(error) from error


def _read(path: Path, extension: str | int | None) -> FloatArray:
    """The image in a file as numbers; a SpecError lists what there is."""
    try:
        with fits.open(path, memmap=False) as file:
            images = {i: hdu for i, hdu in enumerate(file) if getattr(hdu, "data", None) is not None and hdu.is_image}
            names = [f"{i}{f' ({hdu.name})' if hdu.name else ''}" for i, hdu in images.items()]
            wanted = [
                hdu for i, hdu in images.items() if extension is None or str(extension) in {str(i), hdu.name.strip()}
            ]
            if len(wanted) != 1:
                raise SpecError("extension", extension, f"one of the images {names or 'that the file has not'}")
            data = np.asarray(wanted[0].data, dtype=np.float64)
    except OSError as error:
        if path.is_file():
            raise SpecError("file", path.name, f"a FITS file ({error})") from error
        raise
    if data.ndim != 2:
        raise SpecError("extension", f"an image of {data.ndim} dimensions", "an image of two")
    return data


def _galaxy(values: FloatArray, nucleus: tuple[float, float]) -> FloatArray:
    """Weight of each pixel: 1 in the galaxy that holds the nucleus, 0 outside, with an edge of a few pixels."""
    smooth = gaussian_filter(values, _SMOOTHING)
    border = border_of(smooth)
    noise = _MAD * float(np.median(np.abs(border - np.median(border))))
    regions, _ = label(smooth > _NOISES * noise)
    column, row = (round(at) for at in nucleus)
    if not (0 <= row < values.shape[0] and 0 <= column < values.shape[1] and regions[row, column]):
        raise SpecError("nucleus", nucleus, "a place in the image where there is light above the noise")
    return np.asarray(uniform_filter(binary_dilation(regions == regions[row, column], iterations=2).astype(float), 5))


def _brightest(values: FloatArray) -> tuple[float, float]:
    """Column and row of the brightest 3 x 3 pixels within the inner half of an image."""
    rows, columns = values.shape
    smooth = uniform_filter(values, 3)
    inner = smooth[rows // 4 : rows - rows // 4, columns // 4 : columns - columns // 4]
    row, column = np.unravel_index(int(np.argmax(inner)), inner.shape)
    return float(column + columns // 4), float(row + rows // 4)
