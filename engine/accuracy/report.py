"""The report of a system: its stages one after the other, as a table, and of several systems as a page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from statistics import median
from types import ModuleType

from threadpoolctl import threadpool_limits

from engine.accuracy import cusps, deflection, draws, drizzling, noise, psf, rendering, sampling, source
from engine.accuracy.curves import AccuracyReport, Curve, Knob, Point, Refusal, by_knob
from engine.accuracy.subject import Subject
from engine.codes.installed import PEERS, installed
from engine.errors import EngineError, SpecError
from engine.spec.realization import Realization
from engine.stages import ACCURACY_STAGES

_MODULES: tuple[ModuleType, ...] = (
    deflection, rendering, cusps, psf, drizzling, noise, source, sampling, draws,
)  # fmt: skip


def accuracy_knobs() -> tuple[Knob, ...]:
    """What is measured, in the order of the stages."""
    found = [value for module in _MODULES for value in vars(module).values() if isinstance(value, Knob)]
    return tuple(dict.fromkeys(found))


def measure_accuracy(
    realization: Realization,
    stages: Sequence[str] = ACCURACY_STAGES,
    progress: Callable[[str], None] | None = None,
) -> AccuracyReport:
    """Measure time against error of each knob of some stages, on one thread.

    Parameters
    ----------
    realization : Realization
        The scene, and by its analysis the defaults; :func:`~engine.accuracy.subject.hardest_realization` is usual.
    stages : sequence of str
        Of :data:`~engine.stages.ACCURACY_STAGES`.
    progress : callable, optional
        Told each stage when it ends.

    Raises
    ------
    SpecError
        There is no such stage.
    EngineError
        The scene cannot be simulated, or no stage can be measured; the message says why.
    """
    for stage in stages:
        if stage not in ACCURACY_STAGES:
            raise SpecError("stage", stage, f"one of {', '.join(ACCURACY_STAGES)}")
    subject, curves, errors = Subject(realization), [], {}
    with threadpool_limits(1):
        for module in _MODULES:
            if module.STAGE not in stages:
                continue
            try:
                curves += module.measure(subject)
            except EngineError as error:
                errors[module.STAGE] = error
            if progress is not None:
                progress(module.STAGE)
    if errors and not curves:
        raise next(iter(errors.values()))
    return AccuracyReport(
        system=realization.system_name,
        scene=subject.told,
        curves=tuple(curves),
        absent=tuple(peer for peer in PEERS if not installed(peer)),
        refused=tuple(Refusal(stage, str(error)) for stage, error in errors.items()),
    )


def _name(point: Point) -> str:
    return (
        f"{point.peer}, {point.setting}" if point.peer else f"**{point.setting}**" if point.default else point.setting
    )


def accuracy_rows(curve: Curve) -> list[tuple[str, str, str, str]]:
    """Setting, CPU time in units of the default's, error, and where the point stands, of each point by rising cost."""
    front, rows = curve.front(), []
    for point in sorted(curve.points, key=lambda found: found.cost):
        stands = "front" if point in front else ""
        rows.append((_name(point), f"{curve.ratio(point):.2g}", f"{point.error:.2g}", stands))
    rows += [(refusal.setting, "", "refused", refusal.reason) for refusal in curve.refused]
    return rows


def _about(curve: Curve) -> Iterator[str]:
    knob = curve.knob
    yield f"`{knob.place}`. Error: {knob.quantity} [{knob.unit}]. Time: {knob.work}. Against: {knob.reference}."
    yield ""


def accuracy_markdown(report: AccuracyReport) -> str:
    """The report of one system as Markdown."""
    lines = [f"# Speed against error: {report.system}", "", f"{report.scene}.", ""]
    lines += [f"{peer} is not installed here." for peer in report.absent]
    lines += [f"Not measured: {refusal.setting}: {refusal.reason}." for refusal in report.refused]
    for curve in report.curves:
        lines += ["", f"## {curve.knob.stage}: {curve.knob.name}", "", *_about(curve)]
        lines += ["| setting | CPU, of the default's | error | |", "|---|---|---|---|"]
        lines += [f"| {' | '.join(row)} |" for row in accuracy_rows(curve)]
        lines += ["", f"The reference is good to {curve.floor:.1g}."] if curve.floor else []
        lines += [f"The default is {'' if curve.default_on_front else 'not '}on the front."]
        lines += [curve.knob.why_off_front] if curve.knob.why_off_front and not curve.default_on_front else []
    return "\n".join([*lines, ""])


def accuracy_page(reports: Sequence[AccuracyReport]) -> str:
    """The reports of several systems as the body of a page: a table for each knob, medians and errors of each."""
    lines = [
        f"Not measured in {report.system}: {refusal.setting}: {refusal.reason}."
        for report in reports
        for refusal in report.refused
    ]
    for (stage, name), found in by_knob(reports).items():
        curves = [curve for _, curve in found]
        knob = curves[0].knob
        lines += ["", f"## {stage}: {name}", "", *_about(curves[0])]
        header = ["setting", "CPU, of the default's", *(system for system, _ in found), "on the front"]
        lines += [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
        lines += [f"| {' | '.join(row)} |" for row in _across(curves)]
        floors = [curve.floor for curve in curves if curve.floor]
        notes = [f"The reference is good to {median(floors):.1g} (median)."] if floors else []
        off = [system for system, curve in found if not curve.default_on_front]
        if off:
            notes.append(f"The default is off the front in {', '.join(off)}. {knob.why_off_front}")
        lines += ["", *notes] if notes else []
    return "\n".join([*lines, ""])


def _across(curves: Sequence[Curve]) -> Iterator[list[str]]:
    """A row for each setting: median ratio of time, the error in each system, and in how many it is on the front."""
    settings = dict.fromkeys((point.setting, point.peer) for curve in curves for point in curve.points)
    rows = []
    for setting, peer in settings:
        points = [next((p for p in curve.points if (p.setting, p.peer) == (setting, peer)), None) for curve in curves]
        there = [(curve, point) for curve, point in zip(curves, points, strict=True) if point is not None]
        ratio = median(curve.ratio(point) for curve, point in there)
        front = sum(point in curve.front() for curve, point in there)
        stands = f"{front} of {len(there)}" if peer is None else ""
        errors = ["-" if point is None else f"{point.error:.2g}" for point in points]
        rows.append((ratio, [_name(there[0][1]), f"{ratio:.2g}", *errors, stands]))
    yield from (row for _, row in sorted(rows, key=lambda found: found[0]))
