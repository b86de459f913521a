"""/healthz and /readyz: whether the process answers, and whether what it accepts is carried out."""

from __future__ import annotations

from fastapi import APIRouter

from service.api.context import Service
from service.schemas import Health, Readiness

router = APIRouter(tags=["health"])


@router.get("/healthz")
def healthz() -> Health:
    """Whether this process answers."""
    return Health()


@router.get("/readyz")
def readyz(service: Service) -> Readiness:
    """Database, dispatcher and workers; 503 where the database is away, ``degraded`` where nothing computes."""
    leader = service.leadership.alive()
    workers = 0 if leader is None else leader.workers
    return Readiness(
        status="ready" if workers else "degraded",
        dispatcher="missing" if leader is None else "ok",
        workers=workers,
        engines={} if leader is None else leader.engines,
        beat_at=None if leader is None else leader.beat_at,
    )
