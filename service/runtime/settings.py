"""Every setting of the service, read once from ``HOSTLENS_*`` variables and checked at the door."""

from __future__ import annotations

import os
import re
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field, ValidationError, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from service.runtime.process import API_NUMBER, LISTENER_FD, PARENT_FD
from service.runtime.setting_types import (
    ArtefactUrl,
    ClusterKind,
    DaskAddress,
    DatabaseUrl,
    Home,
    Host,
    Hosts,
    KubernetesMemory,
    Lines,
    LogLevel,
    Memory,
    Seconds,
    Walltime,
    WorkerMemory,
)
from service.runtime.start import ConfigurationError

_PREFIX = "HOSTLENS_"
OTHERS = frozenset({"HOSTLENS_URL", "HOSTLENS_TOKEN", PARENT_FD, LISTENER_FD, API_NUMBER})
"""Variables that are no settings: of the command line's client, of the supervisor for its children."""
DEPLOYMENT = frozenset(
    f"HOSTLENS_{name}" for name in ("DB_PASSWORD", "TAG", "SHARED", "SCHEDULER_HOST", "SCHEDULER_PORT")
)
"""Variables of the files in ``deploy/``, which the processes started there inherit."""
_FAMILIES = ("HOSTLENS_DRILL_",)
"""Variables of the drills for their own tasks."""
_LINK = re.compile(r"_SERVICE_(HOST|PORT(_\w+)?)$|_PORT_\d+_(TCP|UDP|SCTP)(_\w+)?$")
"""What Kubernetes puts into every pod for each Service, unless it is told not to."""
_SECRET = frozenset({"database_url", "artefact_url"})
"""They may hold a password: their values are never repeated."""
LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})
_CLOSE_S = 8.0
"""What a dispatcher needs to hand runs back and to end its workers."""
T = TypeVar("T", bound="LogSettings")


class LogSettings(BaseSettings):
    """How a process logs: all that a worker or a scheduler of Dask needs to know."""

    model_config = SettingsConfigDict(env_prefix=_PREFIX, extra="ignore", str_strip_whitespace=True)

    log_format: Literal["text", "json"] = "text"
    log_level: LogLevel = "INFO"


