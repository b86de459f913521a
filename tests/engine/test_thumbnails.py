"""A grid's runs as thumbnails: each picture where it belongs, upright, and the runs that have none."""

import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from engine import (
    FigureError,
)
from engine.figures import (
    Pictures,
    Thumbnail,
    figure_bytes,
    grid_figure,
)
from tests.engine.bias_records import (
    texts,
)


def _pictures(peak=1.0, edges=None) -> Pictures:
    image = np.zeros((21, 21))
    image[17, 10] = 9.0  # North of the centre
    source = np.full((4, 4), 0.1)
    source[3, 2] = 5.0
    edges = np.array([-1.0, -0.9, 0.0, 0.5, 1.0]) if edges is None else edges
    mask = np.hypot(*(np.mgrid[:21, :21] - 10.0)) < 8.0
    return Pictures(peak * image, np.where(mask, image, np.nan), 0.1, source, edges, edges)


def test_the_montage_has_three_pictures_a_run_and_says_which_have_none():
    runs = [Thumbnail(f"HE0435/{k:02d}", f"{0.01 * k:+.2f} mag", _pictures()) for k in range(6)]
    runs.append(Thumbnail("HE0435/06", "failed", None))
    figure = grid_figure(runs, heading="My grid")
    axes = figure.axes[0]
    assert len(axes.images) == 12
    assert len(axes.collections) == 6
    # Both pictures are cut to the mask's surroundings: 8 pixels and a margin.
    assert all(image.get_array().shape == (19, 19) for image in axes.images)
    np.testing.assert_array_equal(axes.images[0].get_array(), runs[0].pictures.observation[1:20, 1:20])
    np.testing.assert_array_equal(axes.collections[0].get_array(), runs[0].pictures.source)
    assert {"My grid", "7 runs: observation, model, source", "HE0435/03", "+0.03 mag", "failed"} <= set(texts(figure))


def test_in_the_montage_north_is_up():
    figure = grid_figure([Thumbnail("a", "", _pictures(edges=np.linspace(-1.0, 1.0, 5)))])
    shown = imread(io.BytesIO(figure_bytes(figure, "png", dpi=100)))[..., 0]
    axes = figure.axes[0]
    for left in (0.0, 1.0, 2.0):  # the bright pixel, white in red light, is in the upper half of each picture
        ends = axes.transData.transform([(left + 0.02, 1.29), (left + 0.95, 0.36)]) * 100 / figure.dpi
        (x0, y0), (x1, y1) = np.round(ends).astype(int)
        rows = shown[shown.shape[0] - y1 : shown.shape[0] - y0, x0:x1]
        bright = np.argwhere(rows > 0.97).mean(axis=0)
        assert bright[0] < 0.45 * rows.shape[0]


def test_a_montage_refuses_what_it_cannot_hold():
    empty = replace(_pictures(), model=np.full((21, 21), np.nan))
    flat = replace(_pictures(), source_x_edges=np.zeros(5), source_y_edges=np.zeros(5))
    for runs, words in (
        ([Thumbnail("a", "", None)] * 401, "runs: got 401, allowed are 400"),
        ([Thumbnail("a", "", empty)], "a: got a model without a finite pixel"),
        ([Thumbnail("a", "", flat)], "source edges: got a width of 0.0"),
    ):
        with pytest.raises(FigureError, match=words):
            grid_figure(runs)
