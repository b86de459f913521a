"""Other programs on the same axes, where they are installed: lenstronomy's deflection and its image of a host.

lenstronomy is no dependency of hostlens: it is imported when its points are wanted.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile, effective_brightness


def _ellipticity(phi: float, q: float) -> dict[str, float]:
    from lenstronomy.Util.param_util import phi_q2_ellipticity  # noqa: PLC0415 - no dependency

    e1, e2 = phi_q2_ellipticity(phi, q)
    return {"e1": float(e1), "e2": float(e2)}


def _lens_model(lens: PowerLawLens, profile: str) -> tuple[Any, list[dict[str, float]]]:
    from lenstronomy.LensModel.lens_model import LensModel  # noqa: PLC0415 - as above

    model = LensModel([profile, "SHEAR"] if lens.gamma1 or lens.gamma2 else [profile])
    values = [
        {
            "theta_E": lens.theta_E,
            "gamma": lens.slope,
            **_ellipticity(lens.phi, lens.q),
            "center_x": lens.x,
            "center_y": lens.y,
        }
    ]
    if lens.gamma1 or lens.gamma2:
        values.append({"gamma1": lens.gamma1, "gamma2": lens.gamma2})
    return model, values


def lenstronomy_deflection(lens: PowerLawLens, profile: str, x: FloatArray, y: FloatArray) -> Any:
    """A function that gives lenstronomy's deflection (alpha_x, alpha_y) [arcsec] at positions (k,) by a profile of it.

    ``profile`` is EPL (exact functions of scipy) or EPL_NUMBA (a series of fixed length).
    """
    model, values = _lens_model(lens, profile)
    return lambda: model.alpha(x, y, values)


def lenstronomy_image(
    profile: SersicProfile, lens: PowerLawLens, x: FloatArray, y: FloatArray, scale: float, subpixels: int
) -> Any:
    """A function that gives lenstronomy's image (n, n) of a lensed host with so many rays along a side of a pixel."""
    from lenstronomy.Data.imaging_data import ImageData  # noqa: PLC0415 - as above
    from lenstronomy.Data.psf import PSF  # noqa: PLC0415 - as above
    from lenstronomy.ImSim.image_model import ImageModel  # noqa: PLC0415 - as above
    from lenstronomy.LightModel.light_model import LightModel  # noqa: PLC0415 - as above

    data = ImageData(
        image_data=np.zeros((y.size, x.size)),
        ra_at_xy_0=x[0],
        dec_at_xy_0=y[0],
        transform_pix2angle=np.eye(2) * scale,
    )
    lens_model, lens_values = _lens_model(lens, "EPL_NUMBA")
    light = {
        "amp": profile.flux * effective_brightness(profile),
        "R_sersic": profile.r_eff,
        "n_sersic": profile.n,
        **_ellipticity(profile.phi, profile.q),
        "center_x": profile.x,
        "center_y": profile.y,
    }
    model = ImageModel(
        data,
        PSF(psf_type="NONE"),
        lens_model,
        LightModel(["SERSIC_ELLIPSE"]),
        kwargs_numerics={"supersampling_factor": subpixels, "supersampling_convolution": False},
    )
    return lambda: np.asarray(model.source_surface_brightness([light], lens_values, unconvolved=True))
