"""The walls of the house: packages of ``service`` import each other in one direction, and the engine by its face."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import service
from tests.sources import parsed

FOLDER = Path(service.__file__).parent


def imports(file: Path) -> Iterator[str]:
    """Every module that a file names in an import, wherever it stands: also for types, also within a function."""
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import"
            yield str(node.module)
            yield from (f"{node.module}.{alias.name}" for alias in node.names if (node.module or "") == "service")


def room(module: str) -> str:
    """The package, or the module beside the packages, that a module of the service is in."""
    return module.split(".")[1]


def graph() -> dict[str, set[str]]:
    """Which rooms each room imports. The entry points beside them, which import what they start, are in none."""
    found: dict[str, set[str]] = {}
    for file in FOLDER.rglob("*.py"):
        inside = file.relative_to(FOLDER)
        here = inside.parts[0].removesuffix(".py")
        if here.startswith("__"):
            continue
        others = {room(name) for name in imports(file) if name.startswith("service.")}
        found.setdefault(here, set()).update(others - {here, "VERSION"})
    return found


def test_no_package_of_the_service_imports_one_that_imports_it() -> None:
    rooms = graph()
    assert {"api", "cli", "dispatcher", "domain", "runtime", "store", "worker"} <= rooms.keys()
    order = list(TopologicalSorter(rooms).static_order())  # CycleError names the cycle
    assert order.index("domain") < order.index("store") < order.index("dispatcher")


def test_the_domain_knows_nothing_of_the_service_and_the_store_nothing_of_the_api() -> None:
    rooms = graph()
    assert rooms["domain"] == set()
    assert rooms["store"] == {"domain"}
    assert not {"sqlalchemy", "fastapi", "distributed"} & {
        name.split(".")[0] for file in (FOLDER / "domain").glob("*.py") for name in imports(file)
    }


def test_the_service_uses_the_face_of_the_engine_alone() -> None:
    allowed = {"engine", "engine.figures", "engine.measurement_files"}  # the latter two load matplotlib and FITS, late
    for file in FOLDER.rglob("*.py"):
        named = {name for name in imports(file) if name.split(".")[0] == "engine"}
        assert named <= allowed, f"{file.relative_to(FOLDER)}: {sorted(named - allowed)}"


@pytest.mark.parametrize("module", ["service.api.serve", "service.dispatcher.dispatch", "service.runtime.supervisor"])
def test_a_process_that_computes_nothing_starts_without_what_computes(module: str) -> None:
    """It would be half of the start; the API loads it with the first grid that it is asked for."""
    program = f"import json, sys, {module}; print(json.dumps(sorted(sys.modules)))"
    loaded = json.loads(subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True).stdout)
    late = {"numba", "scipy", "astropy", "matplotlib", "pyarrow", "alembic", "engine.lensing", "engine.imaging"}
    assert not late & set(loaded)
