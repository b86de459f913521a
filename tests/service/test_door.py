"""Hostile requests to a real server over a raw socket, on both databases: each refused for what it is, none a 5xx."""

from __future__ import annotations

import copy
import json
import os
import re
import socket
import subprocess
import sys
import tomllib
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.store.migrate import upgrade
from tests.drills.installation import eventually, free_port
from tests.service.conftest import empty
from tests.service.plans import BODY

ROOT = Path(__file__).resolve().parents[2]
OWN: dict[str, Any] = tomllib.loads((ROOT / "docs" / "examples" / "my_system.toml").read_text(encoding="utf-8"))
OWN_BODY: dict[str, Any] = {"systems": [OWN], "n": [2], "r_eff": [0.35], "magnitude": [21], "l_eta": [1.0]}
GRID = "g_" + "0" * 26
JSON = ("Content-Type", "application/json")
HOSTILE_TEXT = (
    "a\x00b",
    "a\x1bb",
    "a\u202eb",
    "a\u200bb",
    "a\ufeffb",
    "a\u2028b",
    "a\U000e0041b",
    "a\u0378b",
    "\ud800",
    "\u3164",
)


@dataclass(frozen=True)
class Server:
    """A server process and the file that it logs to."""

    port: int
    log: Path

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def server(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("door")
    if request.param == "sqlite":
        url = f"sqlite:///{folder}/door.sqlite"
        upgrade(url)
    else:
        url = str(request.getfixturevalue("migrated_postgres"))
        empty(url)
    port, log = free_port(), folder / "log"
    settings = {"HOSTLENS_DATABASE_URL": url, "HOSTLENS_PORT": str(port), "HOSTLENS_DATA_DIR": str(folder)}
    with log.open("wb") as to:
        process = subprocess.Popen(
            [sys.executable, "-m", "service.api"], env=os.environ | settings, stdout=to, stderr=to, cwd=ROOT
        )
    try:
        found = Server(port, log)
        eventually(lambda: answers(found), what="an answer of the server")
        yield found
        assert "Traceback" not in log.read_text()
    finally:
        process.kill()
        process.wait()


def answers(server: Server) -> bool:
    try:
        return httpx.get(server.url + "/healthz", trust_env=False).is_success
    except httpx.TransportError:
        return False


def ask(server: Server, request: bytes) -> Answer:
    """Send bytes, take all that comes until the server closes."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=120) as connection:
        connection.sendall(request)
        received = b""
        while piece := connection.recv(65536):
            received += piece
    head, _, body = received.partition(b"\r\n\r\n")
    first, *lines = head.decode("ascii").split("\r\n")
    headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines)}
    return Answer(int(first.split()[1]), headers, body)


def http(method: str, target: str, *headers: tuple[str, str | bytes], body: bytes | None = None) -> bytes:
    """A well-formed request, but for what stands in its parts; the connection ends with the answer."""
    lines = [f"{method} {target} HTTP/1.1".encode("latin-1"), b"Host: localhost", b"Connection: close"]
    lines += [
        name.encode() + b": " + (value if isinstance(value, bytes) else value.encode()) for name, value in headers
    ]
    if body is not None:
        lines.append(b"Content-Length: %d" % len(body))
    return b"\r\n".join(lines) + b"\r\n\r\n" + (body or b"")


def post(
    body: bytes | Any, *headers: tuple[str, str | bytes], form: tuple[str, str] | None = JSON, query: str = ""
) -> bytes:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return http("POST", "/v1/grids" + query, *([form] if form else []), *headers, body=content)


def with_text(text: str) -> bytes:
    """The usual grid, with JSON that no writer makes added."""
    return json.dumps(BODY)[:-1].encode() + b", " + text.encode() + b"}"


def own(**changes: Any) -> dict[str, Any]:
    return {**OWN_BODY, "systems": [{**copy.deepcopy(OWN), **changes}]}


def changed(steps: tuple[str | int, ...], value: Any) -> dict[str, Any]:
    document = copy.deepcopy(OWN_BODY)
    place: Any = document["systems"][0]
    for step in steps[:-1]:
        place = place[step]
    place[steps[-1]] = value
    return document


@dataclass(frozen=True)
class Refused:
    """A request, the status of its answer, and the place that the answer names."""

    request: bytes
    status: int = 422
    pointer: str | None = None
    source: str = "body"
    headers: dict[str, str] = field(default_factory=dict)


MASS = "/systems/0/mass_models"
MODEL = OWN["mass_models"]["recommended"]["1.0"]
REFUSED = {
    # Forms of bodies
    "no content type": Refused(post(BODY, form=None), 415, "content-type", "header", {"accept": "application/json"}),
    "text": Refused(post(BODY, form=("Content-Type", "text/plain")), 415, "content-type", "header"),
    "form": Refused(post(BODY, form=("Content-Type", "application/x-www-form-urlencoded")), 415, "content-type", "header"),
    "another json": Refused(post(BODY, form=("Content-Type", "application/ld+json")), 415, "content-type", "header"),
    "latin-1": Refused(post(BODY, form=("Content-Type", "application/json; charset=latin-1")), 415, "content-type", "header"),
    "utf-16": Refused(post(json.dumps(BODY).encode("utf-16"), form=("Content-Type", "application/json; charset=utf-16")), 415, "content-type", "header"),
    "two types": Refused(post(BODY, ("Content-Type", "text/plain")), 422, "content-type", "header"),
    "gzip": Refused(post(BODY, ("Content-Encoding", "gzip")), 415, "content-encoding", "header", {"accept-encoding": "identity"}),
    "codings": Refused(post(BODY, ("Content-Encoding", "identity, br")), 415, "content-encoding", "header"),
    "empty": Refused(post(b""), 422, ""),
    "blank": Refused(post(b" \n"), 422, ""),
    "utf-16 unsaid": Refused(post(json.dumps(BODY).encode("utf-16-le")), 422, ""),
    "not utf-8": Refused(post(b'{"name": "\xff"}'), 422, ""),
    "overlong utf-8": Refused(post(b'{"name": "\xc0\x80"}'), 422, ""),
    "byte order mark": Refused(post(b"\xef\xbb\xbf" + json.dumps(BODY).encode()), 422, ""),
    "half": Refused(post(b'{"preset": '), 422, ""),
    "two documents": Refused(post(json.dumps(BODY).encode() * 2), 422, ""),
    "single quotes": Refused(post(b"{'preset': 'h0licow-vi'}"), 422, ""),
    "comment": Refused(post(with_text("/* */ \"seed\": 1")), 422, ""),
    "raw control character": Refused(post(with_text('"name": "a\nb"')), 422, ""),
    "list": Refused(post([BODY]), 422, ""),
    "text only": Refused(post("x"), 422, ""),
    "null": Refused(post(None), 422, ""),
    "deep lists": Refused(post(b"[" * 400_000), 422, ""),
    "deep tables": Refused(post(b'{"a":' * 150_000), 422, ""),
    "deep but whole": Refused(post(b'{"a":' * 900 + b"1" + b"}" * 900), 422, "/a" * 32),
    # Keys
    "twice": Refused(post(with_text('"seed": 1, "seed": 1')), 422, "/seed"),
    "twice by escapes": Refused(post(with_text('"se\\u0065d": 1, "seed": 2')), 422, "/seed"),
    "twice and deep": Refused(post(with_text('"optics": {"jitter": 0, "jitter": 0.1}')), 422, "/optics/jitter"),
    "twice in a list": Refused(post(with_text('"systems": ["HE0435", {"name": "a", "name": "b"}]')), 422, "/systems/1/name"),
    "twice with a slash": Refused(post(with_text('"a/b~c": 1, "a/b~c": 2')), 422, "/a~1b~0c"),
    "empty key": Refused(post(with_text('"": 1')), 422, "/"),
    "quotes in a key": Refused(post({**BODY, 'a"].b': 1}), 422, '/a"].b'),
    "tag as a key": Refused(post({**BODY, "<name>": 1}), 422, "/<name>"),
    "tag as a key of a system": Refused(post(own(**{"<object>": 1})), 422, "/systems/0/<object>"),
    "mark as a key": Refused(post({**BODY, "[key]": 1}), 422, "/[key]"),
    "control character in a key": Refused(post({**BODY, "a\x00\u202e": 1}), 422, "/a\x00\u202e"),
    "surrogate in a key": Refused(post(with_text('"\\ud800": 1')), 422, "/?"),
    # Numbers
    "nan": Refused(post(with_text('"optics": {"jitter": NaN}')), 422, "/optics/jitter"),
    "infinity": Refused(post(with_text('"optics": {"defocus_nm": -Infinity}')), 422, "/optics/defocus_nm"),
    "beyond a double": Refused(post(with_text('"optics": {"jitter": 1e400}')), 422, "/optics/jitter"),
    "5,000 digits": Refused(post(with_text('"seed": ' + "9" * 5000)), 422, "/seed"),
    "400 digits": Refused(post(with_text('"optics": {"jitter": ' + "9" * 400 + "}")), 422, "/optics/jitter"),
    "nan as a seed": Refused(post(with_text('"seed": NaN')), 422, "/seed"),
    "number as text": Refused(post({**BODY, "n": ["2"]}), 422, "/n/0"),
    "count as text": Refused(post({**BODY, "seed": "1"}), 422, "/seed"),
    "true as a number": Refused(post({**BODY, "magnitude": [True]}), 422, "/magnitude/0"),
    "true as a count": Refused(post({**BODY, "replicates": True}), 422, "/replicates"),
    "a whole number with a point": Refused(post({**BODY, "seed": 1.0}), 422, "/seed"),
    "settings as text": Refused(post({**BODY, "analysis": {"walkers": "8"}}), 422, "/analysis/walkers"),
    "true as a setting": Refused(post({**BODY, "analysis": {"subrays": True}}), 422, "/analysis/subrays"),
    "one as true": Refused(post({**BODY, "analysis": {"source_envelope": 1}}), 422, "/analysis/source_envelope"),
    "yes as true": Refused(post({**BODY, "analysis": {"source_envelope": "yes"}}), 422, "/analysis/source_envelope"),
    "least radius": Refused(post({**OWN_BODY, "systems": ["HE0435"], "r_eff": [1e-4]}), 422, "/r_eff/0"),
    "1001 values": Refused(post({**BODY, "n": [2] * 1001}), 422, "/n"),
    # Own systems
    "nan as l_eta": Refused(post(own(mass_models={"recommended": {"nan": MODEL}})), 422, MASS + "/recommended/nan"),
    "inf as l_eta": Refused(post(own(mass_models={"recommended": {"inf": MODEL}})), 422, MASS + "/recommended/inf"),
    "1_0 as l_eta": Refused(post(own(mass_models={"recommended": {"1_0": MODEL}})), 422, MASS + "/recommended/1_0"),
    "space in l_eta": Refused(post(own(mass_models={"recommended": {" 1.0": MODEL}})), 422, MASS + "/recommended/ 1.0"),
    "other digits": Refused(post(own(mass_models={"recommended": {"１.０": MODEL}})), 422, MASS + "/recommended/１.０"),
    "one l_eta twice": Refused(post(own(mass_models={"recommended": {"1": MODEL, "1.0": MODEL}})), 422, MASS + "/recommended/1"),
    "a model with dots": Refused(post(own(mass_models={"v1.2": {"1.0": {**MODEL, "q": 9}}})), 422, MASS + "/v1.2/1.0/q"),
    "the name of the catalogue": Refused(post(own(name="HE0435")), 422, "/systems/0/name"),
    "two of one name": Refused(post({**OWN_BODY, "systems": [OWN, OWN]}), 422, "/systems"),
    # Headers
    "two keys": Refused(post(BODY, ("Idempotency-Key", "a"), ("Idempotency-Key", "b")), 422, "idempotency-key", "header"),
    "one key twice": Refused(post(BODY, ("Idempotency-Key", "a"), ("idempotency-key", "a")), 422, "idempotency-key", "header"),
    "empty key header": Refused(post(BODY, ("Idempotency-Key", "")), 422, "idempotency-key", "header"),
    "long key": Refused(post(BODY, ("Idempotency-Key", "k" * 256)), 422, "idempotency-key", "header"),
    "key not in ascii": Refused(post(BODY, ("Idempotency-Key", b"\xc3\xa9")), 422, "idempotency-key", "header"),
    "key with a space": Refused(post(BODY, ("Idempotency-Key", "a b")), 422, "idempotency-key", "header"),
    "no number of an event": Refused(http("GET", f"/v1/grids/{GRID}/events", ("Last-Event-ID", "1_0")), 422, "last-event-id", "header"),
    "two numbers of events": Refused(http("GET", f"/v1/grids/{GRID}/events", ("Last-Event-ID", "1"), ("Last-Event-ID", "1")), 422, "last-event-id", "header"),
    # Queries
    **{
        f"limit {value}": Refused(http("GET", f"/v1/grids?limit={value}"), 422, "limit", "query")
        for value in ("1_0", "%2010", "10%20", "%2B10", "+10", "1e1", "10.0", "010", "0x10", "%EF%BC%91", "", "%00", "%ff", "-1", "1001", "9" * 5000, "nan", "1&limit=1")
    },
    "wait nan": Refused(http("GET", f"/v1/grids/{GRID}/events?wait=nan"), 422, "wait", "query"),
    "wait 1_0": Refused(http("GET", f"/v1/grids/{GRID}/events?wait=1_0"), 422, "wait", "query"),
    "no switch": Refused(post(BODY, query="?dry_run=maybe"), 422, "dry_run", "query"),
    "yes as a switch": Refused(post(BODY, query="?dry_run=yes"), 422, "dry_run", "query"),
    "one as a switch": Refused(post(BODY, query="?dry_run=1"), 422, "dry_run", "query"),
    "capitals as a switch": Refused(post(BODY, query="?dry_run=True"), 422, "dry_run", "query"),
    "parameter of the document": Refused(http("GET", "/openapi.json?x=1"), 422, "x", "query"),
    "a switch twice": Refused(post(BODY, query="?dry_run=true&dry_run=true"), 422, "dry_run", "query"),
    "unknown parameter": Refused(http("GET", "/v1/grids?Limit=1"), 422, "Limit", "query"),
    "parameter in brackets": Refused(http("GET", "/v1/grids?limit[]=1"), 422, "limit[]", "query"),
    "bidi parameter": Refused(http("GET", "/v1/grids?%E2%80%AE=1"), 422, "\u202e", "query"),
    "parameter that is not utf-8": Refused(http("GET", "/v1/grids?%ff=1"), 422, "\ufffd", "query"),
    "nul cursor": Refused(http("GET", "/v1/grids?cursor=%00"), 422, "cursor", "query"),
    "state not utf-8": Refused(http("GET", f"/v1/grids/{GRID}/runs?state=%ff"), 422, "state", "query"),
    # Addresses
    "nothing": Refused(http("GET", "/nothing"), 404),
    "upwards": Refused(http("GET", "/v1/systems/../grids"), 404),
    "encoded upwards": Refused(http("GET", "/v1/systems/%2e%2e%2fgrids"), 404),
    "encoded slash": Refused(http("GET", "/v1%2Fgrids%2F" + GRID + "%2F"), 404),
    "double slash": Refused(http("GET", "/v1//grids"), 404),
    "nul": Refused(http("GET", "/v1/systems/%00"), 404),
    "not utf-8 in the path": Refused(http("GET", "/v1/systems/%ff%fe"), 404),
    "bidi in the path": Refused(http("GET", "/v1/systems/%E2%80%AE"), 404),
    "long name": Refused(http("GET", "/v1/systems/" + "x" * 65), 422, "name", "path"),
    "nul in an id": Refused(http("GET", f"/v1/grids/{GRID}%00"), 422, "grid_id", "path"),
    "line end in an id": Refused(http("GET", f"/v1/grids/{GRID}%0a"), 422, "grid_id", "path"),
    "capitals in an id": Refused(http("GET", f"/v1/grids/{GRID.upper()}"), 422, "grid_id", "path"),
    "other digits in an id": Refused(http("GET", "/v1/grids/g_" + "%EF%BC%90" * 26), 422, "grid_id", "path"),
    "no such run": Refused(http("GET", f"/v1/runs/r_{'0' * 26}_0000000/figure"), 404),
    # Methods
    "wrong method": Refused(http("DELETE", "/v1/grids"), 405, headers={"allow": "GET, HEAD, OPTIONS, POST"}),
    "only post": Refused(http("GET", f"/v1/grids/{GRID}/cancel"), 405, headers={"allow": "OPTIONS, POST"}),
    "only get": Refused(http("POST", "/healthz", body=b""), 405, headers={"allow": "GET, HEAD, OPTIONS"}),
    "document": Refused(http("PUT", "/openapi.json", body=b"{}"), 405, headers={"allow": "GET, HEAD, OPTIONS"}),
    "trace": Refused(http("TRACE", "/v1/grids"), 405),
    "options of nothing": Refused(http("OPTIONS", "/nothing"), 404),
}  # fmt: skip


def assert_problem(answer: Answer, status: int) -> dict[str, Any]:
    assert answer.status == status, (answer, status)
    assert answer.headers["content-type"] == "application/problem+json"
    # Nothing that a terminal or a log would take for more than letters.
    assert answer.body.isascii()
    document: dict[str, Any] = json.loads(answer.body)
    assert document["status"] == status
    told = [document.get("detail") or "", *(place["message"] for place in document.get("errors", ()))]
    assert all(unicodedata.category(sign)[0] not in "C" and len(text) < 2500 for text in told for sign in text)
    return document


@pytest.mark.parametrize("name", REFUSED)
def test_a_hostile_request_is_refused_for_what_it_is(server: Server, name: str) -> None:
    expected = REFUSED[name]
    answer = ask(server, expected.request)
    document = assert_problem(answer, expected.status)
    assert expected.headers.items() <= answer.headers.items(), answer.headers
    if expected.pointer is not None:
        places = [(place["in"], place["pointer"]) for place in document["errors"]]
        assert (expected.source, expected.pointer) in places, places
    else:
        assert re.fullmatch(r"[\x21-\x7e]+", document["instance"])


def paths(document: Any, steps: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place of a document."""
    if steps:
        yield steps
    parts = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    for step, part in parts:
        yield from paths(part, (*steps, step))


def refused_at(answer: httpx.Response) -> list[str]:
    assert answer.status_code == 422, answer.text
    return [place["pointer"] for place in answer.json()["errors"]]


def test_nothing_of_an_own_system_may_hold_what_cannot_be_seen_or_stored(server: Server) -> None:
    tried = 0
    with httpx.Client(base_url=server.url, trust_env=False, timeout=120) as client:

        def refuse(document: Any, pointer: str) -> None:
            nonlocal tried
            tried += 1
            content = json.dumps(document).encode()
            found = refused_at(client.post("/v1/grids", content=content, headers=dict([JSON])))
            assert any(place.startswith(pointer) for place in found), (found, pointer)

        for steps in paths(OWN):
            pointer = "/systems/0/" + "/".join(map(str, steps))
            holder = pointer.rpartition("/")[0]
            text = HOSTILE_TEXT[tried % len(HOSTILE_TEXT)]
            # As a value, and as the key of one more field beside it.
            refuse(changed(steps, text), pointer)
            if isinstance(steps[-1], str):
                refuse(changed((*steps[:-1], text), 1), holder)
        for text in HOSTILE_TEXT:
            refuse({**BODY, "name": text}, "/name")
            refuse(changed(("agn", 0, "name"), text), "/systems/0/agn/0/name")
            refuse(changed(("mass_models", text), OWN["mass_models"]["recommended"]), "/systems/0/mass_models/")
            refuse({**OWN_BODY, "systems": [OWN], "camera": {**OWN["camera"], "name": text}}, "/camera/name")
    assert tried > 200


def test_a_document_of_a_hundred_thousand_errors_names_a_hundred(server: Server) -> None:
    body = {**BODY, **{f"k{number}": 1 for number in range(70_000)}}
    answer = ask(server, post(body))
    assert 1 < len(assert_problem(answer, 422)["errors"]) <= 100


@pytest.mark.parametrize("address", ["/healthz", "/readyz", "/v1/grids", "/v1/systems", "/v1/systems/HE0435", "/v1/cameras", "/v1/engine", "/openapi.json", "/v1/systems/none", "/nothing", f"/v1/grids/{GRID}/summary", "/v1/grids?limit=0"])  # fmt: skip
def test_head_is_get_without_the_body_and_options_tells_what_there_is(server: Server, address: str) -> None:
    got, head = ask(server, http("GET", address)), ask(server, http("HEAD", address))
    assert head.status == got.status
    assert head.body == b""
    assert {**head.headers, "date": ""} == {**got.headers, "date": ""}
    told = ask(server, http("OPTIONS", address))
    if address == "/nothing":
        assert_problem(told, 404)
    else:
        assert (told.status, told.headers["allow"], told.body) == (
            204,
            "GET, HEAD, OPTIONS",
            b"",
        ) or "POST" in told.headers["allow"]


def test_the_head_of_a_stream_comes_alone(server: Server) -> None:
    grid = httpx.post(server.url + "/v1/grids", json=BODY, trust_env=False, timeout=120).json()["links"]["self"]
    events = ("Accept", "text/event-stream")
    answer = ask(server, http("HEAD", grid + "/events", events))
    assert (answer.status, answer.body) == (200, b"")
    assert answer.headers["content-type"].startswith("text/event-stream")


@pytest.mark.parametrize(
    "form",
    ["application/json", "APPLICATION/JSON", "application/json;charset=utf-8", 'application/json; charset="UTF-8"'],
)
def test_json_is_taken_however_its_type_is_written(server: Server, form: str) -> None:
    assert ask(server, post(BODY, form=("Content-Type", form), query="?dry_run=true")).status == 200
    assert ask(server, post({**BODY, "name": "Größe 3 – 日本"}, ("Content-Encoding", "identity"))).status == 202


def raw(first: bytes, *lines: bytes, body: bytes = b"") -> bytes:
    return b"\r\n".join((first, *lines)) + b"\r\n\r\n" + body


GET, HOST, CLOSE = b"GET /healthz HTTP/1.1", b"Host: a", b"Connection: close"
POST = (b"POST /v1/grids HTTP/1.1", HOST, b"Content-Type: application/json")
CHUNKED = b"Transfer-Encoding: chunked"
LARGE = b"x" * 20_000_000
MALFORMED = {
    "no request line": (400, b"\x00\x01\x02\r\n\r\n"),
    "tls": (400, b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\x00" * 64),
    "http/2": (400, b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"),
    "no version": (505, raw(b"GET /")),
    "version 2.0": (505, raw(b"GET / HTTP/2.0", HOST)),
    "version 3.0": (505, raw(b"GET / HTTP/3.0", HOST)),
    "version 0.9": (505, raw(b"GET / HTTP/0.9", HOST)),
    "version of letters": (400, raw(b"GET / HTTP/x.y", HOST)),
    "unknown method": (400, raw(b"FOO / HTTP/1.1", HOST)),
    "small method": (400, raw(b"get / HTTP/1.1", HOST)),
    "long method": (400, raw(b"G" * 100_000 + b" / HTTP/1.1", HOST)),
    "connect": (501, raw(b"CONNECT a:80 HTTP/1.1", HOST)),
    "connect to a path": (501, raw(b"CONNECT /healthz HTTP/1.1", HOST)),
    "space in target": (400, raw(b"GET /a b HTTP/1.1", HOST)),
    "no slash": (400, raw(b"GET healthz HTTP/1.1", HOST)),
    "raw bytes in target": (400, raw(b"GET /v1/systems/\xff HTTP/1.1", HOST)),
    "address with no port": (400, raw(b"GET http://a:99999/healthz HTTP/1.1", HOST)),
    "asterisk": (404, raw(b"GET * HTTP/1.1", HOST, CLOSE)),
    "target of 33 kB": (414, raw(b"GET /" + b"x" * 33_000 + b" HTTP/1.1", HOST)),
    "target of 100 kB": (414, raw(b"GET /" + b"x" * 100_000 + b" HTTP/1.1", HOST)),
    "target of 5 MB": (414, raw(b"GET /" + b"x" * 5_000_000 + b" HTTP/1.1", HOST)),
    "long query": (414, raw(b"GET /v1/grids?cursor=" + b"x" * 100_000 + b" HTTP/1.1", HOST)),
    "no colon": (400, raw(b"GET / HTTP/1.1", b"Host a")),
    "space before colon": (400, raw(b"GET / HTTP/1.1", b"Host : a")),
    "space in a name": (400, raw(GET, HOST, b"X Y: a")),
    "empty name": (400, raw(GET, HOST, b": a")),
    "nul in a header": (400, raw(GET, HOST, b"X: a\x00b")),
    "cr in a header": (400, raw(GET, HOST, b"X: a\rb")),
    "folded": (400, raw(GET, HOST, b"X: a", b" b")),
    "line feeds alone": (400, b"GET /healthz HTTP/1.1\nHost: a\n\n"),
    "no host": (400, raw(GET)),
    "two hosts": (400, raw(GET, HOST, HOST)),
    "a path as host": (400, raw(GET, b"Host: a/b?c@d")),
    "long header": (431, raw(GET, HOST, b"X: " + b"x" * 200_000)),
    "many headers": (431, raw(GET, HOST, *[b"X-Many: some"] * 10_000)),
    "5 MB of headers": (431, raw(GET, HOST, *[b"X: " + b"x" * 500] * 10_000)),
    "long trailer": (431, raw(*POST, CHUNKED, body=b"2\r\n{}\r\n0\r\n" + b"X: y\r\n" * 40_000 + b"\r\n")),
    "negative length": (400, raw(*POST, b"Content-Length: -1")),
    "signed length": (400, raw(*POST, b"Content-Length: +2", body=b"{}")),
    "endless length": (400, raw(*POST, b"Content-Length: " + b"9" * 40)),
    "two lengths": (400, raw(*POST, b"Content-Length: 1", b"Content-Length: 2", body=b"ab")),
    "list of lengths": (400, raw(*POST, b"Content-Length: 2, 2", body=b"{}")),
    "length and chunks": (400, raw(*POST, b"Content-Length: 3", CHUNKED, body=b"0\r\n\r\n")),
    "chunks and length": (400, raw(*POST, CHUNKED, b"Content-Length: 3", body=b"0\r\n\r\n")),
    "gzip and chunks": (501, raw(*POST, b"Transfer-Encoding: gzip, chunked", body=b"0\r\n\r\n")),
    "chunks twice": (400, raw(*POST, CHUNKED, CHUNKED, body=b"0\r\n\r\n")),
    "chunks of http/1.0": (400, raw(b"POST /v1/grids HTTP/1.0", CHUNKED, body=b"0\r\n\r\n")),
    "bad chunk": (400, raw(*POST, CHUNKED, body=b"zz\r\n{}\r\n0\r\n\r\n")),
    "bad second chunk": (400, raw(*POST, CHUNKED, body=b"2\r\n{}\r\nzz\r\n")),
    "chunk longer than said": (400, raw(*POST, CHUNKED, body=b"2\r\n{}x\r\n0\r\n\r\n")),
    "bad trailer": (400, raw(*POST, CHUNKED, body=b"2\r\n{}\r\n0\r\nX Y: 1\r\n\r\n")),
    "another expectation": (417, raw(*POST, b"Expect: tea", b"Content-Length: 2", body=b"{}")),
    "body that is asked for first": (413, raw(*POST, b"Expect: 100-continue", b"Content-Length: 20000000")),
    "large body": (413, raw(*POST, b"Content-Length: %d" % len(LARGE), body=LARGE)),
    "large body, then close": (413, raw(*POST, CLOSE, b"Content-Length: %d" % len(LARGE), body=LARGE)),
    "large chunk": (413, raw(*POST, CHUNKED, body=b"%x\r\n" % len(LARGE) + LARGE)),
}  # fmt: skip


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_not_http_is_told_so_and_nothing_else_happens(server: Server, name: str) -> None:
    status, request = MALFORMED[name]
    assert_problem(ask(server, request), status)
    assert answers(server)


@pytest.mark.parametrize("target", [b"/", b"http://a"])
def test_an_address_without_a_path_is_the_first_page(server: Server, target: bytes) -> None:
    answer = ask(server, raw(b"GET " + target + b" HTTP/1.1", HOST, CLOSE))
    assert answer.status == 200
    assert answers(server)


@pytest.mark.parametrize("bad", ["space in target", "two hosts", "bad chunk", "large body", "target of 100 kB"])
def test_a_bad_request_behind_good_ones_takes_no_answer_from_them(server: Server, bad: str) -> None:
    status, request = MALFORMED[bad]
    sent = 2 * raw(GET, HOST) + request + raw(GET, HOST)
    with socket.create_connection(("127.0.0.1", server.port), timeout=120) as connection:
        connection.sendall(sent)
        received = b""
        while piece := connection.recv(65536):
            received += piece
    assert re.findall(rb"HTTP/1\.1 (\d+) ", received) == [b"200", b"200", b"%d" % status]


@pytest.mark.parametrize("protocol", [b"websocket", b"h2c"])
def test_a_wish_for_another_protocol_changes_nothing(server: Server, protocol: bytes) -> None:
    wish = (b"Connection: Upgrade, HTTP2-Settings", b"Upgrade: " + protocol)
    content = json.dumps(BODY).encode()
    first = raw(*POST, *wish, b"Content-Length: %d" % len(content), body=content)
    second = raw(*POST, *wish, CHUNKED, body=b"%x\r\n%s\r\n0\r\n\r\n" % (len(content), content))
    with socket.create_connection(("127.0.0.1", server.port), timeout=120) as connection:
        connection.sendall(first + second + raw(GET, HOST, *wish) + raw(GET, HOST, CLOSE))
        received = b""
        while piece := connection.recv(65536):
            received += piece
    assert re.findall(rb"HTTP/1\.1 (\d+) ", received) == [b"202", b"202", b"200", b"200"]
