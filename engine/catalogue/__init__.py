"""The eight systems, three cameras and the paper's grid, read from the data files beside this module.

The files keep source and confidence of every number; :func:`system_facts` returns them unabridged, the other functions
return validated specifications.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError

from engine.errors import SpecError
from engine.spec.instrument import Camera, Dither
from engine.spec.realization import Realization
from engine.spec.sky import LensSystem
from engine.spec.validation import spec_error

_SYSTEM = TypeAdapter(LensSystem)
_CAMERA = TypeAdapter(Camera)
_DITHER = TypeAdapter(Dither)
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The one in C takes a tenth of the time, which every process takes at its start; not every PyYAML is built with it."""


@cache
def read_catalogue(name: str) -> dict[str, Any]:
    """The data file ``name``.yaml as it stands: ``systems``, ``cameras`` or ``h0licow_vi``."""
    text = files(__package__).joinpath(f"{name}.yaml").read_text(encoding="utf-8")
    document = yaml.load(text, _LOADER)  # noqa: S506 - both are safe
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


_Specified = TypeVar("_Specified")


def _read(adapter: TypeAdapter[_Specified], name: str, document: dict[str, Any]) -> _Specified:
    """An entry as its specification; sources, confidences and notes that stand beside the values are passed over."""
    try:
        return adapter.validate_python({**document, "name": name}, extra="ignore")
    except ValidationError as error:
        raise spec_error(error, prefix=name) from error


@cache
def load_system(name: str) -> LensSystem:
    """The lens system called ``name`` (short form, as HE0435)."""
    facts = system_facts(name)
    shape = facts["host_shape"]
    gathered = {
        "agn": [{"name": label, **image} for label, image in facts["agn"]["images"].items()],
        "coordinates": facts["coordinates"]["degrees"],
        "host_q": shape["q"],
        "host_position_angle": shape["position_angle"],
    }
    return _read(_SYSTEM, name, {**facts, **gathered})


@cache
def load_camera(name: str) -> Camera:
    """The camera called ``name`` (as WFC3-IR_F160W)."""
    catalogue = read_catalogue("cameras")
    if name not in catalogue["cameras"]:
        raise SpecError("camera", name, f"one of {list(catalogue['cameras'])}")
    facts = catalogue["cameras"][name]
    zernikes = facts["pupil"].get("zernike_waves_at_547nm", {})
    gathered = {
        "read_noise_short_e": facts.get("read_noise_short_e", facts["read_noise_e"]),
        "wavelength_nm": facts["bandpass"]["wavelength_nm"],
        "throughput": facts["bandpass"]["throughput"],
        "pupil": {
            **catalogue["telescope"],
            **facts["pupil"],
            "zernike_waves_at_547nm": [(int(term[1:]), waves) for term, waves in zernikes.items()],
        },
        "detector_kernel": facts["detector_kernel"]["matrix"],
    }
    return _read(_CAMERA, name, {**facts, **gathered})


@cache
def load_dither(name: str) -> Dither:
    """The dither pattern called ``name``."""
    dithers = read_catalogue("cameras")["dithers"]
    if name not in dithers:
        raise SpecError("dither", name, f"one of {list(dithers)}")
    return _read(_DITHER, name, dithers[name])


def resolve_system(realization: Realization) -> LensSystem:
    """The lens system of a realization, from the catalogue where it is named."""
    system = realization.system
    return load_system(system) if isinstance(system, str) else system


def resolve_camera(realization: Realization) -> Camera:
    """The camera of a realization: its own choice, else the system's."""
    camera = realization.camera
    if camera is None:
        camera = resolve_system(realization).camera
    return load_camera(camera) if isinstance(camera, str) else camera


def resolve_dither(system: LensSystem) -> Dither:
    """The dither pattern of a system's exposures, from the catalogue where it is named."""
    dither = system.exposures.dither
    return load_dither(dither) if isinstance(dither, str) else dither
