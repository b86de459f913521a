"""Every setting of the service, read once from ``HOSTLENS_*`` variables and checked at the door."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

Seconds = Annotated[float, Field(gt=0.0, le=7 * 86400.0, allow_inf_nan=False)]
ClusterKind = Literal["local", "address", "slurm", "kubernetes"]
LogLevel = Annotated[
    Literal["DEBUG", "INFO", "WARNING", "ERROR"],
    BeforeValidator(lambda level: level.upper() if isinstance(level, str) else level),
]
LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})
_CLOSE_S = 8.0
"""What a dispatcher needs to hand runs back and to end its workers."""


class LogSettings(BaseSettings):
    """How a process logs: all that a worker or a scheduler of Dask needs to know."""

    model_config = SettingsConfigDict(env_prefix="HOSTLENS_", extra="ignore")

    log_format: Literal["text", "json"] = "text"
    log_level: LogLevel = "INFO"


class Settings(LogSettings):
    """Settings of all processes; each reads the same environment, so that API and dispatcher cannot disagree.

    Raises
    ------
    pydantic.ValidationError
        Names the variable that is not acceptable.
    """

    data_dir: Path = Path("var/hostlens")
    """Where the embedded database, the artefacts and Dask's scratch files lie unless said otherwise."""
    database_url: str | None = None
    """SQLAlchemy URL; a SQLite file in ``data_dir`` where None."""
    artefact_url: str | None = None
    """fsspec URL of the artefact store; a folder in ``data_dir`` where None."""

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 8421
    allow_remote: bool = False
    """Let the API listen beyond loopback. There are no tokens yet: whoever reaches the port may submit."""
    max_body_bytes: Annotated[int, Field(ge=1024, le=2**30)] = 1_000_000
    max_grid_runs: Annotated[int, Field(ge=1, le=10_000_000)] = 100_000

    task: Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")] = "service.worker:execute"
    """What a worker runs for a run, as ``module:function``."""
    workers: Annotated[int, Field(ge=1, le=1024)] = 2
    """Single-thread workers of a cluster that is started from here."""
    cluster: ClusterKind | None = None
    """Where the workers are; where None, at ``scheduler_address`` if there is one, else on this machine."""
    scheduler_address: str | None = None
    """A Dask scheduler started elsewhere, with workers of its own."""
    tls_ca: Path | None = None
    """With ``tls_cert`` and ``tls_key``, PEM files: only TLS is spoken to the scheduler and its workers."""
    tls_cert: Path | None = None
    tls_key: Path | None = None
    slurm_queue: str | None = None
    slurm_account: str | None = None
    slurm_walltime: str = "24:00:00"
    slurm_interface: str | None = None
    """Network interface that nodes and dispatcher reach each other by."""
    slurm_memory: str = "4GB"
    """Memory of a job."""
    slurm_workers_per_job: Annotated[int, Field(ge=1, le=1024)] = 1
    slurm_directives: list[str] = Field(default_factory=list)
    """More ``#SBATCH`` lines, as a JSON list."""
    slurm_prologue: list[str] = Field(default_factory=list)
    """Commands before a worker starts, as a JSON list."""
    kubernetes_name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,40}$")] = "hostlens"
    kubernetes_namespace: str | None = None
    """Where the Dask operator makes the pods; the dispatcher's own where None."""
    kubernetes_image: str = "hostlens:latest"
    kubernetes_memory: str = "4Gi"
    window: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """Runs claimed at most; one per worker thread (or ``batch``), and one more where they are short, where None."""
    batch: Annotated[int, Field(ge=1, le=1000)] = 1
    """Runs that a worker thread is given at a time: more than one where runs take less than about a second."""
    worker_memory: str = "auto"
    """Memory of a worker of the local cluster, as ``2GiB``; beyond it the worker is ended."""
    worker_lifetime_s: Seconds | None = None
    """A worker older than this is started anew once it is idle, each at its own time within a fifth of it."""
    worker_ttl_s: Annotated[float, Field(ge=10.0, le=86400.0)] = 60.0
    """A local worker that says nothing for so long is started anew."""

    metrics_host: str = "127.0.0.1"
    metrics_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Where the dispatcher shows its metrics; nowhere where None. The API shows its own on its own port."""

    heartbeat_s: Seconds = 5.0
    leader_ttl_s: Seconds = 30.0
    poll_s: Seconds = 0.25
    """How long the dispatcher sleeps between two looks at an empty queue."""
    reconcile_s: Seconds = 10.0
    deadline_s: Seconds = 3600.0
    """A run in flight for longer is stopped."""
    retry_delay_s: Seconds = 2.0
    """Back-off before the first retry of a failed run; doubles with each."""
    drain_s: Annotated[float, Field(ge=0.0, le=7 * 86400.0)] = 2.0
    """How long the dispatcher waits at its stop for runs to end; the others go back to the queue."""
    stop_grace_s: Seconds = 15.0
    """How long the supervisor waits for a process to end by itself."""

    @model_validator(mode="after")
    def _consistent(self) -> Settings:
        if self.leader_ttl_s < 2 * self.heartbeat_s:
            raise ValueError("HOSTLENS_LEADER_TTL_S must be at least twice HOSTLENS_HEARTBEAT_S")
        if self.stop_grace_s < self.drain_s + _CLOSE_S:
            raise ValueError(f"HOSTLENS_STOP_GRACE_S must be at least HOSTLENS_DRAIN_S and {_CLOSE_S:g} s")
        if (self.kind_of_cluster == "address") != (self.scheduler_address is not None):
            raise ValueError("HOSTLENS_CLUSTER=address and HOSTLENS_SCHEDULER_ADDRESS go together")
        if len({self.tls_ca is None, self.tls_cert is None, self.tls_key is None}) > 1:
            raise ValueError("HOSTLENS_TLS_CA, HOSTLENS_TLS_CERT and HOSTLENS_TLS_KEY go together")
        if self.tls_ca is not None and self.kind_of_cluster != "address":
            raise ValueError("HOSTLENS_TLS_CA is for a HOSTLENS_SCHEDULER_ADDRESS")
        if self.host not in LOOPBACK and not self.allow_remote:
            raise ValueError(
                f"HOSTLENS_HOST is {self.host}, which others can reach, and the API asks for no token: "
                "set HOSTLENS_ALLOW_REMOTE=true if a proxy or a firewall guards it"
            )
        return self

    @property
    def kind_of_cluster(self) -> ClusterKind:
        """Where the workers are."""
        return self.cluster or ("local" if self.scheduler_address is None else "address")

    @property
    def database(self) -> str:
        """URL of the database."""
        return self.database_url or f"sqlite:///{(self.data_dir / 'hostlens.sqlite').absolute()}"

    @property
    def artefacts(self) -> str:
        """URL of the artefact store."""
        return self.artefact_url or str((self.data_dir / "artefacts").absolute())

    @property
    def scratch(self) -> str:
        """Folder of Dask's temporary files."""
        return str((self.data_dir / "dask").absolute())

    def make_folders(self) -> None:
        """Create the data folder; OSError where that is not allowed."""
        self.data_dir.mkdir(parents=True, exist_ok=True)
