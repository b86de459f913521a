"""Realizations: what a run is asked to do."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from engine.spec.analysis import ESTIMATORS, Analysis
from engine.spec.deflector import Deflector
from engine.spec.host import Host
from engine.spec.instrument import Camera, CameraChoice, NoiseLevel, Optics
from engine.spec.quantities import STRICT, Identifier, Seed, Slope
from engine.spec.sky import LensSystem, SystemChoice
from engine.spec.validation import spec_error

_Read = TypeVar("_Read")


@dataclass(frozen=True, config=STRICT)
class Realization:
    """One run of the study: a system at one slope, a host, a noise level, a study seed and how it is analysed.

    ``system`` names a catalogue entry or is a :class:`LensSystem` of the user's own; ``camera`` likewise, and is the
    system's own where None. ``deflector`` is what the lens has beside light and mass of the system. ``optics`` spoils
    the PSF of the simulation, not the one that the analysis is given.
    Equal realizations have equal digests and give the same bits.
    """

    system: SystemChoice
    l_eta: Slope
    host: Host
    seed: Seed = 0
    noise_level: NoiseLevel = "author"
    mass_model: Identifier = "recommended"
    camera: CameraChoice | None = None
    optics: Optics | None = None
    deflector: Deflector | None = None
    analysis: Analysis = Field(default_factory=Analysis)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form; :func:`realization_from_dict` reads it back."""
        dumped = _REALIZATION.dump_python(self, mode="json")
        if not isinstance(dumped, dict):  # pragma: no cover - a dataclass always dumps to a mapping
            raise TypeError(type(dumped))
        # Left out where it is not used, so that realizations from before there was such a field keep their digests.
        for holder, names in ((dumped, ("optics", "deflector")), (dumped["host"], ("n", "image", "made", "name"))):
            for name in names:
                if holder[name] is None:
                    del holder[name]
        dumped["analysis"] |= _GONE
        for name in ("agn_position_sd", "background_sd", "max_error"):
            if dumped["analysis"][name] is None:
                del dumped["analysis"][name]
        if self.analysis.estimators == ESTIMATORS:
            del dumped["analysis"]["estimators"]
        for holder in (dumped["analysis"], dumped["system"]):
            if isinstance(holder, dict) and not holder["priors"]:
                del holder["priors"]
        return dumped

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the canonical JSON: the identity of the run."""
        return spec_digest(self.to_dict())

    @property
    def observation_digest(self) -> str:
        """SHA-256 (hex) of all but analysis and priors: realizations that differ in these alone are the same image."""
        document = self.to_dict()
        del document["analysis"]
        if isinstance(document["system"], dict):
            document["system"].pop("priors", None)
        return spec_digest(document)

    @property
    def system_name(self) -> str:
        """Name of the lens system, whether from the catalogue or the user's own."""
        return self.system if isinstance(self.system, str) else self.system.name


_GONE = {"source_softening": None}
"""Fields that an analysis once had, with the only value that they can still have: digests are made with them."""
_REALIZATION = TypeAdapter(Realization)
_SYSTEM = TypeAdapter(LensSystem)
_CAMERA = TypeAdapter(Camera)


def spec_digest(document: dict[str, Any]) -> str:
    """SHA-256 (hex) of the canonical JSON of a realization's JSON-ready form: its digest, without reading it back."""
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def realization_from_dict(document: object) -> Realization:
    """Read a realization from its JSON form; a SpecError names the field that is wrong."""
    if isinstance(document, Mapping) and isinstance(analysis := document.get("analysis"), Mapping):
        kept = {name: value for name, value in analysis.items() if value is not None or name not in _GONE}
        document = {**document, "analysis": kept}
    try:
        return _REALIZATION.validate_python(document)
    except ValidationError as error:
        raise spec_error(error) from error


def system_from_mapping(document: Mapping[str, Any]) -> LensSystem:
    """Read a lens system from its JSON or TOML form; a SpecError names the field that is wrong, as ``agn[1].name``."""
    return _read(_SYSTEM, document)


def camera_from_mapping(document: Mapping[str, Any]) -> Camera:
    """Read a camera from its JSON or TOML form; a SpecError names the field that is wrong."""
    return _read(_CAMERA, document)


def camera_to_mapping(camera: Camera) -> dict[str, Any]:
    """JSON-ready form of a camera; :func:`camera_from_mapping` reads it back."""
    return dict(_CAMERA.dump_python(camera, mode="json"))


def _read(adapter: TypeAdapter[_Read], document: Mapping[str, Any]) -> _Read:
    try:
        return adapter.validate_python(document)
    except ValidationError as error:
        raise spec_error(error) from error
