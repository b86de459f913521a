"""Every setting of the service, read once from ``HOSTLENS_*`` variables and checked at the door."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

Seconds = Annotated[float, Field(gt=0.0, le=7 * 86400.0, allow_inf_nan=False)]
LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})


class Settings(BaseSettings):
    """Settings of all processes; each reads the same environment, so that API and dispatcher cannot disagree.

    Raises
    ------
    pydantic.ValidationError
        Names the variable that is not acceptable.
    """

    model_config = SettingsConfigDict(env_prefix="HOSTLENS_", extra="ignore")

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
    """Single-thread worker processes of the local cluster."""
    scheduler_address: str | None = None
    """A Dask scheduler started elsewhere; a local cluster is made where None."""
    window: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """Runs in flight at most; one per worker thread where None."""
    worker_memory: str = "auto"

    heartbeat_s: Seconds = 5.0
    leader_ttl_s: Seconds = 30.0
    poll_s: Seconds = 0.25
    """How long the dispatcher sleeps between two looks at an empty queue."""
    reconcile_s: Seconds = 10.0
    deadline_s: Seconds = 3600.0
    """A run in flight for longer is stopped."""
    retry_delay_s: Seconds = 2.0
    """Back-off before the first retry of a failed run; doubles with each."""
    stop_grace_s: Seconds = 15.0
    """How long the supervisor waits for a process to end by itself."""

    @model_validator(mode="after")
    def _consistent(self) -> Settings:
        if self.leader_ttl_s < 2 * self.heartbeat_s:
            raise ValueError("HOSTLENS_LEADER_TTL_S must be at least twice HOSTLENS_HEARTBEAT_S")
        if self.host not in LOOPBACK and not self.allow_remote:
            raise ValueError(
                f"HOSTLENS_HOST is {self.host}, which others can reach, and the API asks for no token: "
                "set HOSTLENS_ALLOW_REMOTE=true if a proxy or a firewall guards it"
            )
        return self

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
