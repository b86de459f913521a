"""The recommended estimator on hosts that are no Sersic profiles, and behind deflectors that are no single power law.

    python -m benchmarks.hosts [--systems HE0435 HE0047] [--images FILE.fits ...] [--deflectors] [--picture FILE.png]

Prints, of each run, what ``image`` (n in the wide range) finds beside the truth of the simulation: magnitude of all
light and half-light radius; an index has no truth there. ``--images`` runs every image of FITS files as a host, too.
``--picture`` only pictures the made-up galaxies, before and behind the lens.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from astropy.io import fits

from engine import Analysis, Deflector, EngineError, Host, HostShape, MadeGalaxy, Realization, read_host_image, run
from engine.catalogue import resolve_system
from engine.figures import hosts_figure
from engine.simulation.simulate import simulate_realization
from engine.spec.deflector import MassMultipole, MassSatellite
from engine.spec.light import SersicLight

MADE = (
    ("bulge_disc", (0,)), ("clumpy", (1, 2)), ("companion", (1, 2)), ("irregular", (1, 2, 3)), ("spiral", (1, 2, 3, 4)),
    ("merger", (1, 2, 3, 4, 5, 6)),
)  # fmt: skip
SIZES = {"HE0435": (0.39, 20.5), "HE0047": (0.37, 20.5)}
ANALYSIS = Analysis(estimators=("image",))


def made_hosts() -> list[HostShape]:
    """The made-up galaxies that are pictured and run."""
    return [HostShape(made=MadeGalaxy(kind=kind, seed=seed)) for kind, seeds in MADE for seed in seeds]  # type: ignore[arg-type]


def image_hosts(paths: list[Path]) -> list[HostShape]:
    """Every image of some files."""
    found = []
    for path in paths:
        with fits.open(path) as file:
            numbers = [i for i, hdu in enumerate(file) if getattr(hdu, "data", None) is not None]
            names = [file[i].name or str(i) for i in numbers]
        found += [
            HostShape(image=read_host_image(path, extension=i), name=name.lower())
            for i, name in zip(numbers, names, strict=True)
        ]
    return found


def deflectors(system: str) -> list[Deflector]:
    """Deflectors of two profiles, with multipoles, with a satellite of a tenth of the main mass."""
    realization = Realization(system=system, l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=20.5))
    own = resolve_system(realization).deflector
    theta_E = resolve_system(realization).mass_model("recommended", 1.0).theta_E
    place = (1.4 * theta_E, 0.6 * theta_E)
    light = () if own is None else (SersicLight(own.magnitude + 0.7, 2.5 * own.r_eff, 1.0, own.q, own.position_angle),)
    small = SersicLight(21.5, 0.15, 2.0, 0.9, 0.0, place)
    return [
        Deflector(light=light),
        Deflector(multipoles=(MassMultipole(4, 0.02),)),
        Deflector(multipoles=(MassMultipole(3, 0.01, 20.0), MassMultipole(4, -0.02))),
        Deflector(satellites=(MassSatellite(0.1 * theta_E, place),)),
        Deflector(satellites=(MassSatellite(0.1 * theta_E, place),), light=(small,), name="bright-satellite"),
    ]


def line_of(realization: Realization) -> tuple[str, tuple[float, float] | None]:
    """A run as a line of the table, and bias and pull of its magnitude; None where it has no answer."""
    began = time.process_time()
    deflector = "plain" if realization.deflector is None else realization.deflector.label
    head = f"{realization.system_name:8s} {realization.host.label:14s} {deflector:18s}"
    try:
        result = run(realization)
        found = result.estimate("image", "wide")
    except (EngineError, KeyError) as error:
        return f"{head} {type(error).__name__}: {str(error)[:90]}", None
    bias, sd, radius = found.magnitude.bias, found.magnitude.sd, found.r_eff.bias
    assert bias is not None
    assert radius is not None
    assert (found.n.truth is None) == (realization.host.n is None)
    fit = f"{bias:+7.3f} {sd:6.3f} {bias / sd:+6.1f} {radius / realization.host.r_eff:+7.3f} {found.n.mean:6.2f}"
    chi2 = result.chi2 / result.degrees_of_freedom
    return f"{head} {fit} {chi2:6.2f} {time.process_time() - began:6.1f} s  {'; '.join(result.warnings)[:80]}", (
        bias, bias / sd,
    )  # fmt: skip


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", default=list(SIZES))
    parser.add_argument("--images", nargs="+", type=Path, default=[])
    parser.add_argument("--deflectors", action="store_true")
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    if asked.picture is not None:
        spec = Realization(system="HE0435", l_eta=1.0, host=Host(n=2.0, r_eff=0.39, magnitude=21.0))
        hosts = [Host.of(shape, 0.39, 21.0) for shape in made_hosts()]
        pictures = [simulate_realization(Realization(spec.system, spec.l_eta, host)) for host in hosts]
        hosts_figure(pictures).savefig(asked.picture, dpi=96)
        return
    print("system   host           deflector            bias    sd    pull  R_eff       n   chi2  CPU")
    for system in asked.systems:
        r_eff, magnitude = SIZES.get(system, (0.39, 20.5))
        shapes = (
            [HostShape(n=2.0)] if asked.deflectors else [HostShape(n=2.0), *made_hosts(), *image_hosts(asked.images)]
        )
        found = []
        for shape in shapes:
            for deflector in [None, *deflectors(system)] if asked.deflectors else [None]:
                line, numbers = line_of(
                    Realization(
                        system=system, l_eta=1.0, host=Host.of(shape, r_eff, magnitude), analysis=ANALYSIS,
                        deflector=deflector,
                    )
                )  # fmt: skip
                print(line, flush=True)
                found += [] if numbers is None else [numbers]
        bias, pull = np.array(found).T
        print(
            f"{system}: {len(found)} answers, median |bias| {np.median(np.abs(bias)):.3f} mag, "
            f"|pull| below 1: {np.mean(np.abs(pull) < 1):.0%}, below 2: {np.mean(np.abs(pull) < 2):.0%}"
        )


if __name__ == "__main__":
    main()
