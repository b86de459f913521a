"""What is wrong with the surroundings of a process: one line that names it and exit code 2, before anything starts."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.runtime import preflight
from service.runtime.settings import Settings, read_settings
from service.runtime.start import ConfigurationError
from service.runtime.supervisor import Supervisor
from tests.service.service_process import ROOT, free_port

SECRET = "hunter2"  # noqa: S105 - what no message may repeat


@pytest.fixture(autouse=True)
def _plain(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [name for name in os.environ if name.startswith("HOSTLENS_")]:
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))


REFUSED = [
    ("HOSTLENS_DATABASE_ULR", f"postgresql://u:{SECRET}@h/x", "did you mean HOSTLENS_DATABASE_URL"),
    ("HOSTLENS_WORKER", "2", "did you mean HOSTLENS_WORKERS"),
    ("HOSTLENS_SOMETHING_ELSE", "2", "is not a setting"),
    ("HOSTLENS_MERTICS_PORT", "8422", "did you mean HOSTLENS_METRICS_PORT"),
    ("hostlens_prot", "8422", "did you mean HOSTLENS_PORT"),
    ("HOSTLENS_DATABASE_URL", "", "is empty"),
    ("HOSTLENS_DATABASE_URL", "  ", "is empty"),
    ("HOSTLENS_SCHEDULER_ADDRESS", "", "is empty"),
    ("HOSTLENS_PORT", "", "is empty"),
    ("HOSTLENS_URL", "", "is empty"),
    ("HOSTLENS_PORT", "http", "got 'http'"),
    ("HOSTLENS_PORT", "0", "greater than or equal to 1"),
    ("HOSTLENS_PORT", "8_421x", "got '8_421x'"),
    ("HOSTLENS_METRICS_PORT", "65536", "less than or equal to 65535"),
    ("HOSTLENS_WORKER_MEMORY", "two gigs", "allowed is a size as 2GiB"),
    ("HOSTLENS_WORKER_MEMORY", "2", "allowed is a size as 2GiB"),
    ("HOSTLENS_WORKER_MEMORY", "1kB", "allowed is a size as 2GiB"),
    ("HOSTLENS_WORKER_MEMORY", "9" * 400 + "GB", "allowed is a size as 2GiB"),
    ("HOSTLENS_SLURM_MEMORY", "auto", "allowed is a size as 2GiB"),
    ("HOSTLENS_KUBERNETES_MEMORY", "four", "got 'four'"),
    ("HOSTLENS_DEADLINE_S", "an hour", "got 'an hour'"),
    ("HOSTLENS_DEADLINE_S", "nan", "HOSTLENS_DEADLINE_S"),
    ("HOSTLENS_POLL_S", "inf", "HOSTLENS_POLL_S"),
    ("HOSTLENS_POLL_S", "-1", "HOSTLENS_POLL_S"),
    ("HOSTLENS_SLURM_DIRECTIVES", "--mem=4G", "allowed is a JSON list"),
    ("HOSTLENS_SLURM_PROLOGUE", '{"a": 1}', "HOSTLENS_SLURM_PROLOGUE"),
    ("HOSTLENS_SLURM_PROLOGUE", "[1, 2]", "HOSTLENS_SLURM_PROLOGUE"),
    ("HOSTLENS_SLURM_PROLOGUE", "[" * 100_000, "HOSTLENS_SLURM_PROLOGUE"),
    ("HOSTLENS_SLURM_WALLTIME", "a day", "allowed is a time as Slurm"),
    ("HOSTLENS_AUTH", "perhaps", "HOSTLENS_AUTH"),
    ("HOSTLENS_HOST", "http://127.0.0.1", "allowed is the name or the address"),
    ("HOSTLENS_HOST", "::zz", "allowed is the name or the address"),
    ("HOSTLENS_CLUSTER", "cloud", "HOSTLENS_CLUSTER"),
    ("HOSTLENS_LOG_LEVEL", "loud", "HOSTLENS_LOG_LEVEL"),
    ("HOSTLENS_LOG_FORMAT", "xml", "HOSTLENS_LOG_FORMAT"),
    ("HOSTLENS_TASK", "os.system", "HOSTLENS_TASK"),
    ("HOSTLENS_SCHEDULER_ADDRESS", "scheduler", "allowed is tcp://host:port"),
    ("HOSTLENS_SCHEDULER_ADDRESS", "tcp://::1:8786", "allowed is tcp://host:port"),
    ("HOSTLENS_SCHEDULER_ADDRESS", "tcp://h:99999", "allowed is tcp://host:port"),
    ("HOSTLENS_SCHEDULER_ADDRESS", "tls://h:8786", "HOSTLENS_TLS_CA"),
    ("HOSTLENS_DATABASE_URL", f"mysql://u:{SECRET}@h/x", "of another kind, mysql"),
    ("HOSTLENS_DATABASE_URL", f"postgresql+asyncpg://u:{SECRET}@h/x", "of another kind, postgresql+asyncpg"),
    ("HOSTLENS_DATABASE_URL", f"postgresql//u:{SECRET}@h/x", "the database URL is none"),
    ("HOSTLENS_DATABASE_URL", f"postgresql://u:{SECRET}@h:port/x", "the database URL is none"),
    ("HOSTLENS_DATABASE_URL", "/var/lib/hostlens.sqlite", "the database URL is none"),
    ("HOSTLENS_DATABASE_URL", "sqlite://", "names no file"),
    ("HOSTLENS_DATABASE_URL", "sqlite:///", "names no file"),
    ("HOSTLENS_DATABASE_URL", "sqlite:///:memory:", "names no file"),
    ("HOSTLENS_DATABASE_URL", "sqlite:///file:x?mode=memory&uri=true", "has mode=memory"),
    ("HOSTLENS_DATABASE_URL", f"postgresql://u:{SECRET}@h/x?sslmod=require", "libpq does not know: sslmod"),
    ("HOSTLENS_DATABASE_URL", "sqlite:///~nobody-of-this-name/x", "~ cannot be replaced"),
    ("HOSTLENS_ARTEFACT_URL", "memory://x", "not shared"),
    ("HOSTLENS_ARTEFACT_URL", "file://", "names no place"),
    ("HOSTLENS_ARTEFACT_URL", "s3://", "names no place"),
    ("HOSTLENS_DATA_DIR", "~nobody-of-this-name/x", "~ cannot be replaced"),
]


@pytest.mark.parametrize(
    ("name", "value", "said"), REFUSED, ids=[f"{name[9:]}={value[:20]}" for name, value, _ in REFUSED]
)
def test_a_variable_that_is_unknown_empty_or_no_value_is_refused_by_its_name(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, said: str
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(ConfigurationError) as refusal:
        read_settings()
    message = str(refusal.value)
    assert name in message
    assert said in message
    assert SECRET not in message
    assert "\n" not in message
    assert len(message) < 400


def test_variables_of_others_are_none_of_our_business(monkeypatch: pytest.MonkeyPatch) -> None:
    """What Kubernetes makes of its Services, what the files in deploy/ use themselves, what drills tell their tasks."""
    for name, value in {
        "HOSTLENS_API_SERVICE_HOST": "10.0.0.1",
        "HOSTLENS_API_SERVICE_PORT": "8421",
        "HOSTLENS_API_SERVICE_PORT_HTTP": "8421",
        "HOSTLENS_API_PORT": "tcp://10.0.0.1:8421",
        "HOSTLENS_API_PORT_8421_TCP": "tcp://10.0.0.1:8421",
        "HOSTLENS_API_PORT_8421_TCP_ADDR": "10.0.0.1",
        "HOSTLENS_SCHEDULER_PORT": "8786",
        "HOSTLENS_SHARED": "/shared",
        "HOSTLENS_DRILL_SLEEP": "1",
        "HOSTLENS_URL": "http://x",
    }.items():
        monkeypatch.setenv(name, value)
    assert read_settings().port == 8421


def test_a_tilde_is_the_home_wherever_a_path_may_stand(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    home = tmp_path / "home"
    monkeypatch.setenv("HOSTLENS_DATA_DIR", "~/data")
    monkeypatch.setenv("HOSTLENS_DATABASE_URL", "sqlite:///~/queue.sqlite")
    for url, path in (("~/kept", f"{home}/kept"), ("file://~/kept", f"file://{home}/kept"), ("s3://~/x", "s3://~/x")):
        monkeypatch.setenv("HOSTLENS_ARTEFACT_URL", url)
        found = read_settings()
        assert (found.data_dir, found.artefacts) == (home / "data", path)
        assert found.database == f"sqlite:///{home}/queue.sqlite"


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("127.0.0.1", "http://127.0.0.1:8421"),
        ("::1", "http://[::1]:8421"),
        ("[::1]", "http://[::1]:8421"),
        ("localhost", "http://localhost:8421"),
        ("0.0.0.0", "http://127.0.0.1:8421"),  # noqa: S104 - what a client of this machine makes of it is the point
        ("::", "http://[::1]:8421"),
    ],
)
def test_the_service_is_reached_where_it_listens_in_either_family(host: str, url: str) -> None:
    assert Settings(host=host).url == url


@contextlib.contextmanager
def taken() -> Iterator[int]:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield int(other.getsockname()[1])


def refusal(settings: Settings) -> str:
    with pytest.raises(ConfigurationError) as found:
        preflight.for_both(settings)
    return str(found.value)


def test_what_the_settings_name_is_looked_at_before_a_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "file"
    file.touch()
    data, port = tmp_path / "data", free_port()
    preflight.for_both(Settings(data_dir=data, port=port))
    for where in (file, file / "below"):
        assert "HOSTLENS_DATA_DIR: cannot use" in refusal(Settings(data_dir=where, port=port))
    with taken() as other:
        assert f"HOSTLENS_PORT: cannot listen on 127.0.0.1:{other}" in refusal(Settings(data_dir=data, port=other))
        found = refusal(Settings(data_dir=data, port=port, metrics_port=other))
        assert f"HOSTLENS_METRICS_PORT: cannot listen on 127.0.0.1:{other}" in found
    assert "both" in refusal(Settings(data_dir=data, port=port, metrics_port=port))
    # Kept for documentation: no machine has it.
    assert "HOSTLENS_HOST" in refusal(Settings(data_dir=data, port=port, host="192.0.2.1"))
    assert "HOSTLENS_ARTEFACT_URL" in refusal(Settings(data_dir=data, port=port, artefact_url="nothing://x"))
    assert "HOSTLENS_ARTEFACT_URL" in refusal(Settings(data_dir=data, port=port, artefact_url=str(file / "x")))
    assert "is not a file" in refusal(Settings(data_dir=data, port=port, database_url=f"sqlite:///{tmp_path}"))
    nowhere = f"sqlite:///{tmp_path}/no/such/x.sqlite"
    assert "HOSTLENS_DATABASE_URL" in refusal(Settings(data_dir=data, port=port, database_url=nowhere))
    tls = {"tls_ca": file, "tls_cert": file, "tls_key": file, "scheduler_address": "tls://x:1"}
    assert "HOSTLENS_TLS_CA" in refusal(Settings.model_validate({"data_dir": data, "port": port, **tls}))
    os.mkfifo(tmp_path / "pipe")
    tls["tls_ca"] = tmp_path / "pipe"
    assert "not a regular file" in refusal(Settings.model_validate({"data_dir": data, "port": port, **tls}))
    assert "takes no files" in refusal(Settings(data_dir=data, port=port, artefact_url="http://127.0.0.1/store"))
    assert "HOSTLENS_TASK: there is no module" in refusal(Settings(data_dir=data, port=port, task="no.such:task"))
    monkeypatch.setitem(sys.modules, "psycopg.pq", None)
    remote = Settings(data_dir=data, port=port, database_url="postgresql://h/x")
    assert "HOSTLENS_DATABASE_URL: PostgreSQL needs hostlens with its extra postgres" in refusal(remote)
    monkeypatch.setitem(sys.modules, "dask_jobqueue.slurm", None)
    assert "extra slurm" in refusal(Settings(data_dir=data, port=port, cluster="slurm"))


def test_without_semaphores_local_workers_are_refused_and_others_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr("multiprocessing.context.BaseContext.Lock", none)
    assert "/dev/shm" in refusal(Settings(data_dir=tmp_path, port=free_port()))  # noqa: S108
    preflight.for_both(Settings(data_dir=tmp_path, port=free_port(), scheduler_address="tcp://127.0.0.1:1"))


def run(*command: str, limit_s: float = 120.0, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", *command],
        env={**os.environ, "PYTHONPATH": str(ROOT), **variables},
        capture_output=True,
        text=True,
        timeout=limit_s,
        check=False,
    )


@pytest.mark.parametrize(
    "command",
    [
        ("service", "serve"),
        ("service", "api"),
        ("service", "dispatcher"),
        ("service", "scheduler", "--host", "127.0.0.1"),
        ("service", "worker", "tcp://127.0.0.1:1"),
        ("service", "db", "upgrade"),
        ("service", "status"),
        ("service.api",),
        ("service.dispatcher",),
    ],
    ids=" ".join,
)
def test_every_process_ends_by_a_wrong_setting_with_one_line_and_2(command: tuple[str, ...]) -> None:
    ended = run(*command, HOSTLENS_WORKER_MEMORY="two gigs")
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert [line.split(":")[:2] for line in ended.stderr.splitlines()] == [["hostlens", " HOSTLENS_WORKER_MEMORY"]]


@pytest.mark.parametrize("first", ["engine.home", "service.runtime.start"])
def test_a_home_that_may_not_be_entered_is_taken_for_none(first: str, tmp_path: Path) -> None:
    """As ``su`` and ``sudo`` leave it: the home of whoever called. Astropy cannot be imported with such a one."""
    program = (
        "import os, sys; real = os.stat\n"
        "def stat(path, *rest, **options):\n"
        f"    if str(path).startswith({str(tmp_path)!r} + '/'):\n"
        "        raise PermissionError(13, 'Permission denied')\n"
        "    return real(path, *rest, **options)\n"
        "os.stat = stat\n"
        f"import {first}\n"
        "if 'service' in sys.modules:\n    sys.modules['service.runtime.start'].begin()\n"
        "os.stat = real; print(os.environ['HOME'])"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.stdout, ended.stderr) == ("/nonexistent\n", "")


def test_slurm_without_its_command_is_told_before_a_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigurationError, match="HOSTLENS_CLUSTER: slurm needs the command sbatch"):
        preflight.require_cluster(Settings(data_dir=tmp_path, cluster="slurm"))


def test_the_check_of_semaphores_leaves_no_process(tmp_path: Path) -> None:
    """A process that watches over them would outlive by a moment whoever asked for it."""
    program = (
        "import psutil; from service.runtime import preflight; from service.runtime.settings import Settings\n"
        "preflight.require_cluster(Settings()); print(psutil.Process().children())"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False)  # fmt: skip
    assert ended.stdout == "[]\n", ended.stderr


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("setpriv") is None, reason="only root can be somebody else")
def test_a_data_folder_that_may_not_be_written_is_told_before_a_start(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir(mode=0o755)
    rights = "-all,+dac_read_search"
    other = ["setpriv", "--reuid=12345", "--regid=12345", "--clear-groups"]
    other += [f"--inh-caps={rights}", f"--ambient-caps={rights}"]
    for command in ("serve", "dispatcher", "api"):
        ended = subprocess.run(
            [*other, sys.executable, "-m", "service", command],
            env={**os.environ, "PYTHONPATH": str(ROOT), "HOSTLENS_DATA_DIR": str(tmp_path / "data")},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert ended.returncode == 2
        assert "HOSTLENS_DATA_DIR: cannot use" in ended.stderr
        assert len(ended.stderr.splitlines()) == 1


def test_a_child_that_refuses_its_configuration_is_not_started_again(tmp_path: Path) -> None:
    """What the supervisor could not know: the settings of a child are wrong all the same."""
    from threading import Event

    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "refusing.py").write_text("import sys; open('starts', 'a').write('x'); sys.exit(2)", encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder))
        supervisor = Supervisor(Settings(data_dir=tmp_path, port=free_port()), ("refusing",))
        assert supervisor.run(Event()) == 2
    assert (tmp_path / "starts").read_text() == "x"
