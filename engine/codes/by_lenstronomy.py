"""The image model of lenstronomy (Birrer & Amara 2018), where it is installed: lensing, light, PSF and points."""

from __future__ import annotations

from typing import Any

import numpy as np

from engine.codes.answer import CodeAnswer
from engine.codes.joint_fit import Task, fitted
from engine.conventions import FloatArray, pixel_centres
from engine.light.sersic import effective_brightness, profile_of
from engine.parametric.parameters import ParameterSpace
from engine.stages import Progress

_SUBPIXELS = 4
"""Rays along a side of a pixel."""


def fit_with_lenstronomy(task: Task, progress: Progress | None = None) -> CodeAnswer:
    """The best model of an image by lenstronomy."""
    from lenstronomy import __version__  # noqa: PLC0415 - no dependency

    return fitted(task, "lenstronomy", __version__, LenstronomyImages(task), limits=task.limits, progress=progress)


class LenstronomyImages:
    """Columns of lenstronomy; linear amplitudes are its own, for unit flux here."""

    def __init__(self, task: Task) -> None:
        from lenstronomy.Data.imaging_data import ImageData  # noqa: PLC0415 - as above
        from lenstronomy.Data.psf import PSF  # noqa: PLC0415 - as above
        from lenstronomy.ImSim.image_model import ImageModel  # noqa: PLC0415 - as above
        from lenstronomy.LensModel.lens_model import LensModel  # noqa: PLC0415 - as above
        from lenstronomy.LightModel.light_model import LightModel  # noqa: PLC0415 - as above
        from lenstronomy.PointSource.point_source import PointSource  # noqa: PLC0415 - as above

        observation, space = task.observation, task.space
        (ny, nx), scale = observation.shape, observation.pixel_scale
        data = ImageData(
            image_data=np.zeros((ny, nx)),
            ra_at_xy_0=float(pixel_centres(nx, scale)[0]),
            dec_at_xy_0=float(pixel_centres(ny, scale)[0]),
            transform_pix2angle=np.eye(2) * scale,
        )
        points = PointSource(["UNLENSED"], fixed_magnification_list=[False]) if space.n_agn else None
        self.images = ImageModel(
            data,
            # Not normalised: the sum of a stamp is the light of a star that is inside it.
            PSF("PIXEL", kernel_point_source=task.fit.psf, kernel_point_source_normalisation=False),
            LensModel(["EPL", "SHEAR"] if space.shear else ["EPL"]),
            LightModel(["SERSIC_ELLIPSE"]),
            LightModel(["SERSIC_ELLIPSE"] if space.deflector else []),
            points,
            kwargs_numerics={"supersampling_factor": _SUBPIXELS, "supersampling_convolution": False},
        )

    def __call__(self, space: ParameterSpace, values: FloatArray) -> FloatArray:
        """Columns (ny nx, amplitudes) of a vector."""
        theta_E, e1, e2, slope, x, y, *shear = values[space.lens_slice].tolist()
        mass = [{"theta_E": theta_E, "gamma": slope, "e1": e1, "e2": e2, "center_x": x, "center_y": y}]
        mass += [{"gamma1": shear[0], "gamma2": shear[1]}] if shear else []
        agn = space.agn(values)
        places = {"ra_image": agn[:, 0], "dec_image": agn[:, 1]}
        columns = [self.images.point_source([{**places, "point_amp": one}], mass) for one in np.eye(len(agn))]
        if space.deflector:
            columns.append(self.images.lens_surface_brightness([_light(values[space.deflector_slice])]))
        columns.append(self.images.source_surface_brightness([_light(values[space.host_slice])], mass))
        columns.append(np.ones_like(columns[-1]))
        return np.stack([np.asarray(column).ravel() for column in columns], axis=1)


def _light(shape: FloatArray) -> dict[str, Any]:
    """A profile of unit flux, by lenstronomy's names."""
    ln_r, n, e1, e2, x, y = shape.tolist()
    radius = float(np.exp(ln_r))
    return {
        "amp": effective_brightness(profile_of(shape)),
        "R_sersic": radius, "n_sersic": n, "e1": e1, "e2": e2, "center_x": x, "center_y": y,
    }  # fmt: skip
