"""Lenses that nobody has simulated, drawn at random, and what ``image`` finds in them: what predictions learn from.

    python -m benchmarks.strangers [--lenses 200] [--results FILE]      simulate
    python -m benchmarks.strangers --table service/predictions/drawn.parquet

They stand beside the study's eight systems, and are what benchmarks.predictions is scored on, each by the others. A
lens has a camera of the catalogue with a dither pattern that the study has for it and 1, 2 or 4 long exposures; its
mass, source position and host are drawn, with an AGN of two images or four. ``image`` alone takes 2-4 CPU s. What is
done is not done again; two sets, of other seeds and the same distribution, can be simulated side by side.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from pyarrow import parquet

from engine import Analysis, EngineError, Host, Realization, load_system, run, traits_of
from engine.conventions import sky_to_image
from engine.digest import engine_digest
from engine.lensing.lens_equation import LensedImage, solve_lens_equation
from engine.simulation.scene import power_law_lens
from engine.spec.instrument import ExposurePlan
from engine.spec.sky import AgnImage, LensSystem, MassModel, SersicLight

ROOT = Path(__file__).resolve().parent.parent
SETS = {"strangers": 20174, "drawn": 20175}
QUANTITIES = ("magnitude", "r_eff", "n")
# Share of the lenses, system whose exposures they have, Einstein radii, R_eff [arcsec] and magnitudes of the hosts.
CAMERAS = (
    (0.35, "HE0435", (0.8, 1.7), (0.25, 0.9), (20.0, 22.5)),
    (0.15, "HE1104", (0.8, 1.7), (0.25, 0.9), (20.0, 22.5)),
    (0.3, "HE0047", (0.5, 1.1), (0.2, 0.7), (20.5, 23.0)),
    (0.2, "RXJ1131", (1.0, 1.9), (0.3, 1.0), (19.0, 21.5)),
)


def drawn_system(rng: np.random.Generator, name: str) -> tuple[LensSystem, float, Host]:
    """A lens, its l_eta, and the host behind it."""
    weights = [row[0] for row in CAMERAS]
    _, like, radii, sizes, magnitudes = CAMERAS[rng.choice(len(CAMERAS), p=weights)]
    base = load_system(like)
    wanted = 4 if rng.uniform() < 0.5 else 2
    while True:
        l_eta = float(round(rng.uniform(0.8, 1.2), 3))
        reach = radii[1] * 0.5
        angle = rng.uniform(0.0, 180.0)
        mass = MassModel(
            theta_E=float(rng.uniform(*radii)),
            q=float(rng.uniform(0.6, 0.95)),
            position_angle=float(angle),
            slope=l_eta + 1.0,
            source_position=(float(rng.uniform(-reach, reach)), float(rng.uniform(-reach, reach))),
            shear=None if rng.uniform() < 0.6 else tuple(float(g) for g in rng.normal(0.0, 0.05, 2)),  # type: ignore[arg-type]
        )
        x, y = sky_to_image(mass.source_position)
        images = solve_lens_equation(power_law_lens(mass), x, y)
        if len(images) == wanted and min(abs(image.magnification) for image in images) > 0.3:
            break
    host = Host(
        n=float(round(rng.uniform(1.0, 4.5), 2)),
        r_eff=float(round(math.exp(rng.uniform(*np.log(sizes))), 3)),
        magnitude=float(round(rng.uniform(*magnitudes), 2)),
    )
    agn = _agn(rng, images, host.magnitude)
    deflector = SersicLight(
        magnitude=float(rng.uniform(17.2, 19.4)),
        r_eff=float(rng.uniform(0.5, 2.5)),
        n=float(rng.uniform(3.0, 6.0)),
        q=float(min(1.0, mass.q + rng.uniform(-0.05, 0.15))),
        position_angle=float((angle + rng.normal(0.0, 8.0)) % 180.0),
    )
    plan: ExposurePlan = replace(base.exposures, n_long=int(rng.choice([1, 2, 4])))
    system = LensSystem(
        name=name,
        camera=base.camera,
        exposures=plan,
        agn=agn,
        host_q=float(rng.uniform(0.5, 0.95)),
        host_position_angle=float(rng.uniform(0.0, 180.0)),
        mass_models={"recommended": {repr(l_eta): mass}},
        deflector=deflector,
    )
    return system, l_eta, host


def _agn(rng: np.random.Generator, images: tuple[LensedImage, ...], host: float) -> tuple[AgnImage, ...]:
    """AGN images whose total is 3.5 mag brighter to 0.5 fainter than the host lensed as they are, some of it micro."""
    unlensed = host + rng.uniform(-3.5, 0.5)
    return tuple(
        AgnImage(
            name="ABCD"[place],
            # The image frame has x to the West; the catalogue's is to the East.
            position=(float(-image.x), float(image.y)),
            magnitude=float(unlensed - 2.5 * math.log10(abs(image.magnification)) + rng.normal(0.0, 0.25)),
        )
        for place, image in enumerate(images)
    )


def drawn_realization(kind: str, number: int, seed: int) -> Realization:
    """Lens ``number`` of a set, with noise of ``seed``."""
    rng = np.random.default_rng([SETS[kind], number])
    system, l_eta, host = drawn_system(rng, f"{kind}-{number}")
    return Realization(system=system, l_eta=l_eta, host=host, seed=seed, analysis=Analysis(estimators=("image",)))


def measured(kind: str, number: int, seed: int) -> dict[str, Any]:
    """What ``image`` finds in one image of a lens, or why it finds nothing."""
    realization = drawn_realization(kind, number, seed)
    record: dict[str, Any] = {"set": kind, "lens": number, "seed": seed, "engine": engine_digest()}
    try:
        found = run(realization)
    except EngineError as error:
        return {**record, "error": str(error)}
    host = found.estimate("image", "wide")
    record |= {name: [float(f"{value:.5g}") for value in _two(host, name)] for name in QUANTITIES}
    properties = ("arc_magnitude", "agn_contrast", "surface_brightness")
    return record | {name: round(getattr(found, name), 4) for name in properties}


def _two(host: Any, name: str) -> tuple[float, float]:
    value = getattr(host, name)
    return value.bias, value.sd


def write_table(records: list[dict[str, Any]], path: Path) -> None:
    """A row for each run that found something: the lens's traits, biases and stated deviations."""
    rows = []
    for record in sorted(records, key=lambda one: (one["set"], one["lens"], one["seed"])):
        if "error" in record:
            continue
        traits = traits_of(drawn_realization(record["set"], record["lens"], record["seed"]), record["arc_magnitude"])
        row: dict[str, Any] = {"run_id": f"{record['set']}-{record['lens']}#{record['seed']}"}
        row["lens"] = f"{record['set']}-{record['lens']}"
        row |= {f"traits_{name}": value for name, value in asdict(traits).items()}
        for name in QUANTITIES:
            row[f"{name}_bias"], row[f"{name}_sd"] = record[name]
        rows.append(row)
    table = pyarrow.Table.from_pylist(rows)
    small = [field.with_type(pyarrow.float32()) if field.type == pyarrow.float64() else field for field in table.schema]
    provenance = {"command": "python -m benchmarks.strangers", "engines": sorted({one["engine"] for one in records})}
    schema = pyarrow.schema(small, metadata={"hostlens": json.dumps(provenance)})
    parquet.write_table(table.cast(schema), path, compression="zstd", compression_level=19, write_statistics=False)
    print(f"{path}: {len(rows)} runs of {len({row['lens'] for row in rows})} lenses, {path.stat().st_size} bytes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--set", choices=sorted(SETS), default="strangers")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--lenses", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--results", type=Path, default=ROOT / "var" / "strangers.jsonl")
    parser.add_argument("--table", type=Path, help="Write what is done as Parquet, and simulate nothing")
    given = parser.parse_args()
    if given.table is not None:
        write_table([json.loads(line) for line in given.results.read_text().splitlines()], given.table)
        return
    given.results.parent.mkdir(parents=True, exist_ok=True)
    done = set()
    if given.results.exists():
        for line in given.results.read_text().splitlines():
            record = json.loads(line)
            done.add((record["set"], record["lens"], record["seed"]))
    with given.results.open("a") as log:
        for seed in range(given.seeds):
            for number in range(given.first, given.first + given.lenses):
                if (given.set, number, seed) not in done:
                    log.write(json.dumps(measured(given.set, number, seed)) + "\n")
                    log.flush()


if __name__ == "__main__":
    main()
