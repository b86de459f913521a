"""The walls of the engine: which package may know which."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import engine
from tests.sources import parsed

ROOT = Path(engine.__file__).parent
MODULES = sorted(ROOT.rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {module_name(path) for path in MODULES}


def imported(path: Path) -> Iterator[str]:
    """Modules that a module imports, wherever in it the import stands."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide what is imported"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in NAMES else str(node.module)


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """Nodes of a cycle in their order; none where there is none."""
    finished: set[str] = set()

    def visit(node: str, path: list[str]) -> list[str]:
        if node in path:
            return [*path[path.index(node) :], node]
        if node not in finished:
            for other in sorted(graph.get(node, ())):
                if found := visit(other, [*path, node]):
                    return found
            finished.add(node)
        return []

    return next((found for node in sorted(graph) if (found := visit(node, []))), [])


def graph_of(depth: int) -> dict[str, set[str]]:
    """Who imports whom within the engine, by the first ``depth`` parts of their names; the public face left out."""
    graph: dict[str, set[str]] = {}
    for path in MODULES:
        here = module_name(path)
        if here == "engine":
            continue
        others = {name for name in imported(path) if name.startswith("engine.")}
        known = graph.setdefault(".".join(here.split(".")[:depth]), set())
        known |= {".".join(name.split(".")[:depth]) for name in others}
    return graph


@pytest.mark.parametrize(("what", "depth"), [("packages", 2), ("modules", 9)])
def test_no_two_parts_of_the_engine_need_each_other(what: str, depth: int) -> None:
    graph = {node: others - {node} for node, others in graph_of(depth).items()}
    assert len(graph) > 20
    assert not cycle(graph), what


def test_a_cycle_would_be_found() -> None:
    assert cycle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert cycle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_the_engine_knows_nothing_of_service_tests_or_its_own_face(path: Path) -> None:
    names = set(imported(path))
    assert not {name for name in names if name.split(".")[0] in {"service", "tests", "benchmarks", "migrations"}}
    assert "engine" not in names


def test_the_face_has_every_name_it_says_and_shows_what_is_not_loaded_yet() -> None:
    program = "import engine, sys; print(set(engine.__all__) <= set(dir(engine)), 'numba' in sys.modules)"
    told = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert told.split() == ["True", "False"]
    for name in engine.__all__:
        assert getattr(engine, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = engine.nothing  # type: ignore[attr-defined]


def test_no_module_of_the_engine_takes_a_name_of_its_face() -> None:
    # The import of a module binds its name in the package, and what the face means by it would be out of reach.
    assert not {name.split(".")[1] for name in NAMES if "." in name} & set(engine.__all__)
