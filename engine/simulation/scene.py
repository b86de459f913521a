"""From a realization (sky frame, magnitudes) to a scene (image frame, count rates): the one place that converts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from engine.catalogue import load_camera, resolve_camera, resolve_dither, resolve_system
from engine.conventions import image_angle, magnitude_to_rate, sky_to_image, sky_to_image_shear
from engine.errors import LensEquationError, SpecError
from engine.lensing.lens_equation import LensedImage, solve_lens_equation
from engine.lensing.perturbers import Multipole, Perturber, Satellite
from engine.lensing.power_law import PowerLawLens, deflection
from engine.light.galaxy import Light
from engine.light.sersic import SersicProfile
from engine.simulation.host import host_light
from engine.spec.deflector import Deflector
from engine.spec.instrument import NOMINAL_OPTICS, Camera, Optics
from engine.spec.light import SersicLight
from engine.spec.realization import Realization
from engine.spec.sky import AgnImage, LensSystem, MassModel

_FAINT = 0.05
"""Magnification beside that of the faintest image that was observed below which nobody sees an image: 3.3 mag."""


@dataclass(frozen=True)
class PointSource:
    """A point source in the image: position [arcsec, image frame] and count rate [e-/s]."""

    name: str
    x: float
    y: float
    flux: float


@dataclass(frozen=True)
class Scene:
    """What stands before the telescope, in the image frame; ``deflector_more`` is its light beside one profile."""

    system: LensSystem
    camera: Camera
    lens: PowerLawLens
    host: Light
    deflector: SersicProfile | None
    agn: tuple[PointSource, ...]
    optics: Optics = NOMINAL_OPTICS
    deflector_more: tuple[SersicProfile, ...] = ()

    @property
    def host_profile(self) -> SersicProfile:
        """The host where it is a Sersic profile; a SpecError where it is none."""
        if isinstance(self.host, SersicProfile):
            return self.host
        raise SpecError("host", "no Sersic profile", "a host with an index n")


def check_system(system: LensSystem) -> None:
    """Refuse a system that cannot be simulated.

    Its camera and dither pattern must be known, and each of its mass models must make as many images of the AGN as
    ``agn`` lists (any number where it lists none); a SpecError names the field.
    """
    if isinstance(system.camera, str):
        load_camera(system.camera)
    resolve_dither(system)
    for model, by_slope in system.mass_models.items():
        for l_eta, mass in by_slope.items():
            if not system.agn:
                continue
            images = solve_lens_equation(power_law_lens(mass), *sky_to_image(mass.source_position))
            if len(images) != len(system.agn):
                raise SpecError(
                    "agn",
                    [image.name for image in system.agn],
                    f"{len(images)} images, as many as mass_models.{model}[{l_eta!r}] makes of its source",
                )


def check_analysis(realization: Realization) -> None:
    """Refuse an analysis that asks for what the system has not.

    Priors of the shear need a mass model with shear, positions as data two AGN images; a SpecError names the field.
    """
    system, analysis = resolve_system(realization), realization.analysis
    mass = system.mass_model(realization.mass_model, realization.l_eta)
    if not any(mass.shear or ()):
        for name in ("gamma1", "gamma2"):
            if name in analysis.priors or name in system.priors:
                raise SpecError("analysis.priors", name, f"a lens parameter of {system.name}, whose model has no shear")
    if analysis.agn_position_sd is not None and len(system.agn) < 2:
        raise SpecError("analysis.agn_position_sd", analysis.agn_position_sd, "nothing: there are no two AGN images")


def check_deflector(realization: Realization) -> None:
    """Refuse a deflector that does not make as many images as the system has; a SpecError names it ``deflector``."""
    system = resolve_system(realization)
    if realization.deflector is None or not system.agn:
        return
    mass = system.mass_model(realization.mass_model, realization.l_eta)
    lens, label = power_law_lens(mass, realization.deflector), realization.deflector.label
    try:
        images = _bright_images(lens, source_place(mass, lens), len(system.agn))
    except LensEquationError as error:
        raise SpecError("deflector", label, f"one whose images can be found: {error}") from error
    if len(images) != len(system.agn):
        sizes = ", ".join(f"{abs(one.magnification):.2f}" for one in images)
        raise SpecError(
            "deflector",
            label,
            f"one that leaves {system.name} its {len(system.agn)} images of the AGN; this makes {len(images)}, of "
            f"magnifications {sizes}",
        )


def _bright_images(lens: PowerLawLens, place: tuple[float, float], number: int) -> tuple[LensedImage, ...]:
    """The images that are seen: beside satellites there can be others, which are faint."""
    images = solve_lens_equation(lens, *place)
    faintest = abs(images[min(number, len(images)) - 1].magnification)
    return tuple(one for one in images if not lens.perturbers or abs(one.magnification) >= _FAINT * faintest)


def source_place(mass: MassModel, lens: PowerLawLens) -> tuple[float, float]:
    """Where the AGN and its host stand in the source plane [arcsec, image frame].

    The mass model's place, moved by what satellites deflect at the centre of the lens: that is a shift of the whole
    source plane, which nobody sees, and without it the images would not be where they were observed.
    """
    x, y = sky_to_image(mass.source_position)
    satellites = tuple(one for one in lens.perturbers if isinstance(one, Satellite))
    if not satellites:
        return x, y
    centre = np.array(lens.x), np.array(lens.y)
    ax, ay = deflection(replace(lens, perturbers=satellites), *centre)
    bx, by = deflection(replace(lens, perturbers=()), *centre)
    return x - float(ax - bx), y - float(ay - by)


def perturbers_of(mass: MassModel, deflector: Deflector | None) -> tuple[Perturber, ...]:
    """What a deflector's mass has beside the power law, in the image frame."""
    if deflector is None:
        return ()
    multipoles = (
        Multipole(
            one.m,
            one.amplitude,
            image_angle(mass.position_angle if one.position_angle is None else one.position_angle),
        )
        for one in deflector.multipoles
    )
    satellites = (
        Satellite(one.theta_E, *sky_to_image(one.position), one.q, image_angle(one.position_angle))
        for one in deflector.satellites
    )
    return (*multipoles, *satellites)


