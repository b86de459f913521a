"""The Matern regularisation: the covariance it is named after, its limits and its determinant."""

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve
from scipy.special import k1

from engine.errors import SpecError
from engine.inversion.regularisation import (
    SourceModel,
    ln_determinant,
    regularisation_matrix,
    sparse_regularisation,
)
from engine.spec import Analysis, Host, Realization


@pytest.mark.parametrize("length", [3.0, 6.0])
def test_the_inverse_of_h_is_the_matern_covariance(length: float) -> None:
    side = 81
    model = SourceModel((side, side), "matern", None, length)
    centre = np.zeros(side * side)
    middle = side // 2
    centre[middle * side + middle] = 1.0
    covariance = spsolve(sparse_regularisation(model).tocsc(), centre).reshape(side, side)
    z = np.sqrt(2.0) / length
    # The precision (kappa^2 - Laplacian)^2 has the variance 1 / (4 pi kappa^2) in the plane; the lattice changes it by
    # the order of 1 / length^2: 8 % and 3 % here.
    error = 1.5 / length**2
    assert covariance[middle, middle] == pytest.approx(1.0 / (4 * np.pi * z**2), rel=error)
    for dy, dx in ((0, 3), (0, 6), (4, 4), (9, 2), (0, 15)):
        r = z * np.hypot(dx, dy)
        correlation = covariance[middle + dy, middle + dx] / covariance[middle, middle]
        assert correlation == pytest.approx(r * k1(r), abs=0.5 * error)


@pytest.mark.parametrize("softening", [None, 0.15, 1e3])
@pytest.mark.parametrize("length", [0.3, 2.0, 50.0])
@pytest.mark.parametrize("shape", [(2, 2), (5, 9), (14, 11)])
def test_it_is_positive_definite_with_the_determinant_it_states(
    shape: tuple[int, int], length: float, softening: float | None
) -> None:
    model = SourceModel(shape, "matern", softening, length)
    h = regularisation_matrix(model)
    assert np.allclose(h, h.T, rtol=1e-12)
    assert np.linalg.eigvalsh(h).min() > 0
    assert ln_determinant(model) == pytest.approx(np.linalg.slogdet(h)[1], abs=1e-8)
    if softening == 1e3:
        assert np.allclose(h, regularisation_matrix(SourceModel(shape, "matern", None, length)), rtol=1e-4, atol=1e-5)


def test_short_lengths_tend_to_the_identity_and_long_ones_to_the_squared_laplacian() -> None:
    shape = (7, 9)
    short = regularisation_matrix(SourceModel(shape, "matern", None, 1e-3))
    assert np.allclose(short / (2e6**2), np.eye(63), atol=1e-5)
    gradient = regularisation_matrix(SourceModel(shape, "gradient"))
    long = regularisation_matrix(SourceModel(shape, "matern", None, 1e4))
    assert np.allclose(long, gradient @ gradient, atol=1e-6)


@pytest.mark.parametrize("length", [0.0, -1.0, float("nan"), float("inf")])
def test_a_length_without_meaning_is_refused(length: float) -> None:
    with pytest.raises(SpecError, match="length"):
        SourceModel((5, 5), "matern", None, length)


def test_the_length_is_part_of_a_realization_that_uses_it_and_of_no_other() -> None:
    def made(**changes: object) -> Realization:
        host = Host(n=2.0, r_eff=0.39, magnitude=21.0)
        return Realization(system="HE0435", l_eta=1.0, host=host, analysis=Analysis(**changes))  # type: ignore[arg-type]

    assert made(regularisation_length=5.0).digest == made().digest
    assert "regularisation_length" not in made().to_dict()["analysis"]
    matern = made(regularisation="matern")
    assert made(regularisation="matern", regularisation_length=5.0).digest != matern.digest
    assert matern.to_dict()["analysis"]["regularisation_length"] == 3.0
