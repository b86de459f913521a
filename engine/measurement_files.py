"""The images of a measurement as a FITS file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from astropy.io import fits

from engine.imaging.fits import world_coordinates
from engine.measure import ImageMeasurement


def write_measurement(path: str | Path, found: ImageMeasurement) -> None:
    """Write the image and, on the same pixels, MODEL, ARC (lensed host), RESIDUAL and SIGMA [e-/s] of the fit.

    All have the world coordinates of the observation.

    SIGMA is infinite where a pixel was not fitted. The extension RESULT holds what
    :meth:`~engine.measure.ImageMeasurement.to_dict` says, as JSON text in one cell.
    """
    fit, observation = found.fit, found.observation
    planes = {
        "IMAGE": observation.image,
        "MODEL": fit.model,
        "ARC": fit.arc,
        "RESIDUAL": np.where(np.isfinite(fit.sigma), observation.image - fit.model, 0.0),
        "SIGMA": fit.sigma,
    }
    primary = fits.PrimaryHDU()
    primary.header["PIXSCALE"] = (observation.pixel_scale, "[arcsec] side of a pixel")
    primary.header["ZEROPNT"] = (observation.zero_point, "[mag] AB magnitude of 1 electron/s")
    primary.header["STATUS"] = found.status
    world = world_coordinates(observation)
    hdus = [primary, *(fits.ImageHDU(values, world, name=name) for name, values in planes.items())]
    for hdu in hdus[1:]:
        hdu.header["BUNIT"] = "electron/s"
    text = json.dumps(found.to_dict())
    hdus.append(fits.BinTableHDU.from_columns([fits.Column("json", f"{len(text)}A", array=[text])], name="RESULT"))
    fits.HDUList(hdus).writeto(path, overwrite=True)
