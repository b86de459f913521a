"""Observations as FITS files: maps, PSF, covariance, world coordinates and provenance, without loss."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS
from scipy import sparse

from engine.conventions import NORTH_UP, Orientation
from engine.errors import ObservationError
from engine.imaging.geometry import Geometry
from engine.imaging.observation import Observation
from engine.imaging.optics.exposed import ExposedOptics
from engine.imaging.telescope import TelescopeState
from engine.spec.realization import camera_from_mapping, camera_to_mapping

FORMAT_VERSION = 2
_KEYWORD = re.compile(r"[A-Z][A-Z0-9_-]{0,7}")
_RESERVED = {"SIMPLE", "BITPIX", "NAXIS", "EXTEND", "END", "CONTINUE", "COMMENT", "HISTORY", "CHECKSUM", "DATASUM"}
_CARD_TEXT = 68


def write_observation(path: str | Path, observation: Observation, *, overwrite: bool = False) -> None:
    """Write an Observation: extensions IMAGE, NOISE, PSF, VALID and, where it has them, COVARIANCE and EXPOSURES.

    The image and its maps carry a tangential projection, turned as its ``orientation`` says, where the observation
    knows its ``centre``, and otherwise a linear system in arcsec from the centre, x increasing with the columns. The
    provenance stands in the primary header: as JSON text in PKEYn and PVALn, which keeps every digit and the type, and
    for people also under its own name where that is a FITS keyword and the value fits on a card.
    """
    primary = fits.PrimaryHDU()
    header = primary.header
    header["LONGSTRN"] = ("OGIP 1.0", "long text goes on in CONTINUE cards")
    header["HOSTLENS"] = (FORMAT_VERSION, "version of this layout")
    header["PIXSCALE"] = (observation.pixel_scale, "[arcsec] side of a pixel")
    header["ZEROPNT"] = (observation.zero_point, "[mag] AB magnitude of 1 electron/s")
    exact = {
        "pixel_scale": observation.pixel_scale, "zero_point": observation.zero_point, "centre": observation.centre,
        "orientation": asdict(observation.orientation), "notes": observation.notes,
    }  # fmt: skip
    header["EXACT"] = json.dumps(exact)
    for key, value in observation.provenance.items():
        if _KEYWORD.fullmatch(key) and key not in header and key not in _RESERVED and _fits_on_a_card(value):
            header[key] = value
    for index, (key, value) in enumerate(observation.provenance.items()):
        header[f"PKEY{index}"] = json.dumps(key)
        header[f"PVAL{index}"] = json.dumps(value)
    world = world_coordinates(observation)
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


def _fits_on_a_card(value: str | float | int) -> bool:
    if isinstance(value, str):
        return value.isascii() and value.isprintable() and len(value.replace("'", "''")) <= _CARD_TEXT
    return math.isfinite(value) and abs(value) < 2**63


def world_coordinates(observation: Observation) -> fits.Header:
    """World coordinates of an observation's pixels, as :func:`write_observation` has them."""
    ny, nx = observation.shape
    world = WCS(naxis=2)
    world.wcs.crpix = [(nx + 1) / 2, (ny + 1) / 2]  # FITS counts pixels from 1
    if observation.centre is None:
        world.wcs.ctype, world.wcs.cunit = ["X", "Y"], ["arcsec", "arcsec"]
        world.wcs.cdelt = [observation.pixel_scale, observation.pixel_scale]
    else:
        degrees = observation.pixel_scale / 3600
        world.wcs.ctype, world.wcs.cunit = ["RA---TAN", "DEC--TAN"], ["deg", "deg"]
        world.wcs.crval, world.wcs.cdelt = observation.centre, [-degrees, degrees]
        if observation.orientation != NORTH_UP:
            # One pixel along each axis, as steps to the East and the North.
            (east_x, north_x), (east_y, north_y) = (observation.orientation.on_sky(*step) for step in ((1, 0), (0, 1)))
            world.wcs.pc = [[-east_x, -east_y], [north_x, north_y]]
        world.wcs.radesys = "ICRS"
    return world.to_header()


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


def _exposures(response: ExposedOptics) -> fits.ImageHDU:
    """The optical PSF on sub-pixels, with sampling and detector kernel as JSON text in its header."""
    plane = fits.ImageHDU(response.psf, name="EXPOSURES")
    plane.header["LONGSTRN"] = "OGIP 1.0"
    plane.header["SAMPLING"] = json.dumps(asdict(response.geometry))
    plane.header["DETECTOR"] = json.dumps(response.detector_kernel.tolist())
    if response.correction is not None:
        raise ObservationError("response: a PSF that a fit has corrected is not written")
    if response.camera is not None:
        plane.header["CAMERA"] = json.dumps(camera_to_mapping(response.camera))
        plane.header["STATE"] = json.dumps(asdict(response.state))
    return plane


def _response(plane: fits.ImageHDU) -> ExposedOptics:
    values = json.loads(plane.header["SAMPLING"])
    try:
        # JSON has lists where the geometry has tuples, on which its hash depends.
        tuples = {name: _tuples(value) for name, value in values.items()}
        geometry = Geometry(**tuples)
    except TypeError as error:
        raise ObservationError(f"EXPOSURES: its sampling is not of this layout ({error})") from error
    kernel = np.array(json.loads(plane.header["DETECTOR"]))
    response = ExposedOptics(plane.data.astype(np.float64), geometry, kernel)
    if "CAMERA" not in plane.header:
        return response
    camera = camera_from_mapping(json.loads(plane.header["CAMERA"]))
    return replace(response, camera=camera, state=TelescopeState(**json.loads(plane.header["STATE"])))


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
    exact = json.loads(header["EXACT"])
    provenance: dict[str, str | float | int] = {}
    while f"PKEY{len(provenance)}" in header:
        index = len(provenance)
        provenance[json.loads(header[f"PKEY{index}"])] = json.loads(header[f"PVAL{index}"])
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
        exact["pixel_scale"],
        exact["zero_point"],
        covariance=covariance,
        valid=hdus["VALID"].data.astype(bool),
        provenance=provenance,
        response=_response(hdus["EXPOSURES"]) if "EXPOSURES" in hdus else None,
        centre=None if exact["centre"] is None else (exact["centre"][0], exact["centre"][1]),
        # Files of before have neither.
        orientation=Orientation(**exact.get("orientation", {})),
        notes=tuple(exact.get("notes", ())),
    )
