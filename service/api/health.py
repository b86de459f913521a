"""/healthz, /readyz, /metrics: whether the process answers, whether what it accepts is carried out, and how much."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, HTTPException, Response
from prometheus_client import CONTENT_TYPE_LATEST

from service.api.context import Context, Service
from service.api.threads import PROBES, Route, patient, run_in
from service.domain.views import Health, Readiness
from service.store.leadership import LeaderView

router = APIRouter(tags=["health"], route_class=Route)
_DATABASE_S = 2.0
_TEXT = {200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "Prometheus text format"}}


@router.get("/healthz")
async def healthz() -> Health:
    """Whether this process answers: it waits for no thread and for no database."""
    return Health()


@router.get("/readyz")
async def readyz(service: Service) -> Readiness:
    """Database, dispatcher, artefact store and workers; ``degraded`` where nothing computes.

    503 where the database is away or its schema is not the one that this code was written for.
    """
    try:
        leader = await asyncio.wait_for(run_in(PROBES, _leader, service), _DATABASE_S)
    except TimeoutError as error:
        detail = f"the database did not answer within {_DATABASE_S:g} s"
        raise HTTPException(503, detail, headers={"Retry-After": "5"}) from error
    workers = 0 if leader is None else leader.workers
    artefacts_away = leader is not None and leader.artefacts_away
    return Readiness(
        status="ready" if workers and not artefacts_away else "degraded",
        dispatcher="missing" if leader is None else "ok",
        artefacts="away" if artefacts_away else "ok",
        workers=workers,
        engines={} if leader is None else leader.engines,
        beat_at=None if leader is None else leader.beat_at,
    )


def _leader(service: Context) -> LeaderView | None:
    service.probed.require_schema()
    return service.leadership.alive()


@router.get("/metrics", response_class=Response, responses=_TEXT)  # type: ignore[arg-type]
@patient
def metrics(service: Service) -> Response:
    """Metrics of this process and of the queue, for Prometheus."""
    return Response(service.metrics.text(), media_type=CONTENT_TYPE_LATEST)
