"""A stand-in for the engine: valid synthetic results, quickly.

``HOSTLENS_TASK=service.worker.synthetic:brief`` has workers run it, as ``hostlens check`` does. What it looks at:

``HOSTLENS_DRILL_SLEEP``  seconds that a run takes (0.2)
``HOSTLENS_DRILL_LOG``    a file that gets a line for each execution that came to its end
"""

from __future__ import annotations

import hashlib
import os
import random
import time
from typing import Any

from engine import Realization, realization_from_dict
from service.domain.payload import ESTIMATES
from service.store.artefacts import ArtefactStore

# A PNG of one pixel.
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de"
    "0000000c49444154789c63f8cfc0000003010100c9fe92ef0000000049454e44ae426082"
)


def synthetic_payload(spec: dict[str, Any]) -> dict[str, Any]:
    """What a run could have found: near the truth, and always the same for the same spec."""
    return payload_of(realization_from_dict(spec))


def payload_of(realization: Realization) -> dict[str, Any]:
    """The same from a realization that has been read already."""
    digest = realization.digest
    dice = random.Random(digest)  # noqa: S311 - no secret
    host = realization.host

    def quantity(truth: float, sd: float) -> dict[str, float]:
        return {"mean": truth + dice.gauss(0.0, sd), "sd": sd, "truth": truth}

    def estimate() -> dict[str, Any]:
        return {
            "magnitude": quantity(host.magnitude, 0.1),
            "r_eff": quantity(host.r_eff, 0.03),
            "r_eff_galfit": quantity(host.r_eff / (host.q or 0.8) ** 0.5, 0.04),
            "n": {"mean": 2.0 + dice.gauss(0.0, 0.3), "sd": 0.3} if host.n is None else quantity(host.n, 0.3),
            "q": quantity(host.q or 0.8, 0.05),
            "position_angle": quantity(host.position_angle or 30.0, 4.0),
            "x": quantity(0.01, 0.001),
            "y": quantity(-0.02, 0.001),
            "draws": 30,
            "at_bound": 3,
            "n_at_bound": 2,
            "r_eff_at_bound": 1,
            "failed": 0,
            "budget": {
                name: {
                    "rendering": 1e-5 * sd,
                    "psf": 1e-6 * sd,
                    "grid": 0.1 * sd,
                    "sampling": 0.07 * sd,
                    "draws": 0.17 * sd,
                }
                for name, sd in (("magnitude", 0.1), ("r_eff", 0.03), ("n", 0.3))
            },
        }

    return {
        "realization_digest": digest,
        "engine_digest": hashlib.sha256(b"no engine").hexdigest(),
        "versions": {"tasks": "1"},
        "noise_treatment": realization.analysis.noise_treatment,
        "regularisation": realization.analysis.regularisation,
        "profile": realization.analysis.profile,
        "estimates": {name: estimate() for name in ESTIMATES},
        "aperture": {
            "radius": 1.0, "magnitude": quantity(host.magnitude + 0.1, 0.05), "coverage": 0.9, "draws": 30, "failed": 0,
        },
        "lens": {"theta_E": quantity(1.2, 0.01), "slope": quantity(2.0, 0.05), "ln_lambda": {"mean": 2.0, "sd": 0.3}},
        "chain": {
            "status": "converged", "walkers": 24, "steps": 400, "burn_in": 100,
            "tau": 31.5, "effective_samples": 228.0, "acceptance": 0.41, "evaluations": 9600,
            "r_hat": 1.004,
        },
        "ln_evidence": -5123.25,
        "chi2": 4980.0,
        "degrees_of_freedom": 5100,
        "condition_number": 1e6,
        "arc_magnitude": 18.4,
        "agn_contrast": -1.5,
        "surface_brightness": 21.0,
        "stages": [{"stage": "sleep", "wall_s": 0.05, "cpu_s": 0.001}],
        "work": {
            "pixels_rendered": 16_000_000, "rays_traced": 9_000_000, "columns_solved": 210_000, "parameters_sampled": 7,
            "evidence_evaluations": 9600,
        },
    }  # fmt: skip


def brief(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """A run that sleeps, leaves a figure, and a line in the log for each execution."""
    payload = synthetic_payload(spec)
    time.sleep(seconds())
    log_execution(payload["realization_digest"])
    payload["figure"] = ArtefactStore(artefact_url).put(PNG, "png").model_dump()
    return payload


def seconds() -> float:
    """How long a run is to take [s]."""
    return float(os.environ.get("HOSTLENS_DRILL_SLEEP", "0.2"))


def log_execution(digest: str) -> None:
    """Leave a line for an execution, where that is asked for."""
    log = os.environ.get("HOSTLENS_DRILL_LOG")
    if log is not None:
        with open(log, "a", encoding="utf-8") as file:
            file.write(f"{digest} {os.getpid()}\n")