class Settings(LogSettings):
    """Settings of all processes; each reads the same environment, so that API and dispatcher cannot disagree.

    Raises
    ------
    pydantic.ValidationError
        Names the variable that is not acceptable.
    """

    data_dir: Home = Path("var/hostlens")
    """Where the embedded database, the artefacts and Dask's scratch files lie unless said otherwise."""
    database_url: DatabaseUrl | None = None
    """SQLAlchemy URL; a SQLite file in ``data_dir`` where None."""
    artefact_url: ArtefactUrl | None = None
    """fsspec URL of the artefact store; a folder in ``data_dir`` where None."""

    host: Host = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 8421
    auth: Literal["off", "tokens"] | None = None
    """Whether the API asks for tokens; where None, unless it listens on loopback. ``off`` elsewhere is for a proxy or a
    firewall that asks who comes; ``tokens`` on loopback for a proxy that does not."""
    allowed_hosts: Hosts = Field(default_factory=list)
    """Names that requests may call the API by beside those of loopback and those without a dot, as a JSON list. Without
    any, requests to a service that asks nobody on loopback have to call it by those, and to any other as they like."""
    max_body_bytes: Annotated[int, Field(ge=1024, le=2**30)] = 1_000_000
    max_upload_bytes: Annotated[int, Field(ge=10_000, le=2**33)] = 64_000_000
    """Of the files of a measurement together."""
    max_grid_runs: Annotated[int, Field(ge=1, le=10_000_000)] = 100_000
    api_processes: Annotated[int, Field(ge=1, le=64)] = 2
    """API processes that ``hostlens serve`` starts on the one port; the three limits below hold in each."""
    max_connections: Annotated[int, Field(ge=16, le=100_000)] = 1000
    """More are answered 503; the probes are not."""
    max_streams: Annotated[int, Field(ge=1, le=100_000)] = 500
    """Event streams and long polls that wait at a time; more are answered 429."""
    request_timeout_s: Seconds = 30.0
    """A request has to come whole within so long, and an answer to be taken on with: the connection is closed."""

    task: Annotated[str, Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")] = "service.worker:execute"
    """What a worker runs for a run, as ``module:function``."""
    workers: Annotated[int, Field(ge=1, le=1024)] = 2
    """Single-thread workers of a cluster that is started from here."""
    cluster: ClusterKind | None = None
    """Where the workers are; where None, at ``scheduler_address`` if there is one, else on this machine."""
    scheduler_address: DaskAddress | None = None
    """A Dask scheduler started elsewhere, with workers of its own."""
    tls_ca: Home | None = None
    """With ``tls_cert`` and ``tls_key``, PEM files: only TLS is spoken to the scheduler and its workers."""
    tls_cert: Home | None = None
    tls_key: Home | None = None
    slurm_queue: str | None = None
    slurm_account: str | None = None
    slurm_walltime: Walltime = "24:00:00"
    slurm_interface: str | None = None
    """Network interface that nodes and dispatcher reach each other by."""
    slurm_memory: Memory = "4GB"
    """Memory of a job."""
    slurm_workers_per_job: Annotated[int, Field(ge=1, le=1024)] = 1
    slurm_directives: Lines = Field(default_factory=list)
    """More ``#SBATCH`` lines, as a JSON list."""
    slurm_prologue: Lines = Field(default_factory=list)
    """Commands before a worker starts, as a JSON list."""
    kubernetes_name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,40}$")] = "hostlens"
    kubernetes_namespace: str | None = None
    """Where the Dask operator makes the pods; the dispatcher's own where None."""
    kubernetes_image: str = "hostlens:latest"
    kubernetes_memory: KubernetesMemory = "4Gi"
    window: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """Runs in flight at most; one per worker thread where None."""
    worker_memory: WorkerMemory = "auto"
    """Memory of a worker of the local cluster, as ``2GiB``; beyond it the worker is ended."""
    worker_ttl_s: Annotated[float, Field(ge=10.0, le=86400.0)] = 60.0
    """A worker that says nothing for so long is started anew."""
    worker_patience_s: Annotated[float, Field(ge=4.0, le=86400.0)] = 20.0
    """A worker that is alive and takes no work for so long is replaced."""

    metrics_host: Host = "127.0.0.1"
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

    @model_validator(mode="before")
    @classmethod
    def _environment(cls, values: Any) -> Any:
        _require_known(frozenset(f"{_PREFIX}{name.upper()}" for name in cls.model_fields))
        return values

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
        encrypted = str(self.scheduler_address).startswith("tls://")
        if self.scheduler_address is not None and encrypted != (self.tls_ca is not None):
            raise ValueError("HOSTLENS_SCHEDULER_ADDRESS begins with tls:// where HOSTLENS_TLS_CA is set, only there")
        return self

    @property
    def kind_of_cluster(self) -> ClusterKind:
        """Where the workers are."""
        return self.cluster or ("local" if self.scheduler_address is None else "address")

    @property
    def asks_for_tokens(self) -> bool:
        """Whether the API lets in only who brings a token."""
        return (self.auth or ("off" if self.host in LOOPBACK else "tokens")) == "tokens"

    @property
    def hosts(self) -> frozenset[str] | None:
        """Names that the API is called by beside those of loopback; any will do where None."""
        is_open = not self.asks_for_tokens and self.host in LOOPBACK
        return frozenset(map(str.lower, self.allowed_hosts)) if is_open or self.allowed_hosts else None

    @property
    def url(self) -> str:
        """Address that the API is reached at from this machine."""
        everywhere = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - an address to speak to, not to listen at
        return f"http://{bracketed(everywhere.get(self.host, self.host))}:{self.port}"

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
        """Create the data folder, for nobody else to look into; OSError where that is not allowed."""
        self.data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)


def bracketed(host: str) -> str:
    """A host as it stands before a port: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host


def read_settings(kind: type[T] = Settings, **changes: Any) -> T:  # type: ignore[assignment]
    """The settings of this process; ``changes`` are those that were given on the command line.

    Raises
    ------
    ConfigurationError
        A variable is unknown, empty or not acceptable.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    try:
        return kind(**given)
    except ValidationError as error:
        places = [_place(dict(found), given) for found in error.errors(include_url=False, include_context=False)]
        raise ConfigurationError("; ".join(places)) from None


def _place(found: dict[str, Any], given: dict[str, Any]) -> str:
    said = str(found["msg"]).removeprefix("Value error, ")
    if not found["loc"]:
        return said
    name = str(found["loc"][0])
    variable = f"--{name.replace('_', '-')}" if name in given else f"{_PREFIX}{name.upper()}"
    value = "" if name in _SECRET else f"got {str(found['input'])[:80]!r}; "
    return f"{variable}: {value}{said[0].lower()}{said[1:]}"


def _require_known(settings: frozenset[str]) -> None:
    """Refuse variables that nobody reads, and empty ones, which would stand for a default that nobody asked for."""
    known = settings | OTHERS | DEPLOYMENT
    for variable, value in sorted(os.environ.items()):
        name = variable.upper()
        if not name.startswith(_PREFIX) or name.startswith(_FAMILIES):
            continue
        if name not in known and not _LINK.search(name) and not ("://" in value and name.endswith("_PORT")):
            near = get_close_matches(name, known, 1, 0.75)
            hint = f": did you mean {near[0]}?" if near else "; docs/reference/settings.md lists them"
            raise ValueError(f"{variable} is not a setting of hostlens{hint}")
        if name in settings | {"HOSTLENS_URL", "HOSTLENS_TOKEN"} and not value.strip():
            raise ValueError(f"{variable} is empty: give it a value, or unset it for the default")
