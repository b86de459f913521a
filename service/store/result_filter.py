"""Which results are meant: the axes that answers are grouped and filtered by, and what may be asked of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Column, ColumnElement, Select, and_, case, or_, select

from service.store.tables import USUAL_INPUTS, input_group, run

NONE = "none"
"""How a value that is not there is written, in a filter and in an answer's link."""


@dataclass(frozen=True)
class Axis:
    """Something that runs have in common, a column of the table ``input``."""

    name: str
    column: Column[Any]
    description: str
    unit: str | None = None
    is_number: bool = False


AXES: dict[str, Axis] = {
    axis.name: axis
    for axis in (
        Axis("grid", input_group.c.grid_id, "Grid that the runs belong to"),
        Axis("system", input_group.c.system, "Lens system"),
        Axis("camera", input_group.c.camera, "Camera"),
        Axis("configuration", input_group.c.configuration, "Lens with four AGN images (quad), two (double), or other"),
        Axis("mass_model", input_group.c.mass_model, "Mass model of the system"),
        Axis("l_eta", input_group.c.l_eta, "Slope of the deflector's mass, less 1", is_number=True),
        Axis("n", input_group.c.n, "Sersic index of the host that was put in", is_number=True),
        Axis("r_eff", input_group.c.r_eff, "Half-light radius of the host that was put in", "arcsec", is_number=True),
        Axis("magnitude", input_group.c.magnitude, "Magnitude of the host that was put in", "AB mag", is_number=True),
        Axis("host_kind", input_group.c.host_kind, "Kind of the host that was put in: sersic, image, spiral, ..."),
        Axis("host_label", input_group.c.host_label, "Name of the host that was put in"),
        Axis("deflector", input_group.c.deflector, "What the deflector has beside one profile and one power law"),
        Axis(
            "defocus_nm",
            input_group.c.defocus_nm,
            "Focus error of the telescope, rms of wavefront",
            "nm",
            is_number=True,
        ),
        Axis("jitter", input_group.c.jitter, "Pointing jitter, rms an axis", "arcsec", is_number=True),
        Axis("colour", input_group.c.colour, "How much bluer the sky is than the star of the PSF", is_number=True),
        Axis("residual", input_group.c.residual, "Random error of the PSF, as a part of its light", is_number=True),
        Axis("coarse", input_group.c.coarse, "Sub-pixels a side on which the PSF is known", is_number=True),
        Axis("noise_level", input_group.c.noise_level, "Noise of the simulation"),
        Axis("noise_treatment", input_group.c.noise_treatment, "Noise as the analysis takes it"),
        Axis("regularisation", input_group.c.regularisation, "Regularisation of the source"),
        Axis("profile", input_group.c.profile, "Profile of the analysis"),
        Axis("engine", input_group.c.engine_digest, "Digest of the engine"),
    )
}
"""By the names that requests use. Another axis is one line here and a column of ``input``."""


class FilterError(ValueError):
    """A filter cannot be read: which parameter, what was given, what is allowed."""

    def __init__(self, parameter: str, given: str, allowed: str) -> None:
        super().__init__(f"{parameter}: got {given!r}, allowed is {allowed}")
        self.parameter = parameter


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``, both included; None where there is no bound."""

    low: float | None
    high: float | None

    def holds(self, value: float) -> bool:
        """Whether a number lies within."""
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)


Wanted = str | Range | None
"""One value of an axis, or a range of numbers; None is the value that is not there."""


@dataclass(frozen=True)
class ResultFilter:
    """Results that agree, on each axis named, with one of the values given for it."""

    wanted: Mapping[str, tuple[Wanted, ...]] = field(default_factory=dict)

    @classmethod
    def read(cls, given: Mapping[str, list[str]]) -> ResultFilter:
        """From the values of a query by axis, as ``{"system": ["HE0435"], "magnitude": ["20..22"]}``."""
        return cls({name: tuple(_read(AXES[name], text) for text in texts) for name, texts in given.items() if texts})

    def conditions(self) -> ColumnElement[bool] | None:
        """On rows of the table ``input``; None where everything is wanted."""
        found = [_condition(AXES[name].column, wanted) for name, wanted in self.wanted.items()]
        return and_(*found) if found else None

    def inputs(self) -> Select[Any] | None:
        """Ids of the inputs that are meant; None where everything is wanted."""
        condition = self.conditions()
        return None if condition is None else select(input_group.c.id).where(condition)

    def accepts(self, values: Mapping[str, Any]) -> bool:
        """Whether something with these values by axis is meant; the same as the conditions, for what has no row."""
        return all(any(_is(values[name], one) for one in wanted) for name, wanted in self.wanted.items())


def profile_of_spec() -> ColumnElement[str | None]:
    """The profile of a run by its specification: none where the run is to choose its settings, as in its result."""
    analysis = run.c.spec["analysis"]
    return case((analysis["max_error"].as_string().is_not(None), None), else_=analysis["profile"].as_string())


def axes_of_run(
    inputs: Mapping[str, Any], grid_id: str, profile: str | None, regularisation: str | None, engine: str | None
) -> dict[str, Any]:
    """The axes of a run, whether it has a result or not."""
    return {
        **USUAL_INPUTS,
        **inputs,
        "grid": grid_id,
        "profile": profile,
        "regularisation": regularisation,
        "engine": engine,
    }


def _read(axis: Axis, text: str) -> Wanted:
    if text == NONE and axis.column.nullable:
        return None
    if not axis.is_number:
        return text
    low, dots, high = text.partition("..")
    try:
        bounds = [float(bound) if bound else None for bound in (low, high if dots else low)]
    except ValueError:
        bounds = []
    is_ordered = len(bounds) == 2 and (None in bounds or bounds[0] <= bounds[1])  # type: ignore[operator]
    if not is_ordered or bounds == [None, None] or any(bound is not None and abs(bound) > 1e300 for bound in bounds):
        raise FilterError(axis.name, text, "a number, or a range as 20..22, 20.. or ..22")
    return Range(*bounds)


def _is(value: Any, wanted: Wanted) -> bool:
    if isinstance(wanted, Range):
        return value is not None and wanted.holds(value)
    return bool(value == wanted)


def _condition(column: Column[Any], wanted: tuple[Wanted, ...]) -> ColumnElement[bool]:
    """One of the values; those that are one number or text stand together, because there may be many."""
    plain: list[Any] = [one for one in wanted if isinstance(one, str)]
    plain += [one.low for one in wanted if isinstance(one, Range) and one.low == one.high]
    parts: list[ColumnElement[bool]] = [column.in_(plain)] if plain else []
    for one in wanted:
        if one is None:
            parts.append(column.is_(None))
        elif isinstance(one, Range) and one.low != one.high:
            bounds = ([] if one.low is None else [column >= one.low]) + (
                [] if one.high is None else [column <= one.high]
            )
            parts.append(and_(*bounds))
    return or_(*parts)
