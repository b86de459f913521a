"""What runs on a worker for an uploaded image: the measuring engine, on files from the artefact store."""

from __future__ import annotations

import io
import tempfile
import time
from pathlib import Path
from typing import Any

from engine import (
    ImageMeasurement,
    Observation,
    engine_digest,
    measure_image,
    read_external_observation,
    read_observation,
    spec_digest,
)
from engine.figures import measurement_figure
from service.domain.payload import read_measurement
from service.store.artefacts import ArtefactStore

_DPI = 110


def measure(spec: dict[str, Any], artefact_url: str) -> dict[str, Any]:
    """Measure an image and return the payload, ready for JSON.

    Here alone is an upload parsed: a file that is made to hurt hurts a worker, whose memory is limited and which is
    started anew.

    Raises
    ------
    engine.errors.EngineError
        The files or the options are not acceptable, or nothing can be measured in them.
    """
    options, artefacts = spec["options"], ArtefactStore(artefact_url)
    wall, cpu = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory(prefix="hostlens-") as folder:
        files = {name: Path(folder) / f"{name}.fits" for name in spec["uploads"]}
        for name, key in spec["uploads"].items():
            files[name].write_bytes(artefacts.read(key))
        found = measure_image(
            _observation(files, options),
            profile=options["profile"],
            agn_images=options["agn_images"],
            deflector=options["deflector"],
            shear=options["shear"],
            theta_E=options["theta_e"],
            positions=[(x, y) for x, y in options["positions"]] or None,
            centre=options.get("centre"),
            seed=options["seed"],
            inversion=options["inversion"],
            trust_options=options["trust_options"],
        )
    payload = {
        "realization_digest": spec_digest(spec),
        "engine_digest": engine_digest(),
        "document": found.to_dict(),
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "figure": artefacts.put(_figure(found), "png").model_dump(),
    }
    return read_measurement(payload).model_dump(mode="json")


def _observation(files: dict[str, Path], options: dict[str, Any]) -> Observation:
    if "psf" not in files:
        return read_observation(files["image"])
    center = (options["center"] or "").partition(",")
    return read_external_observation(
        files["image"],
        files["psf"],
        zero_point=options["zeropoint"],
        noise=files.get("noise"),
        mask=files.get("mask"),
        dq=files.get("dq"),
        pixel_scale=options["pixel_scale"],
        unit=options["unit"],
        exposure_s=options["exposure"],
        gain=options["gain"],
        saturation_e_s=options["saturation"],
        sky_rms_e_s=options["sky_rms"],
        good_bits=options["good_bits"],
        center=None if options["center"] is None else (center[0].strip(), center[2].strip()),
        size=options["size"],
        extension=options["extension"],
        psf_oversampling=options["psf_oversampling"],
        trust_options=options["trust_options"],
        recentre_psf="pixel",
        normalise_psf=True,
        mend_psf=True,
    )


def _figure(found: ImageMeasurement) -> bytes:
    data = io.BytesIO()
    measurement_figure(found).savefig(data, format="png", dpi=_DPI)
    return data.getvalue()
