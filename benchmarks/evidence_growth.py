"""How one evidence evaluation grows with mask, source grid, PSF and sub-rays: time, time to prepare, peak memory.

Each case runs in a process of its own, so that its peak memory is its own.
"""

import json
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from threadpoolctl import threadpool_limits

from benchmarks.timing import least
from engine.conventions import pixel_centres
from engine.inversion.blurring import blurring_matrix
from engine.inversion.evidence import ln_evidence
from engine.inversion.mapping import cast_rays
from engine.inversion.operator import LinearData, build_operator
from engine.inversion.regularisation import SourceModel
from engine.lensing.power_law import PowerLawLens

SCALE = 0.05
LIMIT_MIB = 2048
MARGIN = 4
"""Pixels outside the mask whose rays count."""


@dataclass(frozen=True)
class Case:
    """A ring of about ``mask`` pixels, a source of side x side, a PSF of psf x psf, subrays x subrays rays a pixel."""

    mask: int = 1850
    side: int = 30
    psf: int = 31
    subrays: int = 2
    amplitudes: int = 6
    correlated: bool = False


def measure(case: Case) -> dict[str, float]:
    """Pixels, milliseconds of an evaluation, seconds to prepare and MiB at the peak, of this process."""
    rng = np.random.default_rng(0)
    # A ring between 0.4 and 1.65 Einstein radii, as a run's.
    theta_E = float(np.sqrt(case.mask / (np.pi * (1.65**2 - 0.4**2)))) * SCALE
    n = 2 * int(1.65 * theta_E / SCALE + MARGIN + 2) + 1
    axis = pixel_centres(n, SCALE)
    r = np.hypot(*np.meshgrid(axis, axis))
    mask = (r > 0.4 * theta_E) & (r < 1.65 * theta_E)
    margin = distance_transform_edt(~mask) <= MARGIN
    rays = cast_rays(mask, margin, axis, axis, SCALE, case.subrays)
    offset = np.arange(case.psf) - case.psf // 2
    psf = 1.0 / (1.0 + np.add.outer(offset**2, offset**2) / 1.5**2) ** 2
    m = int(mask.sum())
    covariance = rng.uniform(0.5, 1.5, m)
    if case.correlated:
        # Neighbours correlated by 0.1, as drizzling does.
        deviations = sparse.diags(np.sqrt(covariance))
        near = blurring_matrix(0.1 + 0.9 * np.eye(3)[1][:, None] * np.eye(3)[1], np.nonzero(mask), np.nonzero(mask))
        covariance = deviations @ near @ deviations
    linear = LinearData(rng.normal(size=m), covariance, rng.normal(size=(m, case.amplitudes)))
    began = time.perf_counter()
    operator = build_operator(
        linear, blurring_matrix(psf / psf.sum(), np.nonzero(mask), np.nonzero(mask | margin)), rays
    )
    prepared = time.perf_counter() - began
    lens = PowerLawLens(theta_E, 0.8, 0.4, 2.05)
    model = SourceModel((case.side, case.side), "gradient")
    evaluation = least(lambda: ln_evidence(operator, lens, 0.0, model), 5)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"pixels": m, "ms": 1e3 * evaluation, "prepared": prepared, "mib": peak}


def in_own_process(case: Case) -> dict[str, float]:
    """The same in a child."""
    command = [sys.executable, "-m", "benchmarks.evidence_growth", json.dumps(asdict(case))]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def table(title: str, cases: list[tuple[str, Case]]) -> None:
    """Print one table; a case that takes more memory than allowed ends it."""
    print(f"\n{title:>24} {'pixels':>7} {'one evaluation ms':>18} {'to prepare s':>13} {'peak MiB':>9}")
    for name, case in cases:
        found = in_own_process(case)
        print(f"{name:>24} {found['pixels']:7.0f} {found['ms']:18.1f} {found['prepared']:13.1f} {found['mib']:9.0f}")
        assert found["mib"] < LIMIT_MIB, (case, found)


def main() -> None:
    base = Case()
    table("mask", [(str(m), replace(base, mask=m)) for m in (500, 1000, 1850, 4000, 9000, 10000)])
    table("source", [(f"{s}x{s}", replace(base, side=s)) for s in (10, 20, 30, 45, 60)])
    table("PSF", [(f"{p}x{p}", replace(base, psf=p)) for p in (11, 21, 31, 61)])
    table("sub-rays", [(f"{s}x{s}", replace(base, subrays=s)) for s in (1, 2, 3, 4)])
    large = replace(base, mask=9000)
    table("RXJ1131's size", [("PSF 61x61", replace(large, psf=61)), ("covariance", replace(large, correlated=True))])
    table(
        "what the scene needs",
        [("6 amplitudes", base), ("no AGN: 2", replace(base, amplitudes=2)), ("none", replace(base, amplitudes=0))],
    )


if __name__ == "__main__":
    with threadpool_limits(1):
        if len(sys.argv) > 1:
            print(json.dumps(measure(Case(**json.loads(sys.argv[1])))))
        else:
            main()
