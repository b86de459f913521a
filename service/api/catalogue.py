"""/v1/systems, /v1/cameras, /v1/engine."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path

from engine import SpecError
from service import VERSION
from service.api.links import link_system
from service.domain.requests import engine_view, list_cameras, list_systems, system_view
from service.domain.views import CameraList, EngineView, SystemList, SystemView
from service.store.runs import NotFoundError

router = APIRouter(prefix="/v1", tags=["catalogue"])
# Its handlers are no threads' work: what they give was read with the engine.


@router.get("/systems")
async def systems() -> SystemList:
    """The lens systems that a grid may name."""
    return SystemList(items=[link_system(found) for found in list_systems()])


@router.get("/systems/{name}")
async def system(name: Annotated[str, Path(max_length=64)]) -> SystemView:
    """One lens system with source and confidence of every number."""
    try:
        return link_system(system_view(name))
    except SpecError as error:
        raise NotFoundError(str(error)) from error


@router.get("/cameras")
async def cameras() -> CameraList:
    """The cameras of the catalogue."""
    return CameraList(items=list_cameras())


@router.get("/engine")
async def engine() -> EngineView:
    """Which engine this process carries, and the presets that it knows."""
    return engine_view(VERSION)
