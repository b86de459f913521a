"""Schemathesis reads the OpenAPI document and tries everything: no 5xx, nothing undocumented."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, reject, settings
from hypothesis.errors import Unsatisfiable
from hypothesis.strategies import DrawFn, composite
from schemathesis.checks import not_a_server_error
from schemathesis.generation import GenerationMode
from schemathesis.schemas import APIOperation
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from service.api.app import create_app
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.leases import Outcome
from service.store.migrate import upgrade
from service.store.queue import Failure, RunQueue
from tests.service.conftest import empty
from tests.service.plans import BODY, body
from tests.service.tasks import PNG
from tests.service.test_api import TestClient, work

HEADER = b"".join(card.ljust(80) for card in (b"SIMPLE  =                    T", b"END")).ljust(2880)
"""A FITS file as far as anybody looks who is no worker."""
PATIENCE_S = 120
"""For an answer: a file of all estimators' columns takes a second of CPU, and more of a busy machine's."""
CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def schema(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[schemathesis.schemas.BaseSchema]:
    folder = tmp_path_factory.mktemp("schema")
    if request.param == "sqlite":
        url = f"sqlite:///{folder}/schema.sqlite"
        upgrade(url)
    else:
        url = str(request.getfixturevalue("migrated_postgres"))
        empty(url)
    own = Settings(database_url=url, data_dir=folder, max_grid_runs=50)
    app = create_app(own)
    with TestClient(app) as client:
        # Something to be found: grids that are done, failed, paused and cancelled, and one that waits.
        done = client.post("/v1/grids", json=body(3)).json()
        work(own, ArtefactStore(own.artefacts).put(PNG, "png"))
        client.post("/v1/grids", json=body(2, seed=7))
        fail(own)
        paused = client.post("/v1/grids", json={**BODY, "n": [4]}).json()
        client.post(paused["links"]["pause"])
        cancelled = client.post("/v1/grids", json=body(1, seed=9)).json()
        client.post(cancelled["links"]["cancel"])
        client.post("/v1/grids", json=body(2, seed=20))
        waiting = client.post("/v1/measurements", files={"image": HEADER, "psf": HEADER}, data={"zeropoint": "25"})
        assert waiting.status_code == 202
        runs = client.get(done["links"]["runs"]).json()["items"]
    KNOWN["grid_id"] = [done["id"], paused["id"], cancelled["id"], waiting.json()["id"]]
    KNOWN["run_id"] = [run["id"] for run in runs]
    loaded = schemathesis.openapi.from_asgi("/openapi.json", app)
    # The engine's digest needs the engine's numerics, which have tests of their own.
    yield loaded.exclude(path="/v1/engine")
    app.state.context.database.close()


def fail(settings: Settings) -> None:
    """Let every queued run fail, as a dispatcher would."""
    database = Database(settings.database)
    generation = Leadership(database).take("failing", lambda _: True)
    assert generation is not None
    queue = RunQueue(database)
    for lease in queue.claim(generation, 1000):
        queue.fail(lease, Failure(Outcome.ERROR, "invalid_spec", "it was not to be", retries=0))
    database.close()


# Identifiers of what is there, for half of the cases: made ones meet nothing but 404.
KNOWN: dict[str, list[str]] = {}
CASES = settings(
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


@composite
def cases(draw: DrawFn, operation: APIOperation, mode: GenerationMode) -> schemathesis.Case:
    """Cases of an operation, without those that Schemathesis fails to make.

    What it makes of the schema of a file it cannot check against that schema itself, now and then.
    """
    try:
        return draw(operation.as_strategy(generation_mode=mode))
    except ValueError as error:
        if str(error) != "Unsupported type: 'Binary'":
            raise
        return reject()


@pytest.mark.parametrize(("each", "least"), [(5, 80), pytest.param(120, 2000, marks=pytest.mark.long)])
@pytest.mark.parametrize("mode", list(GenerationMode))
def test_no_request_that_fits_or_breaks_the_schema_gives_a_5xx(
    schema: schemathesis.schemas.BaseSchema, mode: GenerationMode, each: int, least: int
) -> None:
    tried = 0
    for found in schema.get_all_operations():
        operation = found.ok()

        @settings(CASES, max_examples=each)
        @given(case=cases(operation, mode))
        def try_it(case: schemathesis.Case) -> None:
            nonlocal tried
            tried += 1
            if tried % 2:
                for name in case.path_parameters.keys() & KNOWN.keys():
                    # What is there is not waited for: nothing will happen to it.
                    case.query = {key: value for key, value in (case.query or {}).items() if key != "wait"}
                    case.path_parameters[name] = KNOWN[name][tried // 2 % len(KNOWN[name])]
            case.call_and_validate(checks=CHECKS, timeout=PATIENCE_S)

        try:
            try_it()
        except Unsatisfiable:
            # Nothing can break an operation without parameters.
            assert mode is GenerationMode.NEGATIVE
    print(f"{tried} requests")
    assert tried >= least
