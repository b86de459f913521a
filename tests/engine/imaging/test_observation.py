import numpy as np
import pytest
from scipy import sparse

from engine.errors import ObservationError
from engine.imaging.observation import Observation, observation_from_arrays


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


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_unusable_noise_makes_pixels_invalid_in_foreign_data(value):
    observation = observation_from_arrays(**parts(noise=holed(value)))
    assert not observation.valid[1, 2]
    assert observation.valid.sum() == 11
    assert observation.provenance["unusable_pixels"] == 1


def test_foreign_psf_is_changed_on_request_alone_and_says_so():
    psf = np.full((8, 6), 0.1)
    psf[3, 4] = 2.0
    with pytest.raises(ObservationError, match="odd square"):
        observation_from_arrays(**parts(psf=psf))
    observation = observation_from_arrays(**parts(psf=psf), recentre_psf=True)
    assert observation.psf.shape == (9, 9)
    assert observation.psf[4, 4] == 2.0
    assert observation.psf.sum() == pytest.approx(psf.sum())
    assert observation.provenance["psf_peak_was_at_row"] == 3
    assert observation.provenance["psf_peak_was_at_column"] == 4
    observation = observation_from_arrays(**parts(psf=psf), recentre_psf=True, normalise_psf=True)
    assert observation.psf.sum() == pytest.approx(1, abs=1e-15)
    assert observation.provenance["psf_divided_by"] == pytest.approx(psf.sum())


def test_foreign_mask_and_shapes_are_checked():
    valid = np.ones((3, 4), dtype=bool)
    valid[0] = False
    assert observation_from_arrays(**parts(noise=holed(0.0)), valid=valid).valid.sum() == 7
    with pytest.raises(ObservationError, match="valid"):
        observation_from_arrays(**parts(), valid=valid[:2])
    with pytest.raises(ObservationError, match="noise: got shape"):
        observation_from_arrays(**parts(noise=np.ones((4, 4))))
    with pytest.raises(ObservationError, match="no pixel"):
        observation_from_arrays(**parts(noise=np.zeros((3, 4))))
    with pytest.raises(ObservationError, match="psf"):
        observation_from_arrays(**parts(psf=np.full((3, 3), np.nan)), recentre_psf=True)
