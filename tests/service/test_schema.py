"""Schemathesis reads the OpenAPI document and tries everything: no 5xx, nothing undocumented."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis.checks import not_a_server_error
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from service.api.app import create_app
from service.settings import Settings
from service.store.database import Database
from service.store.migrate import upgrade
from tests.service.plans import BODY, body
from tests.service.test_api import TestClient, work

CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


@pytest.fixture(scope="module")
def schema(tmp_path_factory: pytest.TempPathFactory) -> Iterator[schemathesis.schemas.BaseSchema]:
    folder = tmp_path_factory.mktemp("schema")
    own = Settings(database_url=f"sqlite:///{folder}/schema.sqlite", data_dir=folder, max_grid_runs=50)
    upgrade(own.database)
    app = create_app(own)
    with TestClient(app) as client:
        # Something to be found: a grid that is done, and one that waits.
        client.post("/v1/grids", json=body(3))
        work(own)
        client.post("/v1/grids", json={**BODY, "n": [4]})
    loaded = schemathesis.openapi.from_asgi("/openapi.json", app)
    # The engine's digest needs the engine's numerics, which have tests of their own.
    yield loaded.exclude(path="/v1/engine")
    Database(own.database).close()


CASES = settings(
    max_examples=50,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


@pytest.mark.parametrize("mode", list(GenerationMode))
def test_no_request_that_fits_or_breaks_the_schema_gives_a_5xx(
    schema: schemathesis.schemas.BaseSchema, mode: GenerationMode
) -> None:
    tried = 0
    for found in schema.get_all_operations():
        operation = found.ok()

        @CASES
        @given(case=operation.as_strategy(generation_mode=mode))
        def try_it(case: schemathesis.Case) -> None:
            nonlocal tried
            tried += 1
            case.call_and_validate(checks=CHECKS)

        try:
            try_it()
        except Unsatisfiable:
            # Nothing can break an operation without parameters.
            assert mode is GenerationMode.NEGATIVE
    print(f"{tried} requests")
    assert tried > 100
