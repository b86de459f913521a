"""From a realization (sky frame, magnitudes) to a scene (image frame, count rates): the one place that converts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from engine.catalogue import load_camera, load_system
from engine.conventions import image_angle, magnitude_to_rate, sky_to_image, sky_to_image_shear
from engine.errors import SpecError
from engine.lensing.lens_equation import LensedImage, solve_lens_equation
from engine.lensing.power_law import PowerLawLens
from engine.light.sersic import SersicProfile
from engine.spec import NOMINAL_OPTICS, AgnImage, Camera, LensSystem, MassModel, Optics, Realization, SersicLight


@dataclass(frozen=True)
class PointSource:
    """A point source in the image: position [arcsec, image frame] and count rate [e-/s]."""

    name: str
    x: float
    y: float
    flux: float


@dataclass(frozen=True)
class Scene:
    """What stands before the telescope, in the image frame."""

    system: LensSystem
    camera: Camera
    lens: PowerLawLens
    host: SersicProfile
    deflector: SersicProfile | None
    agn: tuple[PointSource, ...]
    optics: Optics = NOMINAL_OPTICS


def resolve_system(realization: Realization) -> LensSystem:
    """The lens system of a realization, from the catalogue where it is named."""
    system = realization.system
    return load_system(system) if isinstance(system, str) else system


def resolve_camera(realization: Realization) -> Camera:
    """The camera of a realization: its own choice, else the system's."""
    camera = realization.camera
    if camera is None:
        camera = resolve_system(realization).camera
    return load_camera(camera) if isinstance(camera, str) else camera


def power_law_lens(mass: MassModel) -> PowerLawLens:
    """A catalogue's mass model in the image frame."""
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
    system, camera = resolve_system(realization), resolve_camera(realization)
    mass = system.mass_model(realization.mass_model, realization.l_eta)
    lens = power_law_lens(mass)
    source_x, source_y = sky_to_image(mass.source_position)
    spec = realization.host
    host_angle = system.host_position_angle if spec.position_angle is None else spec.position_angle
    host = SersicProfile(
        flux=magnitude_to_rate(spec.magnitude, camera.zero_point),
        r_eff=spec.r_eff,
        n=spec.n,
        q=system.host_q if spec.q is None else spec.q,
        phi=image_angle(host_angle),
        x=source_x,
        y=source_y,
    )
    deflector = None if system.deflector is None else sersic_profile(system.deflector, camera.zero_point)
    agn: tuple[PointSource, ...] = ()
    if system.agn:
        agn = place_agn(solve_lens_equation(lens, source_x, source_y), system.agn, camera.zero_point)
    return Scene(
        system=system,
        camera=camera,
        lens=lens,
        host=host,
        deflector=deflector,
        agn=agn,
        optics=realization.optics or NOMINAL_OPTICS,
    )
