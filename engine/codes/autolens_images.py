"""Images of a lens model by PyAutoLens, run by the Python that it is installed for: nothing of hostlens is imported.

``python autolens_images.py SCENE.npz``: scale, shape, PSF and rays along a side of a pixel from the file; then for each
line of standard input, a model as JSON, the images (number, ny, nx) of deflector and host as raw float64 on standard
output. The first line of output is the version.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

# The library logs on the standard output from its import on: that goes to the errors, the answers stay by themselves.
ANSWERS = os.fdopen(os.dup(1), "wb")
os.dup2(2, 1)

import autolens as al  # noqa: E402


def ell_comps(q: float, phi: float) -> tuple[float, float]:
    """Ellipticity components of an axis ratio and an angle [rad]."""
    return tuple(al.convert.ell_comps_from(axis_ratio=q, angle=float(np.degrees(phi))))


def sersic(light: dict[str, Any]) -> al.lp.Sersic:
    """A Sersic profile; its radius is on the intermediate axis."""
    return al.lp.Sersic(
        centre=(light["y"], light["x"]),
        ell_comps=ell_comps(light["q"], light["phi"]),
        intensity=light["brightness"],
        effective_radius=light["r_eff"],
        sersic_index=light["n"],
    )


def power_law(lens: dict[str, Any]) -> al.mp.PowerLaw:
    """An elliptical power law that deflects at one place as is asked for: releases differ in what its radius means."""

    def of(radius: float) -> al.mp.PowerLaw:
        comps = ell_comps(lens["q"], lens["phi"])
        return al.mp.PowerLaw(
            centre=(lens["y"], lens["x"]), ell_comps=comps, einstein_radius=radius, slope=lens["slope"]
        )

    # Deflection goes with this power of the radius.
    ratio = np.hypot(*lens["deflection"]) / np.hypot(*deflection([of(1.0)], lens["place"]))
    return of(float(ratio ** (1.0 / (lens["slope"] - 1.0))))


def deflection(masses: list[Any], place: list[float]) -> NDArray[np.float64]:
    """Deflection (x, y) at a place (x, y), both in arcsec."""
    grid = al.Grid2DIrregular(values=[(place[1], place[0])])
    parts = [np.asarray(mass.deflections_yx_2d_from(grid=grid))[0] for mass in masses]
    return np.asarray(np.sum(parts, axis=0)[::-1], dtype=np.float64)


def main() -> None:
    """Answer until the input ends."""
    scene = np.load(sys.argv[1])
    scale, subpixels = float(scene["scale"]), int(scene["subpixels"])
    shape = tuple(int(side) for side in scene["shape"])
    # Rows from the top in their images, from the bottom in ours.
    psf = al.Convolver(kernel=al.Array2D.no_mask(scene["psf"][::-1], pixel_scales=scale), normalize=False)
    mask = al.Mask2D.all_false(shape_native=shape, pixel_scales=scale)
    blank = al.Array2D.no_mask(np.ones(shape), pixel_scales=scale)
    dataset = al.Imaging(data=blank, noise_map=blank, psf=psf).apply_mask(mask=mask)
    dataset = dataset.apply_over_sampling(over_sample_size_lp=subpixels)
    grids = dataset.grids
    # Imaging makes a sum of one of every kernel; that of a stamp is the light of a star that is inside it.
    inside = float(np.sum(scene["psf"]) / np.sum(np.asarray(dataset.psf.kernel.native)))
    ANSWERS.write(f"{al.__version__}\n".encode())
    ANSWERS.flush()
    for line in sys.stdin:
        model = json.loads(line)
        mass = {"mass": power_law(model["lens"])}
        if model["lens"]["gamma1"] or model["lens"]["gamma2"]:
            mass["shear"] = al.mp.ExternalShear(gamma_1=model["lens"]["gamma1"], gamma_2=model["lens"]["gamma2"])
        if "probe" in model:
            answer = deflection(list(mass.values()), model["probe"])
        else:
            images = []
            for light, lens in ((model["deflector"], None), (model["host"], mass)):
                if light is None:
                    continue
                near, far = al.Galaxy(redshift=0.5, **(lens or {})), al.Galaxy(redshift=1.5, light=sersic(light))
                tracer = al.Tracer(galaxies=[near, far])
                image = tracer.blurred_image_2d_from(grid=grids.lp, psf=dataset.psf, blurring_grid=grids.blurring)
                images.append(np.asarray(image.native)[::-1] * scale**2 * inside)
            answer = np.stack(images)
        ANSWERS.write(np.ascontiguousarray(answer, dtype=np.float64).tobytes())
        ANSWERS.flush()


if __name__ == "__main__":
    main()
