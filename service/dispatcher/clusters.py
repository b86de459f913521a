"""Where the workers come from: this machine, a scheduler elsewhere, Slurm or Kubernetes. Dask executes, keeps nothing.

Slurm and Kubernetes need the extras of that name; nothing of them is imported otherwise.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster, Security

from service.dispatcher.cluster_process import take_host
from service.dispatcher.pickle_guard import only_plain_data
from service.runtime.settings import Settings
from service.worker.fork_server import ONE_THREAD

_OUR_RULES = {
    "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0",
    "DASK_DISTRIBUTED__SCHEDULER__WORK_STEALING": "false",
}
_LOCAL_RULES = {
    # From the nursery.
    "distributed.worker.multiprocessing-method": "forkserver",
    # Dask's own pages have no TLS, and tell every user of the machine who asks what runs here.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}
_CREDENTIALS = ("require_encryption", "tls_ca_file", "tls_client_cert", "tls_client_key")
_CONNECT_S = 5  # a stop has to wait for it
_STOP_S = 5.0


def dask_config(settings: Settings) -> dict[str, Any]:
    """Dask's configuration where the scheduler or the workers are started from here."""
    return {
        # The first death of a worker comes to us: how often a run may be tried again is the queue's decision.
        "distributed.scheduler.allowed-failures": 0,
        "distributed.scheduler.work-stealing": False,
        "distributed.scheduler.worker-ttl": f"{settings.worker_ttl_s} s",
        # Dask pins all of these but NUMBA_NUM_THREADS by itself.
        "distributed.nanny.pre-spawn-environ": ONE_THREAD,
        "distributed.worker.daemon": True,
        # Said here whatever a configuration file of Dask's says. What we keep on a worker is a few bytes, so there is
        # nothing to spill. Beyond 80 % a worker takes no further run: the one it is at may still end, and what it
        # leaves behind is judged in `stalls`. Beyond 95 % its nanny ends it, before the kernel ends anything else.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": 0.8,
        "distributed.worker.memory.terminate": 0.95,
        # Workers write the lines that the service writes, with the run on them.
        "distributed.worker.preload": ["service.runtime.logs"],
        "distributed.comm.timeouts.connect": "10s",
        # Dask looks at itself fifty times a second in each process, for a dashboard that nobody sees; on two cores
        # this took 7 % of one from the engine.
        "distributed.admin.tick.interval": "500ms",
        "distributed.admin.system-monitor.interval": "5s",
        "distributed.worker.profile.enabled": False,
        # For its own developers it keeps the last thousand messages of each connection, with all the runs in them.
        "distributed.admin.low-level-log-length": 10,
        "temporary-directory": settings.scratch,
    }


@contextmanager
def open_client(settings: Settings) -> Iterator[Any]:
    """A client of the workers that the settings ask for; OSError where the scheduler does not answer.

    While it is open nothing is unpickled in this process.
    """
    with ExitStack() as closing:
        closing.enter_context(dask.config.set(dask_config(settings)))
        closing.enter_context(only_plain_data())
        address, security = settings.scheduler_address, security_of(settings)
        if settings.kind_of_cluster != "address":
            host = take_host(settings.kind_of_cluster)
            closing.callback(host.close)
            found = host.start_cluster(settings)
            address, security = found["address"], found["security"] and Security(**found["security"])
        client = Client(address, timeout=f"{_CONNECT_S} s", set_as_default=False, security=security)
        with client:
            # By value, so that the scheduler need not have this package: it only schedules.
            client.run_on_scheduler(_first_death_is_ours())
            yield client


