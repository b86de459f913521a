"""Records of biases that are made up, figures of them, and what such a figure shows."""

import itertools
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np

from engine import (
    BiasPoint,
    coverage_curve,
    group_points,
    pull_summary,
    trend_series,
)
from engine.biases import TRENDS
from engine.figures import (
    bias_figure,
    coverage_figure,
    figure_bytes,
    pull_figure,
    sample_figure,
    trend_figure,
)
from engine.result import Quantity

MAGNITUDES = (21.0, 21.5, 22.0, 22.5)
SLOPES, RADII, INDICES = (0.8, 1.0, 1.2), (0.39, 0.78), (2.0, 4.0)


def point(bias=0.1, sd=0.05, **changes) -> BiasPoint:
    """A point whose magnitude, radius and index are off by ``bias``, a tenth and twice of it."""
    given = {
        "run_id": "r1", "system": "HE1104", "configuration": "double", "n": 2.0, "r_eff": 0.39, "magnitude": 21.0,
        "l_eta": 1.0, "seed": 0, "estimator": "paper", "index_prior": "free", "arc_magnitude": 19.0,
        "agn_contrast": -2.0, "surface_brightness": 21.0, **changes,
    }  # fmt: skip
    fixed = given["index_prior"] == "fixed"
    recovered = {
        "magnitude": Quantity(given["magnitude"] + bias, sd, given["magnitude"]),
        "r_eff": Quantity(given["r_eff"] + 0.1 * bias, 0.1 * sd, given["r_eff"]),
        "n": Quantity(given["n"] + (0.0 if fixed else 2.0 * bias), 0.0 if fixed else 2.0 * sd, given["n"]),
    }
    return BiasPoint(recovered=recovered, **given)


def paper_grid(priors=("free", "fixed"), seeds=1) -> list[BiasPoint]:
    """A system's 48 inputs with biases drawn once and for all."""
    rng = np.random.default_rng(4)
    return [
        point(
            float(rng.normal(0.2, 0.2)), 0.05, run_id=f"r{number}s{seed}", magnitude=m, l_eta=slope, r_eff=r, n=n,
            index_prior=prior, seed=seed, arc_magnitude=m - 2.0,
        )
        for number, (m, slope, r, n) in enumerate(itertools.product(MAGNITUDES, SLOPES, RADII, INDICES))
        for seed in range(seeds)
        for prior in priors
    ]  # fmt: skip


def sample() -> list[BiasPoint]:
    rng = np.random.default_rng(8)
    return [
        point(
            float(rng.normal(0.0, 0.3)), 0.1, run_id=f"{name}{m}{prior}", system=name, configuration=configuration,
            magnitude=m, index_prior=prior, arc_magnitude=m - shift, agn_contrast=contrast and contrast - m,
            surface_brightness=m + 0.3 * shift,
        )
        for name, configuration, shift, contrast in (
            ("HE0435", "quad", 2.0, 18.0), ("HE1104", "double", 1.5, 17.0), ("HE0047", "double", 1.0, 17.0),
            ("bare", "quad", 1.2, None),
        )
        for m in MAGNITUDES
        for prior in ("wide", "free", "fixed")
    ]  # fmt: skip


def lines(axes) -> dict:
    return {line.get_gid(): line for line in axes.lines if line.get_gid()}


def bars(axes) -> dict:
    """Half-lengths of the error bars of each named series."""
    return {
        container.lines[0].get_gid(): np.array([np.ptp(s[:, 1]) / 2 for s in container.lines[2][0].get_segments()])
        for container in axes.containers
    }


def bands(axes) -> dict:
    spans = [patch for patch in axes.patches if (patch.get_gid() or "").startswith("band-")]
    return {
        patch.get_gid(): (patch.get_y(), patch.get_y() + patch.get_height(), patch.get_facecolor()) for patch in spans
    }


def texts(figure) -> list[str]:
    root = ET.fromstring(figure_bytes(figure, "svg"))  # noqa: S314 - our own
    return ["".join(node.itertext()) for node in root.iter("{http://www.w3.org/2000/svg}text")]


def figures(columns=2):
    """Every figure of biases, with a long name, for a page or for a phone (one column)."""
    points, long = paper_grid(("wide", "free", "fixed"), seeds=2), "A grid of a name that is long enough for two lines"
    image = [replace(p, estimator="image", index_prior="wide") for p in paper_grid(("wide",))]
    groups = group_points(points, "index_prior").items()
    trends = [trend_series(k, v, "magnitude", against) for against in TRENDS for k, v in groups]
    yield bias_figure(points, heading=long, columns=columns)
    yield sample_figure(points, heading=long, columns=columns)
    yield coverage_figure([coverage_curve(k, v, "magnitude") for k, v in groups], "magnitude", heading=long)
    yield pull_figure([pull_summary(k, v, "magnitude") for k, v in groups], "magnitude", heading=long, columns=columns)
    yield trend_figure(trends, heading=long, columns=columns)
    yield bias_figure(image, heading=long, columns=columns)
