"""One evidence evaluation of HE0435: equal to the dense oracle, then timed against BLAS and against the dense path.

The yardstick is one dsyrk of an (1850, n) matrix and one dpotrf of order n, which a dense evaluation cannot avoid. The
scene with limits is that of the profile ``paper``: 30 x 30 even nodes, no envelope, independent noise, 31 x 31 PSF, 2 x
2 rays a pixel. That of a run by default (20 x 20, envelope, covariance of the drizzle) follows; of several that are
asked for together, as chain, lessons and optimum do, the time of one. Times are CPU times of
one thread, the least of several in turns.
"""

import json
import math
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.linalg import blas, lapack
from threadpoolctl import threadpool_limits

from benchmarks.peers import interpreter, missing
from benchmarks.timing import in_turns, least
from engine.conventions import FloatArray, pixel_centres
from engine.imaging.observation import Observation
from engine.imaging.optics.stamp_matrix import blurring_matrix, central_stamp
from engine.lensing.power_law import PowerLawLens, deflection
from engine.likelihood.amplitudes import LinearData, MarginalLikelihood, marginalise_amplitudes
from engine.likelihood.curvature import curvature_matrix, together
from engine.likelihood.evidence import ln_evidence, ln_evidences
from engine.likelihood.problem import Problem, prepare_problem
from engine.likelihood.strength import find_strength
from engine.parametric.fit import fit_parametric
from engine.simulation.scene import build_scene
from engine.simulation.simulate import simulate
from engine.source.grid import SourceGrid
from engine.source.lensing_matrix import LensingMatrix, cast_rays, map_rays
from engine.source.regularisation import SourceModel, sparse_regularisation
from engine.spec.analysis import Analysis
from engine.spec.host import Host
from engine.spec.realization import Realization


def dense_ln_evidence(
    likelihood: MarginalLikelihood, lens: PowerLawLens, ln_lambda: float, model: SourceModel
) -> float:
    """The same number from explicit matrices, amplitudes as extra columns."""
    mapping = map_rays(likelihood.rays, lens, model.shape)
    white = likelihood.whitened
    g = np.hstack([white.noise.whiten(likelihood.blurring @ mapping.dense()), white.columns])
    n, k = model.shape[0] * model.shape[1], white.columns.shape[1]
    h = sparse_regularisation(model).toarray()
    a = g.T @ g
    a[:n, :n] += math.exp(ln_lambda) * h
    d = g.T @ white.data
    value = -0.5 * (white.data @ white.data - d @ np.linalg.solve(a, d))
    value += 0.5 * (np.linalg.slogdet(h)[1] - np.linalg.slogdet(a)[1] + n * ln_lambda)
    value -= 0.5 * white.noise.ln_determinant + 0.5 * (white.data.size - k) * math.log(2 * math.pi)
    return float(value)


def yardstick(m: int, n: int) -> tuple[Callable[[], object], Callable[[], object]]:
    """One dsyrk of (m, n) and one dpotrf of order n."""
    matrix = np.asfortranarray(np.random.default_rng(1).random((m, n)))
    f = blas.dsyrk(1.0, matrix, trans=1, lower=1) + m * np.eye(n)
    return lambda: blas.dsyrk(1.0, matrix, trans=1, lower=1), lambda: lapack.dpotrf(f, lower=1, clean=0)