def power_law_lens(mass: MassModel, deflector: Deflector | None = None) -> PowerLawLens:
    """A catalogue's mass model in the image frame, with what the deflector has beside it."""
    x, y = sky_to_image(mass.centre)
    gamma1, gamma2 = sky_to_image_shear(mass.shear or (0.0, 0.0))
    return PowerLawLens(
        theta_E=mass.theta_E,
        q=mass.q,
        phi=image_angle(mass.position_angle),
        slope=mass.slope,
        x=x,
        y=y,
        gamma1=gamma1,
        gamma2=gamma2,
        perturbers=perturbers_of(mass, deflector),
    )


def sersic_profile(light: SersicLight, zero_point: float) -> SersicProfile:
    """A catalogue's light profile in the image frame."""
    x, y = sky_to_image(light.centre)
    return SersicProfile(
        flux=magnitude_to_rate(light.magnitude, zero_point),
        r_eff=light.r_eff,
        n=light.n,
        q=light.q,
        phi=image_angle(light.position_angle),
        x=x,
        y=y,
    )


def place_agn(
    images: tuple[LensedImage, ...], observed: tuple[AgnImage, ...], zero_point: float
) -> tuple[PointSource, ...]:
    """Point sources at the lens-equation images, with the catalogue's magnitudes of the nearest observed images.

    The pairing minimises the summed squared distance. A SpecError tells where the lens makes another number of images
    than the catalogue has.
    """
    if len(images) != len(observed):
        raise SpecError(
            "agn", [image.name for image in observed], f"as many images as the lens equation has: {len(images)}"
        )
    model = np.array([(image.x, image.y) for image in images])
    sky = np.array([sky_to_image(image.position) for image in observed])
    distance2 = ((sky[:, None, :] - model[None, :, :]) ** 2).sum(axis=2)
    rows, columns = linear_sum_assignment(distance2)
    return tuple(
        PointSource(
            observed[row].name,
            images[column].x,
            images[column].y,
            magnitude_to_rate(observed[row].magnitude, zero_point),
        )
        for row, column in zip(rows, columns, strict=True)
    )


def build_scene(realization: Realization) -> Scene:
    """The scene of a realization."""
    check_deflector(realization)
    system, camera = resolve_system(realization), resolve_camera(realization)
    mass = system.mass_model(realization.mass_model, realization.l_eta)
    lens = power_law_lens(mass, realization.deflector)
    source = source_place(mass, lens)
    agn: tuple[PointSource, ...] = ()
    if system.agn:
        agn = place_agn(_bright_images(lens, source, len(system.agn)), system.agn, camera.zero_point)
    profiles = [] if system.deflector is None else [system.deflector]
    profiles += [] if realization.deflector is None else realization.deflector.light
    light = tuple(sersic_profile(one, camera.zero_point) for one in profiles)
    return Scene(
        system=system,
        camera=camera,
        lens=lens,
        host=host_light(realization.host, system, camera.zero_point, *source),
        deflector=light[0] if light else None,
        agn=agn,
        optics=realization.optics or NOMINAL_OPTICS,
        deflector_more=light[1:],
    )
