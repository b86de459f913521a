"""How kernels are compiled: without the GIL, so that a worker stays responsive, and cached on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a kernel."""
    return cast(F, njit(nogil=True, cache=True)(function))


def inlined_kernel(function: F) -> F:
    """Compile a small kernel into its callers, whose loops can then be vectorised across it."""
    return cast(F, njit(nogil=True, cache=True, inline="always")(function))


def contracted_kernel(function: F) -> F:
    """Compile a kernel in which a product and the sum it goes into may be one instruction, rounded once."""
    return cast(F, njit(nogil=True, cache=True, fastmath={"contract"})(function))
