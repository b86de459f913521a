"""/v1/frontier: the cheapest profile that keeps a numerical error, with its evidence."""

from __future__ import annotations

from typing import Annotated, Any, Literal
from urllib.parse import urlencode

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from pydantic import Field

from service.api.answer_views import share_view, six
from service.api.context import Service
from service.api.freshness import NOT_MODIFIED, REVALIDATED, IfNoneMatch, is_known, not_modified, weak_tag
from service.api.results import ESTIMATORS, PRIORS, RECOMMENDED_PARTS, FilterBody, given_filter, read_filter
from service.api.threads import Route, patient
from service.domain.answers import FrontierAnswer
from service.domain.payload import BUDGETED
from service.domain.requests import list_systems
from service.store.answers import Question
from service.store.bias_rows import content
from service.store.frontier import KEPT, ProfileErrors, profile_errors
from service.store.result_rows import QUANTITY_UNITS

router = APIRouter(prefix="/v1", tags=["answers"], route_class=Route)
_LEAST = 30
"""Stored runs with a predicted error below which no more than a guess is had."""
_TO_KNOW = ("draft", "standard", "reference")
_PAPER = "h0licow-vi"


class FrontierQuery(FilterBody):
    """What /v1/frontier is asked."""

    quantity: Literal[BUDGETED] = "magnitude"  # type: ignore[valid-type]
    max_error: float = Field(gt=0.0, le=100.0, allow_inf_nan=False, description="In units of the quantity")
    estimator: Literal[ESTIMATORS] = RECOMMENDED_PARTS[0]  # type: ignore[valid-type]
    index_prior: Literal[PRIORS] = RECOMMENDED_PARTS[1]  # type: ignore[valid-type]


@router.get("/frontier", response_model=FrontierAnswer, responses=NOT_MODIFIED)
@patient
def frontier(
    request: Request,
    service: Service,
    query: Annotated[FrontierQuery, Query()],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """The cheapest profile whose stored runs predict a numerical error that is no larger, and how sure that is."""
    question = Question(read_filter(query), query.quantity, query.estimator, query.index_prior)
    with service.database.read() as connection:
        tag = weak_tag(request, content(connection, question.where))
        if is_known(tag, if_none_match):
            return not_modified(tag)
        found = profile_errors(connection, question, query.max_error)
    cheapest = next((one for one in found if one.kept), None)
    few = [one.profile for one in found if one.error.size < _LEAST]
    known = {one.profile for one in found}
    lacking = [name for name in _TO_KNOW if name in few or name not in known]
    answer = {
        "quantity": query.quantity,
        "unit": "mag" if query.quantity == "magnitude" else QUANTITY_UNITS[query.quantity],
        "max_error": query.max_error,
        "estimator": query.estimator,
        "index_prior": query.index_prior,
        "filter": given_filter(query),
        "kept_by": KEPT,
        "cheapest": None if cheapest is None else cheapest.profile,
        "told": _told(query, found, cheapest),
        "profiles": [_profile_view(query, one) for one in found],
        "to_know": [_request(query, name) for name in lacking],
    }
    text = FrontierAnswer.model_validate(answer).model_dump_json()
    return Response(text, media_type="application/json", headers={"ETag": tag, **REVALIDATED})


def _told(query: FrontierQuery, found: list[ProfileErrors], cheapest: ProfileErrors | None) -> str:
    name = f"{query.estimator}, n {query.index_prior}"
    if not any(one.error.size for one in found):
        return f"no stored run has a predicted error of {query.quantity} by {name}: run what to_know holds"
    if cheapest is None:
        return f"no profile keeps {query.max_error:g} in {100 * KEPT:.0f} % of its stored runs"
    kept = round(float(cheapest.keeps.fraction[0]) * cheapest.error.size)
    few = f"; fewer than {_LEAST} runs are little evidence" if cheapest.error.size < _LEAST else ""
    return f"{cheapest.profile} keeps {query.max_error:g} in {kept} of {cheapest.error.size} stored runs{few}"


def _profile_view(query: FrontierQuery, found: ProfileErrors) -> dict[str, Any]:
    known = bool(found.error.size)
    spread = float(found.cpu_s.std(ddof=1)) if found.cpu_s.size > 1 else None
    asked = given_filter(query) | {"profile": [found.profile]}
    where = {**asked, "estimator": query.estimator, "index_prior": query.index_prior}
    return {
        "profile": found.profile,
        "stored": found.stored,
        "with_error": int(found.error.size),
        "kept": found.kept,
        "keeps": share_view(found.keeps, 0) if known else None,
        "median_error": six(float(np.median(found.error))) if known else None,
        "p95_error": six(float(np.quantile(found.error, 0.95))) if known else None,
        "cpu_s": six(found.expected_cpu_s),
        "cpu_s_scatter": None if spread is None else six(spread),
        "run_ids": found.run_ids,
        "links": {"results": f"/v1/results?{urlencode(where, doseq=True)}"},
    }


def _request(query: FrontierQuery, profile: str) -> dict[str, Any]:
    """A body of POST /v1/grids, the paper's hosts at its lower slope: runs of a profile from which it can be known."""
    known = {item.name for item in list_systems()}
    systems = [name for name in given_filter(query).get("system", []) if name in known]
    return {
        "name": f"errors of {profile}",
        "preset": _PAPER,
        **({"systems": systems} if systems else {}),
        "l_eta": [1.0],
        "replicates": 2,
        "analysis": {"profile": profile, "estimators": [query.estimator]},
    }
