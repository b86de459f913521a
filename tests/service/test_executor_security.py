"""What a worker that means harm, and another user of the machine, can do to the dispatcher: nothing."""

from __future__ import annotations

import socket
import ssl
import stat
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.service.certificates import Certificates, make_certificates
from tests.service.hostile import MODES
from tests.service.plans import body
from tests.service.service_process import Serving, eventually, serving


def harmed(folder: Path, service: Serving) -> list[list[str]]:
    """Command lines of the processes that ran a worker's code and are no workers."""
    workers = {process.pid for process in service.workers()}
    touched = {int(file.name) for file in folder.iterdir() if file.name.isdigit()} - workers
    return [psutil.Process(pid).cmdline() for pid in touched if psutil.pid_exists(pid)]


def test_nothing_that_a_worker_answers_becomes_code_in_the_dispatcher(tmp_path: Path) -> None:
    harm = tmp_path / "harm"
    harm.mkdir()
    settings = {
        "HOSTLENS_TASK": "tests.service.hostile:answer",
        "HOSTLENS_RETRY_DELAY_S": "0.1",
        "HOSTLENS_DRILL_HARM": str(harm),
        "HOSTLENS_DRILL_SLEEP": "0.1",
    }
    with serving(tmp_path, **settings) as service:
        grid = service.client.submit(body(len(MODES)))
        ended = service.client.wait(grid.id, timeout_s=300)
        runs = {
            mode: service.client.run(found.id) for mode, found in zip(MODES, service.client.runs(grid.id), strict=True)
        }
        told = {mode: (found.state, found.error and found.error.code) for mode, found in runs.items()}
        assert told.pop("well") == told.pop("events") == ("done", None)
        assert told.pop("exception") == ("failed", "task_error")
        assert told.pop("exit") == ("failed", "error")
        assert set(told.values()) == {("failed", "invalid_result")}, told
        assert "HarmfulError" in str(runs["exception"].error)
        assert "text of an exit" in str(runs["exit"].error)
        assert ended.counts.done == 2
        dispatcher = service.child("service.dispatcher")
        assert dispatcher is not None
        assert not (harm / str(dispatcher.pid)).exists(), harmed(harm, service)
        # It goes on, with the same dispatcher.
        again = service.client.submit(body(2, seed=0))
        eventually(lambda: service.client.status(again.id).finished_at is not None, what="the end of another grid")
        assert service.child("service.dispatcher") == dispatcher


@pytest.mark.parametrize("kind", ["result", "exception"])
def test_a_greeting_that_is_not_plain_data_is_refused_and_the_worker_replaced(tmp_path: Path, kind: str) -> None:
    harm = tmp_path / "harm"
    harm.mkdir()
    (harm / "greeting").write_text(kind)
    settings = {
        "HOSTLENS_TASK": "tests.service.hostile:answer",
        "HOSTLENS_DRILL_HARM": str(harm),
        "HOSTLENS_WORKERS": "1",
    }
    with serving(tmp_path, **settings) as service:
        assert "cannot be used" in service.tail()
        dispatcher = service.child("service.dispatcher")
        assert dispatcher is not None
        assert not (harm / str(dispatcher.pid)).exists(), harmed(harm, service)


def listening(service: Serving) -> dict[int, list[str]]:
    """Ports that the service listens on, but for the API's; with the command line of who does."""
    found: dict[int, list[str]] = {}
    for process in service.processes():
        for connection in process.net_connections("tcp"):
            if connection.status == psutil.CONN_LISTEN and connection.laddr.port != service.port:
                assert connection.laddr.ip == "127.0.0.1", "reachable from elsewhere"
                found[connection.laddr.port] = process.cmdline()
    return found


def test_the_local_cluster_is_closed_to_who_has_not_its_credentials_and_its_workers_know_no_password(
    tmp_path: Path,
) -> None:
    # A password that nothing needs, since a URL of SQLite has none: it must go no further than the dispatcher.
    secrets = {"PGPASSWORD": "swordfish", "HOSTLENS_DATABASE_URL": f"sqlite:///{tmp_path / 'data' / 'hostlens.sqlite'}"}
    with serving(tmp_path, **secrets) as service:
        ports = listening(service)
        assert len(ports) >= 3, "scheduler, nannies, workers"
        certificates = make_certificates(tmp_path)
        for port in ports:
            for page in ("/", "/health", "/metrics", "/info/main/workers.html", "/json/counts.json"):
                said = _ask(port, f"GET {page} HTTP/1.0\r\n\r\n".encode())
                # Nothing, an alert of TLS, or a server that knows no such page.
                assert said[:1] in {b"", b"\x15"} or b" 404 " in said[:20], (port, page, said)
            for certificate in (None, certificates):
                # What the server sends first, and would send to one of its own.
                with suppress(OSError):
                    assert not _ask(port, b"", certificate), port
        dispatcher = service.child("service.dispatcher")
        assert dispatcher is not None
        below = dispatcher.children(recursive=True)
        assert {process.pid for process in service.workers()} <= {process.pid for process in below}
        for process in below:
            assert not {"PGPASSWORD", "HOSTLENS_DATABASE_URL"} & process.environ().keys(), process.cmdline()
            assert "swordfish" not in " ".join(process.cmdline())
        # What other users of the machine could open: Dask's folders, the database, the socket that forks workers.
        data = tmp_path / "data"
        assert stat.S_IMODE(data.stat().st_mode) == stat.S_IMODE((data / "dask").stat().st_mode) == 0o700
        names = {found.laddr for process in below for found in process.net_connections("unix")}
        sockets = [Path(name) for name in names if str(name).startswith("/")]
        assert sockets
        for path in sockets:
            assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


def _ask(port: int, question: bytes, certificate: Certificates | None = None) -> bytes:
    """What a server answers to somebody who has found its port, over TLS where there is no question."""
    with socket.create_connection(("127.0.0.1", port), timeout=5) as plain:
        if question:
            plain.sendall(question)
            with suppress(TimeoutError, ConnectionResetError):
                return plain.recv(1000)
            return b""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        if certificate is not None:
            context.load_cert_chain(certificate.cert, certificate.key)
        with context.wrap_socket(plain) as secure:
            return secure.recv(1000)
