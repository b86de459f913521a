"""/status: whether what is submitted is being computed, and by whom."""

from __future__ import annotations

from fastapi import APIRouter, Response

from engine import engine_digest
from service.api.context import Service
from service.api.threads import Route, patient
from service.store.depth import Depth, QueueDepth
from service.web.rendering import page

router = APIRouter(include_in_schema=False, route_class=Route)


@router.get("/status")
@patient
def status(service: Service) -> Response:
    """Queue, leader, workers, engines."""
    depth = QueueDepth(service.database).look()
    leader = depth.leader
    alive = leader is not None and service.leadership.beats(leader)
    engine = engine_digest()
    return page(
        "status.html",
        here="/status",
        depth=depth,
        leader=leader,
        alive=alive,
        silent_s=None if leader is None else service.leadership.silent_s(leader),
        engine=engine,
        database="SQLite" if service.database.is_sqlite else "PostgreSQL",
        trouble=_trouble(depth, alive=alive, engine=engine),
    )


def _trouble(depth: Depth, *, alive: bool, engine: str) -> str:
    """What keeps runs from being computed; empty where nothing does."""
    leader = depth.leader
    if leader is None or not alive:
        return "No dispatcher runs: what is submitted waits until one does."
    if leader.artefacts_away:
        return "The artefact store takes nothing: runs wait until it does."
    if not leader.workers:
        return "There is no worker: runs wait until there is one."
    if engine not in leader.engines:
        return "No worker has the engine of this service: its grids wait for one."
    return ""
