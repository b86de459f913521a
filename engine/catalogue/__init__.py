"""The eight systems, three cameras and the paper's grid, read from the data files beside this module.

The files keep source and confidence of every number; :func:`system_facts` returns them unabridged, the other functions
return validated specifications.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from engine.errors import SpecError
from engine.spec.instrument import Camera, Dither
from engine.spec.sky import LensSystem
from engine.spec.validation import spec_error

_SYSTEM = TypeAdapter(LensSystem)
_CAMERA = TypeAdapter(Camera)
_DITHER = TypeAdapter(Dither)


@cache
def read_catalogue(name: str) -> dict[str, Any]:
    """The data file ``name``.yaml as it stands: ``systems``, ``cameras`` or ``h0licow_vi``."""
    document = yaml.safe_load(files(__package__).joinpath(f"{name}.yaml").read_text(encoding="utf-8"))
    if not isinstance(document, dict):
        raise TypeError(f"{name}.yaml is not a mapping")
    return document


def system_names() -> tuple[str, ...]:
    """Short names of the catalogue's systems, in the order of the paper's Table 1."""
    return tuple(read_catalogue("systems")["systems"])


def camera_names() -> tuple[str, ...]:
    """Names of the catalogue's cameras."""
    return tuple(read_catalogue("cameras")["cameras"])


def dither_names() -> tuple[str, ...]:
    """Names of the catalogue's dither patterns."""
    return tuple(read_catalogue("cameras")["dithers"])


def system_facts(name: str) -> dict[str, Any]:
    """Everything the catalogue holds of a system, with source and confidence of each group."""
    systems = read_catalogue("systems")["systems"]
    if name not in systems:
        raise SpecError("system", name, f"one of {list(systems)}")
    facts = systems[name]
    if not isinstance(facts, dict):
        raise TypeError(name)
    return facts


def _pick(group: dict[str, Any], *fields: str) -> dict[str, Any]:
    return {field: group[field] for field in fields if field in group}


@cache
def load_system(name: str) -> LensSystem:
    """The lens system called ``name`` (short form, as HE0435)."""
    facts = system_facts(name)
    light = ("magnitude", "r_eff", "n", "q", "position_angle", "centre")
    mass = ("theta_E", "q", "position_angle", "slope", "source_position", "centre", "shear")
    document = {
        "name": name,
        "camera": facts["camera"],
        "exposures": _pick(facts["exposures"], "field_pixels", "dither", "long_s", "n_long", "short_s"),
        "agn": [{"name": label, **image} for label, image in facts["agn"]["images"].items()],
        "deflector": _pick(facts["deflector"], *light),
        "coordinates": facts["coordinates"]["degrees"],
        "priors": facts.get("priors", {}),
        "host_q": facts["host_shape"]["q"],
        "host_position_angle": facts["host_shape"]["position_angle"],
        "mass_models": {
            model: {slope: _pick(entry, *mass) for slope, entry in by_slope.items()}
            for model, by_slope in facts["mass_models"].items()
        },
    }
    try:
        return _SYSTEM.validate_python(document)
    except ValidationError as error:
        raise spec_error(error, prefix=name) from error


@cache
def load_camera(name: str) -> Camera:
    """The camera called ``name`` (as WFC3-IR_F160W)."""
    catalogue = read_catalogue("cameras")
    if name not in catalogue["cameras"]:
        raise SpecError("camera", name, f"one of {list(catalogue['cameras'])}")
    facts, telescope = catalogue["cameras"][name], catalogue["telescope"]
    zernikes = facts["pupil"].get("zernike_waves_at_547nm", {})
    document = {
        "name": name,
        **_pick(
            facts,
            "pixel_scale",
            "drizzled_scale",
            "pixfrac",
            "drizzle_kernel",
            "oversampling",
            "zero_point",
            "gain",
            "full_well_e",
            "read_noise_e",
            "dark_e_s",
            "sky_e_s",
        ),
        "read_noise_short_e": facts.get("read_noise_short_e", facts["read_noise_e"]),
        "noise_author": facts["noise_author"]
        and _pick(facts["noise_author"], "std_long_e_s", "std_short_e_s", "bright_threshold_e_s"),
        "wavelength_nm": facts["bandpass"]["wavelength_nm"],
        "throughput": facts["bandpass"]["throughput"],
        "pupil": {
            **_pick(telescope, "primary_diameter_m", "secondary", "spider_width", "pads"),
            **_pick(facts["pupil"], "rotation_deg", "cold_mask"),
            "zernike_waves_at_547nm": [(int(term[1:]), waves) for term, waves in zernikes.items()],
        },
        "detector_kernel": facts["detector_kernel"]["matrix"],
    }
    try:
        return _CAMERA.validate_python(document)
    except ValidationError as error:
        raise spec_error(error, prefix=name) from error


@cache
def load_dither(name: str) -> Dither:
    """The dither pattern called ``name``."""
    dithers = read_catalogue("cameras")["dithers"]
    if name not in dithers:
        raise SpecError("dither", name, f"one of {list(dithers)}")
    return _DITHER.validate_python({"name": name, **_pick(dithers[name], "subpixels", "shifts")})
