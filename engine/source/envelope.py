"""The brightness that is expected of the source, to which the regularisation is relative."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from engine.compiled import kernel
from engine.conventions import FloatArray
from engine.lensing.power_law import PowerLawLens
from engine.light.cell_means import profile_on_grid
from engine.light.radial_table import look_up, tabulate
from engine.light.sersic import (
    SersicConstants,
    SersicProfile,
    sersic_constants,
    sersic_k,
    sersic_normalisation,
)
from engine.source.grid import SourceGrid


@dataclass(frozen=True)
class PlacedEnvelope:
    """An envelope in the source plane of one lens: a profile that is one at r_eff, its radial table, a floor."""

    profile: SersicProfile
    table: FloatArray
    floor: float

    def on_cells(self, grid: SourceGrid) -> FloatArray:
        """Its mean (ny nx,) over the cells round the nodes, that of the cusp's cell to a hundredth of itself."""
        return profile_on_grid(self.profile, grid.x_edges, grid.y_edges) + self.floor

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Its value (k,) at points of the source plane [arcsec], to 2e-7 of the centre."""
        return np.asarray(_envelope_at(x, y, sersic_constants(self.profile), self.table, self.floor))


@dataclass(frozen=True)
class Envelope:
    """The brightness that is expected of the source: a Sersic profile plus a floor, both in units of that at r_eff.

    The source is modelled as this times a smooth function t, so that the regularisation asks for smoothness relative
    to the expected run of the brightness and not of the brightness itself (cf. Nightingale et al. 2018, section 3.4,
    who adapt its strength). ``profile`` was found behind ``lens``; behind another its position and size go with the
    source grid: it keeps its distance from the mean of the mapped anchors, and a lens that magnifies less, hence has a
    larger grid, gets a larger envelope. What the envelope tells of the lens is then only its shape. ``x``, ``y`` of the
    profile count from there; behind ``lens`` the anchors lie at ``anchor`` and the grid has a side of ``size``.
    """

    profile: SersicProfile
    floor: float
    size: float
    lens: PowerLawLens
    anchor: tuple[float, float]

    @cached_property
    def _table(self) -> FloatArray:
        table = tabulate(replace(self.profile, r_eff=1.0))
        return np.asarray(table / (sersic_normalisation(self.profile.n, 1.0) * math.exp(-sersic_k(self.profile.n))))

    @property
    def host(self) -> SersicProfile:
        """The profile where it lies behind ``lens``, with the flux at which it is one at r_eff."""
        p = self.profile
        return _one_at_r_eff(replace(p, x=self.anchor[0] + p.x, y=self.anchor[1] + p.y))

    def placed(self, x: float, y: float, size: float) -> PlacedEnvelope:
        """The envelope about anchors at (x, y) [arcsec] on a grid of side ``size`` [arcsec]."""
        stretch = size / self.size
        p = self.profile
        moved = replace(p, r_eff=p.r_eff * stretch, x=x + p.x * stretch, y=y + p.y * stretch)
        return PlacedEnvelope(_one_at_r_eff(moved), self._table, self.floor)


def _one_at_r_eff(profile: SersicProfile) -> SersicProfile:
    """The profile with the flux at which its brightness at r_eff is one."""
    bright = sersic_normalisation(profile.n, profile.r_eff) * math.exp(-sersic_k(profile.n))
    return replace(profile, flux=1.0 / bright)


@kernel
def _envelope_at(bx: FloatArray, by: FloatArray, light: SersicConstants, table: FloatArray, floor: float) -> FloatArray:
    """Value of the envelope (k,) at points (k,) [arcsec] of the source plane, from its radial ``table`` (bins, 4)."""
    out = np.empty(bx.size)
    for i in range(bx.size):
        dx, dy = bx[i] - light.x, by[i] - light.y
        u, v = light.cos * dx + light.sin * dy, light.cos * dy - light.sin * dx
        out[i] = floor + look_up((light.q * u * u + v * v / light.q) * light.inverse_r2, table)
    return out
