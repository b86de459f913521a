"""The matrices of an inversion made otherwise than the engine's: L from scipy's 2F1 and hats, H from differences.

The engine sums a series, walks through its cells and keeps sparse rows; here every ray meets every node.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import hyp2f1

from engine.lensing.power_law import PowerLawLens
from engine.source.lensing_matrix import RayBundle
from engine.source.regularisation import SourceModel


def traced(lens: PowerLawLens, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Source positions of image positions, by Tessore & Metcalf (2015), eq. 13; the centre is not deflected."""
    t, turn = lens.slope - 1.0, np.exp(1j * lens.phi)
    inside = (x - lens.x + 1j * (y - lens.y)) / turn
    elliptical = lens.q * inside.real + 1j * inside.imag
    radius = np.abs(elliptical)
    safe = np.where(radius > 0.0, radius, 1.0)
    phase = elliptical / safe
    flattening = (1.0 - lens.q) / (1.0 + lens.q)
    b = lens.theta_E * np.sqrt(lens.q)
    alpha = 2.0 * b / (1.0 + lens.q) * (b / safe) ** (t - 1.0) * phase
    alpha = alpha * hyp2f1(1.0, t / 2.0, 2.0 - t / 2.0, -flattening * phase**2) * turn
    beta = x + 1j * y - alpha - (lens.gamma1 + 1j * lens.gamma2) * (x - 1j * y)
    return beta.real, beta.imag


def hats(nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Piecewise linear (values, nodes): one at a node, zero at its neighbours, ghosts a quarter of a cell beyond."""
    low, high = nodes[0] - 0.25 * (nodes[1] - nodes[0]), nodes[-1] + 0.25 * (nodes[-1] - nodes[-2])
    ghosts = np.concatenate([[low], nodes, [high]])
    rising = (values[..., None] - ghosts[:-2]) / np.diff(ghosts)[:-1]
    falling = (ghosts[2:] - values[..., None]) / np.diff(ghosts)[1:]
    return np.clip(np.minimum(rising, falling), 0.0, None)


def nodes_round(values: np.ndarray, number: int) -> np.ndarray:
    """Nodes from the least to the largest value."""
    return values.min() + (values.max() - values.min()) * np.arange(number) / (number - 1)


def lensing_matrix(
    rays: RayBundle, lens: PowerLawLens, shape: tuple[int, int], envelope: Callable[..., np.ndarray] | None = None
) -> np.ndarray:
    """L (P, ny nx): the light of each pixel with rays in terms of the source's nodes (ratios to an envelope)."""
    per_pixel = rays.subrays**2
    x, y = (values.reshape(-1, per_pixel) for values in traced(lens, rays.x, rays.y))
    columns, rows = nodes_round(x[rays.in_mask], shape[1]), nodes_round(y[rays.in_mask], shape[0])
    light = np.ones(x.shape)
    if envelope is not None:
        # Beyond the grid the source goes on as its envelope does.
        light = envelope(x, y)
        x, y = np.clip(x, columns[0], columns[-1]), np.clip(y, rows[0], rows[-1])
    across, up = hats(columns, x), hats(rows, y) * light[..., None]
    return np.einsum("pri,prj->pij", up, across).reshape(x.shape[0], -1) * rays.pixel_area / per_pixel


def regularisation(model: SourceModel) -> np.ndarray:
    """H from its definition."""
    ny, nx = model.shape
    if model.regularisation == "zeroth":
        return np.eye(ny * nx)

    def second(n: int) -> np.ndarray:
        return 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)

    tx, ty = second(nx), second(ny)
    if model.regularisation == "curvature":
        tx, ty = tx @ tx, ty @ ty
    return np.asarray(np.kron(np.eye(ny), tx) + np.kron(ty, np.eye(nx)))
