"""The OpenAPI document as it is committed: ``python -m tests.docs.openapi`` writes it anew."""

from __future__ import annotations

import json

from service.api.app import create_app
from service.runtime.settings import Settings
from tests.docs.pages import ROOT

FILE = ROOT / "docs" / "reference" / "openapi.json"


def document_text() -> str:
    """The document of the application, a line for each value."""
    return json.dumps(create_app(Settings()).openapi(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    FILE.write_text(document_text())
