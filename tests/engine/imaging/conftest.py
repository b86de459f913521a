"""Three ways of observing, one for each camera, and the foreign data."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from engine.catalogue import load_camera, load_dither
from engine.conventions import FloatArray
from engine.imaging.geometry import Geometry, exposure_geometry
from engine.imaging.psf import detector_kernel, telescope_psf
from engine.simulation.simulate import Simulation, simulate_realization
from engine.spec.host import Host
from engine.spec.instrument import Camera
from engine.spec.realization import Realization

SHARED_DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data"


@dataclass(frozen=True)
class Setup:
    """A camera, a geometry and an optical PSF whose stamp fits on the image, so that no light is lost."""

    camera: Camera
    geometry: Geometry
    psf: FloatArray
    kernel: FloatArray


SETUPS = {
    "F160W": ("WFC3-IR_F160W", "eight_point_quarter_pixel", (98, 98)),
    "F160W-sixth": ("WFC3-IR_F160W", "twelve_point_sixth_pixel", (99, 98)),
    "UVIS": ("WFC3-UVIS_F814W", "eight_point_quarter_pixel", (120, 121)),
    "ACS": ("ACS-WFC_F814W", "box_half_pixel", (100, 101)),
}


def make_setup(name: str) -> Setup:
    camera_name, dither, shape = SETUPS[name]
    camera = load_camera(camera_name)
    geometry = exposure_geometry(camera, load_dither(dither), shape)
    side = 0.5 * min(geometry.native_shape) * geometry.pixel_scale
    psf = telescope_psf(camera, oversampling=geometry.oversampling, field_of_view=side, pupil_pixels=256)
    return Setup(camera, geometry, psf, detector_kernel(camera))


@pytest.fixture(scope="session", params=list(SETUPS))
def setup(request: pytest.FixtureRequest) -> Setup:
    return make_setup(request.param)


@pytest.fixture(scope="session")
def f160w() -> Setup:
    return make_setup("F160W")


@pytest.fixture(scope="session")
def simulated() -> Simulation:
    """A realization of HE0435 with all its provenance."""
    host = Host(n=2.0, r_eff=0.39, magnitude=21.0)
    return simulate_realization(Realization(system="HE0435", l_eta=1.0, host=host, seed=3))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip("the foreign example data (shared/data beside the project) are not here")
    return SHARED_DATA
