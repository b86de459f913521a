"""Answers as COOLEST (Galan et al. 2023), the common language of lens models: a JSON text and the FITS files it names.

Its frame is ours: x to the right, y up, arcsec, radii on the intermediate axis; its angles are from +y towards -x
[deg], East of North where North is up and East left. Readers tell lens from source by redshifts: they are nominal.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io import fits

from engine.codes.answer import CodeAnswer
from engine.codes.joint_fit import Task
from engine.conventions import FloatArray, position_angle
from engine.imaging.observation import Observation
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile, effective_brightness

_REDSHIFTS = (0.5, 1.5)
"""Of deflector and host; nothing in a model of an image depends on them."""
_PLANES = ("image", "noise", "mask", "psf")


def write_coolest(folder: Path, task: Task, answers: list[CodeAnswer]) -> tuple[Path, ...]:
    """Write ``CODE.json`` for each answer, and once the planes that they share, into a folder; the files of JSON."""
    observation = task.observation
    used = np.isfinite(task.sigma)
    planes = {
        "image": np.where(observation.valid, observation.image, 0.0),
        # A pixel that does not count has no noise in COOLEST's sense: the mask says so.
        "noise": np.where(used, task.sigma, 1.0),
        "mask": used.astype(np.float64),
        "psf": task.fit.psf,
    }
    for name in _PLANES:
        fits.PrimaryHDU(planes[name]).writeto(folder / f"{name}.fits", overwrite=True)
    out = []
    for answer in answers:
        path = folder / f"{answer.code}.json"
        text = json.dumps(coolest_document(answer, observation, task.fit.psf), indent=2, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")
        out.append(path)
    return tuple(out)


def coolest_document(answer: CodeAnswer, observation: Observation, psf: FloatArray) -> dict[str, Any]:
    """The JSON-ready form of one answer; its planes are ``image.fits``, ``noise.fits``, ``mask.fits``, ``psf.fits``."""
    scale = observation.pixel_scale
    middle = {} if observation.centre is None else _origin(*observation.centre)
    pixels = _grid("image", observation.shape, scale)
    return {
        "standard": "COOLEST",
        "mode": "MAP",
        "coordinates_origin": middle,
        "lensing_entities": _entities(answer),
        "cosmology": None,
        "observation": {
            "pixels": pixels,
            "mag_zero_point": observation.zero_point,
            "noise": {"type": "NoiseMap", "noise_map": _grid("noise", observation.shape, scale)},
        },
        "instrument": {
            "pixel_size": scale,
            "name": str(observation.provenance.get("camera", "")),
            "psf": {"type": "PixelatedPSF", "pixels": _grid("psf", (psf.shape[0], psf.shape[1]), scale)},
        },
        "likelihoods": [{"type": "ImagingDataLikelihood", "mask": _grid("mask", observation.shape, scale)}],
        "meta": {
            "code": answer.code,
            "version": answer.version,
            "chi2_per_dof": answer.chi2_per_dof,
            "background": answer.background,
            "limits": list(answer.limits),
            "redshifts": "nominal",
            "north_deg": math.degrees(observation.orientation.north) - 90.0,
            "mirrored": observation.orientation.mirrored,
        },
    }


def _origin(ra: float, dec: float) -> dict[str, str]:
    text = SkyCoord(ra * units.deg, dec * units.deg).to_string("hmsdms", precision=5).split()
    return {"ra": text[0], "dec": text[1]}


def _grid(name: str, shape: tuple[int, int], scale: float) -> dict[str, Any]:
    ny, nx = shape
    return {
        "fits_file": {"path": f"{name}.fits"},
        "field_of_view_x": [-0.5 * nx * scale, 0.5 * nx * scale],
        "field_of_view_y": [-0.5 * ny * scale, 0.5 * ny * scale],
        "num_pix_x": nx,
        "num_pix_y": ny,
    }


def _entities(answer: CodeAnswer) -> list[dict[str, Any]]:
    lens, deflector, host = answer.lens, answer.deflector, answer.host
    host_errors = {name: answer.errors[name] for name in ("n",) if name in answer.errors}
    host_errors["theta_eff"] = answer.errors["r_eff"]
    source = [_profile("Sersic", _sersic(host), host_errors)]
    if answer.agn:
        places = {
            "ra_list": [image.x for image in answer.agn],
            "dec_list": [image.y for image in answer.agn],
            "amps": [image.flux for image in answer.agn],
        }
        source.append(_profile("LensedPS", places, {}))
    galaxy = {
        "type": "Galaxy",
        "name": "deflector",
        "redshift": _REDSHIFTS[0],
        "mass_model": [_profile("PEMD", _pemd(lens), _lens_errors(answer.errors))],
        "light_model": [] if deflector is None else [_profile("Sersic", _sersic(deflector), {})],
    }
    behind = {"type": "Galaxy", "name": "host", "redshift": _REDSHIFTS[1], "mass_model": [], "light_model": source}
    if not (lens.gamma1 or lens.gamma2):
        return [galaxy, behind]
    strength = math.hypot(lens.gamma1, lens.gamma2)
    angle = _degrees(0.5 * math.atan2(lens.gamma2, lens.gamma1))
    shear = _profile("ExternalShear", {"gamma_ext": strength, "phi_ext": angle}, {})
    return [{"type": "MassField", "name": "shear", "redshift": _REDSHIFTS[0], "mass_model": [shear]}, galaxy, behind]


def _profile(kind: str, values: Mapping[str, Any], errors: Mapping[str, float]) -> dict[str, Any]:
    parameters = {}
    for name, value in values.items():
        parameters[name] = {"point_estimate": {"value": value}}
        if name in errors:
            sd = errors[name]
            parameters[name]["posterior_stats"] = {
                "mean": value, "median": value, "percentile_16th": value - sd, "percentile_84th": value + sd,
            }  # fmt: skip
    return {"type": kind, "parameters": parameters}


def _pemd(lens: PowerLawLens) -> dict[str, float]:
    return {
        "theta_E": lens.theta_E, "gamma": lens.slope, "q": lens.q, "phi": _degrees(lens.phi),
        "center_x": lens.x, "center_y": lens.y,
    }  # fmt: skip


def _lens_errors(errors: Mapping[str, float]) -> dict[str, float]:
    names = {"theta_E": "theta_E", "gamma": "slope", "q": "q", "center_x": "x", "center_y": "y"}
    found = {theirs: errors[ours] for theirs, ours in names.items() if ours in errors}
    return found | ({"phi": math.degrees(errors["phi"])} if "phi" in errors else {})


def _sersic(profile: SersicProfile) -> dict[str, float]:
    """Brightness at the half-light radius [e-/s/arcsec^2], and its shape."""
    return {
        "I_eff": profile.flux * effective_brightness(profile), "theta_eff": profile.r_eff, "n": profile.n,
        "q": profile.q, "phi": _degrees(profile.phi), "center_x": profile.x, "center_y": profile.y,
    }  # fmt: skip


def _degrees(phi: float) -> float:
    """Angle from +y towards -x [deg, -90 to 90] of an angle from +x towards +y [rad]."""
    return math.remainder(position_angle(phi), 180.0)
