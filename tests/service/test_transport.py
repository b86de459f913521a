"""What a real API process does with connections: stalled, broken, too many, and open at its end."""

from __future__ import annotations

import json
import signal
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import text

from service.domain.identifiers import utc_now
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leases import add_event
from tests.drills.installation import PATIENCE_S, Installation, eventually
from tests.service.conftest import empty
from tests.service.plans import body, submit

TIMEOUT_S = 2.0
REQUEST_S = 120.0
# A connection for each request, and not the 25 ms of CPU that httpx needs for a client.
ASKING = httpx.Client(timeout=PATIENCE_S, trust_env=False, limits=httpx.Limits(max_keepalive_connections=0))
BODY = json.dumps(body(1)).encode()


@contextmanager
def serving(folder: Path, url: str, **settings: str) -> Iterator[Installation]:
    """One API process, without supervisor and dispatcher."""
    changes = {"HOSTLENS_DATABASE_URL": url, "HOSTLENS_REQUEST_TIMEOUT_S": str(TIMEOUT_S), **settings}
    api = Installation(folder, changes, commands=(("service.api",),))
    try:
        eventually(lambda: answers(api), what="an answer")
        yield api
    except BaseException:
        print(api.tail())
        raise
    finally:
        api.kill_all()


def answers(api: Installation) -> bool:
    try:
        return ASKING.get(f"http://127.0.0.1:{api.port}/healthz").status_code == 200
    except httpx.TransportError:
        return False


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory, migrated_sqlite: Path) -> Iterator[Installation]:
    folder = tmp_path_factory.mktemp("transport")
    (folder / "own.sqlite").write_bytes(migrated_sqlite.read_bytes())
    with serving(folder, f"sqlite:///{folder}/own.sqlite") as found:
        yield found


def connected(api: Installation) -> closing[socket.socket]:
    return closing(socket.create_connection(("127.0.0.1", api.port), timeout=PATIENCE_S))


def grids(api: Installation) -> int:
    return len(ASKING.get(f"http://127.0.0.1:{api.port}/v1/grids").json()["items"])


def post(headers: bytes, sent: bytes) -> bytes:
    return b"POST /v1/grids HTTP/1.1\r\nHost: a\r\nContent-Type: application/json\r\n" + headers + b"\r\n\r\n" + sent


def to_the_end(connection: socket.socket) -> bytes:
    """All that comes until the server closes the connection."""
    found = b""
    while data := connection.recv(65536):
        found += data
    return found


def assert_refused(answer: bytes, status: int) -> None:
    head, _, document = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 %d " % status), answer
    assert b"\r\ncontent-type: application/problem+json" in head.lower(), answer
    assert b"\r\nconnection: close" in head.lower()
    assert json.loads(document)["status"] == status


CHUNK = b"%x\r\n%s\r\n" % (len(BODY), BODY)
HALF = {
    "announced longer than sent": post(b"Content-Length: %d" % (len(BODY) + 1), BODY),
    "announced far longer than sent": post(b"Content-Length: 900000", BODY),
    "without the last chunk": post(b"Transfer-Encoding: chunked", CHUNK),
    "with half of the last chunk": post(b"Transfer-Encoding: chunked", CHUNK + b"0\r\n"),
    "with a chunk that is no chunk": post(b"Transfer-Encoding: chunked", CHUNK + b"zz\r\n"),
    "that waited to be asked for it": post(b"Content-Length: %d\r\nExpect: 100-continue" % (len(BODY) + 1), BODY),
}


@pytest.mark.parametrize("how", ["closed", "half closed", "reset", "left open"])
@pytest.mark.parametrize("sent", HALF.values(), ids=HALF)
def test_half_a_body_makes_no_grid(api: Installation, sent: bytes, how: str) -> None:
    before = grids(api)
    with connected(api) as connection:
        connection.sendall(sent)
        if b"zz" not in sent:
            eventually(lambda: under_way(api) == 2, what="a request under way, beside the question for it")
        if how == "half closed":
            connection.shutdown(socket.SHUT_WR)
        if how == "reset":
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        if how in {"half closed", "left open"}:
            assert b"202 Accepted" not in to_the_end(connection)
    eventually(lambda: under_way(api) == 1, what="its end")
    assert grids(api) == before


def test_a_whole_body_makes_a_grid_however_it_is_cut(api: Installation) -> None:
    before = grids(api)
    for headers, sent in (
        (b"Content-Length: %d" % len(BODY), BODY),
        (b"Transfer-Encoding: chunked", CHUNK + b"0\r\n\r\n"),
        (b"Transfer-Encoding: chunked", b"".join(b"1\r\n%c\r\n" % byte for byte in BODY) + b"0\r\nX-Late: 1\r\n\r\n"),
    ):
        with connected(api) as connection:
            connection.sendall(post(headers + b"\r\nConnection: close", sent))
            assert to_the_end(connection).startswith(b"HTTP/1.1 202 ")
    assert grids(api) == before + 3


