"""Pages for people: what the API answers, as HTML."""

from fastapi import APIRouter, FastAPI
from starlette.staticfiles import StaticFiles

from service.api.site import compare, grids, runs, status, submit
from service.web.rendering import STATIC

_ROOMS = (grids, runs, submit, compare, status)


def install(app: FastAPI) -> None:
    """Add the pages and the files that they load."""
    router = APIRouter(include_in_schema=False)
    for room in _ROOMS:
        router.include_router(room.router)
    app.include_router(router)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
