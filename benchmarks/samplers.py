"""Evaluations of ln Z that our chain and nautilus need for the same posterior, side by side.

    pip install -c constraints.txt -e '.[bench]'
    python -m benchmarks.samplers [--system HE0435] [--n 2] [--r-eff 0.39] [--magnitude 20.5] [--effective 800]

The posterior is that of the profile ``standard``, ln lambda included. Nautilus (Lange 2023), which PyAutoLens searches
with by default, is given a box of 30 standard deviations about the maximum; our chain starts from a parametric fit, and
the time of that counts.
First the two have to agree on every mean to 0.2 and on every width to 20 % (of some 800 effective samples each); then
evaluations, CPU seconds and effective samples are printed.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from threadpoolctl import threadpool_limits

from engine import Analysis, Host, Realization, simulate_realization
from engine.likelihood.problem import prepare_problem
from engine.parametric.fit import fit_parametric
from engine.posterior.chain import run_chain
from engine.posterior.optimum import Laplace, find_optimum
from engine.posterior.start import find_start, prepare_target
from engine.posterior.target import Target

BOX = 30.0
"""Half a side of the box that nautilus searches, in standard deviations: a favour, the prior is far wider."""
LIVE = 300


def nautilus_posterior(
    target: Target, laplace: Laplace, effective: float, seed: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Samples (n, d), their weights (n,), and the effective number of them."""
    from nautilus import Prior, Sampler

    reach = BOX * np.sqrt(np.diag(laplace.covariance))
    low, high = np.maximum(target.prior.low, laplace.mean - reach), np.minimum(target.prior.high, laplace.mean + reach)
    prior = Prior()
    for name, *ends in zip(target.prior.names, low.tolist(), high.tolist(), strict=True):
        prior.add_parameter(name, dist=tuple(ends))
    sampler = Sampler(
        prior, lambda values: max(target(values), -1e300), n_live=LIVE, pass_dict=False, seed=seed, vectorized=False
    )
    sampler.run(n_eff=effective, verbose=False)
    points, ln_weights, _ = sampler.posterior()
    return points, np.exp(ln_weights), float(sampler.n_eff)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--system", default="HE0435")
    parser.add_argument("--n", type=float, default=2.0)
    parser.add_argument("--r-eff", type=float, default=0.39)
    parser.add_argument("--magnitude", type=float, default=20.5)
    parser.add_argument("--effective", type=float, default=800.0)
    given = parser.parse_args()
    realization = Realization(
        system=given.system, l_eta=1.0, host=Host(n=given.n, r_eff=given.r_eff, magnitude=given.magnitude)
    )
    simulation = simulate_realization(realization)
    analysis, scene = Analysis(), simulation.scene
    shear = scene.lens.gamma1 != 0.0 or scene.lens.gamma2 != 0.0
    with threadpool_limits(1):
        began = time.process_time()
        fit = fit_parametric(simulation.observation, agn_images=len(scene.agn), shear=shear)
        target = prepare_target(prepare_problem(simulation.observation, fit, analysis), fit, analysis)
        laplace = find_optimum(target, *find_start(target, fit))
        chain = run_chain(
            target,
            laplace,
            walkers=analysis.walkers,
            max_steps=analysis.max_steps,
            length=analysis.chain_length,
            rng=np.random.default_rng(1),
        )
        ours, our_seconds = target.evaluations, time.process_time() - began
        target.evaluations, began = 0, time.process_time()
        points, weights, effective = nautilus_posterior(target, laplace, given.effective, seed=1)
        theirs, their_seconds = target.evaluations, time.process_time() - began
    flat = chain.flat()
    mean = np.average(points, axis=0, weights=weights)
    sd = np.sqrt(np.average((points - mean) ** 2, axis=0, weights=weights))
    means, widths = np.abs(flat.mean(axis=0) - mean) / sd, np.abs(flat.std(axis=0) / sd - 1.0)
    assert means.max() < 0.2, dict(zip(target.prior.names, means, strict=True))
    assert widths.max() < 0.2, dict(zip(target.prior.names, widths, strict=True))
    print(f"{given.system}: largest difference of means {means.max():.2f} sd, of widths {100 * widths.max():.0f} %")
    print("| sampler | evaluations | CPU s | effective samples | evaluations an effective sample |")
    print("|---|---|---|---|---|")
    for name, evaluations, seconds, samples in (
        ("ours, `standard`", ours, our_seconds, chain.summary.effective_samples),
        ("nautilus", theirs, their_seconds, effective),
    ):
        print(f"| {name} | {evaluations} | {seconds:.0f} | {samples:.0f} | {evaluations / samples:.1f} |")
    print(f"ratio of evaluations {theirs / ours:.1f}, of CPU seconds {their_seconds / our_seconds:.1f}")


if __name__ == "__main__":
    main()
