"""The non-negative source: its Karush-Kuhn-Tucker conditions, and that the evidence does not know of it."""

import math

import numpy as np
import pytest

from engine.inversion.evidence import Inversion, invert
from engine.inversion.positivity import non_negative_source
from engine.inversion.regularisation import SourceModel, regularisation_matrix
from tests.engine.explicit_inversion import LENS, Explicit

MODEL = SourceModel((14, 13), "gradient", 0.4)
LN_LAMBDA = -3.0


@pytest.fixture(scope="module")
def inversion() -> Inversion:
    return invert(Explicit().operator(), LENS, LN_LAMBDA, MODEL)


def test_the_source_fulfils_the_kkt_conditions(inversion: Inversion) -> None:
    assert (inversion.source < 0).any()
    found = non_negative_source(inversion)
    a = inversion.curvature + math.exp(LN_LAMBDA) * regularisation_matrix(MODEL)
    s = found.source.ravel()
    gradient = a @ s - inversion.data_vector
    scale = np.abs(a) @ np.abs(s) + np.abs(inversion.data_vector)
    assert (s >= 0).all()
    assert found.held.any()
    assert not found.held.all()
    # Zero gradient where the source is free, none towards larger values where it is held; to rounding of A s - D.
    assert (np.abs(gradient) < 1e-10 * scale)[~found.held.ravel()].all()
    assert (gradient > -1e-10 * scale)[found.held.ravel()].all()
    assert (s[found.held.ravel()] == 0).all()


def test_no_other_non_negative_source_is_better(inversion: Inversion) -> None:
    found = non_negative_source(inversion)
    a = inversion.curvature + math.exp(LN_LAMBDA) * regularisation_matrix(MODEL)

    def penalty(s: np.ndarray) -> float:
        return float(s @ a @ s - 2 * s @ inversion.data_vector)

    best, rng = penalty(found.source.ravel()), np.random.default_rng(1)
    for size in (1e-3, 1e-1, 10.0):
        for _ in range(50):
            other = np.maximum(found.source.ravel() + size * rng.normal(size=found.source.size), 0.0)
            assert penalty(other) > best
    assert penalty(np.maximum(inversion.source.ravel(), 0.0)) > best
    unbounded = penalty(inversion.source.ravel())
    assert found.penalty_increase == pytest.approx(best - unbounded, rel=1e-6)


def test_a_source_that_is_positive_already_is_left_alone() -> None:
    operator = Explicit(mask="disc", columns=()).operator()
    smooth = invert(operator, LENS, 7.0, SourceModel((6, 6), "matern", None, 10.0))
    assert (smooth.source > 0).all()
    found = non_negative_source(smooth)
    assert not found.held.any()
    assert found.penalty_increase == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(found.source, smooth.source, rtol=1e-10)


def test_the_evidence_and_the_solution_stay_as_they_were(inversion: Inversion) -> None:
    source, factor = inversion.source.copy(), inversion.factor.copy()
    non_negative_source(inversion)
    again = invert(Explicit().operator(), LENS, LN_LAMBDA, MODEL)
    assert again.ln_evidence == inversion.ln_evidence
    assert np.array_equal(source, inversion.source)
    assert np.array_equal(factor, inversion.factor)
