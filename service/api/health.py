"""/healthz, /readyz, /metrics: whether the process answers, whether what it accepts is carried out, and how much."""

from __future__ import annotations

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST

from service.api.context import Service
from service.schemas import Health, Readiness

router = APIRouter(tags=["health"])
_TEXT = {200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "Prometheus text format"}}


@router.get("/healthz")
def healthz() -> Health:
    """Whether this process answers."""
    return Health()


@router.get("/readyz")
def readyz(service: Service) -> Readiness:
    """Database, dispatcher and workers; ``degraded`` where nothing computes.

    503 where the database is away or its schema is not the one that this code was written for.
    """
    service.database.require_schema()
    leader = service.leadership.alive()
    workers = 0 if leader is None else leader.workers
    return Readiness(
        status="ready" if workers else "degraded",
        dispatcher="missing" if leader is None else "ok",
        workers=workers,
        engines={} if leader is None else leader.engines,
        beat_at=None if leader is None else leader.beat_at,
    )


@router.get("/metrics", response_class=Response, responses=_TEXT)  # type: ignore[arg-type]
def metrics(service: Service) -> Response:
    """Metrics of this process and of the queue, for Prometheus."""
    return Response(service.metrics.text(), media_type=CONTENT_TYPE_LATEST)
