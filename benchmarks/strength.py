"""The strength of HE0435's regularisation: factorisations and time beside a search of ln Z, after their answers agree.

The search takes eleven evaluations of a grid 60 wide in ln lambda, then a bounded one to 0.01; the engine looks for the
zero of the derivative. Both start from F and D, which do not depend on lambda.
"""

import math

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize_scalar
from threadpoolctl import threadpool_limits

from benchmarks.timing import least
from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import MarginalLikelihood
from engine.likelihood.evidence import ln_evidence, normal_equations
from engine.likelihood.problem import prepare_problem
from engine.likelihood.strength import find_strength
from engine.parametric.fit import fit_parametric
from engine.simulation.scene import build_scene
from engine.simulation.simulate import simulate
from engine.source.lensing_matrix import map_rays
from engine.source.regularisation import SourceModel, add_regularisation, ln_determinant, sparse_regularisation
from engine.spec.analysis import Analysis
from engine.spec.host import Host
from engine.spec.realization import Realization

MODELS = (
    SourceModel((30, 30), "curvature"),
    SourceModel((30, 30), "gradient"),
    SourceModel((30, 30), "zeroth"),
    SourceModel((45, 45), "curvature"),
)


def search(likelihood: MarginalLikelihood, lens: PowerLawLens, model: SourceModel) -> tuple[float, int]:
    """Ln lambda and the number of factorisations."""
    f, d = normal_equations(likelihood, lens, model)
    count = 0

    def minus_ln_evidence(ln_lambda: float) -> float:
        nonlocal count
        count += 1
        a = f.copy()
        add_regularisation(a, model, math.exp(ln_lambda))
        factor, info = lapack.dpotrf(a.T, lower=0, clean=0, overwrite_a=1)
        if info:
            return math.inf
        solution, _ = lapack.dpotrs(factor, d, lower=0)
        return 0.5 * (2 * np.log(np.diag(factor)).sum() - ln_determinant(model) - d.size * ln_lambda - d @ solution)

    grid = np.linspace(-40.0, 20.0, 13)[1:-1]
    best = int(np.argmin([minus_ln_evidence(float(t)) for t in grid]))
    found = minimize_scalar(
        minus_ln_evidence, bounds=(grid[best - 1], grid[best + 1]), method="bounded", options={"xatol": 0.01}
    )
    return float(found.x), count


def single_precision(
    likelihood: MarginalLikelihood, lens: PowerLawLens, ln_lambda: float, model: SourceModel
) -> tuple[float, ...]:
    """Errors of ln Z where W, or W, L and their products, or the factorisation too are in float32."""
    exact = ln_evidence(likelihood, lens, ln_lambda, model)
    f, d = normal_equations(likelihood, lens, model)
    f = np.tril(f) + np.tril(f, -1).T
    dense = map_rays(likelihood.rays, lens, model.shape).dense()
    w = likelihood.w_tilde.dense() - likelihood.border @ likelihood.border.T
    rounded_w = w.astype(np.float32).astype(np.float64)
    single = (dense.T.astype(np.float32) @ (w.astype(np.float32) @ dense.astype(np.float32))).astype(np.float64)
    h = math.exp(ln_lambda) * sparse_regularisation(model).toarray()
    constant = likelihood.ln_constant - 0.5 * likelihood.dd + 0.5 * (ln_determinant(model) + d.size * ln_lambda)

    def value(f: FloatArray, dtype: type) -> float:
        a = (f + h).astype(dtype)
        factor, info = (lapack.spotrf if dtype is np.float32 else lapack.dpotrf)(a)
        if info:
            return math.nan
        solution, _ = (lapack.spotrs if dtype is np.float32 else lapack.dpotrs)(factor, d.astype(dtype))
        return constant + 0.5 * float(d @ solution) - float(np.log(np.diag(factor).astype(np.float64)).sum())

    assert abs(value(f, np.float64) - exact) < 1e-6
    trials = (value(dense.T @ rounded_w @ dense, np.float64), value(single, np.float64), value(f, np.float32))
    return tuple(trial - exact for trial in trials)


def main() -> None:
    spec = Realization(system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5))
    with threadpool_limits(1):
        scene = build_scene(spec)
        observation = simulate(scene, "author", np.random.default_rng(0)).observation
        likelihood = prepare_problem(observation, fit_parametric(observation, agn_images=4), Analysis()).likelihood
        lens = scene.lens
        print(f"{'':>24} {'search of ln Z':>20} {'zero of slope':>20}")
        for model in MODELS:
            zero = find_strength(likelihood, lens, model)
            old, count = search(likelihood, lens, model)
            assert abs(old - zero.ln_lambda) < 2e-2, (old, zero)
            times = (
                least(lambda model=model: search(likelihood, lens, model), 3),
                least(lambda model=model: find_strength(likelihood, lens, model), 3),
            )
            name = f"{model.regularisation} {model.shape[0]}x{model.shape[1]}"
            counts = (count, zero.factorisations)
            cells = " ".join(f"{k:>4} x {t * 1e3:9.0f} ms " for k, t in zip(counts, times, strict=True))
            print(f"{name:>24} {cells}")
        model = MODELS[0]
        strength = find_strength(likelihood, lens, model).ln_lambda
        errors = single_precision(likelihood, lens, strength, model)
        print("error of ln Z with float32: W {:.1e}; W, L and F {:.1e}; the factorisation {:.1e}".format(*errors))


if __name__ == "__main__":
    main()
