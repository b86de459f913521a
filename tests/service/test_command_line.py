"""Whatever a user can type: one line on standard error and 2 or 1, never a traceback, nothing computed in vain."""

from __future__ import annotations

import fcntl
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner, Result

from service.api.app import create_app
from service.cli.app import app
from service.runtime.settings import Settings
from tests.drills.installation import Installation
from tests.service.service_process import ROOT, eventually, free_port

NOBODY = "http://127.0.0.1:1"
GRID = "g_06h05zns0sxqesvz1qxk4a1s56"


def called(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


def refused(outcome: Result, code: int = 2) -> str:
    """The line of a refusal; nothing but this line was said, and no mistake of ours was met."""
    assert outcome.exit_code == code, (outcome.output, outcome.exception)
    assert isinstance(outcome.exception, SystemExit), outcome.exception
    assert outcome.stdout == ""
    (line,) = outcome.stderr.splitlines()
    assert line.startswith("hostlens: ")
    return line


FILES: dict[str, bytes] = {
    "list.json": b"[1, 2]",
    "text.json": b'"HE0435"',
    "none.json": b"null",
    "half.json": b'{"preset": ',
    "nan.json": b'{"n": [NaN]}',
    "infinite.json": b'{"n": [-Infinity]}',
    "twice.json": b'{"n": [2], "n": [4]}',
    "deep.json": b"[" * 100_000,
    "digits.json": b'{"seed": ' + b"9" * 10_000 + b"}",
    "binary.json": bytes(range(256)),
    "empty.json": b"",
    "binary.toml": bytes(range(256)),
    "half.toml": b"name = ",
    "list.toml": b"a = [1, 2]",
    "date.toml": b"name = 2026-01-01",
    "image.fits": b"SIMPLE  =                    T" + bytes(range(256)),
}

WRONG = {
    "no such command": ("nonsense",),
    "no such option": ("status", "--limit", "0"),
    "two arguments": ("status", "a", "b"),
    "no argument": ("cancel",),
    "no value": ("submit", "--name"),
    "a number that is none": ("submit", "--n", "two"),
    "a list as body": ("submit", "--file", "list.json"),
    "a text as body": ("submit", "--file", "text.json"),
    "nothing as body": ("submit", "--file", "none.json"),
    "half a body": ("submit", "--file", "half.json"),
    "NaN in a body": ("submit", "--file", "nan.json"),
    "infinity in a body": ("submit", "--file", "infinite.json"),
    "a field twice": ("submit", "--file", "twice.json"),
    "a deep body": ("submit", "--file", "deep.json"),
    "a number of 10,000 digits": ("submit", "--file", "digits.json"),
    "a binary body": ("submit", "--file", "binary.json"),
    "an empty body": ("submit", "--file", "empty.json"),
    "a folder as body": ("submit", "--file", "."),
    "no such body": ("submit", "--file", "nowhere.json"),
    "a pipe as body": ("submit", "--file", "pipe"),
    "NaN as an option": ("submit", "--n", "nan"),
    "infinity as an option": ("submit", "--magnitude", "inf"),
    "a key beyond ASCII": ("submit", "--preset", "h0licow-vi", "--key", "clé"),
    "a key of two lines": ("submit", "--preset", "h0licow-vi", "--key", "a\nb"),
    "text that is not Unicode": ("submit", "--name", "\udcff"),
    "a body with a date": ("submit", "--file", "date.toml"),
    "a binary body as TOML": ("submit", "--file", "binary.toml"),
    "a field of the analysis without value": ("submit", "--analysis", "draws"),
    "a token beyond ASCII": ("status", "--token", "clé"),
    "no such format": ("results", "--format", "xml"),
    "a filter without value": ("results", "--where", "system"),
    "a filter without name": ("retry", GRID, "--where", "=HE0435"),
    "failed and another state": ("retry", GRID, "--failed", "--where", "state=cancelled"),
    "a grid twice": ("results", GRID, "--where", f"grid={GRID}"),
    "a filter that is not Unicode": ("results", "--where", "system=\udcff"),
    "a camera that is not there": ("submit", "--camera", "nowhere.toml"),
    "a folder as camera": ("submit", "--camera", "folder.toml"),
    "a binary system": ("submit", "--system", "binary.json"),
    "half a system": ("submit", "--system", "half.toml"),
    "no such system file": ("submit", "--system", "nowhere.toml"),
    "a deep system": ("simulate", "deep.json"),
    "a system of digits": ("simulate", "digits.json"),
    "a grid that is not Unicode": ("status", "\udcff"),
    "no address": ("status", "--url", "nonsense"),
    "half an address": ("status", "--url", "http://[::1"),
    "an address of another kind": ("status", "--url", "ftp://127.0.0.1"),
    "a port beyond all": ("status", "--url", "http://127.0.0.1:99999"),
    "an address without host": ("status", "--url", "http://"),
    "an address with a control character": ("status", "--url", "http://a\x00b"),
    "an unknown system": ("simulate", "HE0000"),
    "an unknown preset": ("montage", "HE0000"),
    "a system with a path": ("simulate", "../etc/passwd"),
    "a list as system": ("simulate", "list.json"),
    "a binary system file": ("simulate", "binary.toml"),
    "a folder as system": ("simulate", "folder.toml"),
    "an index that is NaN": ("simulate", "HE0435", "--n", "nan"),
    "an index that is infinite": ("simulate", "HE0435", "--n", "inf"),
    "a huge magnitude": ("simulate", "HE0435", "--magnitude", "1e300"),
    "a huge seed": ("simulate", "HE0435", "--seed", "9" * 30),
    "a seed below 0": ("simulate", "HE0435", "--seed", "-1"),
    "a jitter that is NaN": ("simulate", "HE0435", "--jitter", "nan"),
    "a huge jitter": ("simulate", "HE0435", "--jitter", "1e9"),
    "a huge defocus": ("simulate", "HE0435", "--defocus-nm", "1e300"),
    "a defocus that is NaN": ("simulate", "HE0435", "--defocus-nm", "nan"),
    "an unknown noise level": ("simulate", "HE0435", "--noise-level", "none"),
    "an unknown mass model": ("simulate", "HE0435", "--mass-model", "none"),
    "an unknown camera": ("simulate", "HE0435", "--camera", "none"),
    "a list as camera": ("simulate", "HE0435", "--camera", "list.toml"),
    "an output that is a file": ("simulate", "HE0435", "--out", "list.json"),
    "a montage into a file": ("montage", "HE0435", "--out", "list.json/x"),
    "a gallery into a file": ("gallery", "--out", "list.json"),
    "a gallery of no run": ("gallery", "--run", "49"),
    "an inversion as text": ("inversion", "HE0435", "--out", "x.txt"),
    "an inversion without suffix": ("inversion", "HE0435", "--out", "x"),
    "an inversion into a file": ("inversion", "HE0435", "--out", "list.json/x.png"),
    "an inversion with a name too long": ("inversion", "HE0435", "--out", "x" * 300 + ".png"),
    "speed against error of no system": ("accuracy", "HE0436"),
    "speed against error of no stage": ("accuracy", "HE0435", "none"),
    "speed against error as text": ("accuracy", "HE0435", "--json", "x.txt"),
    "speed against error, files of one name": ("accuracy", "HE0435", "--figure", "x.png", "--figure", "none/x.png"),
    "an unknown profile": ("inversion", "HE0435", "--profile", "none"),
    "no source pixels": ("inversion", "HE0435", "--source-pixels", "0"),
    "too many source pixels": ("inversion", "HE0435", "--source-pixels", "1000000"),
    "no image": ("measure", "nowhere.fits"),
    "an image that is none": ("measure", "list.json", "--psf", "list.json", "--zeropoint", "25"),
    "half an image": ("measure", "image.fits"),
    "a folder as image": ("measure", "."),
    "a picture as text": ("measure", "image.fits", "--figure", "x.txt"),
    "FITS as text": ("measure", "image.fits", "--fits", "x.txt"),
    "a result into a folder": ("measure", "image.fits", "--json", "."),
    "a result nowhere": ("measure", "image.fits", "--json", "no/such/x.json"),
    "a result into a device": ("measure", "image.fits", "--json", os.devnull),
    "a result twice": ("measure", "image.fits", "--json", "x.png", "--figure", "x.png"),
    "a result over the image": ("measure", "image.fits", "--fits", "image.fits"),
    "a revision that there is not": ("db", "upgrade", "zzz"),
    "no revision": ("db", "upgrade", ""),
    "a relative revision": ("db", "upgrade", "+1"),
    "a range of revisions": ("db", "upgrade", "0001:0002"),
    "back to no revision": ("db", "downgrade", "", "--yes"),
    "back to the future": ("db", "downgrade", "head", "--yes"),
    "an age of 0": ("db", "prune", "--older-than", "0d"),
    "an age below 0": ("db", "prune", "--older-than=-1d"),
    "an age in years": ("db", "prune", "--older-than", "1y"),
    "an age without unit": ("db", "prune", "--older-than", "90"),
    "an age before all calendars": ("db", "prune", "--older-than", "999999w"),
    "an age of a hundred thousand days": ("db", "prune", "--older-than", "100000d"),
    "a scheduler that listens nowhere": ("scheduler", "--host", "192.0.2.1"),
    "a scheduler without port": ("scheduler", "--host", "127.0.0.1", "--port", "0"),
    "health nowhere": ("scheduler", "--host", "127.0.0.1", "--port", "{port}", "--health", "nowhere"),
    "health on IPv6": ("worker", "tcp://127.0.0.1:1", "--health", "[::1]:0"),
    "health beyond all ports": ("worker", "tcp://127.0.0.1:1", "--health", "127.0.0.1:99999"),
    "a worker of no address": ("worker", "nowhere"),
    "no worker": ("worker", "tcp://127.0.0.1:1", "--workers", "0"),
    "a service on no port": ("serve", "--port", "0"),
    "a service in a file": ("serve", "--data-dir", "list.json", "--port", "{port}"),
    "a demo in a file": ("demo", "--data-dir", "list.json"),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, data in FILES.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "folder.toml").mkdir()
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.startswith("HOSTLENS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOSTLENS_URL", NOBODY)
    # The logging of this process belongs to all tests.
    monkeypatch.setattr("service.runtime.logs.configure", lambda *_: None)
    return tmp_path


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_asked_is_refused_in_one_line_before_anything_is_done(name: str, folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    began = time.process_time()
    refused(called(*[part.format(port=free_port()) for part in WRONG[name]]))
    # To load the engine is all that may take time: neither is anything simulated nor a figure drawn.
    assert time.process_time() - began < 20
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ("submit", "--preset", "h0licow-vi"), ("status",), ("status", GRID), ("status", GRID, "--watch"),
        ("status", GRID, "--runs"), ("results",), ("results", GRID, "--format", "json"),
        ("submit", "--preset", "h0licow-vi", "--dry-run"), ("retry", GRID, "--failed", "--where", "system=HE0435"),
        ("cancel", GRID), ("pause", GRID),
        ("resume", GRID), ("retry", GRID),
    ],
    ids=" ".join,
)  # fmt: skip
class TestSpeaking:
    """Each command that speaks to a service, and whatever may be there instead of it."""

    def test_nobody_answers(self, arguments: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for proxy in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
            monkeypatch.setenv(proxy, "socks9://nonsense:port")
        assert "does not answer" in refused(called(*arguments), 1)
        assert "does not answer" in refused(called(*arguments, "--url", "http://no-such-host.invalid"), 1)

    @pytest.mark.parametrize(
        ("status", "kind", "text"),
        [
            (200, "text/html", b"<html>It works</html>"),
            (200, "application/json", b'{"hello": 1}'),
            (200, "application/json", b"[" * 100_000),
            (200, "application/json", b"\xff\xfe"),
            (204, "application/json", b""),
            (302, "text/html", b""),
            (404, "text/html", b"<html>"),
            (500, "application/problem+json", b"[1]"),
            (500, "application/problem+json", b"<"),
            (422, "application/problem+json", b'{"detail": 1, "errors": [1, {"pointer": 2}]}'),
            (418, "application/problem+json", b'{"errors": {"a": 1}}'),
        ],
        ids=lambda value: str(value)[:16],
    )
    def test_something_else_answers(
        self, arguments: tuple[str, ...], folder: Path, status: int, kind: str, text: bytes
    ) -> None:
        with answering(status, kind, text) as url:
            refused(called(*arguments, "--url", url), 1)

    def test_noise_answers(self, arguments: tuple[str, ...], folder: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = server.getsockname()[1]

            def answer() -> None:
                connection, _ = server.accept()
                connection.recv(1024)
                connection.sendall(b"220 smtp ready\r\n")
                connection.close()

            thread = threading.Thread(target=answer)
            thread.start()
            refused(called(*arguments, "--url", f"http://127.0.0.1:{port}"), 1)
            thread.join()


@contextmanager
def answering(status: int, kind: str, text: bytes) -> Iterator[str]:
    """Something that is not hostlens and answers to everything."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.rfile.read(int(self.headers.get("Content-Length", 0)))
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        do_POST = do_GET

        def log_message(self, *_: Any) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_the_api_s_refusal_is_told_once_with_its_places(
    tmp_path: Path, sqlite_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with TestClient(create_app(Settings(database_url=sqlite_url, data_dir=tmp_path))) as api:
        monkeypatch.setattr("service.connection.httpx.Client", lambda **_: api)
        monkeypatch.setattr(api, "close", lambda: None)
        line = refused(called("submit", "--preset", "h0licow-vi/HE0435", "--n", "3"), 1)
        assert line.count("allowed is one of") == 1
        assert line.startswith("hostlens: n: got 3.0, ")
        for odd in ("", "..", "../../healthz", "a/b", "a b", "a?b#c", "%2e%2e", "é", GRID, "x" * 5000, "\x00"):
            refused(called("status", odd), 1)


def in_shell(folder: Path, command: str, **variables: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        ["/bin/bash", "-o", "pipefail", "-c", command.format(f"{sys.executable} -m service")],
        cwd=folder,
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), **variables},
        capture_output=True,
        timeout=200,
        check=False,
    )


def assert_light(folder: Path, commands: list[list[str]], slow: tuple[str, ...]) -> None:
    """None of the commands loads one of the modules; one after the other in a process of its own."""
    program = (
        "import sys\n"
        "from service.__main__ import main\n"
        f"for arguments in {commands!r}:\n"
        "    sys.argv[1:] = arguments\n"
        "    try:\n        main()\n"
        "    except SystemExit:\n        pass\n"
        f"    assert not {set(slow)!r} & set(sys.modules), arguments\n"
        "print('all of them')"
    )
    (folder / "program.py").write_text(program)
    ended = in_shell(folder, f"{sys.executable} program.py")
    assert ended.stdout.endswith(b"all of them\n"), ended.stderr


def test_help_and_mistakes_load_nothing_that_takes_long(tmp_path: Path) -> None:
    """All of them are told in a third of a second of CPU; each of these modules takes as long again, and more.

    Rich is not among the largest of them, and would be half of what help takes.
    """
    slow = ("sqlalchemy", "alembic", "httpx", "fastapi", "dask", "numpy", "pydantic_settings", "engine", "rich")
    commands = [
        ["--help"], ["submit", "--help"], ["results", "--help"], ["measure", "--help"], ["db", "--help"],
        ["nonsense"], ["results", "--where", "system"], ["submit", "--analysis", "draws"],
        ["submit", "--file", "nowhere.json"], ["submit", "--system", "nowhere.toml"], ["simulate", "nowhere.toml"],
        ["measure", "nowhere.fits"], ["inversion", "HE0435", "--out", "x.txt"], ["simulate", "HE0435", "--n", "two"],
        ["accuracy", "HE0435", "--json", "x.txt"],
    ]  # fmt: skip
    assert_light(tmp_path, commands, slow)


def test_mistakes_that_only_the_engine_can_tell_load_nothing_that_computes(tmp_path: Path) -> None:
    """They take half a second of CPU; these modules take one and a half more."""
    lens = (ROOT / "docs" / "examples" / "my_system.toml").read_text()
    (tmp_path / "lens.toml").write_text(lens.replace("magnitude = ", 'magnitude = "bright" # ', 1))
    slow = ("numba", "scipy", "astropy", "matplotlib", "engine.lensing", "engine.imaging")
    commands = [
        ["simulate", "lens.toml", "--r-eff", "0.3", "--magnitude", "21"], ["simulate", "HE0436"],
        ["simulate", "HE0435", "--n", "99"], ["simulate", "HE0435", "--mass-model", "none"],
        ["simulate", "HE0435", "--camera", "none"], ["simulate", "HE0435", "--l-eta", "3"], ["montage", "HE0436"],
        ["gallery", "--noise-level", "none"], ["inversion", "HE0435", "--profile", "none"],
        ["accuracy", "HE0436"], ["accuracy", "HE0435", "none"],
    ]  # fmt: skip
    assert_light(tmp_path, commands, slow)


@pytest.mark.parametrize("url", ["nonsense://x", "s3://bucket"])
def test_a_store_of_a_kind_that_cannot_be_reached_is_told_before_it_is_pruned(
    url: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTLENS_DATA_DIR", str(folder / "data"))
    assert called("db", "upgrade").exit_code == 0
    monkeypatch.setenv("HOSTLENS_ARTEFACT_URL", url)
    assert "HOSTLENS_ARTEFACT_URL" in refused(called("db", "prune", "--older-than", "1d", "--yes"))


def test_a_check_of_a_database_at_another_revision_says_what_to_do(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTLENS_DATA_DIR", str(folder / "data"))
    assert called("db", "upgrade").exit_code == 0
    assert called("db", "downgrade", "0003", "--yes").exit_code == 0
    assert "run hostlens db upgrade" in refused(called("db", "check"), 1)
    assert called("db", "downgrade", "base", "--yes").exit_code == 0
    assert "run hostlens db upgrade" in refused(called("db", "check"), 1)


ASCII = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def test_closed_and_broken_streams_and_an_ascii_locale_are_no_reason_to_fail(tmp_path: Path) -> None:
    (tmp_path / "database").mkdir()
    data = {"HOSTLENS_DATA_DIR": str(tmp_path / "database")}
    assert in_shell(tmp_path, "{} db upgrade 2>&- >&- <&-", **data).returncode == 0
    assert in_shell(tmp_path, "{} db check", **data).returncode == 0
    for command in (
        "{} --help >&-",
        "{} --help 2>&-",
        "{} db --help | head -1",
        "{} --version 2>&1 >/dev/full | cat",
    ):
        ended = in_shell(tmp_path, command, **data)
        assert b"Traceback" not in ended.stderr + ended.stdout, command
    for command, code in (
        ("{} db --help", 0),
        ("{} --help", 0),
        ("{} status 'gr\u00fcn' --url http://\u03b8:1", 2),
    ):
        ended = in_shell(tmp_path, command, **ASCII, **data)
        assert (ended.returncode, b"Traceback" in ended.stderr) == (code, False), (command, ended.stderr)


def test_a_service_whose_output_nobody_reads_or_that_has_none_goes_on(tmp_path: Path) -> None:
    """The pipe holds 4 KiB, and each request is a line of the log, of a hundred bytes."""
    for redirection, requests in (("unread", 100), ("closed", 10)):
        with serving_into(tmp_path / redirection, redirection) as service:
            for _ in range(requests):
                service.client.grids(limit=1)
            grid = service.client.submit({"preset": "h0licow-vi/HE0435", "n": [2]})
            assert service.client.wait(grid.id, timeout_s=300).counts.done == grid.n_runs
            assert service.end() == 0
            eventually(lambda: service.processes() == [], what="the end of all processes")
    file = tmp_path / "closed" / "data" / "hostlens.sqlite"
    assert file.read_bytes().startswith(b"SQLite format 3")


@contextmanager
def serving_into(folder: Path, redirection: str) -> Iterator[Any]:
    """A service whose standard streams are a pipe that nobody reads, or closed."""
    folder.mkdir()
    service = Installation(folder, {"HOSTLENS_DRILL_SLEEP": "0", "HOSTLENS_API_PROCESSES": "1"}, commands=())
    command, read_end = [sys.executable, "-m", "service", "serve"], -1
    options: dict[str, Any] = {}
    if redirection == "closed":
        command = ["sh", "-c", 'exec "$@" 0<&- 1>&- 2>&-', "sh", *command]
    else:
        read_end, write_end = os.pipe()
        fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
        options = {"stdout": write_end, "stderr": write_end}
    try:
        service.started.append(subprocess.Popen(command, cwd=folder, env=service.environment, **options))
        service.wait_ready()
        yield service
    finally:
        service.kill_all()
        if read_end >= 0:
            os.close(read_end)
            os.close(options["stdout"])


def test_serve_says_so_when_it_serves_on_ipv6_too(tmp_path: Path) -> None:
    port = free_port()
    settings = {"HOSTLENS_DATA_DIR": str(tmp_path), "HOSTLENS_PORT": str(port), "HOSTLENS_API_PROCESSES": "1"}
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "HOSTLENS_TASK": "service.worker.synthetic:brief", **settings}
    command = [sys.executable, "-m", "service", "serve", "--host", "::1"]
    with subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == f"hostlens serves http://[::1]:{port}; Ctrl-C ends it\n"
        # At once, with nobody to wait for.
        status = called("status", "--url", f"http://[::1]:{port}")
        assert (status.exit_code, status.output) == (0, "")
        run.terminate()
        assert run.wait(120) == 0
