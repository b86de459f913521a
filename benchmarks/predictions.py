"""Are predictions of bias and scatter right for lenses that nobody has simulated? And how fast are they?

    python -m benchmarks.predictions [--study FILE]

Two questions, both of 90 % intervals for what one image shows. Leaving out one *system* of the study at a time, with
all its runs: how many of them does the interval hold that is made of the other systems (and, for ``image``, of the
drawn lenses)? And of strangers, the drawn lenses that come with hostlens (benchmarks.strangers), each predicted by the
study and by the nine tenths of them that it is not in: how many, and how wide is the interval against an oracle's, who
knows the scatter at that very lens?

The oracle of a stranger takes the deviation that ``image`` states there, times the one factor that makes these cover
90 % of all strangers; that of a left-out system the 5 and 95 % quantiles of its own runs' biases.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from engine import PREDICTED, Predictor, SimulatedRun, read_study
from service.predictions.shipped import shipped_runs, study_runs

ESTIMATORS = ("image_wide", "projected_wide", "covariance_wide", "paper_wide")
LEVEL = 0.9
FOLDS = 10


def judged(predictor: Predictor, runs: Iterable[SimulatedRun], estimator: str) -> dict[str, np.ndarray]:
    """By quantity (runs, 6): bias, stated deviation, low and high of one image, low and high of the mean."""
    rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in PREDICTED}
    for run in runs:
        found = predictor.predict(run.traits, estimator, LEVEL).quantities
        for name, (bias, sd) in run.found[estimator].items():
            told = found[name]
            if told is not None:
                one, mean = told.measurement, told.bias
                rows[name].append((bias, sd, one.low, one.high, mean.low, mean.high))
    return {name: np.array(values) for name, values in rows.items() if values}


def inside(rows: np.ndarray) -> float:
    """Share of the biases that the intervals of one image hold."""
    return float(np.mean((rows[:, 0] >= rows[:, 2]) & (rows[:, 0] <= rows[:, 3])))


def leave_out(runs: tuple[SimulatedRun, ...], estimator: str) -> dict[str, dict[str, np.ndarray]]:
    """By system of the study and quantity, what the others predict of its runs."""
    systems = sorted({run.lens for run in runs if "paper_wide" in run.found})
    found = {}
    for system in systems:
        others = Predictor([run for run in runs if run.lens != system and estimator in run.found])
        if estimator in others.estimators():
            mine = [run for run in runs if run.lens == system and estimator in run.found]
            found[system] = judged(others, mine, estimator)
    return found


def tell_left_out(runs: tuple[SimulatedRun, ...]) -> None:
    for estimator in ESTIMATORS:
        found = leave_out(runs, estimator)
        if not found:
            print(f"{estimator}: too few systems have been simulated to leave one out")
            continue
        for name in PREDICTED:
            each = {system: rows[name] for system, rows in found.items()}
            covered = {system: inside(rows) for system, rows in each.items()}
            widths = [
                np.mean(rows[:, 3] - rows[:, 2]) / np.subtract(*np.quantile(rows[:, 0], (0.95, 0.05)))
                for rows in each.values()
            ]
            mean = [float(rows[:, 0].mean()) for rows in each.values()]
            held = [
                rows[:, 4].mean() <= middle <= rows[:, 5].mean()
                for rows, middle in zip(each.values(), mean, strict=True)
            ]
            print(
                f"{estimator:16s} {name:10s} {len(each)} systems, {sum(map(len, each.values()))} runs: "
                f"{100 * np.mean(list(covered.values())):5.1f} % inside "
                f"({' '.join(f'{system} {100 * share:.0f}' for system, share in covered.items())}), "
                f"width {np.median(widths):.2f} of the oracle's, system means held {sum(held)}/{len(held)}"
            )


def tell_strangers(study: tuple[SimulatedRun, ...], strangers: list[SimulatedRun]) -> None:
    """Each stranger by the study and by the folds that it is not in; which fold is a matter of a fixed seed."""
    lenses = sorted({run.lens for run in strangers})
    fold = dict(zip(lenses, np.random.default_rng(20176).permutation(len(lenses)) % FOLDS, strict=True))
    parts: dict[str, list[np.ndarray]] = {name: [] for name in PREDICTED}
    far: list[bool] = []
    for number in range(FOLDS):
        mine = [run for run in strangers if fold[run.lens] == number]
        predictor = Predictor([*study, *(run for run in strangers if fold[run.lens] != number)])
        far += [predictor.predict(run.traits, "image_wide", LEVEL).extrapolating for run in mine]
        for name, rows in judged(predictor, mine, "image_wide").items():
            parts[name].append(rows)
    print(f"{len(strangers)} images of {len(lenses)} strangers, of which {sum(far)} extrapolate:")
    for name, several in parts.items():
        rows = np.concatenate(several)
        factor = np.quantile(np.abs(rows[:, 0]) / rows[:, 1], LEVEL)
        own, ours = 2.0 * factor * rows[:, 1], rows[:, 3] - rows[:, 2]
        print(
            f"  {name:10s} {100 * inside(rows):5.1f} % inside, width {ours.mean() / own.mean():.2f} of the oracle's "
            f"(median ratio {np.median(ours / own):.2f}; the oracle takes {factor:.2f} stated deviations); "
            f"of those that extrapolate {100 * inside(rows[np.array(far)]):.0f} % inside"
        )


def tell_time(runs: tuple[SimulatedRun, ...], strangers: list[SimulatedRun]) -> None:
    began = time.process_time()
    predictor = Predictor(runs)
    names = [name for name in ESTIMATORS if name in predictor.estimators()]
    for name in names:
        predictor.predict(strangers[0].traits, name)
    fitted = time.process_time() - began
    each: list[Any] = []
    for run in strangers[:50]:
        began = time.process_time()
        for name in names:
            predictor.predict(run.traits, name)
        each.append(time.process_time() - began)
    print(f"{len(names)} estimators: fitted in {fitted:.1f} CPU s, then {1000 * np.median(each):.1f} ms a prediction")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--study", type=Path, help="Another study's file than the one that comes with hostlens")
    given = parser.parse_args()
    strangers = [run for run in shipped_runs() if "paper_wide" not in run.found]
    study = tuple(study_runs(read_study(given.study)))
    runs = (*study, *strangers)
    print(f"{len(study)} runs of {len({run.lens for run in study})} systems of the study")
    tell_strangers(study, strangers)
    tell_left_out(runs)
    tell_time(runs, strangers)


if __name__ == "__main__":
    main()
