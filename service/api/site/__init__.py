"""Pages for people: what the API answers, as HTML."""

from fastapi import FastAPI
from starlette.staticfiles import StaticFiles

from service.api.site import compare, grids, runs, status, submit
from service.web.rendering import STATIC

_ROOMS = (grids, runs, submit, compare, status)


def install(app: FastAPI) -> None:
    """Add the pages and the files that they load."""
    for room in _ROOMS:
        app.include_router(room.router)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
