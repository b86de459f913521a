"""What may be asked of an image: the options of POST /v1/measurements, and the run that they mean."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints

from engine import PRINTABLE, spec_digest
from service.domain.plan import IMAGE, PlannedRun

FILES = ("image", "noise", "psf", "mask", "dq")
_OF_OURS = (
    "pixel_scale", "zeropoint", "unit", "exposure", "gain", "saturation", "sky_rms", "good_bits", "center", "size",
    "extension", "psf_oversampling",
)  # fmt: skip
"""What an observation of ``hostlens simulate`` has in its own file."""

Positive = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]
Text = Annotated[str, StringConstraints(min_length=1, max_length=80, pattern=PRINTABLE)]
Place = Annotated[str, StringConstraints(max_length=80, pattern=r"^[^,\s][^,]*,[^,]*[^,\s]$")]
Offset = Annotated[float, Field(ge=-100.0, le=100.0, allow_inf_nan=False)]


def _pair(value: object) -> object:
    """The two parts of the text that a form has, or of a stored document's pair as it is."""
    return value.split(",") if isinstance(value, str) else value


class MeasurementOptions(BaseModel):
    """How an image is to be measured: the options of ``hostlens measure``, as fields of a form."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    name: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=PRINTABLE)] | None = None
    profile: Literal["draft", "standard", "reference"] = "standard"
    zeropoint: Annotated[float, Field(ge=-50.0, le=100.0)] | None = None
    """AB magnitude of 1 e-/s; what the image's header says without."""
    pixel_scale: Positive | None = None
    """[arcsec]; that of the image's header without."""
    unit: Literal["e-/s", "e-", "count/s", "count", "DN/s", "DN", "MJy/sr"] | None = None
    """The image's BUNIT without, and e-/s where it has none."""
    exposure: Positive | None = None
    """[s]; the image's EXPTIME without."""
    gain: Positive | None = None
    """Electrons in a count."""
    saturation: Positive | None = None
    """[e-/s]."""
    good_bits: Text | None = None
    """Flags that do no harm, as 64,512."""
    psf_oversampling: Annotated[int, Field(ge=1, le=16)] | None = None
    """How many times as finely as the image the PSF is sampled; what its own pixel scale says without."""
    center: Place | None = None
    """RA,Dec to cut the image out by, with ``size``."""
    size: Positive | None = None
    """Side of the cutout [arcsec]."""
    extension: Text | None = None
    """Name or number of the image's plane."""
    trust_options: bool = False
    """Options overrule files that contradict them."""
    sky_rms: Positive | None = None
    """[e-/s]; without a noise map only."""
    theta_e: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    """Rough Einstein radius [arcsec]."""
    agn_images: Annotated[int, Field(ge=0, le=20)] | None = None
    positions: Annotated[list[tuple[Offset, Offset]], Field(max_length=20)] = Field(default_factory=list)
    """Of the AGN images [arcsec from the middle]."""
    centre: Annotated[tuple[Offset, Offset], BeforeValidator(_pair)] | None = None
    """x,y of the deflector [arcsec from the middle], to half an arcsec; found without."""
    deflector: bool = True
    shear: bool | None = None
    seed: Annotated[int, Field(ge=0, le=2**62)] = 0
    inversion: bool = True


class OptionError(ValueError):
    """Options that do not go with the files; ``field`` is the first of them."""

    def __init__(self, field: str, said: str) -> None:
        super().__init__(f"{field}: {said}")
        self.field = field


def require_consistent(options: MeasurementOptions, files: set[str], *, is_own: bool) -> None:
    """Refuse options that do not go with the files; ``is_own``: the image is an observation of ``hostlens simulate``.

    Raises
    ------
    OptionError
        Says which, and why.
    """
    if is_own and "psf" not in files:
        extra = sorted(files - {"image"})
        extra += [name for name in _OF_OURS if getattr(options, name) is not None]
        if extra:
            raise OptionError(extra[0], "the image has its own noise map, PSF, pixel scale and zero point")
        return
    if "psf" not in files:
        raise OptionError("psf", "missing; the image is not of hostlens simulate, so a PSF must be given")
    if "noise" in files and options.sky_rms is not None:
        raise OptionError("sky_rms", "the noise map has it already")
    if options.center is not None and options.size is None:
        raise OptionError("size", "missing; allowed is the side of the cutout [arcsec]")


def planned_measurement(options: MeasurementOptions, uploads: dict[str, str]) -> PlannedRun:
    """The run that measures uploaded files, given by their keys in the artefact store."""
    spec: dict[str, Any] = {"uploads": uploads, "options": options.model_dump(mode="json", exclude={"name"})}
    label = options.name or "measurement"
    return PlannedRun(label, None, spec, {"image": uploads["image"]}, spec_digest(spec), IMAGE)
