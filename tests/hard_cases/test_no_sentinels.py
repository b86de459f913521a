"""The engine's source itself: nothing swallows an error, no number stands for one."""

import ast
from collections.abc import Iterator
from pathlib import Path

import engine
from tests.sources import parsed

SOURCES = sorted(Path(engine.__file__).parent.rglob("*.py"))


def _trees() -> Iterator[tuple[str, ast.Module]]:
    root = Path(engine.__file__).parent
    for path in SOURCES:
        yield path.relative_to(root).as_posix(), parsed(path)


def _functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            yield node


def _is_plain_number(node: ast.expr | None) -> bool:
    """0, -1.0, nan, inf and their like: a constant, or a name of one."""
    if node is None:
        return False
    if isinstance(node, ast.UnaryOp):
        return _is_plain_number(node.operand)
    if isinstance(node, ast.Tuple):
        return any(map(_is_plain_number, node.elts))
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    return isinstance(node, ast.Attribute) and node.attr in {"nan", "inf"}


def test_no_exception_is_caught_without_being_named() -> None:
    """`except:` and `except Exception`.

    Could go wrong: a mistake of the program passes for a property of the data. Holds: not one in the engine; and no
    `contextlib.suppress` either.
    """
    found = []
    for name, tree in _trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.ExceptHandler):
                caught = ast.unparse(node.type) if node.type is not None else "everything"
                if caught in {"everything", "Exception", "BaseException"}:
                    found.append(f"{name}:{node.lineno}: catches {caught}")
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("suppress"):
                found.append(f"{name}:{node.lineno}: suppresses")
    assert found == []


def test_no_number_is_returned_for_a_failure() -> None:
    """A handler of an exception that returns 0, -1, NaN or infinity, or does nothing.

    Could go wrong: chi^2 of 1e30, positions of (0, 0), an error of 1.0: numbers that nobody can tell from answers.
    Holds: not one in the engine.
    """
    found = []
    for name, tree in _trees():
        for function in _functions(tree):
            for handler in (node for node in ast.walk(function) if isinstance(node, ast.ExceptHandler)):
                if all(isinstance(statement, ast.Pass) for statement in handler.body):
                    found.append(f"{name}:{handler.lineno}: passes over {ast.unparse(handler.type or handler)}")
                found += [
                    f"{name}:{node.lineno}: returns {ast.unparse(node)}"
                    for node in ast.walk(handler)
                    if isinstance(node, ast.Return) and _is_plain_number(node.value)
                ]
    assert found == []


def test_not_a_number_is_never_made_into_one() -> None:
    """`nan_to_num`, and warnings of invalid operations switched off altogether.

    Could go wrong: NaN becomes zero and goes on as data. Holds: `nan_to_num` and `seterr` stand nowhere in the engine,
    and `errstate(all="ignore")` neither; what is switched off is named.
    """
    found = []
    for name, tree in _trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func).rsplit(".", 1)[-1]
                everything = called == "errstate" and any(word.arg == "all" for word in node.keywords)
                if called in {"nan_to_num", "seterr"} or everything:
                    found.append(f"{name}:{node.lineno}: {ast.unparse(node)}")
    assert found == []
