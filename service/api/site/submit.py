"""/submit: a form made of the schema of POST /v1/grids, with the same answers at its fields."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import islice
from typing import Any
from urllib.parse import parse_qs

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import ValidationError

from engine import (
    LensEquationError,
    SpecError,
    camera_names,
    complaint,
    engine_digest,
    field_path,
    path_steps,
    preset_names,
    read_json,
    system_names,
)
from service.api.context import Context, Service
from service.api.gate import Asking
from service.api.problems import UnsupportedBodyError
from service.api.threads import PATIENT, Route, run_in
from service.domain.requests import GridRequest, Plan, TooManyRunsError, plan
from service.web.form import Field, document_of, field_of, form_fields
from service.web.rendering import page

router = APIRouter(include_in_schema=False, route_class=Route)
_FORM = "application/x-www-form-urlencoded"
_SHOWN_LABELS = 24
_MOST_FIELDS = 100
_MAIN = ("name", "preset", "systems", "n", "r_eff", "magnitude", "l_eta", "replicates", "until", "seed")
_CHOICES = {"preset": preset_names}
_LABELS = {
    "n": "Sérsic index n", "r_eff": "radius r_eff", "magnitude": "magnitude of the host", "l_eta": "slope l_eta",
    "mass_model": "mass model",
}  # fmt: skip
_HINTS = {
    "name": "what it is called in lists and figures",
    "preset": "a part of the grid of the paper",
    "systems": f"of {', '.join(system_names())}; or a system of your own as JSON",
    "camera": f"instead of the systems' own: {', '.join(camera_names())}; or a camera of your own as JSON",
    "mass_model": "of the systems",
    "n": "as 1, 2, 4",
    "r_eff": "half-light radius [arcsec]",
    "magnitude": "AB",
    "l_eta": "slope of the deflector's mass, less 1",
    "replicates": "realizations of each point",
    "seed": "of the first realization",
    "until": 'instead of replicates, until the mean bias is known: as {"quantity": "magnitude", "error": 0.02}',
}


@router.get("/submit")
def empty_form() -> Response:
    """The form."""
    return _page(_fields())


@router.post("/submit")
async def submitted(request: Request, service: Service, caller: Asking) -> Response:
    """Check what was filled in, or start it and go to its page; the form again where something is wrong."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != _FORM:
        raise UnsupportedBodyError("content-type", kind, _FORM, {"Accept-Post": _FORM})
    typed = parse_qs((await request.body()).decode("utf-8", "replace"), max_num_fields=_MOST_FIELDS)
    return await run_in(PATIENT, _take, service, caller.name, {name: values[-1] for name, values in typed.items()})


def _take(service: Context, owner: str | None, typed: Mapping[str, str]) -> Response:
    fields = [replace(field, value=typed.get(field.name, "")) for field in _fields()]
    document, wrong = document_of(fields, typed, _json)
    body, runs = None, None
    if not wrong:
        body, runs, wrong = _planned(document, fields, service.settings.max_grid_runs)
    key = typed.get("key", "")[:64]
    if body is None or runs is None:
        return _page(fields, wrong=wrong, key=key, status=422)
    if typed.get("do") != "submit":
        labels = [run.label for run in islice(runs, _SHOWN_LABELS)]
        cost = service.costs.cost(runs.kinds())
        dry = {"n_runs": len(runs), "least_runs": runs.least, "labels": labels, "cost": cost}
        return _page(fields, dry=dry)
    made = service.grids.create(
        body.canonical(),
        lambda: runs,
        body.name,
        f"page:{key}" if key else None,
        engine_digest(),
        owner,
        lambda: service.costs.expected_wall_s(runs.kinds()),
        body.until,
    )
    return RedirectResponse(f"/grids/{made.grid.id}", 303, {"Cache-Control": "no-store"})


def _json(text: str) -> Any:
    try:
        return read_json(text)
    except SpecError as error:
        raise ValueError(str(error)) from error


def _planned(
    document: dict[str, Any], fields: list[Field], most: int
) -> tuple[GridRequest | None, Plan | None, dict[str, str]]:
    """What the document asks for, or what is wrong with it, by field; no field for what concerns all."""
    names = [field.name for field in fields]
    try:
        body = GridRequest.model_validate(document)
        return body, plan(body, most), {}
    except ValidationError as error:
        wrong: dict[str, str] = {}
        for found in error.errors():
            steps, value, allowed = complaint(dict(found))
            wrong.setdefault(field_of(steps, names), str(SpecError(field_path(steps), value, allowed)))
        return None, None, wrong
    except SpecError as error:
        return None, None, {field_of(path_steps(error.field), names): str(error)}
    except TooManyRunsError as error:
        return None, None, {"replicates": str(error)}
    except LensEquationError as error:
        return None, None, {"systems": str(error)}


@cache
def _fields() -> tuple[Field, ...]:
    found = []
    for field in form_fields(GridRequest.model_json_schema()):
        said = "; ".join(filter(None, (_HINTS.get(field.name, ""), field.hint)))
        options = tuple(_CHOICES[field.name]()) if field.name in _CHOICES else field.options
        blank = "none" if field.name in _CHOICES else field.blank
        label = _LABELS.get(field.name, field.label)
        found.append(replace(field, label=label, hint=said, options=options, blank=blank))
    order = {name: place for place, name in enumerate(_MAIN)}
    return tuple(sorted(found, key=lambda field: order.get(field.name, len(order))))


def _page(
    fields: Sequence[Field],
    wrong: Mapping[str, str] | None = None,
    dry: dict[str, Any] | None = None,
    key: str = "",
    status: int = 200,
) -> Response:
    wrong = wrong or {}
    shown = [replace(field, error=wrong.get(field.name, "")) for field in fields]
    is_filled = [field for field in shown if field.value or field.error]
    return page(
        "submit.html",
        status,
        here="/submit",
        main=[field for field in shown if field.name in _MAIN],
        instrument=[field for field in shown if field.name not in _MAIN and "." not in field.name],
        analysis=[field for field in shown if "." in field.name],
        instrument_open=any(field.name not in _MAIN and "." not in field.name for field in is_filled),
        analysis_open=any("." in field.name for field in is_filled),
        errors=list(wrong.items()),
        dry=dry,
        # The same form sent twice is one grid; one that was shown anew is another.
        key=key or secrets.token_hex(16),
    )
