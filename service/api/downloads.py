"""Artefacts as answers, and the problems that stand for those that cannot be given."""

from __future__ import annotations

import logging

from fastapi import FastAPI, Request, Response

from service.api.freshness import REVALIDATED, is_known, not_modified
from service.api.problems import problem
from service.store.artefacts import ArtefactDamagedError, ArtefactGoneError, ArtefactStore, ArtefactStoreError

_LOG = logging.getLogger(__name__)


def artefact(store: ArtefactStore, key: str, media_type: str, if_none_match: str | None) -> Response:
    """An artefact, checked against its digest, or 304 where the client has it: what a key names never changes."""
    etag = f'"{key}"'
    if is_known(etag, if_none_match):
        return not_modified(etag)
    return Response(store.read(key), media_type=media_type, headers={"ETag": etag, **REVALIDATED})


def install(app: FastAPI) -> None:
    """Answer what the artefact store raises with problems that name the artefact."""
    app.add_exception_handler(ArtefactGoneError, _gone)
    app.add_exception_handler(ArtefactDamagedError, _damaged)
    app.add_exception_handler(ArtefactStoreError, _away)


def _gone(request: Request, error: Exception) -> Response:
    return problem(request, 410, str(error), artefact=getattr(error, "key", None))


def _damaged(request: Request, error: Exception) -> Response:
    _LOG.error("%s", error)
    return problem(request, 500, str(error), artefact=getattr(error, "key", None))


def _away(request: Request, error: Exception) -> Response:
    _LOG.error("the artefact store is not available: %s", error)
    return problem(request, 503, "the artefact store is not available", headers={"Retry-After": "5"})
