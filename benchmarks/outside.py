"""Images of other people in a folder, and what is true of them where that is known."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from engine import Observation, read_external_observation

EINSTEIN_RADII = {"J0029-0055": 0.96, "J1627-0053": 1.23, "J2300+0022": 1.24, "J1250+0523": 1.13}
"""b_SIE [arcsec] of SLACS lenses (Bolton et al. 2008), each good to 3 %."""
_F160W = 25.9463


@dataclass(frozen=True)
class Case:
    """An image, what is true of it (``magnitude``, ``theta_E``, ``arc``, ``agn``; only what is known), and options."""

    name: str
    kind: str
    observation: Observation
    truth: dict[str, float]
    options: dict[str, Any] = field(default_factory=dict)


def cases(folder: Path, kinds: tuple[str, ...] = ()) -> Iterator[Case]:
    """All images below a folder, or those of some kinds: paired_lens, tdlmc, slacs, real_quasar, rxj1131."""
    for kind, read in _KINDS.items():
        if not kinds or kind in kinds:
            yield from read(folder / kind)


def _read(image: Path, psf: Path, noise: Path | None, scale: float, zero_point: float, **how: Any) -> Observation:
    return read_external_observation(
        image, psf, noise=noise, pixel_scale=scale, zero_point=zero_point, recentre_psf="pixel", normalise_psf=True,
        mend_psf=True, **how,
    )  # fmt: skip


def _mapping(text: str, after: str) -> dict[str, Any]:
    found = re.search(after + r"\s*(\{.*?\})", text)
    return {} if found is None else dict(ast.literal_eval(found[1]))


def _paired(folder: Path) -> Iterator[Case]:
    for one in sorted(folder.glob("sim_lens_*")):
        text = (one / "lens_all_info.txt").read_text()
        truth = {
            "theta_E": float(_mapping(text, "SPEMD:")["theta_E"]),
            "magnitude": float(_mapping(text, "source plane:\n\t")["mag"]),
            "agn": 4 if "AGN" in one.name else 0,
        }
        files = one / "Drz_QSO_image.fits", one / "Drz_PSF.fits", one / "noise_map.fits"
        yield Case(one.name.removeprefix("sim_lens_"), "paired_lens", _read(*files, 0.08, _F160W), truth)


def _tdlmc(folder: Path) -> Iterator[Case]:
    for one in sorted(folder.glob("rung*")):
        text = (one / "lens_all_info.txt").read_text()
        truth = {"theta_E": float(_mapping(text, "SPEMD:")["theta_E"]), "agn": 4}
        for name, pattern in (
            ("magnitude", r"(?:Host mag: |'mag(?:_sersic)?': )([\d.]+)(?=[^\n]*\n(?:[^\n]*\n)?AGN light)"),
            ("arc", r"image plane: ([\d.]+) mag, AGN"),
        ):
            found = re.search(pattern, text)
            truth |= {} if found is None else {name: float(found[1])}
        inner = one / "drizzled_image"
        files = inner / "lens-image.fits", inner / "psf.fits", inner / "noise_map.fits"
        yield Case(one.name, "tdlmc", _read(*files, 0.08, _F160W), truth)


def _slacs(folder: Path) -> Iterator[Case]:
    for one in sorted(folder.glob("J*")):
        truth = {"theta_E": EINSTEIN_RADII[one.name]} if one.name in EINSTEIN_RADII else {}
        files = one / "image.fits", one / "psf.fits", one / "noise.fits"
        yield Case(one.name, "slacs", _read(*files, 0.05, 25.94), truth | {"agn": 0})


def _quasar(folder: Path) -> Iterator[Case]:
    if folder.is_dir():
        files = folder / "image.fits", folder / "psf.fits", folder / "noise.fits"
        yield Case("quad", "real_quasar", _read(*files, 0.04, 25.94, psf_oversampling=3), {"agn": 4})


def _rxj(folder: Path) -> Iterator[Case]:
    if folder.is_dir():
        files = folder / "rxj1131_cutout.fits", folder / "rxj1131_psf1.fits", None
        seen = _read(*files, 0.05, 25.94, exposure_s=1980.0, trust_options=True)
        yield Case("RXJ1131", "rxj1131", seen, {"agn": 4})


_KINDS = {"paired_lens": _paired, "tdlmc": _tdlmc, "slacs": _slacs, "real_quasar": _quasar, "rxj1131": _rxj}
