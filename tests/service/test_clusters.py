"""Workers elsewhere: a real scheduler and real workers started apart, with TLS; Slurm and Kubernetes as far as here."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import dask.config
import psutil
import pytest
from distributed import Client
from distributed.batched import BatchedSend
from distributed.core import Status
from pydantic import ValidationError
from sqlalchemy import select

from engine import engine_digest
from service.dispatcher.clusters import dask_config, kubernetes_spec, security_of, slurm
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.tables import attempt
from tests.service.certificates import make_certificates
from tests.service.plans import submit
from tests.service.service_process import ROOT, eventually, free_port

# How long a step may take on a busy machine: cold kernels alone are 20 s. Nothing is claimed of it.
_PATIENCE_S = 150


class Apart:
    """A scheduler, workers and a dispatcher, each started by its own command as on different machines."""

    def __init__(self, folder: Path, url: str, *, tls: bool, **settings: str) -> None:
        self.folder = folder
        self.port = free_port()
        self.executions = folder / "executions"
        self.executions.touch()
        self.processes: list[subprocess.Popen[bytes]] = []
        settings = settings | {
            "DATABASE_URL": url,
            "DATA_DIR": str(folder / "data"),
            "SCHEDULER_ADDRESS": f"{'tls' if tls else 'tcp'}://127.0.0.1:{self.port}",
            "TASK": "tests.service.tasks:fast",
            "DRILL_SLEEP": "0.3",
            "DRILL_LOG": str(self.executions),
            "RECONCILE_S": "1",
            "RETRY_DELAY_S": "0.2",
        }
        self.options: list[str] = []
        if tls:
            files = make_certificates(folder)
            settings |= {"TLS_CA": str(files.ca), "TLS_CERT": str(files.cert), "TLS_KEY": str(files.key)}
            self.options = ["--tls-ca-file", str(files.ca), "--tls-cert", str(files.cert), "--tls-key", str(files.key)]
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")},
            "PYTHONPATH": str(ROOT),
            **{f"HOSTLENS_{name}": value for name, value in settings.items()},
        }
        self.settings = Settings(**{name.lower(): value for name, value in settings.items() if "DRILL_" not in name})

    def start(self, *command: str) -> subprocess.Popen[bytes]:
        with (self.folder / "log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", *command],
                cwd=self.folder,
                env=self.environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self.processes.append(process)
        return process

    def scheduler(self) -> subprocess.Popen[bytes]:
        plain = ["--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"]
        protocol = ["--protocol", "tls"] if self.options else []
        return self.start("dask", "scheduler", *plain, *protocol, *self.options)

    def worker(self, *options: str) -> subprocess.Popen[bytes]:
        plain = ["--nworkers", "1", "--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1"]
        address = str(self.settings.scheduler_address)
        return self.start("dask", "worker", address, *plain, *self.options, *options)

    def dispatcher(self) -> subprocess.Popen[bytes]:
        return self.start("service.dispatcher")

    def end(self) -> None:
        for process in self.processes:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@contextmanager
def apart(folder: Path, url: str, *, tls: bool, **settings: str) -> Iterator[Apart]:
    found = Apart(folder, url, tls=tls, **settings)
    try:
        yield found
    except BaseException:
        print((folder / "log").read_text()[-8000:])
        raise
    finally:
        found.end()


def outcomes(database: Database) -> Counter[str]:
    with database.read() as connection:
        return Counter(connection.scalars(select(attempt.c.outcome)))


def worker_processes(command: subprocess.Popen[bytes]) -> list[psutil.Process]:
    """The process that computes, below the nanny that ``dask worker`` is."""
    found = []
    for process in psutil.Process(command.pid).children(recursive=True):
        with suppress(psutil.Error):  # it may be gone by now
            if "resource_tracker" not in " ".join(process.cmdline()):
                found.append(process)
    return found


def _is_replaced(command: subprocess.Popen[bytes], pid: int) -> bool:
    found = [process.pid for process in worker_processes(command)]
    return bool(found) and pid not in found


def test_workers_started_elsewhere_do_the_work_over_tls_and_every_loss_of_theirs_is_survived(
    tmp_path: Path, sqlite_url: str
) -> None:
    with apart(tmp_path, sqlite_url, tls=True) as cluster, ExitStack() as closing:
        database = Database(sqlite_url)
        closing.callback(database.close)
        grids, leadership = GridStore(database), Leadership(database)
        dispatcher = cluster.dispatcher()  # before there is anything to connect to: it waits
        scheduler = cluster.scheduler()
        workers = [cluster.worker(), cluster.worker()]

        def ready(threads: int) -> bool:
            view = leadership.alive()
            return view is not None and view.engines == {engine_digest(): threads}

        eventually(lambda: ready(2), _PATIENCE_S, "two greeted workers")
        with pytest.raises(OSError, match=r"Timed out|TLS|close|connect"):
            Client(f"tcp://127.0.0.1:{cluster.port}", timeout="2s", set_as_default=False)
        with Client(cluster.settings.scheduler_address, security=security_of(cluster.settings)) as client:
            # Nobody told these workers how many threads to use; the greeting has.
            for threads in client.run(_threads).values():
                assert threads == {1}
            assert client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.allowed_failures) == 0
        first = submit(grids, 12)
        eventually(lambda: grids.grid(first).counts.done == 12, _PATIENCE_S, "the first grid")
        assert outcomes(database) == {"done": 12}

        # A worker that is told to go takes nobody's good name with it.
        second = submit(grids, 60, seed=100)
        eventually(lambda: grids.grid(second).counts.done >= 4, _PATIENCE_S, "progress")
        workers[0].terminate()
        workers[0].wait(timeout=_PATIENCE_S)
        eventually(lambda: ready(1), _PATIENCE_S, "one worker left")
        assert outcomes(database)["worker_lost"] + outcomes(database)["suspected"] == 0

        # The scheduler dies, and with it the workers; both come back, the dispatcher was there all the time.
        scheduler.kill()
        scheduler.wait()
        workers[1].wait(timeout=_PATIENCE_S)
        eventually(lambda: (view := leadership.alive()) is not None and view.workers == 0, _PATIENCE_S, "degraded")
        cluster.scheduler()
        workers = [cluster.worker(), cluster.worker()]
        eventually(lambda: ready(2), _PATIENCE_S, "two workers again")
        assert dispatcher.poll() is None

        # A worker that is killed charges the one run that was on it; the nanny starts it anew. In the moment of the
        # kill it may be between two runs, and nobody is charged: then again.
        third = submit(grids, 120, seed=200)
        kills = 0
        while not outcomes(database)["worker_lost"]:
            assert kills < 12, "a worker was killed twelve times and no run was charged"
            eventually(lambda: ready(2) and grids.grid(third).counts.leased >= 2, _PATIENCE_S, "runs in flight")
            (victim, *_) = eventually(partial(worker_processes, workers[0]), _PATIENCE_S, "its process")
            victim.kill()
            kills += 1
            replaced = partial(_is_replaced, workers[0], victim.pid)
            eventually(
                lambda replaced=replaced: outcomes(database)["worker_lost"] or (replaced() and ready(2)),
                _PATIENCE_S,
                "a charge or another worker",
            )
        rest = {second: 60, third: 120}
        eventually(
            lambda: all(grids.grid(one).counts.done == runs for one, runs in rest.items()),
            _PATIENCE_S,
            "the other grids",
        )
        assert set(outcomes(database)) <= {"done", "worker_lost", "scheduler_lost", "forgotten"}
        assert 1 <= outcomes(database)["worker_lost"] <= kills
        assert outcomes(database)["done"] == 192
        dispatcher.terminate()
        assert dispatcher.wait(timeout=_PATIENCE_S) == 0


def test_workers_elsewhere_that_take_no_work_are_replaced_and_nobody_is_charged(
    tmp_path: Path, sqlite_url: str
) -> None:
    with (
        apart(tmp_path, sqlite_url, tls=False, WORKER_TTL_S="10", WORKER_PATIENCE_S="6") as cluster,
        ExitStack() as closing,
    ):
        database = Database(sqlite_url)
        closing.callback(database.close)
        grids, leadership = GridStore(database), Leadership(database)
        cluster.scheduler()
        workers = [cluster.worker(), cluster.worker("--no-nanny")]
        cluster.dispatcher()
        log = cluster.folder / "log"

        def ready(threads: int) -> bool:
            view = leadership.alive()
            return view is not None and sum(view.engines.values()) == threads

        def replaced(reason: str) -> int:
            return log.read_text().count(f"it is replaced: {reason}")

        eventually(lambda: ready(2), _PATIENCE_S, "two greeted workers")
        client = closing.enter_context(Client(cluster.settings.scheduler_address, set_as_default=False))
        client.run(_pause)
        eventually(lambda: ready(0), _PATIENCE_S, "the news that no worker takes work")
        eventually(lambda: replaced("paused") == 2, _PATIENCE_S, "both being replaced")
        workers[1].wait(timeout=_PATIENCE_S)  # without a nanny it ends, and whatever started it starts it again
        eventually(lambda: ready(1), _PATIENCE_S, "the worker with a nanny")

        for harm, reason in ((_close_and_stay, "closing"), (_let_no_thread_come, "not_started")):
            client.run(harm)
            grid = submit(grids, 4, seed=replaced(""))
            eventually(lambda reason=reason: replaced(reason), _PATIENCE_S, reason)
            eventually(lambda grid=grid: grids.grid(grid).counts.done == 4, _PATIENCE_S, f"the runs after {reason}")
        (process, *_) = worker_processes(workers[0])
        process.suspend()
        eventually(lambda: replaced("silent"), _PATIENCE_S, "the silent worker being replaced")
        eventually(lambda: _is_replaced(workers[0], process.pid) and ready(1), _PATIENCE_S, "another one")
        # Forgotten: claimed for a worker that was replaced. Nobody is charged.
        assert set(outcomes(database)) <= {"done", "stalled", "forgotten"}
        assert outcomes(database)["done"] == 8


def _pause(dask_worker: Any) -> None:
    dask_worker.memory_manager.memory_limit = 1


def _close_and_stay(dask_worker: Any) -> None:
    dask_worker.status = Status.closing_gracefully


def _let_no_thread_come(dask_worker: Any) -> None:
    dask_worker.executors["default"].submit(time.sleep, 3600)


def _threads() -> set[int]:
    from numba import config
    from threadpoolctl import threadpool_info

    return {int(pool["num_threads"]) for pool in threadpool_info()} | {int(config.NUMBA_NUM_THREADS)}


def test_a_slurm_job_runs_pinned_workers_and_asks_for_what_the_settings_say(tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue", reason="the extra slurm is not installed")
    settings = Settings(
        cluster="slurm",
        data_dir=tmp_path,
        slurm_queue="astro",
        slurm_account="h0licow",
        slurm_walltime="02:00:00",
        slurm_memory="8GB",
        slurm_workers_per_job=4,
        slurm_directives=["--constraint=rome"],
        slurm_prologue=["module load python"],
    )
    # No sbatch here: the job is rendered as it would be handed over, and read.
    script = slurm(settings, submit=False).job_script()
    for line in ("-p astro", "-A h0licow", "-t 02:00:00", "--mem=8G", "--constraint=rome", "--cpus-per-task=4"):
        assert any(said.startswith("#SBATCH") and line in said for said in script.splitlines()), (line, script)
    lines = script.splitlines()
    for name in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        assert f"export {name}_NUM_THREADS=1" in lines
    (command,) = [line for line in lines if "distributed.cli.dask_worker" in line]
    for option in (
        "--nthreads 1",
        "--nworkers 4",
        "--nanny",
        "--memory-limit 1.86GiB",
        f"--local-directory {settings.scratch}",
    ):
        assert option in command
    assert lines.index("module load python") < lines.index(command)


def test_a_kubernetes_cluster_is_specified_with_pinned_limited_workers(tmp_path: Path) -> None:
    pytest.importorskip("dask_kubernetes", reason="the extra kubernetes is not installed")
    spec = kubernetes_spec(
        Settings(cluster="kubernetes", data_dir=tmp_path, workers=5, kubernetes_image="x/hostlens:1")
    )
    assert (spec["kind"], spec["spec"]["worker"]["replicas"]) == ("DaskCluster", 5)
    (worker,) = spec["spec"]["worker"]["spec"]["containers"]
    (scheduler,) = spec["spec"]["scheduler"]["spec"]["containers"]
    assert worker["image"] == scheduler["image"] == "x/hostlens:1"
    assert worker["args"][:2] == ["dask", "worker"]
    assert worker["args"][-2:] == ["--nthreads", "1"]
    assert {"name": "NUMBA_NUM_THREADS", "value": "1"} in worker["env"]
    assert worker["resources"]["limits"] == {"memory": "4Gi"}
    assert {"name": "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "value": "0"} in scheduler["env"]


def test_cluster_settings_that_do_not_fit_each_other_are_refused(tmp_path: Path) -> None:
    for wrong, said in (
        ({"cluster": "address"}, "SCHEDULER_ADDRESS"),
        ({"cluster": "slurm", "scheduler_address": "tcp://x:1"}, "SCHEDULER_ADDRESS"),
        ({"scheduler_address": "tls://x:1", "tls_ca": tmp_path}, "TLS_KEY"),
        ({"tls_ca": tmp_path, "tls_cert": tmp_path, "tls_key": tmp_path}, "TLS_CA"),
        ({"drain_s": 60.0}, "STOP_GRACE"),
    ):
        with pytest.raises(ValidationError, match=said):
            Settings(**wrong)


def test_dask_keeps_few_of_the_messages_that_carry_runs() -> None:
    """A thousand of them, which is its default, are tens of megabytes that the dispatcher grows by."""
    with dask.config.set(dask_config(Settings())):
        assert (BatchedSend(interval="2ms").recent_message_log.maxlen or 1000) <= 10
