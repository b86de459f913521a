"""A service that nothing happens to, one for all of these: what it shows, and what it is closed to."""

from __future__ import annotations

import socket
import ssl
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import psutil
import pytest

from tests.service.certificates import Certificates, make_certificates
from tests.service.service_process import Serving, serving

_SILENCE_S = 2.0
"""What has not answered by then says nothing."""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    folder = tmp_path_factory.mktemp("undisturbed")
    # A password that nothing needs, since a URL of SQLite has none: it must go no further than the dispatcher.
    secrets = {"PGPASSWORD": "swordfish", "HOSTLENS_DATABASE_URL": f"sqlite:///{folder / 'data' / 'hostlens.sqlite'}"}
    with serving(folder, **secrets) as found:
        yield found


def test_a_single_api_process_tells_of_itself(service: Serving) -> None:
    assert len(service.children("service.api")) == 1
    shown = httpx.get(f"http://127.0.0.1:{service.port}/metrics", timeout=120.0).text
    assert "process_resident_memory_bytes" in shown


def test_a_second_service_on_the_same_port_says_so_and_starts_nothing(service: Serving, tmp_path: Path) -> None:
    before = {process.pid for process in service.processes()}
    second = subprocess.run(
        [sys.executable, "-m", "service", "serve"],
        cwd=tmp_path,
        env=service.environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert second.returncode == 2
    assert "HOSTLENS_PORT: cannot listen" in second.stderr
    assert {process.pid for process in service.processes()} == before


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
    service: Serving, tmp_path: Path
) -> None:
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
    data = service.folder / "data"
    assert stat.S_IMODE(data.stat().st_mode) == stat.S_IMODE((data / "dask").stat().st_mode) == 0o700
    names = {found.laddr for process in below for found in process.net_connections("unix")}
    sockets = [Path(name) for name in names if str(name).startswith("/")]
    assert sockets
    for path in sockets:
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


def _ask(port: int, question: bytes, certificate: Certificates | None = None) -> bytes:
    """What a server answers to somebody who has found its port, over TLS where there is no question."""
    with socket.create_connection(("127.0.0.1", port), timeout=_SILENCE_S) as plain:
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
