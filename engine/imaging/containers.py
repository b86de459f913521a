"""Arrays that carry a mask or a unit: both are kept, or the array is refused; nothing is stripped."""

from __future__ import annotations

import numpy as np
from astropy import units
from astropy.nddata import NDData, NDUncertainty, StdDevUncertainty
from astropy.utils.masked import Masked
from numpy.typing import ArrayLike, NDArray

from engine.conventions import FloatArray
from engine.errors import ObservationError
from engine.imaging.observation import image_array

_RATE = units.electron / units.s


def unpacked(
    name: str, values: ArrayLike | NDData | NDUncertainty, unit: units.UnitBase | None = _RATE
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """The array (ny, nx) in ``unit`` of anything that carries one, and where it is not masked.

    ``values`` is an array, a masked array, a Quantity, or of astropy's NDData (as CCDData) or NDUncertainty. An array
    without a unit is taken for one in ``unit``; None takes any.

    Raises
    ------
    ObservationError
        It is no image, or has a unit that does not become ``unit``.
    """
    own: units.UnitBase | None = None
    mask: ArrayLike = False
    data: object = values
    if isinstance(data, NDUncertainty):
        converted = data.represent_as(StdDevUncertainty)
        own, data = converted.unit, converted.array
    elif isinstance(data, NDData):
        own, mask, data = data.unit, False if data.mask is None else data.mask, data.data
    if isinstance(data, Masked):
        mask, data = np.asarray(mask) | data.mask, data.unmasked
    if isinstance(data, units.Quantity):
        own, data = data.unit, data.value
    if isinstance(data, np.ma.MaskedArray):
        mask, data = np.asarray(mask) | np.ma.getmaskarray(data), data.data
    array = image_array(name, data)  # type: ignore[arg-type]  # which says what is wrong with it
    if own is not None and unit is not None:
        array = array * _factor(name, own, unit)
    return np.array(array), np.broadcast_to(~np.asarray(mask, dtype=bool), array.shape)


def usable(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """A mask (ny, nx) as bool: False where it is zero, NaN or masked itself."""
    masked = np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else False
    array = np.asarray(values)
    if array.shape != shape:
        raise ObservationError(f"{name}: got shape {array.shape}, allowed is the image's {shape}")
    if array.dtype != bool:
        array = np.isfinite(array) & (array != 0)
    return np.asarray(array & ~np.asarray(masked))


def scalar(name: str, value: float | units.Quantity, unit: units.UnitBase) -> float:
    """A number in ``unit``, of one that has none or another."""
    if not isinstance(value, units.Quantity):
        return float(value)
    if value.unit.is_equivalent(unit):
        return float(value.to_value(unit))
    # Logarithmic units divide by nothing.
    if isinstance(unit, units.Unit | units.CompositeUnit) and value.unit.is_equivalent(unit / units.pix):
        return float(value.to_value(unit / units.pix))
    raise ObservationError(f"{name}: got the unit {value.unit}, allowed is {unit}")


def _factor(name: str, own: units.UnitBase, unit: units.UnitBase) -> float:
    for wanted in (unit, unit / units.pix):
        if own.is_equivalent(wanted):
            return float(own.to(wanted))
    raise ObservationError(f"{name}: got the unit {own or 'of a pure number'}, allowed is {unit}")
