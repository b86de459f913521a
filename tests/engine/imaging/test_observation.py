import numpy as np
import pytest
from scipy import sparse

from engine.errors import ObservationError
from engine.imaging.observation import Observation


def parts(**changes):
    psf = np.zeros((5, 5))
    psf[2, 2] = 1.0
    return {
        "image": np.arange(12.0).reshape(3, 4),
        "noise": np.ones((3, 4)),
        "psf": psf,
        "pixel_scale": 0.08,
        "zero_point": 25.9463,
    } | changes


def holed(value):
    noise = np.ones((3, 4))
    noise[1, 2] = value
    return noise


def test_a_good_observation_is_copied_and_frozen():
    image = np.ones((3, 4))
    observation = Observation(**parts(image=image))
    image[0, 0] = 99
    assert observation.image[0, 0] == 1
    assert observation.valid.all()
    assert observation.shape == (3, 4)
    for array in (observation.image, observation.noise, observation.psf, observation.valid):
        assert not array.flags.writeable
    with pytest.raises(TypeError):
        observation.provenance["new"] = 1


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"noise": np.ones((4, 3))}, "noise: got shape"),
        ({"image": np.ones(5)}, "image: got shape"),
        ({"image": "text"}, "image: not an array"),
        ({"image": np.full((3, 4), np.nan)}, "image: not finite"),
        ({"noise": holed(0.0)}, "noise: zero"),
        ({"noise": holed(-1.0)}, "noise: zero"),
        ({"noise": holed(np.nan)}, "noise: zero"),
        ({"noise": holed(np.inf)}, "noise: zero"),
        ({"valid": np.zeros((3, 4), dtype=bool)}, "no pixel"),
        ({"valid": np.ones((2, 2), dtype=bool)}, "valid: got shape"),
        ({"valid": np.ones((3, 4))}, "allowed is bool"),
        ({"psf": np.ones((4, 4))}, "odd square"),
        ({"psf": np.ones((3, 5))}, "odd square"),
        ({"psf": np.empty((0, 0))}, "psf: got shape"),
        ({"psf": np.full((3, 3), np.nan)}, "psf: not finite"),
        ({"psf": np.zeros((3, 3))}, "psf: got the sum"),
        ({"pixel_scale": 0.0}, "pixel_scale"),
        ({"zero_point": np.inf}, "zero_point"),
        ({"provenance": {"a": [1]}}, "provenance 'a'"),
        ({"covariance": sparse.eye(3)}, "covariance: got shape"),
        ({"covariance": sparse.eye(12, k=1)}, "covariance: not symmetric"),
        ({"covariance": sparse.csr_matrix((12, 12))}, "no positive variance"),
        ({"covariance": sparse.eye(12) * np.nan}, "covariance: not finite"),
    ],
)
def test_bad_input_is_refused_and_named(changes, names):
    with pytest.raises(ObservationError, match=names):
        Observation(**parts(**changes))


def test_one_pixel_and_a_psf_larger_than_the_image_are_allowed():
    Observation(**parts(image=np.ones((1, 1)), noise=np.ones((1, 1)), psf=np.ones((9, 9))))


@pytest.mark.parametrize("centre", [(360.0, 0.0), (10.0, 91.0), (np.nan, 0.0)])
def test_a_centre_that_is_not_on_the_sky_is_refused(centre):
    with pytest.raises(ObservationError, match="centre"):
        Observation(**parts(), centre=centre)
