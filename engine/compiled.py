"""How kernels are compiled: without the GIL, so that a worker stays responsive, and cached on disk where that may be.

Numba keeps what it has compiled in ``NUMBA_CACHE_DIR``, in the ``__pycache__`` beside the source, or in the user's
cache folder, and refuses to import a kernel where none of them can be written. Here such a place is a gain and no
condition: kernels that an installation brings along are read where they are, and what cannot be kept is compiled again
by the next process.
"""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, InTreeCacheLocator, NullCache

F = TypeVar("F", bound=Callable[..., Any])
_LOG = logging.getLogger(__name__)
_UNREADABLE = (OSError, EOFError, pickle.UnpicklingError)
"""A cache of another user, on a disk that is full or gone, or half written when the machine lost its power."""


def kernel(function: F) -> F:
    """Compile a kernel."""
    return _compiled(function)


def inlined_kernel(function: F) -> F:
    """Compile a small kernel into its callers, whose loops can then be vectorised across it."""
    return _compiled(function, inline="always")


def contracted_kernel(function: F) -> F:
    """Compile a kernel in which a product and the sum it goes into may be one instruction, rounded once."""
    return _compiled(function, fastmath={"contract"})


def _compiled(function: F, **options: Any) -> F:
    dispatcher = njit(nogil=True, **options)(function)
    dispatcher._cache = _KernelCache(function)  # as enable_caching() does with Numba's own
    return cast(F, dispatcher)


class _InstalledLocator(InTreeCacheLocator):  # type: ignore[misc]  # Numba has no types
    """The ``__pycache__`` beside the source, whether or not it may be written."""

    def ensure_cache_path(self) -> None:
        """Nothing is made: it is only read."""


class _InstalledImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (_InstalledLocator,)


class _InstalledCache(FunctionCache):  # type: ignore[misc]
    _impl_class = _InstalledImpl


class _NoCache(NullCache):  # type: ignore[misc]
    def save_overload(self, _sig: Any, _data: Any) -> None:
        _warn("no folder for them can be written; NUMBA_CACHE_DIR may name one")


class _KernelCache(NullCache):  # type: ignore[misc]
    """Numba's cache where there is one, else the installed kernels; never a reason to fail."""

    def __init__(self, function: Callable[..., Any]) -> None:
        try:
            self._own: Any = FunctionCache(function)
        except RuntimeError:  # no place that can be written
            self._own = _NoCache()
        self._installed = _InstalledCache(function)

    @property
    def cache_path(self) -> str | None:
        """Folder that this process writes to."""
        return cast("str | None", self._own.cache_path)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """A compiled kernel, None where it has to be compiled."""
        for each in (self._own, self._installed):
            try:
                found = each.load_overload(sig, target_context)
            except _UNREADABLE as error:
                _LOG.debug("%s cannot be read: %s", each.cache_path, error)
                continue
            if found is not None:
                return found
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel for the next process, if that can be."""
        try:
            self._own.save_overload(sig, data)
        except _UNREADABLE as error:
            _warn(str(error))


@cache
def _warn(why: str) -> None:
    """Say it once: there are some twenty kernels."""
    _LOG.warning("compiled kernels are not kept, so that each process compiles them again: %s", why)
