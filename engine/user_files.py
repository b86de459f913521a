"""Lens systems and cameras of a user's own, read from TOML or JSON files: the schema is that of the catalogue.

The one place where the engine's specifications meet files that somebody else wrote.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from engine.errors import SpecError
from engine.spec.instrument import Camera
from engine.spec.json_text import read_json
from engine.spec.realization import camera_from_mapping, system_from_mapping
from engine.spec.sky import LensSystem


def read_system(path: str | Path) -> LensSystem:
    """The lens system in a file, checked as a whole: each mass model must make as many images as there are AGN images.

    Parameters
    ----------
    path
        A ``.toml`` or ``.json`` file with the fields of :class:`~engine.spec.sky.LensSystem`; ``camera`` and
        ``exposures.dither`` are names of the catalogue or tables of their own.

    Raises
    ------
    SpecError
        It names the field, as ``agn[1].magnitude``, the value and what is allowed.
    OSError
        The file cannot be read.
    """
    system = system_from_mapping(read_mapping(path))
    # Solves the lens equation, which takes a second to load: only a system whose fields are right is worth that.
    from engine.simulation.scene import check_system  # noqa: PLC0415

    check_system(system)
    return system


def read_camera(path: str | Path) -> Camera:
    """The camera in a ``.toml`` or ``.json`` file, with the fields of :class:`~engine.spec.instrument.Camera`."""
    return camera_from_mapping(read_mapping(path))


def read_mapping(path: str | Path) -> dict[str, Any]:
    """The table that a TOML or JSON file holds; a SpecError says where its syntax fails."""
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in {".toml", ".json"}:
        raise SpecError("file", path.name, "a file that ends in .toml or .json")
    try:
        text = path.read_text(encoding="utf-8")
        document = tomllib.loads(text) if kind == ".toml" else read_json(text)
    except SpecError:
        raise
    except (ValueError, RecursionError) as error:  # not UTF-8; not TOML, or TOML whose numbers or nesting have no end
        raise SpecError("file", path.name, f"valid {kind[1:].upper()} ({error})") from error
    if not isinstance(document, dict):
        raise SpecError("file", path.name, "a table of fields")
    return document
