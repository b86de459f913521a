"""What does a scene cost, and is it in proportion to what is there?

    python -m benchmarks.scenes [--write FILE]

One image (HE0435's lens and camera, host of n = 2) with and without AGN, shear and deflector light is simulated and
fitted; its inversion is laid out and evaluated with and without correlations of the noise, with few and many
exposures, with n free and fixed, in small and large masks. First the counts are asserted: a component that is not
there is not rendered, traced, solved for or sampled. Then CPU time is printed as a ratio to the whole scene in the
same run, beside the ratios of the counts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from engine import Analysis, Host, LensSystem, Realization, Work, analyse, load_system
from engine.likelihood.evidence import ln_evidences
from engine.likelihood.problem import prepare_problem
from engine.parametric.fit import ParametricFit
from engine.posterior.start import prepare_target
from engine.simulation.scene import build_scene, resolve_dither
from engine.simulation.simulate import Simulation, simulate
from engine.source.regularisation import SourceModel
from engine.work import counted

IMAGE = Analysis(estimators=("image",))
EVALUATIONS = 20
_SHEAR = (0.03, 0.02)


@dataclass(frozen=True)
class Cost:
    """What a piece of work counts and takes."""

    work: Work
    cpu_s: float


def system(*, agn: bool = True, shear: bool = True, deflector: bool = True, dithers: int | None = None) -> LensSystem:
    """HE0435 with a shear, or with parts of it left out; ``dithers`` of its exposures where given."""
    whole = load_system("HE0435")
    mass = whole.mass_models["recommended"]["1.0"]
    mass = replace(mass, shear=_SHEAR if shear else None)
    changed = replace(whole, priors={}, mass_models={"recommended": {"1.0": mass}})
    if not agn:
        changed = replace(changed, agn=())
    if not deflector:
        changed = replace(changed, deflector=None)
    if dithers is not None:
        pattern = resolve_dither(changed)
        pattern = replace(pattern, name="fewer", shifts=pattern.shifts[:dithers])
        changed = replace(changed, exposures=replace(changed.exposures, dither=pattern))
    return changed


def sky(one: LensSystem) -> Simulation:
    """The image of a system."""
    realization = Realization(system=one, l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5))
    return simulate(build_scene(realization), "author", np.random.default_rng(3))


def cost(function: Callable[[], object], repetitions: int = 3) -> Cost:
    """Counts of one call, asserted to be those of every other, and the least CPU seconds of some."""
    works, times = [], []
    for _ in range(repetitions):
        began = time.process_time()
        with counted() as tally:
            function()
        times.append(time.process_time() - began)
        works.append(tally.work())
    assert len(set(works)) == 1, works
    return Cost(works[0], min(times))


def fitted(simulation: Simulation, *, fixed_index: float | None = None) -> ParametricFit:
    """The parametric fit, told what there is."""
    scene = simulation.scene
    return analyse(
        simulation.observation, IMAGE, np.random.default_rng(0), agn_images=len(scene.agn),
        deflector=scene.deflector is not None, shear=scene.lens.gamma1 != 0.0, fixed_index=fixed_index,
    ).fit  # fmt: skip


def evaluated(simulation: Simulation, fit: ParametricFit, analysis: Analysis) -> tuple[Cost, Cost, int]:
    """Layout of the inversion, evaluations of its evidence, and the parameters that a chain would sample."""
    layout = cost(lambda: prepare_problem(simulation.observation, fit, analysis), 2)
    problem = prepare_problem(simulation.observation, fit, analysis)
    model = SourceModel(analysis.source_pixels)
    lenses = [fit.lens.with_values(theta_E=fit.lens.theta_E + 1e-4 * k) for k in range(EVALUATIONS)]
    evidence = cost(lambda: ln_evidences(problem.likelihood, lenses, [-9.0] * EVALUATIONS, model), 5)
    rays, n = problem.likelihood.rays.x.size, model.shape[0] * model.shape[1]
    assert evidence.work == Work(0, EVALUATIONS * rays, EVALUATIONS * n, 0, EVALUATIONS)
    assert layout.work.columns_solved == problem.likelihood.amplitudes == len(fit.agn) + (fit.deflector is not None) + 1
    return layout, evidence, len(prepare_target(problem, fit, analysis).prior.names)


def _row(name: str, costs: tuple[Cost, ...], whole: tuple[Cost, ...], sampled: int) -> str:
    cells = []
    for one, all_of_it in zip(costs, whole, strict=True):
        for part in ("pixels_rendered", "rays_traced", "columns_solved"):
            there = getattr(all_of_it.work, part)
            cells.append(f"{getattr(one.work, part) / there:.2f}" if there else "0")
        cells.append(f"**{one.cpu_s / all_of_it.cpu_s:.2f}**")
    return f"| {name} | " + " | ".join(cells) + f" | {sampled} |"


def scenes() -> list[str]:
    """The table of scenes: simulation, fit, inversion."""
    rows, whole = [], None
    for name, given in (
        ("everything", {}),
        ("no shear", {"shear": False}),
        ("no deflector light", {"deflector": False}),
        ("no AGN", {"agn": False}),
        ("4 exposures instead of 8", {"dithers": 4}),
        ("host alone", {"shear": False, "deflector": False, "agn": False}),
    ):
        one = system(**given)
        simulation = sky(one)
        fits: list[ParametricFit] = []
        made = cost(lambda one=one: sky(one), 2)
        found = cost(lambda simulation=simulation, fits=fits: fits.append(fitted(simulation)), 2)
        layout, evidence, sampled = evaluated(simulation, fits[0], Analysis(noise_treatment="diagonal"))
        costs = (made, found, layout, evidence)
        whole = whole or costs
        assert sampled == (9 if given.get("shear", True) else 7)
        # A component that is not there is not rendered.
        if not given.get("deflector", True):
            assert made.work.pixels_rendered < whole[0].work.pixels_rendered
            assert found.work.pixels_rendered < whole[1].work.pixels_rendered
        rows.append(_row(name, costs, whole, sampled))
    return rows


def inversions() -> list[str]:
    """The table of layouts of one scene without shear."""
    one = sky(system(shear=False))
    fit = fitted(one)
    standard = Analysis(noise_treatment="diagonal")
    whole = evaluated(one, fit, standard)[:2]
    rows = [_row("standard, independent noise", whole, whole, 7)]
    for name, analysis in (
        ("correlated noise", Analysis(noise_treatment="covariance")),
        ("small mask, 0.7 to 1.3 theta_E", replace(standard, mask_inner=0.7, mask_outer=1.3)),
        ("large mask, 0.2 to 2.2 theta_E", replace(standard, mask_inner=0.2, mask_outer=2.2)),
        ("1 ray a pixel instead of 4", replace(standard, subrays=1)),
        ("30 x 30 source pixels", replace(standard, source_pixels=(30, 30))),
        ("10 x 10 source pixels", replace(standard, source_pixels=(10, 10))),
    ):
        layout, evidence, sampled = evaluated(one, fit, analysis)
        rows.append(_row(name, (layout, evidence), whole, sampled))
    free, fixed = cost(lambda: fitted(one), 2), cost(lambda: fitted(one, fixed_index=2.5), 2)
    # One more fit, with n held, begins where the first one ended.
    assert free.work.rays_traced < fixed.work.rays_traced < 1.5 * free.work.rays_traced
    ratio = fixed.work.rays_traced / free.work.rays_traced
    told = (
        f"With n held at one value as well, the fit traces {ratio:.2f} times the rays in {fixed.cpu_s / free.cpu_s:.2f}"
    )
    return [*rows, "", f"{told} of the CPU time."]


HEAD = """# What a scene costs

Written by `python -m benchmarks.scenes`: counts (pixels rendered, rays traced, columns solved) and CPU time, as ratios
to the first line of each table in the same run. A fit of another scene takes another number of steps, and without AGN
images, which say where the lens is, it begins from more places: it costs more, not less. A chain samples as many
parameters as the last column says.
"""


def table() -> str:
    """The page."""
    parts = ("simulation", "fit", "layout", "evidence")
    titles = [f"{part}: {what}" for part in parts for what in ("pixels", "rays", "columns", "CPU")]
    lines = [HEAD, "| scene | " + " | ".join(titles) + " | sampled |", "|" + "---|" * (len(titles) + 2), *scenes(), ""]
    lines += ["| inversion | " + " | ".join(titles[8:]) + " | sampled |", "|" + "---|" * 10, *inversions()]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the tables, or write them."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--write", type=Path)
    given = options.parse_args()
    with threadpool_limits(1):
        page = table()
    if given.write is None:
        print(page)
    else:
        given.write.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
