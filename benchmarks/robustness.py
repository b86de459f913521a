"""Real-life spoilings of the paired lenses: does any of them make an answer that is wrong and said to be right?

    python -m benchmarks.robustness --data FOLDER [--lenses AGN_ID1 ...] [--spoilings crop star ...]

An answer is silently wrong that is ``ok`` while its magnitude is more than three of its errors and 0.1 mag off. The
exit code is their number.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.outside import Case, cases
from benchmarks.outside_images import line, measured
from engine import Observation

_SHIFT_PIXELS, _CROP_PIXELS, _PADDING = 12, 10, 12
_ANGLE = 30.0
_STAR = (2.6, 1.6)
_GALAXY = (-2.4, 2.0)


def _cut(seen: Observation, rows: slice, columns: slice) -> Observation:
    return replace(
        seen, image=seen.image[rows, columns], noise=seen.noise[rows, columns], valid=seen.valid[rows, columns]
    )


def crop(seen: Observation) -> Observation:
    """The border off."""
    inner = slice(_CROP_PIXELS, -_CROP_PIXELS)
    return _cut(seen, inner, inner)


def shift(seen: Observation) -> Observation:
    """The lens half an arcsec and more off the middle."""
    return _cut(seen, slice(_SHIFT_PIXELS, None), slice(None, -_SHIFT_PIXELS))


def pad(seen: Observation) -> Observation:
    """A frame of zeros that are not valid."""
    image, noise, valid = (np.pad(values, _PADDING) for values in (seen.image, seen.noise, seen.valid))
    return replace(seen, image=image, noise=np.where(valid, noise, 1.0), valid=valid)


def rotate(seen: Observation) -> Observation:
    """Image, noise and PSF turned by 30 degrees and interpolated."""
    image, noise, psf = (
        ndimage.rotate(values, _ANGLE, reshape=False, order=3, mode="constant", cval=np.nan if k < 2 else 0.0)
        for k, values in enumerate((seen.image, seen.noise, seen.psf))
    )
    valid = np.isfinite(image) & np.isfinite(noise) & (np.nan_to_num(noise) > 0)
    return replace(
        seen, image=np.where(valid, image, 0.0), noise=np.where(valid, noise, 1.0), valid=valid, psf=psf / psf.sum()
    )


def star(seen: Observation) -> Observation:
    """A star as bright as the brightest pixel of the image, 3 arcsec from the lens."""
    light = seen.point_source(*_STAR)
    return replace(seen, image=seen.image + light * float(seen.image.max() / light.max()))


def neighbour(seen: Observation) -> Observation:
    """A round galaxy, a fifth of the light of the image, 3 arcsec from the lens."""
    from engine.light.sersic import SersicProfile

    profile = SersicProfile(0.2 * float(seen.image.sum()), 0.25, 1.5, 0.8, 0.3, *_GALAXY)
    return replace(seen, image=seen.image + seen.optics.sersic_image(profile))


def cosmic_ray(seen: Observation) -> Observation:
    """One hot pixel an arcsec from the middle, as bright as the brightest pixel of the image."""
    image = seen.image.copy()
    ny, nx = seen.shape
    image[ny // 2 + round(0.9 / seen.pixel_scale), nx // 2 + round(0.5 / seen.pixel_scale)] += float(image.max())
    return replace(seen, image=image)


def noisier(seen: Observation) -> Observation:
    """A noise map that is half as large again."""
    return replace(seen, noise=1.5 * seen.noise)


SPOILINGS: dict[str, Callable[[Observation], Observation]] = {
    "crop": crop, "shift": shift, "pad": pad, "rotate": rotate, "star": star, "neighbour": neighbour,
    "cosmic_ray": cosmic_ray, "noise": noisier,
}  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Print the table; the exit code is the number of answers that are silently wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--lenses", nargs="*", default=[])
    parser.add_argument("--spoilings", nargs="*", default=[*SPOILINGS, "other_psf"])
    given = parser.parse_args(arguments)
    lenses = list(cases(given.data, ("paired_lens",)))
    wrong = 0
    for k, case in enumerate(lenses):
        if given.lenses and case.name not in given.lenses:
            continue
        for name in given.spoilings:
            if name == "other_psf":
                seen = replace(case.observation, psf=lenses[(k + 1) % len(lenses)].observation.psf)
            else:
                seen = SPOILINGS[name](case.observation)
            record = measured(Case(f"{case.name} {name}", "", seen, case.truth))
            silent = False
            if record.get("status") == "ok":
                mean, sd = record["magnitude"][:2]
                off = abs(mean - case.truth["magnitude"])
                silent = off > 3.0 * sd and off > 0.1
            wrong += silent
            print(f"{line(record)}{'  SILENTLY WRONG' if silent else ''}", flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
