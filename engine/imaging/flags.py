"""Which pixels may be used: masks, and the bits of DQ planes by the names that missions give them."""

from __future__ import annotations

import numpy as np
from astropy.nddata.bitmask import BitFlagNameMap, bitfield_to_boolean_mask, extend_bit_flag_map, interpret_bit_flags
from numpy.typing import NDArray

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.fits_planes import Headers
from engine.imaging.readings import Findings

JWST_FLAGS = extend_bit_flag_map(
    "JWST", DO_NOT_USE=1, SATURATED=2, JUMP_DET=4, DROPOUT=8, OUTLIER=16, PERSISTENCE=32, AD_FLOOR=64, CHARGELOSS=128,
    UNRELIABLE_ERROR=256, NON_SCIENCE=512, DEAD=1024, HOT=2048, WARM=4096, LOW_QE=8192,
)  # fmt: skip
"""The bits of JWST that are told by name; the pipeline's own rule is that DO_NOT_USE decides."""
HST_FLAGS = extend_bit_flag_map(
    "HST", REED_SOLOMON=1, FILLED=2, BAD_DETECTOR=4, MASKED=8, HOT=16, UNSTABLE=32, WARM=64, BIAS=128, SATURATED=256,
    BAD_FLAT=512, TRAP=1024, AD_SATURATED=2048, COSMIC_RAY_DRIZZLE=4096, COSMIC_RAY=8192, GHOST=16384,
)  # fmt: skip
HST_IR_FLAGS = extend_bit_flag_map(
    "HST_IR", REED_SOLOMON=1, FILLED=2, BAD_DETECTOR=4, ZERO_READ_DEVIANT=8, HOT=16, UNSTABLE=32, WARM=64,
    BAD_REFERENCE=128, SATURATED=256, BAD_FLAT=512, PERSISTENCE=1024, ZERO_READ_SIGNAL=2048, COSMIC_RAY_DRIZZLE=4096,
    COSMIC_RAY=8192,
)  # fmt: skip
_GOOD = {
    "JWST": tuple(2**bit for bit in range(31) if 2**bit not in (1, 2, 512)),
    # What AstroDrizzle takes as well: warm and hot pixels, whose dark is subtracted, but not saturated ones.
    "HST": (16, 64),
    # Of the IR channel: blobs, a signal in the first read, and cosmic rays that the ramp has been mended for.
    "HST_IR": (64, 512, 2048, 8192),
    "": (),
}
_FEWEST_USABLE, _MIDDLE = 0.25, 0.5


def usable_by_mask(values: FloatArray, origin: str, found: Findings) -> NDArray[np.bool_]:
    """Pixels (ny, nx) that a mask allows: those where it is not zero; NaN allows nothing.

    Raises
    ------
    ObservationError
        It has more than two values, as flags have, or leaves so little that it is likely inside out.
    """
    finite: NDArray[np.bool_] = np.isfinite(values)
    kinds = np.unique(values[finite])
    if kinds.size > 2 or (kinds.size == 2 and not (kinds == 0).any()):
        few = ", ".join(f"{value:g}" for value in kinds[:4])
        found.contradict(
            f"{origin}: mask: got the values {few}{' ...' if kinds.size > 4 else ''}, allowed are 0 and one other "
            "where a pixel may be used; flags of bad pixels are given as dq"
        )
    usable: NDArray[np.bool_] = finite & (values != 0)
    _refuse_inside_out(usable, origin, "mask", "not zero where a pixel may be used", found)
    found.read("mask", f"{np.count_nonzero(~usable)} pixels out", origin)
    return usable


def usable_by_flags(values: FloatArray, headers: Headers, good_bits: str | None, found: Findings) -> NDArray[np.bool_]:
    """Pixels (ny, nx) without a bad bit in a DQ plane, where zero is good.

    ``good_bits`` are bits, by value or name, that do no harm, as ``64,512`` or ``WARM,HOT``; where None those of the
    mission.

    Raises
    ------
    ObservationError
        The plane has no flags in it, ``good_bits`` are none, or so little is left that it is likely inside out.
    """
    origin = headers.origin
    if not (np.isfinite(values).all() and (values == np.rint(values)).all() and (values >= 0).all()):
        raise ObservationError(f"{origin}: dq: allowed are flags, whole numbers from 0")
    if values.max() >= 2.0**31:
        # JWST's 32nd bit is its reference pixels'; beyond it there are none.
        values = np.where(values < 2.0**32, values % 2.0**31 + (values >= 2.0**31), 1.0)
    flags = values.astype(np.int64)
    mission, names = _mission(headers)
    if good_bits is None:
        good = sum(_GOOD[mission])
    else:
        try:
            good = interpret_bit_flags(good_bits, flag_name_map=names) or 0
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            raise ObservationError(f"good_bits: got {good_bits!r}, allowed are bits, as 64,512 ({error})") from error
    bad = bitfield_to_boolean_mask(flags, ignore_flags=int(good), flag_name_map=names, dtype=np.bool_)
    usable = ~np.asarray(bad, dtype=bool)
    _refuse_inside_out(usable, origin, "dq", "zero where a pixel is good", found)
    told = [f"{np.count_nonzero(bad)} pixels out"]
    for bit in range(32):
        number = int(np.count_nonzero(bad & (flags & 2**bit != 0)))
        if number and not int(good) & 2**bit:
            told.append(f"{_name(names, 2**bit)} {number}")
    found.read("dq", ", ".join(told), origin)
    return usable


def _mission(headers: Headers) -> tuple[str, type[BitFlagNameMap] | None]:
    telescope, detector = (str((headers.find(name) or ("",))[0]).upper() for name in ("TELESCOP", "DETECTOR"))
    if telescope == "JWST":
        return "JWST", JWST_FLAGS
    if telescope == "HST":
        return ("HST_IR", HST_IR_FLAGS) if detector == "IR" else ("HST", HST_FLAGS)
    return "", None


def _name(names: type[BitFlagNameMap] | None, bit: int) -> str:
    known = {} if names is None else {getattr(names, name): name for name in dir(names) if name.isupper()}
    return str(known.get(bit, f"bit {bit}"))


def _refuse_inside_out(usable: NDArray[np.bool_], origin: str, what: str, rule: str, found: Findings) -> None:
    share = float(usable.mean())
    if share < _FEWEST_USABLE:
        found.contradict(f"{origin}: {what}: leaves {share:.1%} of the pixels; it is {rule}: is it inside out?")
    ny, nx = usable.shape
    middle = usable[ny // 4 : -(ny // 4) or None, nx // 4 : -(nx // 4) or None]
    if float(middle.mean()) < _MIDDLE * share:
        found.note(f"{what}: {origin} leaves {middle.mean():.1%} of the image's middle and {share:.1%} of the whole")
