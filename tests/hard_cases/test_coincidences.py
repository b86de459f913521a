"""Coincidences: exact alignments, corners and edges, and what a referee would try."""

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import (
    Analysis,
    EngineError,
    Host,
    LensEquationError,
    LensSystem,
    ObservationError,
    Realization,
    SpecError,
    analyse,
    measure_image,
    observation_from_arrays,
    run,
)
from engine.conventions import pixel_centres
from engine.likelihood.evidence import invert
from engine.likelihood.problem import prepare_problem
from engine.likelihood.strength import find_strength
from engine.simulation.scene import Scene, build_scene, check_system
from engine.simulation.simulate import Simulation, simulate
from engine.source.regularisation import SourceModel
from tests.engine.conftest import QUICK, cut
from tests.engine.true_fit import true_fit

IMAGE = replace(QUICK, estimators=("image",))


def round_system(offset: float = 0.0, *, agn: bool = False) -> LensSystem:
    """A round lens without shear, and a source ``offset`` arcsec beside the point behind its centre."""
    system = cut()
    mass = replace(
        system.mass_models["recommended"]["1.0"], q=1.0, shear=None, centre=(0.0, 0.0), source_position=(offset, 0.0)
    )
    changed = replace(system, priors={}, mass_models={"recommended": {"1.0": mass}})
    return changed if agn else replace(changed, agn=())


@pytest.mark.parametrize("n", [1.0, pytest.param(4.0, marks=pytest.mark.long)])
def test_a_host_exactly_behind_a_round_lens_is_a_ring_and_is_inverted(n: float) -> None:
    """A lens of q = 1 exactly, no shear, no AGN, and a host exactly behind its centre: a perfect Einstein ring.

    Could go wrong: the lens equation of the host's centre has a circle for its solution, and no points at which to put
    the cusp of the profile. Holds: the ring is simulated, the same in each quadrant to 1e-3 of its peak and, through
    telescope and drizzle, that of a host 1e-4 arcsec beside to 1e-3; and the inversion explains it: its chi^2 per
    pixel is between 0.85 and 1.1.
    """
    host = Host(n=n, r_eff=0.39, magnitude=20.5, q=1.0)
    scenes = [build_scene(Realization(system=round_system(offset), l_eta=1.0, host=host)) for offset in (0.0, 1e-4)]
    behind, beside = (simulate(one, "author", np.random.default_rng(0)) for one in scenes)
    arc = behind.high_resolution_arc
    assert np.abs(arc - arc[::-1]).max() < 1e-3 * arc.max()
    assert np.abs(arc - arc.T).max() < 1e-3 * arc.max()
    assert np.abs(behind.arc - beside.arc).max() < 1e-3 * beside.arc.max()
    lens, model = behind.scene.lens, SourceModel((20, 20))
    problem = prepare_problem(behind.observation, true_fit(behind.scene), Analysis(noise_treatment="diagonal"))
    found = invert(problem.likelihood, lens, find_strength(problem.likelihood, lens, model).ln_lambda, model)
    seen = problem.likelihood.blurring @ found.lensing.apply(found.source.ravel())
    chi2 = problem.likelihood.chi2(seen, problem.likelihood.fit_amplitudes(seen))
    assert 0.85 < chi2 / problem.likelihood.data_points < 1.1


def test_an_agn_exactly_behind_a_round_lens_is_refused() -> None:
    """The same lens with an AGN in the host's centre: its image is a ring of infinite magnification.

    Could go wrong: four of the ring's points are taken for images. Holds: the system is refused, the caustic named.
    """
    with pytest.raises((LensEquationError, SpecError), match="caustic"):
        check_system(round_system(agn=True))


