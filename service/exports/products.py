"""What a run leaves beside its numbers, as files: its maps as FITS, its chain as NetCDF."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

from service import VERSION

if TYPE_CHECKING:
    from numpy.typing import NDArray

_RATE, _SURFACE = "electron/s", "electron/s/arcsec2"
_IMAGE_PLANE = {
    "image": ("IMAGE", _RATE), "noise": ("NOISE", _RATE), "model": ("MODEL", _RATE), "arc_model": ("ARC", _RATE),
    "residual": ("RESIDUAL", None), "mask": ("MASK", None),
}  # fmt: skip
_SOURCE_PLANE = {"source": "SOURCE", "source_sd": "SOURCE_SD", "source_truth": "SOURCE_TRUTH"}
_LENS_UNITS = {"theta_E": "arcsec", "phi": "rad", "x": "arcsec", "y": "arcsec"}

Arrays = Mapping[str, "NDArray[Any]"]


class NoChainError(LookupError):
    """A run was analysed without a chain."""


class NoProductsError(ValueError):
    """What was stored as the products of a run is not what :class:`engine.Products` gives."""


def read_products(data: bytes) -> dict[str, NDArray[Any]]:
    """Arrays of a run by the names of :class:`engine.Products`, from the NPZ that its worker wrote.

    Raises
    ------
    NoProductsError
        The bytes are something else: they are those of another task than the engine's.
    """
    import numpy as np  # noqa: PLC0415 - the API loads it anyway, the command line need not

    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, BadZipFile) as error:
        raise NoProductsError(f"is not NPZ ({error})") from error
    missing = {"pixel_scale", *_IMAGE_PLANE} - arrays.keys()
    if missing:
        raise NoProductsError(f"lacks {', '.join(sorted(missing))}")
    return arrays


def provenance(document: Mapping[str, Any]) -> dict[str, str]:
    """Which run it is, and what it was made of and with; ``document`` is a run with its result."""
    found = document["result"]
    return {
        "run": document["id"],
        "label": document["label"],
        "realization": document["digest"],
        "payload": found["payload_digest"],
        "engine": found["engine_digest"],
        "service": f"hostlens {VERSION}",
        "date": found["stored_at"].isoformat(),
        "spec": json.dumps(document["spec"]),
        "versions": json.dumps(found["versions"]),
    }


def fits_file(arrays: Arrays, about: Mapping[str, str]) -> bytes:
    """Maps in the image plane, those in the source plane and the chain, where there was an inversion, as FITS.

    IMAGE, NOISE, MODEL, ARC (the lensed host) [e-/s], RESIDUAL (in units of the noise) and MASK (1 where fitted) have
    arcsec from the image's centre as coordinates. SOURCE, SOURCE_SD and SOURCE_TRUTH [e-/s per arcsec^2] lie on cells
    whose edges [arcsec] stand in SOURCE_X and SOURCE_Y: cells need not be of one size. CHAIN has a column for each
    lens parameter.
    """
    from astropy.io import fits  # noqa: PLC0415 - takes a while

    primary = fits.PrimaryHDU()
    primary.header["LONGSTRN"] = "OGIP 1.0"
    for name, value in about.items():
        keyword = {"realization": "REALIZ", "service": "CREATOR"}.get(name, name.upper())
        primary.header[keyword] = value.encode("ascii", "backslashreplace").decode()
    scale = float(arrays["pixel_scale"])
    primary.header["PIXSCALE"] = (scale, "[arcsec] side of a pixel")
    units: list[Any] = [primary]
    for name, (extension, unit) in _IMAGE_PLANE.items():
        plane = fits.ImageHDU(_as_numbers(arrays[name]), _from_the_centre(arrays[name].shape, scale), name=extension)
        if unit is not None:
            plane.header["BUNIT"] = unit
        units.append(plane)
    for name, extension in _SOURCE_PLANE.items():
        if name in arrays:
            plane = fits.ImageHDU(arrays[name], name=extension)
            plane.header["BUNIT"] = _SURFACE
            units.append(plane)
    for axis in ("x", "y"):
        edges = arrays.get(f"source_{axis}_edges")
        if edges is not None:
            column = fits.Column("EDGE", "D", unit="arcsec", array=edges)
            units.append(fits.BinTableHDU.from_columns([column], name=f"SOURCE_{axis.upper()}"))
    if "chain" in arrays:
        units.append(_chain_table(arrays))
    data = io.BytesIO()
    fits.HDUList(units).writeto(data, checksum=True)
    return data.getvalue()


def chain_file(arrays: Arrays, document: Mapping[str, Any]) -> bytes:
    """The chain as NetCDF 4, in the groups of ArviZ: ``posterior`` with (chain, draw), ``constant_data`` the truth.

    Each walker is a chain, as ArviZ has it of emcee; draws are in the order in which they were made.

    Raises
    ------
    NoChainError
        There is none.
    """
    import h5netcdf  # noqa: PLC0415 - takes a while
    import numpy as np  # noqa: PLC0415

    found = document["result"]
    if "chain" not in arrays or found["chain"] is None:
        raise NoChainError(f"run {document['id']} has no chain: its analysis asked for nothing that needs one")
    walkers, names = found["chain"]["walkers"], [str(name) for name in arrays["parameter_names"]]
    # Stored step by step, all walkers of a step together.
    samples = arrays["chain"].reshape(-1, walkers, len(names)).swapaxes(0, 1)
    told = {**provenance(document), "created_at": found["stored_at"].isoformat(), "inference_library": "hostlens"}
    told |= {"inference_library_version": found["versions"].get("hostlens", VERSION)}
    data = io.BytesIO()
    with h5netcdf.File(data, "w") as file:
        file.attrs.update(told)
        posterior = file.create_group("posterior")
        posterior.attrs.update(told)
        posterior.dimensions = {"chain": samples.shape[0], "draw": samples.shape[1]}
        for dimension, size in (("chain", samples.shape[0]), ("draw", samples.shape[1])):
            posterior.create_variable(dimension, (dimension,), data=np.arange(size, dtype=np.int64))
        for place, name in enumerate(names):
            variable = posterior.create_variable(name, ("chain", "draw"), data=samples[:, :, place])
            variable.attrs["units"] = _LENS_UNITS.get(name, "1")
        truth = file.create_group("constant_data")
        for name in names:
            known = found["lens"].get(name, {}).get("truth")
            if known is not None:
                truth.create_variable(f"{name}_truth", (), data=np.float64(known))
    return data.getvalue()


def _as_numbers(plane: NDArray[Any]) -> NDArray[Any]:
    return plane.astype("u1") if plane.dtype == bool else plane


def _from_the_centre(shape: tuple[int, ...], scale: float) -> Any:
    """Coordinates in arcsec, x increasing with the columns."""
    from astropy.wcs import WCS  # noqa: PLC0415 - takes a while

    ny, nx = shape
    world = WCS(naxis=2)
    world.wcs.crpix = [(nx + 1) / 2, (ny + 1) / 2]  # FITS counts pixels from 1
    world.wcs.ctype, world.wcs.cunit, world.wcs.cdelt = ["X", "Y"], ["arcsec", "arcsec"], [scale, scale]
    return world.to_header()


def _chain_table(arrays: Arrays) -> Any:
    from astropy.io import fits  # noqa: PLC0415 - takes a while

    columns = [
        fits.Column(str(name), "D", unit=_LENS_UNITS.get(str(name)), array=arrays["chain"][:, place])
        for place, name in enumerate(arrays["parameter_names"])
    ]
    return fits.BinTableHDU.from_columns(columns, name="CHAIN")
