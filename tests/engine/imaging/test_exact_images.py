"""Light through the exposures: the blurring matrix, and exact images of extended light."""

import numpy as np
import pytest
from scipy.special import erf

from engine.conventions import pixel_centres
from engine.imaging.convolution import convolve
from engine.imaging.drizzling import drizzle
from engine.imaging.exposures import expose
from engine.imaging.optics.exposed import ExposedOptics
from engine.simulation.scene import build_scene
from engine.simulation.simulate import Simulation
from engine.spec.host import Host
from engine.spec.realization import Realization
from tests.engine.imaging.conftest import Setup


def _around(setup: Setup, radius: float) -> tuple[np.ndarray, np.ndarray]:
    scale = setup.geometry.drizzled_scale
    y, x = (pixel_centres(n, scale) for n in setup.geometry.drizzled_shape)
    rows, columns = np.nonzero(np.hypot(y[:, None] - 0.11, x[None, :] - 0.23) < radius)
    return rows, columns


def test_a_column_is_the_drizzled_star_at_the_centre_of_its_pixel(setup: Setup) -> None:
    response = ExposedOptics(setup.psf, setup.geometry, setup.kernel)
    ny, nx = setup.geometry.drizzled_shape
    every = tuple(axis.ravel() for axis in np.indices((ny, nx)))
    of = np.array([ny // 2, ny // 2 + 3, ny // 3]), np.array([nx // 2, nx // 2 - 4, nx // 2 + 7])
    radius = 12
    matrix = response.blurring_matrix(every, of, 1, radius).toarray()  # type: ignore[arg-type]
    scale = setup.geometry.drizzled_scale
    for k, (row, column) in enumerate(zip(*of, strict=True)):
        star = response.point_source(
            float(pixel_centres(nx, scale)[column]), float(pixel_centres(ny, scale)[row])
        ).ravel()
        near = (np.abs(every[0] - row) <= radius) & (np.abs(every[1] - column) <= radius)
        # Interpolated between sub-pixels by polynomials of order 7; the drizzle package works in single precision.
        assert np.abs(matrix[near, k] - star[near]).max() < 3e-4 * star.max()
        assert not matrix[~near, k].any()


@pytest.mark.parametrize("subrays", [None, 1, 2, 4])
@pytest.mark.parametrize("width", [0.12, 0.5])
def test_smooth_light_comes_out_as_through_the_exposures(f160w: Setup, width: float, subrays: int | None) -> None:
    geometry = f160w.geometry
    scale = geometry.drizzled_scale

    def integrals(centres: np.ndarray, middle: float, side: float) -> np.ndarray:
        edges = (centres[:, None] + side * np.array([-0.5, 0.5]) - middle) / width / np.sqrt(2.0)
        return 0.5 * np.diff(erf(edges), axis=1)[:, 0]

    def means(centres: np.ndarray, middle: float) -> np.ndarray:
        if subrays is None:
            return integrals(centres, middle, scale)
        offsets = ((np.arange(subrays) + 0.5) / subrays - 0.5) * scale
        density = np.exp(-0.5 * ((centres[:, None] + offsets - middle) / width) ** 2) / width / np.sqrt(2.0 * np.pi)
        return density.mean(axis=1) * scale

    x, y = geometry.high_resolution_axes()
    light = np.outer(integrals(y, 0.11, geometry.subpixel_scale), integrals(x, 0.23, geometry.subpixel_scale))
    exact = drizzle(expose(convolve(light, f160w.psf), geometry, f160w.kernel), geometry)
    to, of = _around(f160w, 0.6), _around(f160w, 6.0 * width + 0.2)
    px, py = geometry.drizzled_axes()
    flux = np.outer(means(py, 0.11), means(px, 0.23))[of]
    response = ExposedOptics(f160w.psf, geometry, f160w.kernel)
    found = response.blurring_matrix(to, of, subrays, 60) @ flux
    # Division by the transfer function of the rays, where the optics have any: 1e-4 of the peak is left.
    assert np.abs(found - exact[to]).max() < 2e-4 * exact.max()


def test_the_exact_image_of_the_host_is_the_simulated_arc(simulated: Simulation) -> None:
    scene = simulated.scene
    image = simulated.observation.optics.sersic_image(scene.host, scene.lens)
    # The same light on the same sub-pixels through the same drizzle.
    assert np.abs(image - simulated.arc).max() < 1e-6 * simulated.arc.max()


def test_the_image_through_a_stamp_has_the_flux_of_the_profile(simulated: Simulation) -> None:
    observation = simulated.observation
    stamped = type(observation)(
        observation.image, observation.noise, observation.psf / observation.psf.sum(), observation.pixel_scale,
        observation.zero_point,
    )  # fmt: skip
    realization = Realization(system="HE0435", l_eta=1.0, host=Host(n=1.0, r_eff=0.2, magnitude=21.0))
    host = build_scene(realization).host
    image = stamped.optics.sersic_image(host)
    # An exponential of 0.2 arcsec lies within the image, but for the wings of its PSF: 0.4 %.
    assert 0.99 * host.flux < image.sum() < host.flux