@pytest.mark.parametrize("kind", ["exposures", "stamp"])
def test_a_star_on_the_corner_of_a_pixel_has_the_flux_of_one_on_its_centre(simulation: Simulation, kind: str) -> None:
    """A point source exactly on the corner, the side and the centre of an image pixel.

    Could go wrong: rounding half a pixel up in one place and down in another moves it by a pixel, or loses a row of its
    light. Holds: flux is kept to 2e-4 through the exposures and to 1e-3 by a moved stamp, whose wings the field cuts;
    the centre of light moves by half a pixel to 0.05, and 1e-9 arcsec to either side of the corner make no difference
    beyond 1e-6 of the peak.
    """
    observation = simulation.observation if kind == "exposures" else replace(simulation.observation, response=None)
    scale, (ny, nx) = observation.pixel_scale, observation.shape
    x, y = pixel_centres(nx, scale), pixel_centres(ny, scale)
    at = np.array([x[nx // 2], y[ny // 2]])
    stars = [
        observation.point_source(*(at + scale * np.array(step))) for step in ((0, 0), (0.5, 0.5), (0.5, 0), (0, -0.5))
    ]
    flux = [star.sum() for star in stars]
    assert flux == pytest.approx([flux[0]] * 4, rel=2e-4 if kind == "exposures" else 1e-3)
    corner = at + 0.5 * scale
    beside = [observation.point_source(*(corner + step)) for step in (-1e-9, 1e-9)]
    assert np.abs(beside[0] - beside[1]).max() < 1e-6 * stars[0].max()
    middles = [(star.sum(axis=0) @ x / star.sum(), star.sum(axis=1) @ y / star.sum()) for star in stars[:2]]
    # The wings that the field cuts off move the centre of what is left.
    assert np.subtract(middles[1], middles[0]) == pytest.approx([0.5 * scale] * 2, abs=0.05 * scale)


def test_agn_images_on_the_edge_of_the_mask_are_boosted_as_far_as_they_are_in_it(
    scene: Scene, simulation: Simulation
) -> None:
    """A ring whose inner edge runs exactly through an AGN image.

    Could go wrong: the core's pixels are counted by another rule than the mask's, and some of an AGN's peak is fitted
    as host. Holds: the boosted pixels are those of the core that are in the mask, some and not all of it; a hundred
    deviations more in one of them change the source by less than 1e-2 of its peak.
    """
    observation, fit = simulation.observation, true_fit(scene)
    agn = fit.agn[0]
    edge = math.hypot(agn.x - fit.lens.x, agn.y - fit.lens.y) / fit.lens.theta_E
    inner = {"mask_inner": edge} if edge < 1.0 else {"mask_outer": edge}
    analysis = Analysis(noise_treatment="diagonal", **inner)
    problem = prepare_problem(observation, fit, analysis)
    scale = observation.pixel_scale
    x, y = np.meshgrid(*(pixel_centres(n, scale) for n in observation.shape[::-1]))
    near = np.hypot(x - agn.x, y - agn.y) <= analysis.core_radius
    assert (problem.core & near).any()
    assert (near & ~problem.mask).any()
    assert not (problem.core & ~problem.mask).any()
    row, column = np.argwhere(problem.core & near)[0]
    image = observation.image.copy()
    image[row, column] += 100.0 * observation.noise[row, column]
    model = SourceModel((12, 12))
    first, second = (
        invert(prepare_problem(one, fit, analysis).likelihood, fit.lens, -9.0, model).source
        for one in (observation, replace(observation, image=image))
    )
    assert np.abs(second - first).max() < 1e-2 * first.max()


def test_pixels_that_are_no_numbers_are_left_out_as_if_they_had_been_flagged(simulation: Simulation) -> None:
    """NaN or infinity in an arc, in the core of an AGN image and in a corner of somebody's image.

    Could go wrong: one of them spoils every pixel that a Fourier transform touches, or counts as zero. Holds: an
    Observation of such pixels is refused; one from arrays measures the same bits as with those pixels flagged, whatever
    they hold, and finds the host.
    """
    given = simulation.observation
    rows, columns = [20, 32, 1, 33], [32, 47, 1, 18]
    image, valid = given.image.copy(), np.ones(given.shape, dtype=bool)
    valid[rows, columns] = False
    for value in (math.inf, -math.inf, math.nan):
        image[rows, columns] = value
        with pytest.raises(ObservationError, match="image"):
            replace(given, image=image)
    image[rows, columns] = math.nan, math.inf, -math.inf, math.inf
    options = {"pixel_scale": given.pixel_scale, "zero_point": given.zero_point, "normalise_psf": True}
    spoilt = observation_from_arrays(image, given.noise, given.psf, **options)
    flagged = observation_from_arrays(given.image, given.noise, given.psf, valid=valid, **options)
    found, expected = (
        analyse(one, replace(IMAGE, noise_treatment="diagonal"), np.random.default_rng(0), agn_images=4)
        for one in (spoilt, flagged)
    )
    assert found.chi2 == pytest.approx(expected.chi2, rel=1e-6)
    host, other = found.estimates[0], expected.estimates[0]
    assert host.magnitude.mean == pytest.approx(other.magnitude.mean, abs=1e-6)
    assert host.magnitude.mean == pytest.approx(20.5, abs=5 * host.magnitude.sd)


@pytest.mark.parametrize(("host", "agn"), [(18.0, 26.0), (26.0, 18.0)])
def test_host_and_agn_eight_magnitudes_apart_are_told_apart_or_refused(host: float, agn: float) -> None:
    """A host eight magnitudes brighter than each AGN image, and one eight fainter.

    Could go wrong: stars are invented on a bright arc, or a host is invented under bright stars, with the error of a
    detection. Holds: an EngineError that says what was not found, or an answer within 4 of its own deviations.
    """
    system = cut()
    system = replace(system, agn=tuple(replace(image, magnitude=agn) for image in system.agn))
    realization = Realization(
        system=system, l_eta=1.0, host=Host(n=1.0, r_eff=0.39, magnitude=host), analysis=IMAGE
    )  # fmt: skip
    try:
        found = run(realization)
    except EngineError as error:
        assert "agn" in str(error) or "host" in str(error) or "chi2" in str(error)  # noqa: PT017
        return
    answer = found.estimate("image", "wide")
    assert answer.magnitude.bias is not None
    assert abs(answer.magnitude.bias) < 4.0 * answer.magnitude.sd or any("host" in told for told in found.warnings)


def test_an_image_that_is_all_one_number_is_no_lens() -> None:
    """An image of zeros with a noise map of ones, and one of a constant sky.

    Could go wrong: 0/0 in every scale that is measured of the image itself. Holds: an EngineError.
    """
    psf = np.zeros((11, 11))
    psf[5, 5] = 1.0
    for sky in (0.0, 5.0):
        flat = observation_from_arrays(
            np.full((64, 64), sky), np.ones((64, 64)), psf, pixel_scale=0.08, zero_point=26.0
        )
        with pytest.raises(EngineError):
            measure_image(flat, inversion=False)
