"""The API as a process."""

from __future__ import annotations

import logging

from service.api import transport
from service.api.app import create_app
from service.runtime import logs, preflight
from service.runtime.process import inherited_listener, spare_collector, stop_with_parent
from service.runtime.settings import Settings


def serve(settings: Settings) -> None:
    """Serve until SIGINT or SIGTERM, or until the supervisor that started this process is gone.

    Raises
    ------
    service.runtime.settings.ConfigurationError
        What the settings name is not there or cannot be used.
    """
    logs.configure(settings, "api")
    # At INFO uvicorn tells four things of every start; its line on each request has a logger of its own.
    logging.getLogger("uvicorn.error").setLevel(max(logging.WARNING, logging.root.level))
    stop_with_parent()
    listener = inherited_listener()
    preflight.for_api(settings)
    if listener is None:
        preflight.require_free(settings.host, settings.port, preflight.API_PORT)
    app = create_app(settings)
    spare_collector()
    transport.run(app, settings, app.state.context.hub.close, listener)