STALLED = {
    "in the request line": b"GET /heal",
    "in the headers": b"GET /healthz HTTP/1.1\r\nHost: a\r\nX-",
    "before the body": post(b"Content-Length: 10", b""),
    "in the body": post(b"Content-Length: 10", b"{"),
    "behind another": b"GET /healthz HTTP/1.1\r\nHost: a\r\n\r\nGET /healthz HT",
}


@pytest.mark.parametrize("sent", STALLED.values(), ids=STALLED)
def test_a_stalled_request_is_told_so_and_closed(api: Installation, sent: bytes) -> None:
    with connected(api) as connection:
        began = time.monotonic()
        connection.sendall(sent)
        answer = to_the_end(connection)
        assert time.monotonic() - began >= TIMEOUT_S - 0.2
    assert_refused(answer[answer.rindex(b"HTTP/1.1 ") :], 408)


@pytest.mark.parametrize("piece", [b"a", b"X-A: b\r\n", b"\r\n"], ids=["letters", "headers", "empty lines"])
def test_a_request_that_trickles_is_closed_as_one_that_stalls(api: Installation, piece: bytes) -> None:
    with connected(api) as connection:
        began = time.monotonic()
        connection.sendall(b"" if piece == b"\r\n" else b"GET /healthz HTTP/1.1\r\nX-Long: ")
        connection.settimeout(0.1)
        closed = False
        while not closed:
            assert time.monotonic() - began < PATIENCE_S, "it is still open"
            try:
                connection.sendall(piece)
                closed = not connection.recv(65536)
            except TimeoutError:
                continue
            except OSError:
                closed = True


def test_an_idle_connection_is_closed(api: Installation) -> None:
    with connected(api) as connection:
        assert to_the_end(connection) == b""
    with connected(api) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n")
        assert to_the_end(connection).startswith(b"HTTP/1.1 200 ")


def test_a_head_without_bound_is_refused(api: Installation) -> None:
    with connected(api) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nX-Long: " + 70_000 * b"a")
        assert_refused(to_the_end(connection), 431)


def test_what_is_not_http_is_a_problem(api: Installation) -> None:
    with connected(api) as connection:
        connection.sendall(b"\x16\x03\x01 hello\r\n\r\n")
        assert_refused(to_the_end(connection), 400)


def test_too_many_connections_are_told_so_and_the_probes_are_not(tmp_path: Path, sqlite_url: str) -> None:
    with serving(tmp_path, sqlite_url, HOSTLENS_MAX_CONNECTIONS="16", HOSTLENS_REQUEST_TIMEOUT_S="60") as api:
        idle = [socket.create_connection(("127.0.0.1", api.port)) for _ in range(16)]
        refused = eventually(
            lambda: (now := ASKING.get(f"http://127.0.0.1:{api.port}/v1/systems")).status_code == 503 and now,
            what="a refusal",
        )
        assert refused.headers["content-type"] == "application/problem+json"
        assert refused.headers["retry-after"]
        for probe in ("healthz", "readyz", "metrics"):
            assert ASKING.get(f"http://127.0.0.1:{api.port}/{probe}").status_code == 200
        for connection in idle:
            connection.close()
        eventually(
            lambda: ASKING.get(f"http://127.0.0.1:{api.port}/v1/systems").status_code == 200,
            what="room",
        )


def opened(api: Installation, address: str, accept: str = "*/*") -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", api.port), timeout=PATIENCE_S)
    connection.sendall(f"GET {address} HTTP/1.1\r\nHost: a\r\nAccept: {accept}\r\n\r\n".encode())
    return connection


def under_way(api: Installation) -> float:
    shown = ASKING.get(f"http://127.0.0.1:{api.port}/metrics").text
    return next(float(line.split()[1]) for line in shown.splitlines() if "_in_progress " in line and line[0] != "#")


def test_streams_and_long_polls_beyond_the_limit_are_refused(tmp_path: Path, sqlite_url: str) -> None:
    database = Database(sqlite_url)
    grid = submit(GridStore(database), 1)
    with serving(tmp_path, sqlite_url, HOSTLENS_MAX_STREAMS="2") as api:
        address = f"/v1/grids/{grid}/events"
        cursor = ASKING.get(f"http://127.0.0.1:{api.port}{address}").json()["cursor"]
        stream = opened(api, address, "text/event-stream")
        poll = opened(api, f"{address}?cursor={cursor}&wait=30")
        assert b"event: grid" in stream.recv(65536) + stream.recv(65536)
        eventually(lambda: under_way(api) == 3, what="both under way, beside the question for it")
        for asked, headers in ((address, {"Accept": "text/event-stream"}), (f"{address}?cursor={cursor}&wait=30", {})):
            refused = ASKING.get(f"http://127.0.0.1:{api.port}{asked}", headers=headers)
            assert (refused.status_code, refused.headers["content-type"]) == (429, "application/problem+json")
            assert int(refused.headers["retry-after"]) > 0
        assert ASKING.get(f"http://127.0.0.1:{api.port}{address}?cursor={cursor}").status_code == 200
        stream.close()
        poll.close()
        # Something happens: nobody need wait for half a minute until the long poll ends by itself.
        assert ASKING.post(f"http://127.0.0.1:{api.port}/v1/grids/{grid}/pause").is_success
        eventually(lambda: under_way(api) == 1, what="the end of both")
        with opened(api, address, "text/event-stream") as again:
            assert again.recv(65536).startswith(b"HTTP/1.1 200 ")
    database.close()


