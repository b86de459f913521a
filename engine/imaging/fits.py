"""Observations as FITS files: maps, PSF, covariance, world coordinates and provenance, without loss."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from scipy import sparse

from engine.errors import ObservationError
from engine.imaging.geometry import Geometry
from engine.imaging.observation import Observation
from engine.imaging.response import PointResponse

FORMAT_VERSION = 1


def write_observation(
    path: str | Path,
    observation: Observation,
    *,
    centre: tuple[float, float] | None = None,
    overwrite: bool = False,
) -> None:
    """Write an Observation: extensions IMAGE, NOISE, PSF, VALID and, where it has them, COVARIANCE and EXPOSURES.

    Parameters
    ----------
    centre
        (RA, Dec) [deg, ICRS] of the centre of the image. With it the image and its maps carry a tangential
        projection, North up and East left; without it a linear system in arcsec from the centre, x increasing
        with the columns.
    """
    primary = fits.PrimaryHDU()
    primary.header["HOSTLENS"] = (FORMAT_VERSION, "version of this layout")
    primary.header["PIXSCALE"] = (observation.pixel_scale, "[arcsec] side of a pixel")
    primary.header["ZEROPNT"] = (observation.zero_point, "[mag] AB magnitude of 1 electron/s")
    for index, (key, value) in enumerate(observation.provenance.items()):
        # JSON text keeps every digit and the type, which a FITS number does not.
        primary.header[f"PKEY{index}"] = (key, "provenance: name")
        primary.header[f"PVAL{index}"] = json.dumps(value)
    world = _world_coordinates(observation, centre)
    planes: list[Any] = [
        fits.ImageHDU(observation.image, world, name="IMAGE"),
        fits.ImageHDU(observation.noise, world, name="NOISE"),
        fits.ImageHDU(observation.psf, name="PSF"),
        fits.ImageHDU(np.asarray(observation.valid, dtype=np.uint8), world, name="VALID"),
    ]
    for plane in planes[:2]:
        plane.header["BUNIT"] = "electron/s"
    if observation.covariance is not None:
        planes.append(_covariance_table(observation.covariance))
    if observation.response is not None:
        planes.append(_exposures(observation.response))
    fits.HDUList([primary, *planes]).writeto(path, overwrite=overwrite, checksum=True)


def _world_coordinates(observation: Observation, centre: tuple[float, float] | None) -> fits.Header:
    ny, nx = observation.shape
    header = fits.Header()
    for axis, n in ((1, nx), (2, ny)):
        header[f"CRPIX{axis}"] = (n + 1) / 2  # FITS counts pixels from 1
    if centre is None:
        for axis, name in ((1, "X"), (2, "Y")):
            header[f"CTYPE{axis}"] = name
            header[f"CUNIT{axis}"] = "arcsec"
            header[f"CRVAL{axis}"] = 0.0
            header[f"CDELT{axis}"] = observation.pixel_scale
        return header
    degrees = observation.pixel_scale / 3600
    for axis, name, value, step in (
        (1, "RA---TAN", centre[0], -degrees),
        (2, "DEC--TAN", centre[1], degrees),
    ):
        header[f"CTYPE{axis}"] = name
        header[f"CUNIT{axis}"] = "deg"
        header[f"CRVAL{axis}"] = value
        header[f"CDELT{axis}"] = step
    header["RADESYS"] = "ICRS"
    return header


def _covariance_table(covariance: sparse.csr_matrix) -> fits.BinTableHDU:
    """All stored elements as (row, column, value); pixels counted from 0 in row-major order."""
    elements = covariance.tocoo()
    return fits.BinTableHDU.from_columns(
        [
            fits.Column("ROW", "J", array=elements.row.astype(np.int32)),
            fits.Column("COL", "J", array=elements.col.astype(np.int32)),
            fits.Column("VALUE", "D", array=elements.data, unit="electron2 s-2"),
        ],
        name="COVARIANCE",
    )


def _exposures(response: PointResponse) -> fits.ImageHDU:
    """The optical PSF on sub-pixels, with sampling and detector kernel as JSON text in its header."""
    plane = fits.ImageHDU(response.psf, name="EXPOSURES")
    plane.header["SAMPLING"] = json.dumps(asdict(response.geometry))
    plane.header["DETECTOR"] = json.dumps(response.detector_kernel.tolist())
    return plane


def _response(plane: fits.ImageHDU) -> PointResponse:
    values = json.loads(plane.header["SAMPLING"])
    try:
        # JSON has lists where the geometry has tuples, on which its hash depends.
        tuples = {name: _tuples(value) for name, value in values.items()}
        geometry = Geometry(**tuples)
    except TypeError as error:
        raise ObservationError(f"EXPOSURES: its sampling is not of this layout ({error})") from error
    return PointResponse(plane.data.astype(np.float64), geometry, np.array(json.loads(plane.header["DETECTOR"])))


def _tuples(value: Any) -> Any:
    return tuple(_tuples(entry) for entry in value) if isinstance(value, list) else value


def read_observation(path: str | Path) -> Observation:
    """Read an Observation written by :func:`write_observation`.

    Raises
    ------
    ObservationError
        For a file that is not FITS, or not of this layout; the message says what is missing.
    """
    try:
        with fits.open(path, memmap=False, checksum=False) as hdus:
            return _observation(hdus)
    except (OSError, KeyError, json.JSONDecodeError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise ObservationError(f"{path}: not an observation of this layout ({error})") from error


def _observation(hdus: fits.HDUList) -> Observation:
    header = hdus[0].header
    if header["HOSTLENS"] != FORMAT_VERSION:
        raise ObservationError(f"HOSTLENS: got layout {header['HOSTLENS']}, allowed is {FORMAT_VERSION}")
    provenance: dict[str, str | float | int] = {}
    while f"PKEY{len(provenance)}" in header:
        index = len(provenance)
        provenance[header[f"PKEY{index}"]] = json.loads(header[f"PVAL{index}"])
    image, noise, psf = (hdus[name].data.astype(np.float64) for name in ("IMAGE", "NOISE", "PSF"))
    covariance = None
    if "COVARIANCE" in hdus:
        table = hdus["COVARIANCE"].data
        covariance = sparse.csr_matrix(
            (table["VALUE"].astype(np.float64), (table["ROW"], table["COL"])), shape=(image.size, image.size)
        )
    return Observation(
        image,
        noise,
        psf,
        header["PIXSCALE"],
        header["ZEROPNT"],
        covariance=covariance,
        valid=hdus["VALID"].data.astype(bool),
        provenance=provenance,
        response=_response(hdus["EXPOSURES"]) if "EXPOSURES" in hdus else None,
    )


def read_image(path: str | Path) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Read the first two-dimensional image in a FITS file of anybody's, as float64 in native byte order."""
    try:
        with fits.open(path, memmap=False) as hdus:
            for hdu in hdus:
                if getattr(hdu, "is_image", False) and hdu.data is not None and hdu.data.ndim == 2:
                    return np.asarray(hdu.data, dtype=np.float64)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ObservationError(f"{path}: not a FITS file ({error})") from error
    raise ObservationError(f"{path}: holds no two-dimensional image")
