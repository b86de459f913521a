"""Source files as syntax trees."""

import ast
import gc
from pathlib import Path


def parsed(path: Path) -> ast.Module:
    """The syntax tree of a file.

    Without garbage collection meanwhile: a finalizer may let another thread run, and where that one parses too (to
    print a traceback, say) CPython 3.11 ends the first with a SystemError (its issue 106905).
    """
    collecting = gc.isenabled()
    gc.disable()
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    finally:
        if collecting:
            gc.enable()
