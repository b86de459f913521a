"""Which profile keeps a numerical error, by what stored runs predict of themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sqlalchemy import Connection, select

from service.domain.payload import ERROR_PARTS
from service.store.answers import Question
from service.store.numbers import read_numbers
from service.store.statistics import FloatArray, Share, share
from service.store.tables import estimate, input_group, result

LOOKED_AT = 20_000
"""Runs of a profile that are looked at, at most: the newest of those that are stored."""
KEPT = 0.95
"""Part of a profile's runs that must predict no more than what is asked for, or the profile does not keep it."""
_SHOWN_RUNS = 10
_ERROR = {quantity: whole for quantity, whole, _ in ERROR_PARTS}


@dataclass(frozen=True)
class ProfileErrors:
    """What stored runs of a profile say: ``stored`` with an answer, of which ``error`` and ``cpu_s`` (runs,) tell.

    Runs without a predicted error, older than that or not predictable, are counted and not looked at. ``keeps`` is the
    part of the others that predict no more than what is asked for, with its interval (arrays of one).
    """

    profile: str
    stored: int
    error: FloatArray
    cpu_s: FloatArray
    keeps: Share
    run_ids: list[str]

    @property
    def kept(self) -> bool:
        """Whether the profile keeps the error."""
        return bool(self.error.size) and float(self.keeps.fraction[0]) >= KEPT

    @property
    def expected_cpu_s(self) -> float:
        """Mean CPU of a run [s]; infinite where none is known."""
        return float(self.cpu_s.mean()) if self.cpu_s.size else np.inf


def profile_errors(connection: Connection, question: Question, max_error: float) -> list[ProfileErrors]:
    """Every profile that has a stored run among those that are meant, the cheapest first."""
    condition = question.where.conditions()
    wanted = select(input_group.c.profile).where(input_group.c.profile.is_not(None)).distinct()
    names = connection.scalars(wanted if condition is None else wanted.where(condition)).all()
    found = [_of_profile(connection, question, str(name), max_error) for name in names]
    return sorted(found, key=lambda one: (one.expected_cpu_s, one.profile))


def _of_profile(connection: Connection, question: Question, profile: str, max_error: float) -> ProfileErrors:
    inputs = select(input_group.c.id).where(input_group.c.profile == profile)
    condition = question.where.conditions()
    mine = [
        estimate.c.estimator == question.estimator,
        estimate.c.index_prior == question.index_prior,
        estimate.c.input_id.in_(inputs if condition is None else inputs.where(condition)),
    ]
    column = estimate.c[_ERROR[question.quantity]]
    joined = select(column, result.c.cpu_s).join_from(estimate, result, result.c.run_id == estimate.c.run_id)
    numbers = read_numbers(connection, joined.where(*mine).order_by(estimate.c.run_id.desc()).limit(LOOKED_AT))
    ids = select(estimate.c.run_id).where(*mine, column.is_not(None)).order_by(estimate.c.run_id.desc())
    known = numbers[~np.isnan(numbers[:, 0])]
    everyone = np.zeros(len(known), dtype=np.intp)
    return ProfileErrors(
        profile=profile,
        stored=len(numbers),
        error=known[:, 0],
        cpu_s=known[:, 1],
        keeps=share(known[:, 0] <= max_error, everyone, np.array([len(known)])),
        run_ids=list(connection.scalars(ids.limit(_SHOWN_RUNS))),
    )
