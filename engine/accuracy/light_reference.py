"""Pixel fluxes of Sersic profiles, made in other ways than the engine's: slow, and good to 1e-6 of the peak.

Without a lens the flux of a pixel is the flow of a vector field through its four sides (Gauss's theorem), which holds
no cusp. With one, the cusps are where the lens equation puts them, and the mesh is graded towards them beforehand, by
distance alone; no estimate of an error takes part. Uniform supersampling is the third way, where neither is trusted.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gamma, gammainc

from engine.conventions import FloatArray
from engine.lensing.lens_equation import solve_lens_equation
from engine.lensing.power_law import PowerLawLens, source_position
from engine.light.sersic import SersicProfile, sersic_k, surface_brightness


def flux_through_the_sides(profile: SersicProfile, x: FloatArray, y: FloatArray, h: float) -> FloatArray:
    """Unlensed pixel fluxes: f(R) is the divergence of X H(R) with H = R^-2 int_0^R f(r) r dr, X from the centre."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    # Panels that halve towards the middle and the ends of a half-side: the integrand is roughest nearest the cusp.
    graded = np.concatenate([[0.0], 0.5 ** np.arange(20, 0, -1)])

    def panels(a: float, b: float, centre: float) -> tuple[FloatArray, FloatArray]:
        """Nodes and weights on [a, b], graded towards the point nearest ``centre``."""
        foot = min(max(centre, a), b)
        edges = np.unique(np.concatenate([foot + (b - foot) * 2 * graded, foot + (a - foot) * 2 * graded]))
        edges = edges[(edges >= a) & (edges <= b)]
        half, middle = 0.5 * np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
        return (middle[:, None] + half[:, None] * nodes).ravel(), (half[:, None] * weights).ravel()

    k, n, p = sersic_k(profile.n), profile.n, profile
    c, s = np.cos(p.phi), np.sin(p.phi)

    def field(dx: FloatArray, dy: FloatArray) -> FloatArray:
        u, v = c * dx + s * dy, c * dy - s * dx
        r2 = p.q * u**2 + v**2 / p.q
        with np.errstate(divide="ignore", invalid="ignore"):
            h_of_r = p.flux / (2 * np.pi) * gammainc(2 * n, k * (r2 / p.r_eff**2) ** (0.5 / n)) / r2
        central = p.flux * k ** (2 * n) / (4 * np.pi * n * p.r_eff**2 * gamma(2 * n))
        return np.asarray(np.where(r2 > 0, h_of_r, central))

    out = np.zeros((y.size, x.size))
    edges_x, edges_y = np.append(x - h / 2, x[-1] + h / 2) - p.x, np.append(y - h / 2, y[-1] + h / 2) - p.y
    for i in range(x.size):
        t, w = panels(edges_x[i], edges_x[i + 1], 0.0)
        flow = np.array([(field(t, np.full_like(t, e)) * e * w).sum() for e in edges_y])
        out[:, i] += np.diff(flow)
    for j in range(y.size):
        t, w = panels(edges_y[j], edges_y[j + 1], 0.0)
        flow = np.array([(field(np.full_like(t, e), t) * e * w).sum() for e in edges_x])
        out[j] += np.diff(flow)
    return out


def graded_fluxes(
    profile: SersicProfile,
    x: FloatArray,
    y: FloatArray,
    h: float,
    lens: PowerLawLens | None = None,
    cusps: FloatArray | None = None,
    reach: float = 4.0,
    order: int = 14,
) -> FloatArray:
    """Pixel fluxes by Gauss-Legendre on cells no larger than their distance from a cusp / ``reach``.

    ``cusps`` (n, 2) are the image positions of the profile's centre, by default all that the lens equation has.
    """
    if lens is None:
        singular = np.array([[profile.x, profile.y]])
    else:
        if cusps is None:
            cusps = np.array([(image.x, image.y) for image in solve_lens_equation(lens, profile.x, profile.y)])
        singular = np.vstack([cusps, [[lens.x, lens.y]]])
    nodes, weights = np.polynomial.legendre.leggauss(order)
    nx, ny = (0.5 * g.ravel() for g in np.meshgrid(nodes, nodes))
    nw = 0.25 * np.outer(weights, weights).ravel()
    cx, cy = (g.ravel() for g in np.meshgrid(x, y))
    owner = np.arange(cx.size)
    out = np.zeros(cx.size)
    for depth in range(36):
        side = h * 0.5**depth
        distance = np.min([np.maximum(np.abs(cx - sx), np.abs(cy - sy)) for sx, sy in singular], axis=0, initial=np.inf)
        near = (distance < (reach + 0.5) * side) & (depth < 35)
        for part in np.array_split(np.flatnonzero(~near), 1 + cx.size // 4000):
            bx, by = np.add.outer(cx[part], side * nx), np.add.outer(cy[part], side * ny)
            if lens is not None:
                bx, by = source_position(lens, bx, by)
            flux = surface_brightness(profile, bx, by) @ nw * side**2
            out += np.bincount(owner[part], weights=flux, minlength=out.size)
        quarter = 0.25 * side
        cx = np.add.outer(cx[near], quarter * np.array([-1, 1, -1, 1])).ravel()
        cy = np.add.outer(cy[near], quarter * np.array([-1, -1, 1, 1])).ravel()
        owner = np.repeat(owner[near], 4)
        if not cx.size:
            break
    return out.reshape(y.size, x.size)


def supersampled(
    profile: SersicProfile, x: FloatArray, y: FloatArray, h: float, n: int, lens: PowerLawLens | None = None
) -> FloatArray:
    """The plain mean over n x n points a pixel."""
    offset = ((np.arange(n) + 0.5) / n - 0.5) * h
    out = np.zeros((y.size, x.size))
    for dy in offset:
        px, py = np.meshgrid(np.add.outer(x, offset).ravel(), y + dy)
        if lens is not None:
            px, py = source_position(lens, px, py)
        out += surface_brightness(profile, px, py).reshape(y.size, x.size, n).sum(axis=2)
    return out * (h / n) ** 2
