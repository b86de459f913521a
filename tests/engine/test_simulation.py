"""The eight systems simulated: both noise levels, every step kept, the same bits again; and pictures of them."""

import io
import itertools
from dataclasses import replace

import numpy as np
import pytest

from engine import Grid, Host, Realization, expand, simulate_realization, system_names
from engine.catalogue import load_camera
from engine.figures import gallery_figure, montage_figure, simulation_figure
from engine.figures.sky import stretch, stretch_ticks
from engine.simulation.seeds import generator
from engine.simulation.simulate import Simulation

LEVELS = ("author", "handbook")
ALL = [(name, "author") for name in system_names()]
BOTH = [("HE0435", "handbook"), ("HE0047", "handbook")]
"""One camera that has a noise of the author's and one that has not, at the other level."""


@pytest.fixture(scope="session")
def simulations() -> dict[tuple[str, str], Simulation]:
    """Run 17 of each system (n = 2, the smaller R_eff, the second brightest host, l_eta = 1)."""
    found = {}
    for name, level in ALL + BOTH:
        spec = expand(Grid(preset=f"h0licow-vi/{name}", noise_level=level))[16].realization
        found[name, level] = simulate_realization(spec)
    return found


@pytest.mark.parametrize(("name", "level"), ALL + BOTH)
def test_every_system_simulates_at_both_noise_levels_and_says_which_was_used(simulations, name, level):
    simulation = simulations[name, level]
    observation, scene = simulation.observation, simulation.scene
    assert observation.shape == (scene.system.exposures.field_pixels,) * 2
    assert observation.valid.all()
    record = observation.provenance
    used = "handbook" if load_camera(scene.system.camera).noise_author is None else level
    assert (record["NOISEREQ"], record["NOISE"]) == (level, used)
    # The light is there, on top of the deflector and beside the AGN: the field holds the wings to some per cent.
    light = sum(source.flux for source in scene.agn) + (scene.deflector.flux if scene.deflector else 0.0)
    assert 0.6 * light < observation.image.sum() < light + 1.5 * simulation.high_resolution_arc.sum()
    assert simulation.high_resolution_arc.sum() > scene.host.flux


def test_the_two_noise_levels_differ_where_the_camera_has_both(simulations):
    for name, _ in BOTH:
        author, handbook = (simulations[name, level].observation.noise for level in LEVELS)
        if load_camera(simulations[name, "author"].scene.system.camera).noise_author is None:
            np.testing.assert_array_equal(author, handbook)
        else:
            assert np.median(author) != pytest.approx(np.median(handbook), rel=0.05)


def test_agn_stand_at_the_brightest_pixels_of_the_picture(simulations):
    # The core of each AGN is brighter than its deflector and its host, in all eight systems but at RXJ1131's faint D.
    for name in system_names():
        observation, scene = simulations[name, "author"].observation, simulations[name, "author"].scene
        ny, nx = observation.shape
        for source in scene.agn:
            row, column = (
                round(source.y / observation.pixel_scale + (ny - 1) / 2),
                round(source.x / observation.pixel_scale + (nx - 1) / 2),
            )
            window = observation.image[row - 2 : row + 3, column - 2 : column + 3]
            assert window.max() == observation.image[row - 1 : row + 2, column - 1 : column + 2].max(), (
                name,
                source.name,
            )


def test_the_same_realization_gives_the_same_bits_and_another_seed_other_noise_alone():
    host = Host(n=2.0, r_eff=0.39, magnitude=21.0)
    spec = Realization(system="HE0435", l_eta=1.0, host=host, seed=5)
    first, again = simulate_realization(spec), simulate_realization(spec)
    other = simulate_realization(replace(spec, seed=6))
    assert first.observation.image.tobytes() == again.observation.image.tobytes()
    np.testing.assert_array_equal(first.exposures.noiseless, other.exposures.noiseless)
    assert np.abs(first.exposures.noisy - other.exposures.noisy).max() > 0
    assert generator(spec, 0).integers(2**62) != generator(spec, 1).integers(2**62)


def test_every_step_of_the_simulation_is_kept_and_leads_to_the_next(simulations):
    from engine.imaging.drizzling import drizzle
    from engine.imaging.exposures import expose
    from engine.imaging.psf import detector_kernel

    simulation = simulations["HE0435", "author"]
    exposures, geometry = simulation.exposures, simulation.exposures.geometry
    kernel = detector_kernel(simulation.scene.camera)
    np.testing.assert_array_equal(expose(simulation.high_resolution_image, geometry, kernel), exposures.noiseless)
    np.testing.assert_array_equal(drizzle(exposures.noisy, geometry), simulation.observation.image)
    assert simulation.high_resolution_arc.shape == geometry.high_resolution_shape
    assert simulation.arc.shape == simulation.observation.shape


def png_size(figure) -> tuple[int, int]:
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=60)
    return Image.open(buffer).size


def overlapping_texts(figure) -> list[tuple[str, str]]:
    """Pairs of texts whose boxes overlap when the figure is drawn."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = []
    for text in figure.findobj(Text):
        box = text.get_window_extent(canvas.get_renderer())
        if text.get_visible() and text.get_text().strip() and box.width > 0:
            boxes.append((text.get_text(), box))
    return [(one, other) for (one, a), (other, b) in itertools.combinations(boxes, 2) if a.padded(-0.5).overlaps(b)]


def test_the_picture_of_a_simulation_has_six_panels_one_stretch_and_labels_that_do_not_overlap(simulations):
    for name in ("HE0435", "RXJ1131"):
        figure = simulation_figure(simulations[name, "author"])
        panels = [axes for axes in figure.axes if axes.images]
        assert len(panels) == 6
        assert len({axes.images[0].norm for axes in panels}) == 1
        assert len({axes.get_xlim() for axes in panels}) == 1
        assert overlapping_texts(figure) == []
    assert png_size(figure) > (500, 300)


def test_a_montage_has_a_panel_for_each_of_the_48_runs(simulations):
    runs = expand(Grid(preset="h0licow-vi/HE0435"))
    observation = simulations["HE0435", "author"].observation
    figure = montage_figure(runs, [observation] * 48)
    assert sum(bool(axes.images) for axes in figure.axes) == 48
    assert overlapping_texts(figure) == []
    with pytest.raises(ValueError, match="12 to a magnitude"):
        montage_figure(runs[:5], [observation] * 5)


def test_the_gallery_shows_the_eight_systems_and_their_hosts_alone(simulations):
    chosen = [simulations[name, "author"] for name in system_names()]
    figure = gallery_figure(chosen)
    assert sum(bool(axes.images) for axes in figure.axes) == 16
    assert overlapping_texts(figure) == []
    assert sum(bool(axes.images) for axes in gallery_figure(chosen[:3]).axes) == 6


def test_a_stretch_is_ticked_at_zero_and_powers_of_ten():
    norm = stretch(0.02, 500.0)
    assert stretch_ticks(norm) == [0.0, 0.1, 1.0, 10.0, 100.0]
    assert norm.vmin < 0