def test_a_stream_that_nobody_reads_is_given_up(tmp_path: Path, sqlite_url: str) -> None:
    database = Database(sqlite_url)
    grid = submit(GridStore(database), 1)
    with database.write() as connection:
        # More than the buffers of both ends take.
        for _ in range(1200):
            add_event(connection, grid, "grid_paused", utc_now(), note=10_000 * "x")
    with serving(tmp_path, sqlite_url) as api:
        stream = socket.socket()
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stream.connect(("127.0.0.1", api.port))
        ask = (
            f"GET /v1/grids/{grid}/events HTTP/1.1\r\nHost: a\r\nLast-Event-ID: 0\r\nAccept: text/event-stream\r\n\r\n"
        )
        stream.sendall(ask.encode())
        eventually(lambda: under_way(api) == 2, what="a stream")
        eventually(lambda: under_way(api) == 1, what="its end")
        stream.close()
    database.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "term"])
def test_an_end_with_everything_open_is_quick_and_leaves_no_traceback(
    tmp_path: Path, sqlite_url: str, number: int
) -> None:
    database = Database(sqlite_url)
    grid = submit(GridStore(database), 1)
    database.close()
    with serving(tmp_path, sqlite_url, HOSTLENS_REQUEST_TIMEOUT_S=str(REQUEST_S)) as api:
        address = f"/v1/grids/{grid}/events"
        cursor = ASKING.get(f"http://127.0.0.1:{api.port}{address}").json()["cursor"]
        stream = opened(api, address, "text/event-stream")
        poll = opened(api, f"{address}?cursor={cursor}&wait=30")
        eventually(lambda: under_way(api) == 3, what="stream and long poll")
        with connected(api) as head, connected(api) as half, connected(api):
            head.sendall(b"GET /healthz HT")
            half.sendall(post(b"Content-Length: 1000", BODY))
            eventually(lambda: under_way(api) == 4, what="half a body")
            api.process.send_signal(number)
            # Before any of these would end by itself.
            assert api.process.wait(timeout=REQUEST_S / 2) in {0, -number}
            assert to_the_end(stream).endswith(b"0\r\n\r\n")
            assert b'"items":[]' in to_the_end(poll)
            assert b"202" not in to_the_end(half)
        said = api.log.read_text()
        assert "Traceback" not in said
        assert "ERROR" not in said.upper()


@pytest.mark.postgres
def test_probes_answer_while_every_other_thread_waits_for_the_database(tmp_path: Path, migrated_postgres: str) -> None:
    empty(migrated_postgres)
    database = Database(migrated_postgres)
    grid = submit(GridStore(database), 1)
    with serving(tmp_path, migrated_postgres) as api, ThreadPoolExecutor(80) as clients:
        base = f"http://127.0.0.1:{api.port}"
        assert ASKING.get(f"{base}/readyz").status_code == 200
        with database.write() as connection:
            connection.execute(text("LOCK TABLE leader, grid, event, run IN ACCESS EXCLUSIVE MODE"))
            stuck = [
                clients.submit(ASKING.get, f"{base}/v1/grids/{grid}{what}") for what in 20 * ("", "/runs", "/events")
            ]
            stuck += [clients.submit(ASKING.post, f"{base}/v1/grids/{grid}/pause") for _ in range(20)]
            eventually(lambda: waiting(migrated_postgres) >= 10, what="threads that wait")
            for _ in range(2):
                # The others are answered when the lock is gone, and not before.
                assert ASKING.get(f"{base}/healthz").status_code == 200
                away = ASKING.get(f"{base}/readyz")
                assert (away.status_code, away.headers["content-type"]) == (503, "application/problem+json")
            assert waiting(migrated_postgres) >= 10
        assert {found.result().status_code for found in stuck} <= {200, 503}
        eventually(lambda: ASKING.get(f"{base}/readyz").status_code == 200, what="readiness")
    database.close()


def waiting(url: str) -> Any:
    database = Database(url, pooled=False)
    with database.read() as connection:
        return connection.scalar(text("SELECT count(*) FROM pg_stat_activity WHERE wait_event_type = 'Lock'"))
