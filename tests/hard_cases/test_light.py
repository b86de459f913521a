"""Light: profiles much smaller than a pixel, cusps, and hosts on caustics."""

import numpy as np
import pytest

from engine import Host, Realization
from engine.accuracy.light_reference import flux_through_the_sides, graded_fluxes, supersampled
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import DEFAULT_TOLERANCE, render_sersic
from engine.light.sersic import SersicProfile
from engine.simulation.scene import build_scene
from tests.engine.light_oracle import GRID, HE0435, assert_as_promised, fold


@pytest.mark.parametrize("centre", [(0.0, 0.0), (0.05, 0.05), (0.05, 0.0), (0.013, 0.021)], ids=str)
@pytest.mark.parametrize("r_eff", [0.01, 0.05, 0.39])
@pytest.mark.parametrize("n", [0.5, 1.0, 4.0, 8.0])
def test_the_cusp_may_lie_on_the_centre_corner_or_side_of_a_pixel(
    n: float, r_eff: float, centre: tuple[float, float]
) -> None:
    """Indices of 0.5 to 8 and half-light radii of a tenth to four pixels, the cusp on a pixel's centre, corner or side.

    Could go wrong: the brightest point falls between the points of a quadrature. Holds: the worst pixel is right to
    the tolerance of the peak, against the flow of a field through the pixel's sides, which holds no cusp.
    """
    profile = SersicProfile(3.0, r_eff, n, 0.6, 0.4, *centre)
    x, y = (np.arange(19) - 9) * 0.1, (np.arange(15) - 7) * 0.1
    assert_as_promised(render_sersic(profile, x, y, 0.1), flux_through_the_sides(profile, x, y, 0.1))


@pytest.mark.parametrize("n", [1.0, 4.0, 8.0])
def test_a_profile_of_a_tenth_of_a_pixel_keeps_its_flux(n: float) -> None:
    """A host of R_eff of a tenth of a pixel.

    Could go wrong: all its light lies between the samples. Holds: the total is kept to 1e-4 for n = 1, and to what
    lies beyond the image for n = 4 and 8.
    """
    profile = SersicProfile(3.0, 0.01, n, 1.0, 0.0, 0.013, 0.021)
    x = (np.arange(61) - 30) * 0.1
    total = render_sersic(profile, x, x, 0.1).sum()
    # n = 4 has 0.07 % of its light beyond 300 half-light radii, outside the image, n = 8 has 1.4 %.
    assert total == pytest.approx(3.0, rel={1.0: 1e-4, 4.0: 1e-3, 8.0: 2e-2}[n])


@pytest.mark.parametrize("where", ["fold", "cusp"])
@pytest.mark.parametrize(("n", "subpixels"), [(0.5, 250), (1.0, 250), (4.0, 1000)])
def test_a_host_on_the_caustic(n: float, subpixels: int, where: str) -> None:
    """A host whose centre stands on a fold or a cusp of the caustic.

    Could go wrong: images of the cusp of its profile merge where no adaptive mesh is good. Holds: the worst pixel
    is right to the tolerance of the peak, against brute force of a million points a pixel.
    """
    # Two or three images merge on the critical curve, where no mesh graded in the image is good: there by brute force,
    # which 1000 points leave 4e-5 of the peak for n = 4.
    point, source = fold(HE0435, 1.29 + (0.6 if where == "fold" else 0.0))
    profile = SersicProfile(10.0, 0.39, n, 0.7, 0.3, *source)
    others = [image for image in solve_lens_equation(HE0435, *source) if abs(image.magnification) < 1e4]
    cusps = np.array([point, *((image.x, image.y) for image in others)])
    i, j = int(np.abs(GRID - point[0]).argmin()), int(np.abs(GRID - point[1]).argmin())
    x, y = GRID[i - 9 : i + 10], GRID[j - 4 : j + 5]
    ours = render_sersic(profile, x, y, 0.08, HE0435)
    reference = graded_fluxes(profile, x, y, 0.08, HE0435, cusps, reach=6.0, order=24)
    reference[3:6, 4:15] = supersampled(profile, x[4:15], y[3:6], 0.08, subpixels, HE0435)
    assert_as_promised(ours, reference)


@pytest.mark.parametrize(("n", "r_eff"), [(1.0, 0.05), (4.0, 0.37)])
def test_the_host_of_sdss1206_reaches_over_its_caustic(n: float, r_eff: float) -> None:
    """The host of SDSS1206: its centre has two images, most of it four.

    Could go wrong: it is cut along the caustic. Holds: the worst pixel is right to the tolerance of the peak.
    """
    # Its centre has two images, most of it four.
    scene = build_scene(Realization(system="SDSS1206", l_eta=1.0, host=Host(n=n, r_eff=r_eff, magnitude=20.5)))
    ours = render_sersic(scene.host, GRID, GRID, 0.08, scene.lens)
    assert_as_promised(ours, graded_fluxes(scene.host, GRID, GRID, 0.08, scene.lens))


def test_the_flux_of_a_small_source_is_magnified_as_the_lens_equation_says() -> None:
    """A host of a five-hundredth of a pixel, behind a lens of q = 0.85 and of 0.05.

    Could go wrong: a whole image falls between the rays. Holds: its light is that of a point magnified by the lens
    equation, to the tolerance.
    """
    # r_eff of a five-hundredth of a pixel: the magnification changes by 1e-5 across it.
    for lens, centre in ((HE0435, (0.03, 0.02)), (HE0435, (0.5, 0.2)), (PowerLawLens(0.5, 0.05, 0.4, 2.0), (0.2, 0.3))):
        profile = SersicProfile(2.0, 0.0002, 0.5, 0.8, 0.3, *centre)
        total = render_sersic(profile, GRID * 1.25, GRID * 1.25, 0.1, lens).sum()
        images = solve_lens_equation(lens, *centre)
        assert total == pytest.approx(2.0 * sum(abs(image.magnification) for image in images), rel=DEFAULT_TOLERANCE)


@pytest.mark.parametrize("slope", [1.4, 2.0, 2.8])
def test_a_lens_centre_on_a_pixel_centre_and_an_exact_ring_are_no_exceptions(slope: float) -> None:
    """A round lens whose centre is a pixel's, and a host exactly behind it: an Einstein ring.

    Could go wrong: 0/0 at the centre, a ring of infinite magnification. Holds: finite, the same in each quadrant,
    and right to 1.5e-3 of the peak against brute force.
    """
    lens = PowerLawLens(1.2, 1.0, 0.0, slope)
    profile = SersicProfile(1.0, 0.39, 1.0, 1.0, 0.0)
    ours = render_sersic(profile, GRID, GRID, 0.08, lens, tolerance=1e-3)
    assert np.isfinite(ours).all()
    # The same in each quadrant: nothing prefers a direction.
    assert np.abs(ours - ours.T).max() < 1e-3 * ours.max()
    assert np.abs(ours - ours[::-1]).max() < 1e-3 * ours.max()
    brute = supersampled(profile, GRID, GRID, 0.08, 40, lens)
    # 40 x 40 points leave 2e-4 where the ring's crest runs through.
    assert np.abs(ours - brute).max() < 1.5e-3 * ours.max()
