"""The API as a process."""

from __future__ import annotations

import logging

import uvicorn

from service import logs
from service.api.app import create_app
from service.process import spare_collector, stop_with_parent
from service.settings import Settings


def serve(settings: Settings) -> None:
    """Serve until SIGINT or SIGTERM, or until the supervisor that started this process is gone."""
    logs.configure(settings, "api")
    # At INFO uvicorn tells four things of every start; its line on each request has a logger of its own.
    logging.getLogger("uvicorn.error").setLevel(max(logging.WARNING, logging.root.level))
    stop_with_parent()
    app = create_app(settings)
    spare_collector()
    uvicorn.run(app, host=settings.host, port=settings.port, log_config=None, timeout_graceful_shutdown=5)
