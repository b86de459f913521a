"""How one evidence evaluation grows with mask, source grid, PSF and sub-rays: time, time to prepare, peak memory.

Each case runs in a process of its own, so that its peak memory is its own. Times are CPU times of one thread. The
tables go to docs/tables/evidence.md.
"""

import json
import resource
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from threadpoolctl import threadpool_limits

from benchmarks.timing import least
from engine.conventions import pixel_centres
from engine.imaging.optics.stamp_matrix import blurring_matrix
from engine.lensing.power_law import PowerLawLens
from engine.likelihood.amplitudes import LinearData, marginalise_amplitudes
from engine.likelihood.evidence import ln_evidence
from engine.source.lensing_matrix import cast_rays
from engine.source.regularisation import SourceModel

TABLE = Path(__file__).resolve().parent.parent / "docs" / "tables" / "evidence.md"
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
    began = time.thread_time()
    likelihood = marginalise_amplitudes(
        linear, blurring_matrix(psf / psf.sum(), np.nonzero(mask), np.nonzero(mask | margin)), rays
    )
    prepared = time.thread_time() - began
    lens = PowerLawLens(theta_E, 0.8, 0.4, 2.05)
    model = SourceModel((case.side, case.side), "gradient")
    evaluation = least(lambda: ln_evidence(likelihood, lens, 0.0, model), 5, time.thread_time)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"pixels": m, "ms": 1e3 * evaluation, "prepared": prepared, "mib": peak}


def in_own_process(case: Case) -> dict[str, float]:
    """The same in a child."""
    command = [sys.executable, "-m", "benchmarks.evidence_growth", json.dumps(asdict(case))]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def table(title: str, cases: list[tuple[str, Case]]) -> list[str]:
    """One table as Markdown, printed as it grows; a case that takes more memory than allowed ends it."""
    lines = [
        f"| {title} | pixels | one evaluation ms | to prepare s | peak MiB |",
        "|---|---|---|---|---|",
    ]
    print("", *lines, sep="\n", flush=True)
    for name, case in cases:
        found = in_own_process(case)
        lines.append(
            f"| {name} | {found['pixels']:.0f} | {found['ms']:.1f} | {found['prepared']:.1f} | {found['mib']:.0f} |"
        )
        print(lines[-1], flush=True)
        assert found["mib"] < LIMIT_MIB, (case, found)
    return [*lines, ""]


HEADING = f"""# One evidence evaluation: growth of time and memory

Written by `python -m benchmarks.evidence_growth`: CPU time of one thread, least of five; the peak is that of the whole
process with Python and its libraries, and must stay below {LIMIT_MIB} MiB. What is not named is a ring of 1,850 pixels
between 0.4 and 1.65 Einstein radii, 30 x 30 even nodes, a 31 x 31 PSF, 2 x 2 rays a pixel, 6 amplitudes and independent
noise. To prepare is done once for an observation.
"""


def main() -> None:
    base = Case()
    # Memory of the compiler, which runs once on a fresh machine, is no case's.
    in_own_process(base)
    large = replace(base, mask=9000)
    lines = [
        *table("mask", [(str(m), replace(base, mask=m)) for m in (500, 1000, 1850, 4000, 10000)]),
        *table("source", [(f"{s} x {s}", replace(base, side=s)) for s in (10, 20, 30, 45, 60)]),
        *table("PSF", [(f"{p} x {p}", replace(base, psf=p)) for p in (11, 21, 31, 61)]),
        *table("rays a pixel", [(f"{s} x {s}", replace(base, subrays=s)) for s in (1, 2, 3, 4)]),
        *table("amplitudes", [(str(k), replace(base, amplitudes=k)) for k in (6, 2, 0)]),
        *table(
            "9,000 pixels (RXJ1131)",
            [
                ("31 x 31 PSF", large),
                ("61 x 61 PSF", replace(large, psf=61)),
                ("covariance", replace(large, correlated=True)),
                ("covariance, 10,000 pixels", replace(large, mask=10000, correlated=True)),
            ],
        ),
    ]
    TABLE.write_text("\n".join([HEADING, *lines]).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    with threadpool_limits(1):
        if len(sys.argv) > 1:
            # Compiled code is loaded, or made, before anything is timed.
            measure(Case(mask=200, side=6))
            print(json.dumps(measure(Case(**json.loads(sys.argv[1])))))
        else:
            main()
