"""Exposures of cuspy profiles: as from sub-pixels three times finer, with every cusp where it is."""

from dataclasses import replace

import numpy as np
import pytest

from engine.catalogue import load_camera, load_dither
from engine.imaging.convolution import convolve
from engine.imaging.cusps import place_cusps
from engine.imaging.exposures import expose
from engine.imaging.geometry import exposure_geometry
from engine.imaging.psf import detector_kernel, telescope_psf
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens
from engine.light.rendering import render_sersic
from engine.light.sersic import SersicProfile

CAMERA = load_camera("WFC3-IR_F160W")
LENS = PowerLawLens(1.2, 0.8, 0.4, 2.0)


def exposures(profile, lens, factor, *, placed):
    geometry = exposure_geometry(CAMERA, load_dither("eight_point_quarter_pixel"), (49, 49), oversampling=4 * factor)
    x, y = geometry.high_resolution_axes()
    light = render_sersic(profile, x, y, geometry.subpixel_scale, lens)
    cusps = [(profile.x, profile.y)]
    if lens is not None:
        cusps = [(image.x, image.y) for image in solve_lens_equation(lens, profile.x, profile.y)]
    if placed:
        light = place_cusps(light, profile, cusps, geometry, lens)
    psf = telescope_psf(CAMERA, oversampling=geometry.oversampling, field_of_view=4.0, pupil_pixels=256)
    return expose(convolve(light, psf), geometry, detector_kernel(CAMERA))


@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize(("n", "r_eff"), [(4.0, 0.3), (4.0, 0.05), (2.0, 0.1)])
def test_exposures_do_not_depend_on_the_sub_pixels(n, r_eff, lens):
    profile = SersicProfile(1.0, r_eff, n, 0.7, 0.5, 0.043, -0.027)
    fine = exposures(profile, lens, 3, placed=True)
    assert np.abs(exposures(profile, lens, 1, placed=True) - fine).max() < 5e-4 * fine.max()
    # The reference is another way where sub-pixels are small: nothing placed, and still closer to it than at first.
    plain = np.abs(exposures(profile, lens, 3, placed=False) - fine).max()
    assert plain < 2e-3 * fine.max()
    assert plain < 0.5 * np.abs(exposures(profile, lens, 1, placed=False) - fine).max()


def test_placing_keeps_the_flux_and_leaves_smooth_light_alone():
    geometry = exposure_geometry(CAMERA, load_dither("eight_point_quarter_pixel"), (49, 49))
    x, y = geometry.high_resolution_axes()
    wide = SersicProfile(1.0, 0.8, 0.5, 0.8, 0.3, 0.11, 0.07)
    light = render_sersic(wide, x, y, geometry.subpixel_scale)
    placed = place_cusps(light, wide, [(wide.x, wide.y)], geometry)
    # A Gaussian of 20 sub-pixels: what differs is the renderer, to its tolerance of 1e-4 on both.
    np.testing.assert_allclose(placed, light, rtol=0, atol=3e-4 * light.max())
    sharp = replace(wide, n=4.0, r_eff=0.3)
    light = render_sersic(sharp, x, y, geometry.subpixel_scale)
    assert place_cusps(light, sharp, [(sharp.x, sharp.y)], geometry).sum() == pytest.approx(light.sum(), rel=1e-5)


def test_cusps_that_overlap_or_leave_the_grid_keep_the_flux():
    geometry = exposure_geometry(CAMERA, load_dither("eight_point_quarter_pixel"), (29, 29))
    x, y = geometry.high_resolution_axes()
    profile = SersicProfile(1.0, 0.2, 4.0, 0.8, 0.3, 0.01, 0.02)
    light = render_sersic(profile, x, y, geometry.subpixel_scale)
    once = place_cusps(light, profile, [(0.01, 0.02)], geometry)
    np.testing.assert_array_equal(place_cusps(light, profile, [(0.01, 0.02), (99.0, 0.0)], geometry), once)
    several = [(0.01, 0.02), (0.15, 0.0), (x[-1], y[-1])]
    assert place_cusps(light, profile, several, geometry).sum() == pytest.approx(light.sum(), rel=1e-5)
