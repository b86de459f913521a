"""/compare: two grids, or two analyses, of the same observations."""

from __future__ import annotations

from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Response

from service.api.answer_views import difference_view
from service.api.context import Context, Service
from service.api.site.questions import SHOWN_AXES, AxisName, QuantityName, group_name, question
from service.api.threads import Route, patient
from service.domain.payload import ESTIMATES, QUANTITIES, RECOMMENDED, estimator_and_prior
from service.store.answers import ANALYSES, compare
from service.store.map_rows import values_of
from service.store.result_filter import ResultFilter
from service.store.result_rows import QUANTITY_UNITS
from service.web.rendering import page

router = APIRouter(include_in_schema=False, route_class=Route)
_CHOICES = ("grid", *ANALYSES)
_KNOWN_GRIDS = 200
_KNOWN = {
    "estimator": tuple(dict.fromkeys(estimator_and_prior(name)[0] for name in ESTIMATES)),
    "index_prior": tuple(dict.fromkeys(estimator_and_prior(name)[1] for name in ESTIMATES)),
}
Side = Annotated[str, Query(max_length=200)]


@router.get("/compare")
@patient
def two_analyses(
    service: Service,
    by: Literal[_CHOICES] = "grid",  # type: ignore[valid-type]
    left: Side = "",
    right: Side = "",
    group_by: AxisName = "system",
    quantity: QuantityName = "magnitude",
) -> Response:
    """Differences, pair by pair."""
    known = _known(service, by)
    names = dict(known)
    error, rows = "", None
    if left and right:
        unknown = [value for value in (left, right) if value not in names]
        if left == right:
            error = f"left and right are the same: {left}"
        elif unknown and by != "grid":
            error = f"{by}: got {unknown[0]}, known are {', '.join(names) or 'none'}"
        else:
            rows = _rows(service, by, left, right, group_by, quantity)
    return page(
        "compare.html",
        here="/compare",
        choices=_CHOICES,
        by=by,
        left=left,
        right=right,
        known=known,
        names=[names.get(left, left), names.get(right, right)],
        axes=SHOWN_AXES,
        group_by=group_by,
        quantities=QUANTITIES,
        quantity=quantity,
        unit=QUANTITY_UNITS[quantity],
        error=error,
        rows=rows,
        figures=_figures(by, left, right, names) if rows else [],
    )


def _known(service: Context, by: str) -> list[tuple[str, str]]:
    """Values that may be compared, with what to call them."""
    if by == "grid":
        return [(grid.id, grid.name or grid.id) for grid in service.grids.grids(_KNOWN_GRIDS).items]
    if by in _KNOWN:
        return [(name, name) for name in _KNOWN[by]]
    with service.database.read() as connection:
        return [(name, name) for name in values_of(connection, by)]


def _rows(service: Context, by: str, left: str, right: str, axis: str, quantity: str) -> list[dict[str, Any]]:
    asked = question(ResultFilter(), quantity, RECOMMENDED)
    with service.database.read() as connection:
        groups, found = compare(connection, asked, by, left, right, (axis,))
    return [
        {"group": group_name(value), **difference_view(found, place)}
        for place, (value,) in enumerate(groups.values)
        if found.difference.number[place]
    ]


def _figures(by: str, left: str, right: str, names: dict[str, str]) -> list[tuple[str, str]]:
    """The sample of each side, one below the other on a phone."""
    return [
        (names.get(side, side), f"/v1/figures/sample.svg?{urlencode({by: side, 'columns': 1})}")
        for side in (left, right)
        # Where n is fixed stands beside where it is free in the other one.
        if (by, side) != ("index_prior", "fixed")
    ]
