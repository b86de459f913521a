"""The API as a process."""

from __future__ import annotations

import logging
import signal

import uvicorn

from service import logs, preflight, start
from service.api.app import create_app
from service.process import spare_collector, stop_with_parent
from service.settings import Settings


def serve(settings: Settings) -> None:
    """Serve until SIGINT or SIGTERM, or until the supervisor that started this process is gone.

    Raises
    ------
    service.settings.ConfigurationError
        What the settings name is not there or cannot be used.
    """
    logs.configure(settings, "api")
    # At INFO uvicorn tells four things of every start; its line on each request has a logger of its own.
    logging.getLogger("uvicorn.error").setLevel(max(logging.WARNING, logging.root.level))
    stop_with_parent()
    preflight.for_api(settings)
    app = create_app(settings)
    spare_collector()
    config = uvicorn.Config(app, settings.host, settings.port, log_config=None, timeout_graceful_shutdown=5)
    server = uvicorn.Server(config)
    # Uvicorn sends itself the signals that ended it once more, for whoever handled them before: also the server.
    for number in start.STOPS:
        signal.signal(number, server.handle_exit)
    server.run()
