"""What POST /v1/predictions is asked: a lens, and which runs are to predict it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from engine import CameraChoice, Host, Identifier, LensSystem, NoiseLevel, Optics, SystemChoice
from service.domain.identifiers import GRID_PATTERN
from service.domain.payload import EstimateName

_ASKED = ConfigDict(extra="forbid", allow_inf_nan=False)
Factor = Annotated[float, Field(gt=0.0, le=1000.0)]
_HOST = ("n", "r_eff", "magnitude")


class LensTraitsRequest(BaseModel):
    """A lens by the numbers that say how hard its host is to measure, where there is no model of it.

    ``camera`` is one of the catalogue; of another one ``resolution`` is needed [arcsec], lambda / D and a pixel as if
    both were Gaussian. ``depth`` is one sigma of empty sky in a square arcsec [AB mag]; ``arc_magnitude`` and
    ``agn_contrast`` (AGN minus arc; null without AGN) are those of the image.
    """

    model_config = _ASKED

    camera: Identifier
    resolution: float | None = None
    depth: float
    configuration: Literal["quad", "double", "other"]
    arc_magnitude: float
    magnitude: float
    agn_contrast: float | None = None
    theta_E: float
    r_eff: float
    n: float
    l_eta: float = 1.0
    defocus_nm: float = 0.0
    jitter: float = 0.0


class PredictionRequest(BaseModel):
    """A lens, as ``system`` with ``host`` and ``l_eta``, or by its ``traits``; and which runs are to predict it.

    ``exposures`` are factors of the exposures that the lens has, longer or more. ``estimators`` are all that can be
    predicted with n in 0.3-8 where none are named. The runs are those that come with hostlens (``study``) and those of
    ``grids``.
    """

    model_config = _ASKED

    system: SystemChoice | None = None
    host: Host | None = None
    l_eta: float = 1.0
    mass_model: Identifier = "recommended"
    noise_level: NoiseLevel = "author"
    camera: CameraChoice | None = None
    optics: Optics | None = None
    traits: LensTraitsRequest | None = None
    exposures: Annotated[list[Factor], Field(min_length=1, max_length=20)] = [1.0]
    estimators: Annotated[list[EstimateName], Field(min_length=1, max_length=12)] | None = None
    level: Annotated[float, Field(ge=0.5, le=0.99)] = 0.9
    study: bool = True
    grids: Annotated[list[Annotated[str, Field(pattern=GRID_PATTERN)]], Field(max_length=100)] = []

    @model_validator(mode="after")
    def _one_lens(self) -> PredictionRequest:
        if (self.system is None) == (self.traits is None):
            raise ValueError("system, traits: allowed is one of the two")
        if (self.system is None) != (self.host is None):
            raise ValueError("host: allowed with system, which needs one")
        if not self.study and not self.grids:
            raise ValueError("study, grids: no runs are left to predict by")
        return self

    @property
    def simulated(self) -> tuple[str | LensSystem, Host] | None:
        """System and host, which can be simulated; None of a lens that its traits tell of."""
        return None if self.system is None or self.host is None else (self.system, self.host)
