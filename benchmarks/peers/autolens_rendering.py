"""A lensed Sersic host by PyAutoLens, run in its own environment: a scene as JSON in, CPU times as JSON out.

Stands alone: nothing of hostlens is installed where it runs. Conventions differ, so its Einstein radius is scaled until
the deflection at one point is the one given.
"""

import json
import sys
import time

import autolens as al
import numpy as np


def ell_comps(q: float, phi: float) -> tuple[float, float]:
    return tuple(al.convert.ell_comps_from(axis_ratio=q, angle=float(np.degrees(phi))))


def isothermal(scene: dict, radius: float) -> al.mp.Isothermal:
    return al.mp.Isothermal(
        centre=(0.0, 0.0), ell_comps=ell_comps(scene["lens_q"], scene["lens_phi"]), einstein_radius=radius
    )


def main() -> None:
    scene = json.loads(sys.argv[1])
    probe = al.Grid2DIrregular(values=[tuple(scene["probe"][::-1])])
    unit = np.asarray(isothermal(scene, 1.0).deflections_yx_2d_from(grid=probe))[0]
    wanted = np.array(scene["deflection"][::-1])
    radius = float(np.hypot(*wanted) / np.hypot(*unit))
    lens = al.Galaxy(redshift=0.5, mass=isothermal(scene, radius))
    host = al.Galaxy(
        redshift=1.5,
        light=al.lp.Sersic(
            centre=(scene["y"], scene["x"]),
            ell_comps=ell_comps(scene["q"], scene["phi"]),
            intensity=scene["intensity"],
            effective_radius=scene["r_eff"],
            sersic_index=scene["n"],
        ),
    )
    tracer = al.Tracer(galaxies=[lens, host])
    out = {"version": al.__version__, "runs": []}
    for subpixels in scene["subpixels"]:
        grid = al.Grid2D.uniform(
            shape_native=(scene["pixels"], scene["pixels"]), pixel_scales=scene["scale"], over_sample_size=subpixels
        )
        times = []
        for _ in range(10):
            began = time.process_time()
            image = tracer.image_2d_from(grid=grid)
            times.append(time.process_time() - began)
        path = f"{scene['folder']}/{subpixels}.npy"
        # Rows from the top in their images, from the bottom in ours.
        np.save(path, np.asarray(image.native)[::-1] * scene["scale"] ** 2)
        out["runs"].append({"subpixels": subpixels, "seconds": min(times), "image": path})
    print(json.dumps(out))


if __name__ == "__main__":
    main()
