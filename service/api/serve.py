"""The API as a process."""

from __future__ import annotations

import uvicorn

from service.api.app import create_app
from service.process import spare_collector, stop_with_parent
from service.settings import Settings


def serve(settings: Settings) -> None:
    """Serve until SIGINT or SIGTERM, or until the supervisor that started this process is gone."""
    stop_with_parent()
    app = create_app(settings)
    spare_collector()
    uvicorn.run(app, host=settings.host, port=settings.port, log_level="warning", timeout_graceful_shutdown=5)
