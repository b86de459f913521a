"""A reconstruction beside the truth that its simulation knows: the only place where the two meet."""

from __future__ import annotations

import math
from dataclasses import replace

from engine.conventions import position_angle, rate_to_magnitude
from engine.digest import engine_digest, engine_versions
from engine.estimators.summaries import galfit_radius
from engine.inspection import InversionView
from engine.light.galaxy import Light, flux_within, light_on_grid
from engine.light.sersic import mean_surface_brightness
from engine.reconstruction import Reconstruction
from engine.result import Aperture, Estimate, LensParameter, Quantity, RunResult, SourcePlane, StageTime
from engine.simulation.scene import Scene
from engine.simulation.simulate import Simulation
from engine.spec.instrument import NOMINAL_OPTICS
from engine.spec.realization import Realization
from engine.work import Work


def compare(
    found: Reconstruction,
    realization: Realization,
    truth: Simulation,
    stages: tuple[StageTime, ...] = (),
    work: Work = Work(),  # noqa: B008 - frozen
) -> RunResult:
    """The result of a run: what was found in the observation of a simulation, beside what was put into it.

    Parameters
    ----------
    found : Reconstruction
        Of ``truth.observation``.
    realization : Realization
        What was simulated.
    truth : Simulation
    stages : tuple of StageTime
        Those before the analysis.
    work : Work
        That of these stages.
    """
    scene, inversion, products = truth.scene, found.inversion, found.products
    plane = products.source_plane
    zero_point = scene.camera.zero_point
    agn_flux = sum(source.flux for source in scene.agn)
    return RunResult(
        realization_digest=realization.digest,
        engine_digest=engine_digest(),
        versions=engine_versions(),
        seed=realization.seed,
        noise_level=truth.exposures.noise.level,
        noise_treatment=found.analysis.noise_treatment,
        regularisation=found.analysis.regularisation,
        profile=None if found.analysis.max_error is not None else found.analysis.profile,
        estimates=tuple(estimate_beside(estimate, scene.host, zero_point) for estimate in found.estimates),
        aperture=None if inversion is None else _aperture_beside(inversion.aperture, scene.host, zero_point),
        lens=tuple(lens_beside(parameter, scene) for parameter in found.lens),
        chain=None if inversion is None else inversion.chain.summary,
        ln_evidence=None if inversion is None else inversion.best.ln_evidence,
        chi2=found.chi2,
        degrees_of_freedom=found.degrees_of_freedom,
        condition_number=None if inversion is None else inversion.best.condition_number,
        arc_magnitude=truth.arc_magnitude,
        agn_contrast=rate_to_magnitude(agn_flux, zero_point) - truth.arc_magnitude if agn_flux > 0 else None,
        surface_brightness=mean_surface_brightness(rate_to_magnitude(scene.host.flux, zero_point), scene.host.r_eff),
        stages=(*stages, *found.stages),
        work=work + found.work,
        warnings=(*found.warnings, *_departures(truth)),
        products=products if plane is None else replace(products, source_plane=source_beside(plane, scene.host)),
    )


def estimate_beside(found: Estimate, host: Light, zero_point: float) -> Estimate:
    """An estimate with the truth in each of its quantities; a host that is no Sersic profile has no index."""
    return replace(
        found,
        magnitude=found.magnitude.beside(rate_to_magnitude(host.flux, zero_point)),
        r_eff=found.r_eff.beside(host.r_eff),
        r_eff_galfit=found.r_eff_galfit.beside(galfit_radius(host)),
        n=found.n if host.n is None else found.n.beside(host.n),
        q=found.q.beside(host.q),
        position_angle=found.position_angle.beside(position_angle(host.phi), period=180.0),
        x=found.x.beside(host.x),
        y=found.y.beside(host.y),
    )


def lens_beside(found: LensParameter, scene: Scene) -> LensParameter:
    """A lens parameter with the truth; the regularisation strength has none."""
    if not hasattr(scene.lens, found.name):
        return found
    period = math.pi if found.name == "phi" else None
    return replace(found, value=found.value.beside(float(getattr(scene.lens, found.name)), period))


def view_beside(view: InversionView, scene: Scene) -> InversionView:
    """An inversion looked at, with the true source, and the true lens as an offset in each trace."""
    traces = []
    for trace in view.traces:
        value = lens_beside(LensParameter(trace.name, Quantity(trace.centre, trace.sd)), scene).value
        traces.append(trace if value.bias is None else replace(trace, truth=-value.bias / value.sd))
    return replace(view, source_plane=source_beside(view.source_plane, scene.host), traces=tuple(traces))


def source_beside(plane: SourcePlane, host: Light) -> SourcePlane:
    """Maps of a source with the true one, averaged over the cells of the grid."""
    true = light_on_grid(host, plane.source_x_edges, plane.source_y_edges).reshape(plane.source.shape)
    return replace(plane, source_truth=true)


def _aperture_beside(found: Aperture | None, host: Light, zero_point: float) -> Aperture | None:
    if found is None:
        return None
    true = rate_to_magnitude(flux_within(host, found.radius), zero_point)
    return replace(found, magnitude=found.magnitude.beside(true))


def _departures(truth: Simulation) -> tuple[str, ...]:
    """Warnings of what was simulated otherwise than asked for, or than the analysis takes it for."""
    noise, optics = truth.exposures.noise, truth.scene.optics
    out = []
    if noise.level != noise.requested:
        out.append(f"noise: camera has no level {noise.requested!r}, {noise.level!r} was used")
    if optics != NOMINAL_OPTICS:
        spoilt = f"{optics.defocus_nm:g} nm of defocus and {optics.jitter:g} arcsec of jitter"
        spoilt += f", {optics.colour:g} of colour" if optics.colour else ""
        spoilt += f", a residual of {optics.residual:g}" if optics.residual else ""
        spoilt += f", known on {optics.coarse} sub-pixels" if optics.coarse > 1 else ""
        out.append(f"optics: simulated with {spoilt}, analysed with the nominal PSF")
    return tuple(out)
