"""Who comes in, what each may do, and that nobody learns a token from here."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from typer.testing import CliRunner

from service.api.app import create_app
from service.api.gate import COOKIE, OPEN
from service.cli.app import app as command_line
from service.domain.access import Caller, Scope
from service.runtime import preflight
from service.runtime.settings import Settings
from service.runtime.start import ConfigurationError
from service.store.database import Database
from service.store.tables import token
from service.store.tokens import TokenStore
from tests.service.conftest import Clock
from tests.service.plans import body
from tests.service.test_api import assert_problem

ELSEWHERE = "0.0.0.0"  # noqa: S104 - nothing listens there


@pytest.fixture
def store(database: Database) -> TokenStore:
    return TokenStore(database)


@pytest.fixture
def settings(url: str, tmp_path: Path) -> Settings:
    return Settings(database_url=url, data_dir=tmp_path, host=ELSEWHERE)


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False, follow_redirects=False) as client:
        yield client


def bearing(made: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {made}"}


def test_a_token_lets_its_holder_in_until_it_expires_or_is_revoked(database: Database, clock: Clock) -> None:
    store = TokenStore(database, clock)
    made = store.create("ada", Scope.SUBMIT, timedelta(days=1))
    assert store.caller(made) == Caller("ada", Scope.SUBMIT)
    clock.advance(86_399)
    assert store.any_valid()
    clock.advance(1)
    assert store.caller(made) is None
    assert not store.any_valid()
    first, second, other = (store.create(name, Scope.READ) for name in ("bob", "bob", "eve"))
    assert store.revoke(first.split("_")[1]) == 1
    assert store.caller(first) is None
    assert store.caller(second) is not None
    assert store.revoke("bob") == 1
    assert store.caller(second) is None
    assert store.caller(other) == Caller("eve", Scope.READ)
    assert store.revoke("bob") == 0


def test_another_secret_with_a_known_id_lets_nobody_in(store: TokenStore) -> None:
    made = store.create("ada", Scope.ADMIN)
    for wrong in (
        made[:-1] + ("A" if made[-1] != "A" else "B"),
        made[:-1],
        made + "x",
        f" {made}",
        "",
        "hl_",
        "\udcff",
    ):
        assert store.caller(wrong) is None


def test_the_database_holds_nothing_by_which_anybody_could_come_in(database: Database, store: TokenStore) -> None:
    secret = store.create("ada", Scope.ADMIN).split("_", 2)[2]
    with database.read() as connection:
        assert secret not in str(connection.execute(select(token)).all())


@pytest.mark.parametrize("name", ["", "a b", "-x", "x" * 65, "a\n", "\u03b8"])
def test_a_name_that_could_be_taken_for_something_else_is_refused(store: TokenStore, name: str) -> None:
    with pytest.raises(ValueError, match="name"):
        store.create(name, Scope.READ)


def test_every_address_but_those_that_are_open_asks_for_a_token(api: TestClient) -> None:
    document = api.app.openapi()  # type: ignore[attr-defined]
    asked = 0
    for path, operations in {**document["paths"], "/openapi.json": {"get": {}}, "/v1/nothing": {"get": {}}}.items():
        for method in operations:
            answer = api.request(method, path.replace("{", "").replace("}", ""))
            if path in OPEN:
                assert answer.status_code == 200, path
            else:
                asked += 1
                assert_problem(answer, 401)
                assert answer.headers["www-authenticate"] == 'Bearer realm="hostlens"'
    assert asked > 10


def test_a_wrong_token_is_refused_and_said_to_be_wrong(api: TestClient) -> None:
    for given in ("Bearer x", "Basic dXNlcjp4", "Bearer", "bearer  ", "Bearer hl_000000000000_" + "a" * 43):
        answer = api.get("/v1/grids", headers={"Authorization": given})
        assert_problem(answer, 401)
        assert 'error="invalid_token"' in answer.headers["www-authenticate"]


def test_a_token_is_refused_what_its_scope_does_not_allow(api: TestClient, store: TokenStore) -> None:
    reader = bearing(store.create("reader", Scope.READ))
    assert api.get("/v1/grids", headers=reader).status_code == 200
    assert api.get("/metrics", headers=reader).status_code == 200
    answer = api.post("/v1/grids", json=body(1), headers=reader)
    assert_problem(answer, 403)
    assert answer.headers["www-authenticate"].endswith('error="insufficient_scope", scope="submit"')
    # A revoked one is refused from the next request on.
    store.revoke("reader")
    assert_problem(api.get("/v1/grids", headers=reader), 401)


def test_a_body_is_not_read_of_who_may_not_come_in(api: TestClient) -> None:
    read = 0

    def pieces() -> Iterator[bytes]:
        nonlocal read
        for _ in range(3):
            read += 1
            yield b"x" * 1_000_000

    answer = api.post("/v1/grids", content=pieces())
    assert_problem(answer, 401)  # and not 413 or 415
    assert answer.headers["connection"] == "close"


def test_a_grid_is_stopped_by_its_owner_and_by_an_administrator_alone(api: TestClient, store: TokenStore) -> None:
    ada, bob = (bearing(store.create(name, Scope.SUBMIT)) for name in ("ada", "bob"))
    admin = bearing(store.create("root", Scope.ADMIN))
    grid = api.post("/v1/grids", json=body(2), headers={**ada, "Idempotency-Key": "k"}).json()
    assert grid["owner"] == "ada"
    for action in ("pause", "resume", "cancel", "retry"):
        answer = api.post(grid["links"][action], headers=bob)
        assert_problem(answer, 403)
        assert "ada" in answer.json()["detail"]
        if action != "retry":
            assert_problem(api.post(f"/grids/{grid['id']}/{action}", headers=bob), 403)
    assert api.get(grid["links"]["self"], headers=bob).json()["state"] == "queued"
    assert api.post(grid["links"]["pause"], headers=ada).json()["state"] == "paused"
    # Another token of the same name is the same person's.
    again = bearing(store.create("ada", Scope.SUBMIT))
    assert api.post(grid["links"]["resume"], headers=again).json()["state"] == "queued"
    assert api.post(grid["links"]["cancel"], headers=admin).json()["state"] == "cancelled"
    assert_problem(api.post(f"/v1/grids/g_{'0' * 26}/cancel", headers=ada), 404)
    # A key is its owner's.
    assert_problem(api.post("/v1/grids", json=body(2), headers={**bob, "Idempotency-Key": "k"}), 422, "idempotency-key")


def test_a_grid_of_nobody_is_an_administrators(api: TestClient, store: TokenStore, settings: Settings) -> None:
    with TestClient(create_app(settings.model_copy(update={"host": "127.0.0.1"}))) as open_api:
        grid = open_api.post("/v1/grids", json=body(1)).json()
        assert grid["owner"] is None
    assert_problem(api.post(grid["links"]["cancel"], headers=bearing(store.create("ada", Scope.SUBMIT))), 403)
    assert api.post(grid["links"]["cancel"], headers=bearing(store.create("root", Scope.ADMIN))).status_code == 200


def log_in(api: TestClient, made: str, **fields: str) -> Any:
    return api.post("/login", data={"token": made, **fields})


def test_a_browser_is_sent_to_log_in_and_back(api: TestClient, store: TokenStore) -> None:
    html = {"Accept": "text/html,*/*"}
    answer = api.get("/v1/grids?limit=2", headers=html)
    assert (answer.status_code, answer.headers["location"]) == (303, "/login?next=/v1/grids%3Flimit%3D2")
    assert api.get("/", headers=html).headers["location"] == "/login?next=/"
    assert api.get("/static/style.css").status_code == 200
    page = api.get(answer.headers["location"], headers=html)
    assert page.status_code == 200
    assert 'value="/v1/grids?limit=2"' in page.text
    answer = log_in(api, store.create("ada", Scope.SUBMIT), next="/v1/grids?limit=2")
    assert (answer.status_code, answer.headers["location"]) == (303, "/v1/grids?limit=2")
    flags = {part.strip().lower() for part in answer.headers["set-cookie"].split(";")[1:]}
    assert {"httponly", "samesite=strict", "path=/"} <= flags
    assert "secure" not in flags
    assert api.get("/v1/grids?limit=2", headers=html).status_code == 200
    assert api.post("/logout").status_code == 303
    assert_problem(api.get("/v1/grids"), 401)


def test_the_cookie_is_for_https_alone_where_it_came_by_https(settings: Settings, store: TokenStore) -> None:
    with TestClient(create_app(settings), base_url="https://testserver", follow_redirects=False) as api:
        answer = log_in(api, store.create("ada", Scope.SUBMIT))
    assert "secure" in answer.headers["set-cookie"].lower()


def test_nobody_is_sent_elsewhere_after_logging_in(api: TestClient, store: TokenStore) -> None:
    made = store.create("ada", Scope.SUBMIT)
    elsewhere = (
        "//evil.example",
        "https://evil.example",
        "/\\evil.example",
        "javascript:alert(1)",
        "/a\r\nX: y",
        "evil",
    )
    for wanted in elsewhere:
        answer = log_in(api, made, next=wanted)
        assert (answer.status_code, answer.headers["location"]) == (303, "/"), wanted


def test_the_login_page_shows_nothing_as_markup(api: TestClient) -> None:
    text = api.get("/login", params={"next": '/"><script>alert(1)</script>'}).text
    assert "<script>" not in text


def test_the_login_page_looks_as_the_others_and_says_what_is_wrong(api: TestClient) -> None:
    asked = api.get("/login", params={"next": "/grids/g"})
    refused = api.post("/login", data={"token": "x", "next": "/grids/g"}, headers={"Accept": "text/html"})
    for answer, status in ((asked, 200), (refused, 401)):
        assert answer.status_code == status
        assert '<a class="brand" href="/">hostlens</a>' in answer.text
        assert 'name="next" value="/grids/g"' in answer.text
        assert ("This token is not valid." in answer.text) == (status == 401)
        assert answer.headers["cache-control"] == "no-store"
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    assert refused.headers["www-authenticate"] == 'Bearer realm="hostlens"'


def test_a_malformed_login_is_refused_politely(api: TestClient) -> None:
    for content in (b"", b"token=", b"token=%ff", b"&" * 3000, b"token=x&" * 500, b"\xff\xfe"):
        answer = api.post("/login", content=content, headers={"Content-Type": "application/x-www-form-urlencoded"})
        assert answer.status_code in (401, 422), answer.text
        assert_problem(answer, answer.status_code)
        assert "set-cookie" not in answer.headers
    assert_problem(api.post("/login", json={"token": "x"}), 415)


@pytest.mark.parametrize("auth", ["off", "tokens"])
def test_what_changes_anything_is_taken_from_no_page_of_another_site(
    settings: Settings, store: TokenStore, auth: str
) -> None:
    made = store.create("ada", Scope.SUBMIT)
    own: list[dict[str, str]] = [
        {},
        {"Origin": "http://testserver"},
        {"Sec-Fetch-Site": "same-origin", "Origin": "http://testserver"},
        {"Sec-Fetch-Site": "none"},
    ]
    others = [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site", "Origin": "http://other.testserver"},
    ]
    with TestClient(create_app(settings.model_copy(update={"auth": auth}))) as api:
        if auth == "tokens":
            api.cookies.set(COOKIE, made)
        for headers in own + others:
            status = 202 if headers in own else 403
            assert api.post("/v1/grids", json=body(1), headers=headers).status_code == status, headers
            # To look does no harm, and a token in the header is nobody's but the sender's.
            assert api.get("/v1/grids", headers=headers).status_code == 200
            assert api.post("/v1/grids", json=body(1), headers={**headers, **bearing(made)}).status_code == 202


@pytest.mark.parametrize(
    ("called", "status"),
    [
        ("localhost", 200), ("LOCALHOST:8421", 200), ("a.localhost", 200), ("127.1.2.3:1", 200), ("[::1]:8421", 200),
        ("evil.example", 421), ("localhost.evil.example:8421", 421), ("192.0.2.1", 421), ("[2001:db8::1]", 421),
        ("[::1", 421), ("lens.example.org", 421), ("observatory:8421", 200),
    ],
)  # fmt: skip
def test_a_name_that_was_made_to_lead_to_loopback_leads_to_nothing(
    settings: Settings, called: str, status: int
) -> None:
    # As a browser does whose page has another site's name, which that site points at 127.0.0.1: same-origin to both.
    open_settings = settings.model_copy(update={"host": "127.0.0.1", "allowed_hosts": []})
    headers = {"Host": called, "Sec-Fetch-Site": "same-origin"}
    with TestClient(create_app(open_settings)) as api:
        assert api.get("/v1/grids", headers=headers).status_code == status
        made = api.post("/v1/grids", json=body(1), headers=headers)
        assert made.status_code == (202 if status == 200 else 421)
        if status == 421:
            assert_problem(made, 421)
    named = open_settings.model_copy(update={"allowed_hosts": ["Lens.example.org"]})
    with TestClient(create_app(named)) as api:
        wanted = 200 if called == "lens.example.org" else status
        assert api.get("/v1/grids", headers=headers).status_code == wanted
    # Who asks for tokens is called as anybody likes, unless told otherwise: a foreign page has none.
    with TestClient(create_app(open_settings.model_copy(update={"auth": "tokens"}))) as api:
        assert api.get("/v1/grids", headers=headers).status_code == 401


def test_a_token_is_in_no_answer_and_no_log(
    api: TestClient, store: TokenStore, caplog: pytest.LogCaptureFixture
) -> None:
    made = store.create("ada", Scope.SUBMIT)
    wrong = made[:-1] + ("A" if made[-1] != "A" else "B")
    caplog.set_level(logging.DEBUG)
    answers = [
        api.post("/v1/grids", json=body(1), headers=bearing(made)),
        api.get("/v1/grids", headers=bearing(wrong)),
        log_in(api, wrong),
        log_in(api, made),
        api.get("/v1/nothing", headers=bearing(made)),
    ]
    for secret in (made.split("_", 2)[2][:-1],):
        assert secret not in caplog.text
        assert not any(secret in answer.text for answer in answers)


def test_without_a_database_nobody_comes_in_and_the_probe_answers(tmp_path: Path) -> None:
    settings = Settings(database_url="sqlite:////nowhere/at/all.sqlite", data_dir=tmp_path, host=ELSEWHERE)
    with TestClient(create_app(settings), raise_server_exceptions=False) as api:
        answer = api.get("/v1/grids", headers=bearing("hl_000000000000_" + "a" * 43))
        assert_problem(answer, 503)
        assert answer.headers["retry-after"]
        assert api.get("/healthz").status_code == 200


def test_the_service_asks_nobody_on_loopback_and_everybody_elsewhere_unless_told_otherwise() -> None:
    for host in ("127.0.0.1", "::1", "localhost"):
        assert not Settings(host=host).asks_for_tokens
        assert Settings(host=host, auth="tokens").asks_for_tokens
    for host in (ELSEWHERE, "192.0.2.1", "::", "host.example"):
        assert Settings(host=host).asks_for_tokens
        assert not Settings(host=host, auth="off").asks_for_tokens


def test_the_service_does_not_listen_elsewhere_as_long_as_nobody_could_come_in(
    settings: Settings, store: TokenStore
) -> None:
    with pytest.raises(ConfigurationError, match="hostlens token create"):
        preflight.for_api(settings)
    preflight.for_api(settings.model_copy(update={"auth": "off"}))
    preflight.for_api(settings.model_copy(update={"host": "127.0.0.1"}))
    store.create("ada", Scope.ADMIN)
    preflight.for_api(settings)
    store.revoke("ada")
    with pytest.raises(ConfigurationError, match="hostlens token create"):
        preflight.for_api(settings)


def test_the_command_line_makes_shows_and_revokes_tokens(
    url: str, store: TokenStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTLENS_DATABASE_URL", url)
    run = CliRunner()
    made = run.invoke(command_line, ["token", "create", "ada", "--scope", "admin", "--expires", "90d"])
    assert made.exit_code == 0, made.output
    assert store.caller(made.output.strip()) == Caller("ada", Scope.ADMIN)
    listed = run.invoke(command_line, ["token", "list"]).output
    number = made.output.split("_")[1]
    assert all(word in listed for word in (number, "ada", "admin", "valid"))
    assert made.output.strip() not in listed
    assert run.invoke(command_line, ["token", "revoke", number]).output == "1 revoked\n"
    assert "revoked" in run.invoke(command_line, ["token", "list"]).output
    for words in (
        ["revoke", number],
        ["create", "a b"],
        ["create", "x", "--expires", "soon"],
        ["create", "x", "--scope", "y"],
    ):
        assert run.invoke(command_line, ["token", *words]).exit_code == 2, words
