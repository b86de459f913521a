"""The FastAPI application."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import Depends, FastAPI, Request
from fastapi.responses import JSONResponse

from service import VERSION
from service.api import (
    catalogue,
    downloads,
    events,
    exports,
    figures,
    frontier,
    grids,
    health,
    login,
    measurements,
    predictions,
    problems,
    results,
    run_files,
    site,
)
from service.api.context import Context, bind_ids
from service.api.gate import COOKIE, Gate
from service.api.limits import BodyLimit, known_parameters
from service.api.methods import Head
from service.api.metrics import Measured
from service.api.observer import observing
from service.domain.views import Problem
from service.runtime.settings import Settings

_PROBLEM: dict[str, Any] = {
    "description": "A problem (RFC 9457)",
    "content": {problems.MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
}


# Neither where the service listens on loopback: it asks for no token there unless told to.
_SECURITY: dict[str, Any] = {
    "token": {"type": "http", "scheme": "bearer", "description": "As hostlens token create makes it"},
    "cookie": {"type": "apiKey", "in": "cookie", "name": COOKIE, "description": "For pages: set by POST /login"},
}


class _App(FastAPI):
    """FastAPI with every error documented as the problem that it is."""

    def openapi(self) -> dict[str, Any]:
        """Make the document once; FastAPI's own describes 422 in a form that this API does not send."""
        if self.openapi_schema is None:
            document = super().openapi()
            schemas = document.setdefault("components", {}).setdefault("schemas", {})
            schemas["Problem"] = Problem.model_json_schema(
                mode="serialization", ref_template="#/components/schemas/{model}"
            )
            schemas |= schemas["Problem"].pop("$defs", {})
            schemas.pop("HTTPValidationError", None)
            schemas.pop("ValidationError", None)
            document["components"]["securitySchemes"] = _SECURITY
            document["security"] = [{}, *({name: []} for name in _SECURITY)]
            for operations in document["paths"].values():
                for operation in operations.values():
                    operation["responses"].pop("422", None)
                    operation["responses"] |= {"4XX": _PROBLEM, "5XX": _PROBLEM}
            self.openapi_schema = document
        return self.openapi_schema


async def _document(request: Request) -> JSONResponse:
    return JSONResponse(request.app.openapi())


def create_app(settings: Settings | None = None) -> FastAPI:
    """Build the application; the database must have been migrated, and need not be there yet."""
    context = Context(settings or Settings())

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        # Nothing but connections lives with the application: the dispatcher is a process of its own.
        with observing(context.leadership, context.settings.heartbeat_s):
            yield
        context.database.close()

    app = _App(
        title="hostlens",
        version=VERSION,
        summary="How faithfully can the host galaxy of a lensed quasar be reconstructed?",
        # Served below instead: FastAPI's own address would take any parameter.
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
        dependencies=[Depends(known_parameters), Depends(bind_ids)],
        redirect_slashes=False,
    )
    app.state.context = context
    app.add_middleware(BodyLimit, max_bytes=context.settings.max_body_bytes, streamed=frozenset({measurements.ADDRESS}))
    # Before the body is read: who may not come in sends none.
    asked = context.tokens if context.settings.asks_for_tokens else None
    app.add_middleware(Gate, tokens=asked, hosts=context.settings.hosts)
    app.add_middleware(Head)
    # Last added is outermost: refused bodies are requests too.
    app.add_middleware(Measured, metrics=context.metrics)
    problems.install(app)
    app.add_api_route("/openapi.json", _document, include_in_schema=False)
    downloads.install(app)
    figures.install(app)
    for room in (
        grids, run_files, figures, results, frontier, predictions, exports, measurements, events, catalogue,
        health, login,
    ):  # fmt: skip
        app.include_router(room.router)
    site.install(app)
    return app