@contextmanager
def start_cluster(settings: Settings) -> Iterator[dict[str, Any]]:
    """A cluster that lives as long as the context; where its scheduler is, and what it takes to speak to it."""
    with dask.config.set(dask_config(settings)):
        if settings.kind_of_cluster == "local":
            dask.config.set(_LOCAL_RULES)
        Path(settings.scratch).mkdir(mode=0o700, parents=True, exist_ok=True)
        security = Security.temporary() if settings.kind_of_cluster == "local" else None
        cluster = _CLUSTERS[settings.kind_of_cluster](settings, security)
        try:
            yield {
                "address": cluster.scheduler_address,
                "security": security and {name: getattr(security, name) for name in _CREDENTIALS},
            }
        finally:
            cluster.close(timeout=_STOP_S)


def security_of(settings: Settings) -> Security | None:
    """TLS in both directions, None where the settings name no certificates."""
    if settings.tls_ca is None:
        return None
    return Security(
        require_encryption=True,
        tls_ca_file=str(settings.tls_ca),
        tls_client_cert=str(settings.tls_cert),
        tls_client_key=str(settings.tls_key),
    )


def _first_death_is_ours() -> Any:
    def rule(dask_scheduler: Any) -> None:
        dask_scheduler.allowed_failures = 0

    return rule


def _local(settings: Settings, security: Security | None) -> Any:
    return LocalCluster(
        security=security,
        n_workers=settings.workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        # Its HTTP server cannot be left out: at a port that nobody else wants, and with no pages (dask_config).
        dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},
        memory_limit=settings.worker_memory,
        silence_logs=logging.ERROR,
    )


def slurm(settings: Settings, *, submit: bool = True) -> Any:
    """Workers as Slurm jobs, one thread each; ModuleNotFoundError without the extra ``slurm``.

    Without ``submit`` no job is started, and ``job_script()`` shows what it would be.
    """
    from dask_jobqueue.slurm import SLURMCluster  # noqa: PLC0415 - an extra

    cluster = SLURMCluster(
        queue=settings.slurm_queue,
        account=settings.slurm_account,
        walltime=settings.slurm_walltime,
        interface=settings.slurm_interface,
        cores=settings.slurm_workers_per_job,
        processes=settings.slurm_workers_per_job,
        memory=settings.slurm_memory,
        local_directory=settings.scratch,
        job_script_prologue=[f"export {name}={value}" for name, value in ONE_THREAD.items()] + settings.slurm_prologue,
        job_extra_directives=settings.slurm_directives,
        worker_extra_args=["--nanny", "--death-timeout", "120"],
        scheduler_options={"dashboard": False},
    )
    if submit:
        cluster.scale(settings.workers)
    return cluster


def kubernetes_spec(settings: Settings) -> dict[str, Any]:
    """The DaskCluster resource that the Kubernetes operator makes pods of; needs the extra ``kubernetes``."""
    from dask_kubernetes.operator import make_cluster_spec  # noqa: PLC0415 - an extra

    spec: dict[str, Any] = make_cluster_spec(
        name=settings.kubernetes_name,
        image=settings.kubernetes_image,
        n_workers=settings.workers,
        resources={
            "requests": {"cpu": "1", "memory": settings.kubernetes_memory},
            "limits": {"memory": settings.kubernetes_memory},
        },
        env={name: str(value) for name, value in ONE_THREAD.items()} | _OUR_RULES,
        worker_command="dask worker",
    )
    worker = spec["spec"]["worker"]["spec"]["containers"][0]
    worker["args"] = [*worker["args"], "--nthreads", "1"]
    return spec


def kubernetes(settings: Settings) -> Any:
    """Workers as pods of the Dask operator; ModuleNotFoundError without the extra ``kubernetes``."""
    from dask_kubernetes.operator import KubeCluster  # noqa: PLC0415 - an extra

    return KubeCluster(namespace=settings.kubernetes_namespace, custom_cluster_spec=kubernetes_spec(settings))


_CLUSTERS: dict[str, Callable[[Settings, Any], Any]] = {
    "local": _local,
    "slurm": lambda settings, _: slurm(settings),
    "kubernetes": lambda settings, _: kubernetes(settings),
}
