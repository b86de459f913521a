"""One evidence evaluation by PyAutoLens, run in its own environment: a scene as a file in, times and matrices out.

Stands alone: nothing of hostlens is installed where it runs. Its fastest path on a CPU: a uniform rectangular mesh,
constant regularisation, NumPy with the Numba sparse operator, without positivity. After one line about itself it
takes the CPU time of one evaluation for every line on its standard input, so that the caller can alternate.
"""

import json
import os
import sys
import time

import numpy as np

# The library logs on the standard output from its import on: that goes to the errors, the answers stay by themselves.
ANSWERS = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)

import autolens as al  # noqa: E402


def ell_comps(q: float, phi: float) -> tuple[float, float]:
    return tuple(al.convert.ell_comps_from(axis_ratio=q, angle=float(np.degrees(phi))))


def main() -> None:
    scene = np.load(sys.argv[1])
    scale, subpixels = float(scene["scale"]), int(scene["subpixels"])
    # Rows from the top in their images, from the bottom in ours.
    mask = al.Mask2D(mask=~scene["mask"][::-1], pixel_scales=scale)
    dataset = al.Imaging(
        data=al.Array2D.no_mask(scene["image"][::-1], pixel_scales=scale),
        noise_map=al.Array2D.no_mask(scene["noise"][::-1], pixel_scales=scale),
        psf=al.Convolver(kernel=al.Array2D.no_mask(scene["kernel"][::-1], pixel_scales=scale), normalize=False),
    ).apply_mask(mask=mask)
    dataset = dataset.apply_over_sampling(over_sample_size_pixelization=subpixels).apply_sparse_operator_cpu()
    comps = ell_comps(float(scene["lens_q"]), float(scene["lens_phi"]))
    unit = al.mp.Isothermal(centre=(0.0, 0.0), ell_comps=comps, einstein_radius=1.0)
    probe = al.Grid2DIrregular(values=[tuple(scene["probe"][::-1])])
    wanted = scene["deflection"]
    radius = float(np.hypot(*wanted) / np.hypot(*np.asarray(unit.deflections_yx_2d_from(grid=probe))[0]))
    pixelization = al.Pixelization(
        mesh=al.mesh.RectangularUniform(shape=tuple(int(n) for n in scene["shape"])),
        regularization=al.reg.Constant(coefficient=float(np.exp(0.5 * scene["ln_lambda"]))),
    )
    settings = al.Settings(use_positive_only_solver=False, use_edge_zeroed_pixels=False, use_border_relocator=False)

    def fit() -> al.FitImaging:
        lens = al.Galaxy(
            redshift=0.5, mass=al.mp.Isothermal(centre=(0.0, 0.0), ell_comps=comps, einstein_radius=radius)
        )
        source = al.Galaxy(redshift=1.5, pixelization=pixelization)
        return al.FitImaging(dataset=dataset, tracer=al.Tracer(galaxies=[lens, source]), settings=settings)

    found = fit()
    inversion = found.inversion
    np.savez(
        sys.argv[2],
        mapping=inversion.mapping_matrix,
        curvature=inversion.curvature_matrix,
        data_vector=inversion.data_vector,
        regularization=inversion.regularization_matrix,
        reconstruction=inversion.reconstruction,
        log_evidence=found.log_evidence,
        rows=np.asarray(mask.derive_indexes.native_for_slim)[:, 0],
        columns=np.asarray(mask.derive_indexes.native_for_slim)[:, 1],
    )
    print(
        json.dumps({"version": al.__version__, "operator": type(dataset.sparse_operator).__name__}),
        file=ANSWERS,
        flush=True,
    )
    for _ in sys.stdin:
        began = time.process_time()
        _ = fit().log_evidence
        print(time.process_time() - began, file=ANSWERS, flush=True)


if __name__ == "__main__":
    main()
