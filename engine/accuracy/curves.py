"""Points of cost and error, the curve that the settings of a knob make, and its Pareto front."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from engine.errors import AccuracyError

MARGIN = 0.1
"""Part of a cost, or of an error, by which points have to differ to be told apart: times repeat to a few per cent."""
SCATTER = 0.5
"""The same of the error of a chain, or of some draws, which is itself drawn by lot."""


@dataclass(frozen=True)
class Point:
    """A setting of a knob: CPU seconds and error. ``peer`` is the program that made it where it is not ours."""

    setting: str
    cost: float
    error: float
    default: bool = False
    peer: str | None = None


@dataclass(frozen=True)
class Refusal:
    """A setting that gives no answer, and why."""

    setting: str
    reason: str


@dataclass(frozen=True)
class Knob:
    """What can be set for speed or accuracy.

    ``place`` is where it is set, ``quantity`` and ``unit`` what its error is of, ``work`` what is timed, ``reference``
    what the error is against. ``why_off_front`` says why the default is kept where another setting is better; it is
    empty where none is in any system. ``resolution`` is the part of an error by which settings have to differ to be
    told apart.
    """

    stage: str
    name: str
    place: str
    quantity: str
    unit: str
    work: str
    reference: str
    why_off_front: str = ""
    resolution: float = MARGIN


@dataclass(frozen=True)
class Curve:
    """What was measured of a knob. ``floor`` is the error of the reference itself: below it errors are alike."""

    knob: Knob
    floor: float
    points: tuple[Point, ...]
    refused: tuple[Refusal, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a curve without exactly one default."""
        defaults = [point.setting for point in self.points if point.default]
        if len(defaults) != 1:
            raise AccuracyError(f"{self.knob.name}: got the defaults {defaults}, allowed is one that gives an answer")

    @property
    def default(self) -> Point:
        """The setting that runs have."""
        return next(point for point in self.points if point.default)

    def ratio(self, point: Point) -> float:
        """Cost in units of the default's."""
        return point.cost / self.default.cost

    def front(self) -> tuple[Point, ...]:
        """Our own points that no other one of ours beats, by rising cost."""
        return pareto_front([point for point in self.points if point.peer is None], self.floor, self.knob.resolution)

    @property
    def default_on_front(self) -> bool:
        """Whether no other setting beats the default."""
        return self.default in self.front()


def beats(one: Point, other: Point, floor: float, resolution: float = MARGIN) -> bool:
    """Whether one point is no worse in cost and error, and better in one of them by what can be told apart."""
    error, against = max(one.error, floor), max(other.error, floor)
    no_worse = one.cost <= other.cost and error <= against
    better = one.cost < (1.0 - MARGIN) * other.cost or error < (1.0 - resolution) * against
    return no_worse and better


def pareto_front(points: Iterable[Point], floor: float = 0.0, resolution: float = MARGIN) -> tuple[Point, ...]:
    """The points that no other beats, by rising cost."""
    all_points = list(points)
    front = [one for one in all_points if not any(beats(other, one, floor, resolution) for other in all_points)]
    return tuple(sorted(front, key=lambda point: (point.cost, point.error)))


@dataclass(frozen=True)
class AccuracyReport:
    """The curves of a system, in the order of the stages.

    ``absent`` names peers that are not installed, ``refused`` the stages that cannot be measured here, and why.
    """

    system: str
    scene: str
    curves: tuple[Curve, ...]
    absent: tuple[str, ...] = ()
    refused: tuple[Refusal, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form, with the ratio of each cost to the default's; :func:`report_from_dict` reads it back."""
        curves = []
        for curve in self.curves:
            front = curve.front()
            points = [
                {**asdict(point), "ratio": curve.ratio(point), "on_front": point in front} for point in curve.points
            ]
            curves.append({**asdict(curve), "points": points, "default_on_front": curve.default_on_front})
        return {
            "system": self.system,
            "scene": self.scene,
            "absent": list(self.absent),
            "refused": [asdict(refusal) for refusal in self.refused],
            "curves": curves,
        }


def report_from_dict(document: dict[str, Any]) -> AccuracyReport:
    """The report of :meth:`AccuracyReport.to_dict`."""
    return AccuracyReport(
        document["system"],
        document["scene"],
        tuple(
            Curve(
                Knob(**entry["knob"]),
                entry["floor"],
                tuple(
                    Point(found["setting"], found["cost"], found["error"], found["default"], found["peer"])
                    for found in entry["points"]
                ),
                tuple(Refusal(**found) for found in entry["refused"]),
            )
            for entry in document["curves"]
        ),
        tuple(document["absent"]),
        tuple(Refusal(**found) for found in document["refused"]),
    )


def by_knob(reports: Sequence[AccuracyReport]) -> dict[tuple[str, str], list[tuple[str, Curve]]]:
    """Curves of several systems (system, curve), by stage and name of the knob, in their order."""
    found: dict[tuple[str, str], list[tuple[str, Curve]]] = {}
    for report in reports:
        for curve in report.curves:
            found.setdefault((curve.knob.stage, curve.knob.name), []).append((report.system, curve))
    return found
