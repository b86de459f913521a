"""Speed against error of every knob, for all eight systems: docs/tables/speed_against_error.md, its data and figure.

    python -m benchmarks.accuracy_report [--systems HE0435 ...] [--stages rendering ...] [--write]

The same as ``hostlens accuracy SYSTEM`` of each system, and PyAutoLens on the axes of the rendering where
``python -m benchmarks.peers`` has prepared it. Systems and stages that are not measured keep what the data hold of
them. Three to ten CPU minutes a system.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import peers
from engine import (
    ACCURACY_STAGES,
    AccuracyReport,
    accuracy_page,
    engine_digest,
    hardest_realization,
    measure_accuracy,
    report_from_dict,
    system_names,
)
from engine.accuracy.curves import Point
from engine.accuracy.rendering import INTEGRATION, PEER_SUBPIXELS, HostImage, uniform
from engine.accuracy.report import accuracy_knobs
from engine.accuracy.subject import Subject
from engine.conventions import FloatArray
from engine.figures import accuracy_figure, figure_bytes
from engine.lensing.power_law import PowerLawLens, deflection
from engine.light.sersic import SersicProfile, effective_brightness

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE, DATA = DOCS / "tables" / "speed_against_error.md", DOCS / "tables" / "speed_against_error.json"
FIGURE = DOCS / "images" / "speed_against_error.svg"
_PROBE = (1.0, 0.3)
_SAME = 1e-3
"""Part of the brightest pixel by which an image of the same rays may differ: conventions are then the same."""


def autolens_images(
    profile: SersicProfile, lens: PowerLawLens, pixels: int, scale: float, subpixels: tuple[int, ...]
) -> list[tuple[FloatArray, float]]:
    """PyAutoLens' image (pixels, pixels) of a lensed host and its CPU seconds, for each number of rays along a pixel.

    For an isothermal lens at the origin without shear; PyAutoLens runs in an environment of its own.
    """
    python = peers.interpreter("autolens")
    if python is None:
        raise FileNotFoundError(peers.missing("autolens"))
    bent = deflection(lens, np.array([_PROBE[0]]), np.array([_PROBE[1]]))
    with tempfile.TemporaryDirectory() as folder:
        scene = {
            "lens_q": lens.q,
            "lens_phi": lens.phi,
            "probe": _PROBE,
            "deflection": [float(component[0]) for component in bent],
            **dataclasses.asdict(profile),
            "intensity": profile.flux * effective_brightness(profile),
            "subpixels": list(subpixels),
            "pixels": pixels,
            "scale": scale,
            "folder": folder,
        }
        done = subprocess.run(
            [str(python), str(Path(peers.__file__).with_name("autolens_rendering.py")), json.dumps(scene)],
            capture_output=True,
            text=True,
            check=True,
            cwd=folder,
            env={**os.environ, "PYAUTO_SKIP_WORKSPACE_VERSION_CHECK": "1"},
        )
        runs = json.loads(done.stdout.splitlines()[-1])["runs"]
        return [(np.load(run["image"]), run["seconds"]) for run in runs]


def autolens_points(subject: Subject) -> list[Point]:
    """PyAutoLens beside the rendering of a subject; none where its script does not know such a lens."""
    image = HostImage(subject)
    lens, host = image.lens, image.host
    if (lens.slope, lens.x, lens.y, lens.gamma1, lens.gamma2) != (2.0, 0.0, 0.0, 0.0, 0.0):
        return []
    found = []
    theirs = autolens_images(host, lens, image.x.size, image.scale, PEER_SUBPIXELS)
    for subpixels, (pixels, seconds) in zip(PEER_SUBPIXELS, theirs, strict=True):
        same = np.abs(pixels - uniform(host, lens, image.x, image.y, image.scale, subpixels)).max() / pixels.max()
        assert same < _SAME, (subpixels, same)
        found.append(Point(f"{subpixels} x {subpixels}", seconds, image.error(pixels), peer="PyAutoLens"))
    return found


def with_autolens(report: AccuracyReport, subject: Subject) -> AccuracyReport:
    """The report with PyAutoLens' points, where it is prepared."""
    if peers.interpreter("autolens") is None:
        return report
    points = tuple(autolens_points(subject))
    curves = tuple(
        dataclasses.replace(curve, points=curve.points + points) if curve.knob == INTEGRATION else curve
        for curve in report.curves
    )
    absent = tuple(peer for peer in report.absent if peer != "PyAutoLens")
    return dataclasses.replace(report, curves=curves, absent=absent)


