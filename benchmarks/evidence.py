"""One evidence evaluation of HE0435: equal to the dense oracle, then timed against BLAS and against the dense path.

The yardstick is one dsyrk of an (M, n) matrix and one dpotrf of order n, which a dense evaluation cannot avoid.
"""

import math

import numpy as np
from scipy.linalg import blas, lapack
from threadpoolctl import threadpool_limits

from benchmarks.timing import least
from engine.inversion.evidence import invert, ln_evidence
from engine.inversion.operator import Operator
from engine.inversion.problem import prepare_problem
from engine.inversion.regularisation import SourceModel, regularisation_matrix
from engine.lensing.power_law import PowerLawLens
from engine.modelling.parametric import fit_parametric
from engine.scene import build_scene
from engine.simulation import simulate
from engine.spec import Analysis, Host, Realization


def dense_ln_evidence(operator: Operator, lens: PowerLawLens, ln_lambda: float, model: SourceModel) -> float:
    """The same number from explicit matrices, amplitudes as extra columns (diagonal noise)."""
    mapping = invert(operator, lens, ln_lambda, model).mapping
    white = operator.whitened
    g = np.hstack([(operator.blurring @ mapping.dense()) / white.covariance[:, None], white.columns])
    n, k = model.shape[0] * model.shape[1], white.columns.shape[1]
    h = regularisation_matrix(model)
    a = g.T @ g
    a[:n, :n] += math.exp(ln_lambda) * h
    d = g.T @ white.data
    value = -0.5 * (white.data @ white.data - d @ np.linalg.solve(a, d))
    value += 0.5 * (np.linalg.slogdet(h)[1] - np.linalg.slogdet(a)[1] + n * ln_lambda)
    value -= np.log(white.covariance).sum() + 0.5 * (white.data.size - k) * math.log(2 * math.pi)
    return float(value)


def main() -> None:
    spec = Realization(system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5))
    with threadpool_limits(1):
        scene = build_scene(spec)
        observation = simulate(scene, "author", np.random.default_rng(0)).observation
        problem = prepare_problem(observation, fit_parametric(observation, agn_images=4), Analysis())
        operator = problem.operator
        m = operator.data_points
        print(f"mask {m} pixels, rays of {operator.rays.pixels} pixels, one core")
        print(f"{'source':>8} {'nodes':>7} {'ours ms':>8} {'dense ms':>9} {'BLAS ms':>8} {'/BLAS':>6} {'error':>8}")
        for side, softening in ((20, None), (30, None), (30, 0.5), (40, 0.5)):
            model = SourceModel((side, side), "curvature", softening)
            exact = dense_ln_evidence(operator, scene.lens, -9.0, model)
            ours = ln_evidence(operator, scene.lens, -9.0, model)
            assert abs(ours - exact) < 1e-6, (ours, exact)
            fast = least(lambda model=model: ln_evidence(operator, scene.lens, -9.0, model))
            slow = least(lambda model=model: dense_ln_evidence(operator, scene.lens, -9.0, model), 3)
            matrix = np.asfortranarray(np.random.default_rng(1).random((m, side * side)))
            f = blas.dsyrk(1.0, matrix, trans=1, lower=1) + m * np.eye(side * side)
            yardstick = least(lambda matrix=matrix: blas.dsyrk(1.0, matrix, trans=1, lower=1))
            yardstick += least(lambda f=f: lapack.dpotrf(f, lower=1, clean=0))
            nodes = "even" if softening is None else str(softening)
            times = f"{fast * 1e3:8.1f} {slow * 1e3:9.1f} {yardstick * 1e3:8.1f} {fast / yardstick:6.2f}"
            print(f"{side}x{side:<5} {nodes:>7} {times} {abs(ours - exact):8.1e}")


if __name__ == "__main__":
    main()
