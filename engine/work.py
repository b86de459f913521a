"""How much is computed: counted where it is done, from the sizes of what is handed over.

Counting costs nothing beside what is counted, and knows no time: the same specification has the same counts, in
whatever process or company it is computed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields
from typing import Literal

WorkName = Literal[
    "pixels_rendered", "rays_traced", "columns_solved", "parameters_sampled", "evidence_evaluations"
]  # fmt: skip


@dataclass(frozen=True)
class Work:
    """What was computed.

    ``pixels_rendered`` are pixels, or the sub-pixels that were asked for, onto which the light of a Sersic profile or
    one of its derivatives was laid, again for every rendering; ``rays_traced`` the positions that were carried through
    a lens for it, refinement included, and for inversions; ``columns_solved`` the unknowns of all linear systems that
    were solved: amplitudes of the parametric model, source pixels of inversions, and the amplitudes that these
    marginalise; ``parameters_sampled`` the dimensions of the chain; ``evidence_evaluations`` those before the chain and
    in it, those included that were refused.
    """

    pixels_rendered: int = 0
    rays_traced: int = 0
    columns_solved: int = 0
    parameters_sampled: int = 0
    evidence_evaluations: int = 0

    def __add__(self, other: Work) -> Work:
        """The work of both."""
        return Work(*(getattr(self, part.name) + getattr(other, part.name) for part in fields(Work)))


_current: ContextVar[Counter[WorkName] | None] = ContextVar("work", default=None)


class Tally:
    """What has been counted since :func:`counted` began."""

    def __init__(self) -> None:
        self._counts: Counter[WorkName] = Counter()

    def work(self) -> Work:
        """All of it so far."""
        return Work(**{str(name): number for name, number in self._counts.items()})


@contextmanager
def counted() -> Iterator[Tally]:
    """Count what is computed within; it counts for what surrounds it as well."""
    tally, outer = Tally(), _current.get()
    token = _current.set(tally._counts)
    try:
        yield tally
    finally:
        _current.reset(token)
        if outer is not None:
            outer.update(tally._counts)


def count(what: WorkName, number: int) -> None:
    """Take note of work, where somebody counts."""
    counts = _current.get()
    if counts is not None:
        counts[what] += number