def against_autolens(observation: Observation, problem: Problem, lens: PowerLawLens) -> None:
    """The same mask, data, noise, PSF and lens by PyAutoLens: equal F and ln Z asserted, then times in turns."""
    python = interpreter("autolens")
    if python is None:
        print(missing("autolens"))
        return
    side, ln_lambda, stamp = 30, -9.0, central_stamp(observation.psf, 15)
    # Theirs is normalised whatever it is told.
    psf = stamp / stamp.sum()
    plain = PowerLawLens(lens.theta_E, lens.q, lens.phi, 2.0, 0.0, 0.0)
    probe = np.array([0.7, 0.4])
    deflected = np.array(deflection(plain, probe[:1], probe[1:])).ravel()
    pixels = np.nonzero(problem.mask)
    environment = os.environ | {"NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    for subrays in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            scene, answer = f"{folder}/scene.npz", f"{folder}/answer.npz"
            np.savez(
                scene, scale=observation.pixel_scale, subpixels=subrays, mask=problem.mask, image=observation.image,
                noise=observation.noise, kernel=psf, lens_q=plain.q, lens_phi=plain.phi, probe=probe,
                deflection=deflected, shape=(side, side), ln_lambda=ln_lambda,
            )  # fmt: skip
            script = str(Path(__file__).parent / "peers" / "autolens_evidence.py")
            with subprocess.Popen(
                [str(python), script, scene, answer], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                env=environment,
            ) as peer:  # fmt: skip
                if peer.stdin is None or peer.stdout is None:
                    raise TypeError("peer: no pipes")
                about = json.loads(peer.stdout.readline())
                theirs = np.load(answer)
                # Their pixels, of the mask alone and rows from the top, in our order; their mapping in our hands.
                order = np.lexsort((theirs["columns"], -theirs["rows"]))
                assert (problem.mask.shape[0] - 1 - theirs["rows"][order] == pixels[0]).all()
                assert (theirs["columns"][order] == pixels[1]).all()
                axes = (pixel_centres(size, observation.pixel_scale) for size in problem.mask.shape[::-1])
                rays = cast_rays(problem.mask, problem.mask, *axes, observation.pixel_scale, subrays)
                data, variance = observation.image[problem.mask], observation.noise[problem.mask] ** 2
                linear = LinearData(data, variance, np.zeros((data.size, 0)))
                likelihood = marginalise_amplitudes(linear, blurring_matrix(psf, pixels, pixels), rays)
                f = curvature_matrix(likelihood.w_tilde, likelihood.border, padded(theirs["mapping"][order], side))
                f = np.tril(f) + np.tril(f, -1).T
                h = theirs["regularization"]
                d = theirs["mapping"][order].T @ likelihood.wd
                solution = np.linalg.solve(f + h, d)
                value = -0.5 * (likelihood.dd - d @ solution) + likelihood.ln_constant
                value += 0.5 * (np.linalg.slogdet(h)[1] - np.linalg.slogdet(f + h)[1])
                f_error = float(np.abs(f - theirs["curvature"]).max() / np.abs(f).max())
                print(
                    f"\nPyAutoLens {about['version']} ({about['operator']}), {subrays} x {subrays} rays: from its own "
                    f"mapping, F differs by {f_error:.1e}, ln Z {value:.6f} and {float(theirs['log_evidence']):.6f}"
                )
                assert f_error < 1e-8
                assert abs(value - float(theirs["log_evidence"])) < 1e-6 * abs(value)
                model = SourceModel((side, side), "gradient")
                times: dict[str, list[float]] = {"peer": [], "same": [], "full": []}
                cases = {"same": likelihood, "full": problem.likelihood}
                for _ in range(9):
                    peer.stdin.write("\n")
                    peer.stdin.flush()
                    times["peer"].append(float(peer.stdout.readline()))
                    for name, case in cases.items():
                        began = time.thread_time()
                        ln_evidence(case, plain, ln_lambda, model)
                        times[name].append(time.thread_time() - began)
                best = {name: min(values) * 1e3 for name, values in times.items()}
                print(
                    f"theirs {best['peer']:.1f} ms; ours on the same pixels and rays {best['same']:.1f} ms, "
                    f"{best['peer'] / best['same']:.2f} times faster (limit {FASTER_THAN_PEER}); ours with 2 x 2 rays, "
                    f"margin and amplitudes {best['full']:.1f} ms, {best['peer'] / best['full']:.2f} times"
                )


def padded(mapping: FloatArray, side: int) -> LensingMatrix:
    """A dense L as ours."""
    entries = (mapping != 0).sum(axis=1).astype(np.int32)
    columns = np.zeros((entries.size, int(entries.max())), dtype=np.int32)
    weights = np.zeros(columns.shape)
    for row, values in enumerate(mapping):
        found = np.flatnonzero(values)
        columns[row, : found.size], weights[row, : found.size] = found, values[found]
    nodes = np.arange(float(side))
    return LensingMatrix(SourceGrid(nodes, nodes), columns, weights, entries)


@dataclass(frozen=True)
class Case:
    """A likelihood by its name, and a source for it."""

    analysis: str
    side: int


CASES = (
    Case("paper", 20),
    Case("paper", 30),
    Case("paper", 40),
    Case("standard", 20),
    Case("standard", 30),
)
NAMED = Case("paper", 30)
"""The case that the limits are for."""
OF_BLAS = 0.6
FASTER_THAN_PEER = 2.5
RELATIVE = 1e-8
"""Largest error of ln Z against explicit matrices."""


def main() -> None:
    print("load", *(f"{load:.1f}" for load in os.getloadavg()))
    spec = Realization(system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5))
    with threadpool_limits(1):
        scene = build_scene(spec)
        observation = simulate(scene, "author", np.random.default_rng(0)).observation
        fit = fit_parametric(observation, agn_images=4)
        problems = {
            "paper": prepare_problem(observation, fit, Analysis(profile="paper")),
            "standard": prepare_problem(observation, fit, Analysis()),
        }
        rays = problems["paper"].likelihood.rays.pixels
        print(f"mask {problems['paper'].likelihood.data_points} pixels, rays of {rays} pixels, one core")
        print(
            f"{'profile':>9} {'source':>7} {'ours ms':>8} {'of some':>7} {'dense ms':>9} {'BLAS ms':>8} "
            f"{'/BLAS':>6} error"
        )
        for case in CASES:
            likelihood = problems[case.analysis].likelihood
            model = SourceModel((case.side, case.side))
            strength = find_strength(likelihood, scene.lens, model).ln_lambda
            exact = dense_ln_evidence(likelihood, scene.lens, strength, model)
            ours = ln_evidence(likelihood, scene.lens, strength, model)
            assert abs(ours - exact) < RELATIVE * abs(exact), (case, ours, exact)
            evaluate = partial(ln_evidence, likelihood, scene.lens, strength, model)
            slow = least(partial(dense_ln_evidence, likelihood, scene.lens, strength, model), 1, clock=time.thread_time)
            number = together(case.side**2)
            lenses = [scene.lens.with_values(slope=scene.lens.slope + 1e-3 * k) for k in range(number)]
            some = partial(ln_evidences, likelihood, lenses, [strength] * number, model)
            fast, shared, syrk, potrf = in_turns(evaluate, some, *yardstick(1850, case.side**2), clock=time.thread_time)
            blas_time = syrk + potrf
            times = f"{fast * 1e3:8.1f} {shared / number * 1e3:7.1f} {slow * 1e3:9.1f} {blas_time * 1e3:8.1f}"
            times += f" {fast / blas_time:6.2f}"
            limit = f" (limit {OF_BLAS})" if case == NAMED else ""
            error = f"{abs(ours - exact):.1e}"
            print(f"{case.analysis:>9} {case.side:>3}x{case.side:<3} {times} {error}{limit}")
        against_autolens(observation, problems["paper"], scene.lens)
    print("load", *(f"{load:.1f}" for load in os.getloadavg()))


if __name__ == "__main__":
    main()