def joined(former: AccuracyReport | None, report: AccuracyReport) -> AccuracyReport:
    """A report with the curves that only a former one has, in the order of the stages."""
    if former is None:
        return report
    measured = {curve.knob.stage for curve in report.curves} | {one.setting for one in report.refused}
    curves = [*report.curves, *(curve for curve in former.curves if curve.knob.stage not in measured)]
    curves.sort(key=lambda curve: ACCURACY_STAGES.index(curve.knob.stage))
    refused = [*report.refused, *(one for one in former.refused if one.setting not in measured)]
    return dataclasses.replace(report, curves=tuple(curves), refused=tuple(refused))


def read_reports() -> tuple[dict[str, AccuracyReport], dict[str, str]]:
    """What the data hold, and the engine that it was measured of, by system."""
    if not DATA.exists():
        return {}, {}
    document = json.loads(DATA.read_text())
    return {entry["system"]: report_from_dict(entry) for entry in document["systems"]}, document["engines"]


def as_described(report: AccuracyReport) -> AccuracyReport:
    """The report with the descriptions that the code has now."""
    known = {(knob.stage, knob.name): knob for knob in accuracy_knobs()}
    curves = tuple(dataclasses.replace(curve, knob=known[curve.knob.stage, curve.knob.name]) for curve in report.curves)
    return dataclasses.replace(report, curves=curves)


def heading(reports: dict[str, AccuracyReport], engines: dict[str, str]) -> str:
    """What stands above the tables."""
    absent = sorted({peer for report in reports.values() for peer in report.absent})
    missing = "".join(f" {peer} was not installed." for peer in absent)
    left = [system for system in system_names() if system not in reports]
    missing += f" Not measured yet: {', '.join(left)}." if left else ""
    made = ", ".join(f"`{digest}`" for digest in dict.fromkeys(engines.values()))
    return f"""# Speed against error

Written by `python -m benchmarks.accuracy_report`; `hostlens accuracy SYSTEM` measures one system. The paper's host of
n = 4 with the smaller radius and the second brightest magnitude, l_eta = 1, seed 0. Errors are against references made
another way and are the same each time; CPU time is of one thread, in units of the default's, the median over the
systems. **Bold** is the default; `on the front` counts the systems in which no other setting of ours is better in one
and no worse in the other. PyAutoLens is shown where the lens has no shear.{missing} Engine {made}.

![Speed against error of every knob](../images/speed_against_error.svg)
"""


def write(reports: dict[str, AccuracyReport], engines: dict[str, str]) -> None:
    """Page, data and figure."""
    shown = {system: as_described(reports[system]) for system in system_names() if system in reports}
    document = {
        "engines": {system: engines[system] for system in shown},
        "systems": [report.to_dict() for report in shown.values()],
    }
    DATA.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    page = heading(shown, document["engines"]) + accuracy_page(list(shown.values()))
    PAGE.write_text(page, encoding="utf-8")
    FIGURE.write_bytes(figure_bytes(accuracy_figure(list(shown.values())), "svg"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--systems", nargs="+", default=list(system_names()), choices=system_names())
    parser.add_argument("--stages", nargs="+", default=list(ACCURACY_STAGES), choices=ACCURACY_STAGES)
    parser.add_argument("--write", action="store_true", help="measure nothing")
    given = parser.parse_args()
    for system in () if given.write else given.systems:
        began, realization = time.process_time(), hardest_realization(system)
        report = measure_accuracy(realization, given.stages)
        if INTEGRATION.stage in given.stages:
            report = with_autolens(report, Subject(realization))
        reports, engines = read_reports()
        reports[system], engines[system] = joined(reports.get(system), report), engine_digest()[:12]
        write(reports, engines)
        off = [curve.knob.name for curve in report.curves if not curve.default_on_front]
        told = f"{system}: {time.process_time() - began:.0f} CPU s"
        print(f"{told}; off the front: {', '.join(off) or 'none'}", flush=True)
    if given.write:
        write(*read_reports())


if __name__ == "__main__":
    main()
