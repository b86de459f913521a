"""The identity of the engine: sources, data files and the versions of what its numbers depend on."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from importlib.resources.abc import Traversable

_NUMERIC_PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "emcee", "drizzle", "poppy", "astropy")
_SUFFIXES = (".py", ".yaml")
_LEFT_OUT = ("figures", "accuracy", "codes", "study")
"""Of the digest: what is drawn or said of a result, measured of the engine, or compared with it, does not change it."""


@cache
def engine_versions() -> dict[str, str]:
    """Versions of Python, of hostlens and of the packages that the numbers depend on."""
    versions = {"python": platform.python_version()}
    for package in ("hostlens", *_NUMERIC_PACKAGES):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed as a distribution"
    return versions


def _walk(folder: Traversable, prefix: str = "") -> list[tuple[str, Traversable]]:
    found = []
    for entry in folder.iterdir():
        name = f"{prefix}{entry.name}"
        if entry.is_dir():
            if entry.name not in ("__pycache__", *_LEFT_OUT):
                found += _walk(entry, f"{name}/")
        elif name.endswith(_SUFFIXES):
            found.append((name, entry))
    return sorted(found)


@cache
def engine_digest() -> str:
    """SHA-256 (hex) over the engine's source and data files and the versions of its numeric packages.

    Left out is what no result depends on: figures, the report of speed against error, and what is said of a study.
    """
    digest = hashlib.sha256()
    for name, entry in _walk(files("engine")):
        digest.update(name.encode() + b"\0" + entry.read_bytes() + b"\0")
    for package, number in sorted(engine_versions().items()):
        if package != "hostlens":
            digest.update(f"{package}=={number}\0".encode())
    return digest.hexdigest()
