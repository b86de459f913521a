"""The tables: wide and typed, with named constraints so that Alembic can change each on every database."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    DateTime,
    Dialect,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    TypeDecorator,
    UniqueConstraint,
    false,
    text,
)
from sqlalchemy.types import TypeEngine

from service.domain.payload import COUNTS, ESTIMATES, LENS_PARAMETERS, QUANTITIES

REVISION = "0007"
"""Revision of the migrations that these tables are."""

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)


class UtcDateTime(TypeDecorator[datetime]):
    """A time in UTC. SQLite keeps no time zone, so it is taken off on the way in and put back on the way out."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Refuse naive times: nobody could say later which zone they were in."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"a time without zone: {value}")
        value = value.astimezone(UTC)
        return value.replace(tzinfo=None) if dialect.name == "sqlite" else value

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Give back UTC on every database."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if dialect.name == "sqlite" else value.astimezone(UTC)


# SQLite numbers rows by itself only where the type is exactly INTEGER.
SERIAL: TypeEngine[int] = BigInteger().with_variant(Integer(), "sqlite")

grid = Table(
    "grid",
    metadata,
    Column("id", String(28), primary_key=True),
    Column("name", String(200)),
    Column("request", JSON, nullable=False),
    Column("n_runs", Integer, nullable=False),
    Column("state", String(16), nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Column("finished_at", UtcDateTime),
    Column("cancelled_at", UtcDateTime),
    Column("paused_at", UtcDateTime),
    # Whose results are taken; null in grids that are older than this column, which take any engine's.
    Column("engine_digest", String(64)),
    # Its runs are still being stored: nobody sees it, and nothing of it is claimed.
    Column("storing", Boolean, nullable=False, server_default=false()),
    # In a retry, the first place that has not been looked at; null where there is none under way.
    Column("revive_from", Integer),
    # What would otherwise be counted anew with every look; null as long as a run is open.
    Column("ending", JSON(none_as_null=True)),
    CheckConstraint("state in ('queued', 'done', 'failed', 'cancelled')", name="state"),
    # How many there are of each, without reading requests of up to a megabyte.
    Index("ix_grid_state_storing", "state", "storing"),
)
# The grids that are not finished: few, however many have ended. All that a claim asks of them is here.
Index(
    "ix_grid_open",
    grid.c.id,
    grid.c.engine_digest,
    grid.c.storing,
    grid.c.cancelled_at,
    grid.c.paused_at,
    sqlite_where=text("state = 'queued'"),
    postgresql_where=text("state = 'queued'"),
)

run = Table(
    "run",
    metadata,
    Column("id", String(36), primary_key=True),
    Column("grid_id", ForeignKey("grid.id"), nullable=False),
    Column("ordinal", Integer, nullable=False),
    Column("label", String(200), nullable=False),
    Column("paper_run", Integer),
    Column("spec", JSON, nullable=False),
    Column("inputs", JSON, nullable=False),
    Column("digest", String(64), nullable=False),
    Column("state", String(16), nullable=False),
    Column("attempt", Integer, nullable=False),
    Column("charged_from", Integer, nullable=False),
    Column("not_before", UtcDateTime, nullable=False),
    Column("token", String(32)),
    Column("generation", BigInteger),
    Column("leased_at", UtcDateTime),
    Column("finished_at", UtcDateTime),
    Column("error_code", String(64)),
    Column("error_detail", Text),
    # It may have killed a worker: from now on it runs alone.
    Column("suspect", Boolean, nullable=False, server_default=false()),
    UniqueConstraint("grid_id", "ordinal"),
    UniqueConstraint("grid_id", "digest"),
    CheckConstraint(
        "state in ('queued', 'paused', 'leased', 'done', 'failed', 'quarantined', 'cancelled')",
        name="state",
    ),
    # A lease is a state with a token, never the one without the other.
    CheckConstraint("(state = 'leased') = (token is not null)", name="lease_has_token"),
    Index("ix_run_grid_id_state_ordinal", "grid_id", "state", "ordinal"),
    # For the rate: those that ended after they had been worked on, however many were cancelled before.
    Index(
        "ix_run_grid_id_finished_at_leased_at",
        "grid_id",
        "finished_at",
        "leased_at",
        sqlite_where=text("finished_at is not null and leased_at is not null"),
        postgresql_where=text("finished_at is not null and leased_at is not null"),
    ),
)
# What a claim reads: the queue in its order, however many finished runs lie beside it. With all that it asks of a run,
# so that it gets quickly past the many of a grid that is being stored, cancelled or paused just now.
Index(
    "ix_run_queue",
    run.c.not_before,
    run.c.id,
    run.c.grid_id,
    run.c.suspect,
    sqlite_where=text("state = 'queued'"),
    postgresql_where=text("state = 'queued'"),
)
# The suspect lane, which is nearly always empty: a look into it must not go through the queue.
Index(
    "ix_run_suspect",
    run.c.not_before,
    run.c.id,
    sqlite_where=text("state = 'queued' and suspect = 1"),
    postgresql_where=text("state = 'queued' and suspect"),
)
# In the order in which they are locked, or a take-over would go through all runs for the sake of that order.
Index(
    "ix_run_leased",
    run.c.id,
    run.c.generation,
    run.c.token,
    sqlite_where=text("state = 'leased'"),
    postgresql_where=text("state = 'leased'"),
)

INPUT_COLUMNS = (
    "system", "camera", "mass_model", "noise_level", "noise_treatment",
    "l_eta", "n", "r_eff", "magnitude", "seed",
)  # fmt: skip


def _input_columns() -> list[Column[Any]]:
    types: dict[str, TypeEngine[Any]] = {
        "l_eta": Float(),
        "n": Float(),
        "r_eff": Float(),
        "magnitude": Float(),
    }
    types["seed"] = BigInteger()
    return [Column(name, types.get(name, String(64)), nullable=False) for name in INPUT_COLUMNS]


def _estimate_columns() -> list[Column[Any]]:
    # All null where an estimator has no answer; new quantities are null in results that are older than they.
    columns: list[Column[Any]] = []
    for estimate in ESTIMATES:
        for quantity in QUANTITIES:
            columns += [Column(f"{estimate}_{quantity}_{part}", Float) for part in ("mean", "sd", "bias")]
        columns += [Column(f"{estimate}_{part}", Integer) for part in COUNTS]
    return columns


def _lens_columns() -> list[Column[Any]]:
    # Lower case, because PostgreSQL wants quotes round anything else; null where the system has no such parameter.
    parts = ("mean", "sd", "truth")
    return [Column(f"lens_{name.lower()}_{part}", Float) for name in LENS_PARAMETERS for part in parts]


result = Table(
    "result",
    metadata,
    Column("run_id", ForeignKey("run.id"), primary_key=True),
    Column("grid_id", ForeignKey("grid.id"), nullable=False, index=True),
    Column("stored_at", UtcDateTime, nullable=False),
    *_input_columns(),
    *_estimate_columns(),
    *_lens_columns(),
    # Null in results that are older than these columns; the aperture also where no map has light in it.
    Column("aperture_radius", Float),
    *(Column(f"aperture_magnitude_{part}", Float) for part in ("mean", "sd", "bias")),
    Column("aperture_coverage", Float),
    Column("aperture_draws", Integer),
    Column("aperture_failed", Integer),
    Column("regularisation", String(32)),
    Column("profile", String(32)),
    Column("r_hat", Float),
    Column("ln_evidence", Float, nullable=False),
    Column("chi2", Float, nullable=False),
    Column("degrees_of_freedom", Integer, nullable=False),
    Column("condition_number", Float, nullable=False),
    Column("chain_status", String(16), nullable=False),
    Column("walkers", Integer, nullable=False),
    Column("steps", Integer, nullable=False),
    Column("burn_in", Integer, nullable=False),
    Column("tau", Float, nullable=False),
    Column("effective_samples", Float, nullable=False),
    Column("acceptance", Float, nullable=False),
    Column("evaluations", BigInteger, nullable=False),
    Column("arc_magnitude", Float, nullable=False),
    Column("agn_contrast", Float),
    Column("surface_brightness", Float, nullable=False),
    Column("wall_s", Float, nullable=False),
    Column("cpu_s", Float, nullable=False),
    Column("stages", JSON, nullable=False),
    Column("payload_digest", String(64), nullable=False),
    Column("engine_digest", String(64), nullable=False),
    Column("versions", JSON, nullable=False),
    Column("warnings", JSON, nullable=False),
    Column("figure", String(200)),
    Column("figure_digest", String(64)),
    Column("products", String(200)),
    Column("products_digest", String(64)),
)

GROUP_COLUMNS = tuple(name for name in INPUT_COLUMNS if name != "seed")
"""Runs that agree in these are runs of one input."""
COUNTED = ("runs", "at_bound", "failed")
"""Runs with an answer of the estimator, and draws of those runs."""
SUMMED = ("magnitude", "r_eff", "n")
"""What a summary shows; the other quantities stand with each result."""


def _sum_columns(parts: tuple[str, ...]) -> list[Column[Any]]:
    columns: list[Column[Any]] = [Column("runs", Integer, nullable=False)]
    for estimate in ESTIMATES:
        columns += [Column(f"{estimate}_{name}", BigInteger, nullable=False) for name in COUNTED]
        for quantity in SUMMED:
            columns += [
                Column(f"{estimate}_{quantity}_{part}", Integer if part == "bias_runs" else Float, nullable=False)
                for part in parts
            ]
    return columns


# Sums over the results of one input and of a whole grid, written by service.store.sums alone.
input_sum = Table(
    "input_sum",
    metadata,
    Column("grid_id", ForeignKey("grid.id"), primary_key=True),
    *(
        Column(column.name, column.type, primary_key=True, autoincrement=False)
        for column in _input_columns()
        if column.name in GROUP_COLUMNS
    ),
    *_sum_columns(("sd", "bias", "bias_runs", "shift", "shift2")),
)

grid_sum = Table(
    "grid_sum",
    metadata,
    Column("grid_id", ForeignKey("grid.id"), primary_key=True),
    *_sum_columns(("sd", "bias", "bias2", "bias_runs")),
)

attempt = Table(
    "attempt",
    metadata,
    Column("run_id", ForeignKey("run.id"), primary_key=True),
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("token", String(32), nullable=False),
    Column("generation", BigInteger, nullable=False),
    Column("started_at", UtcDateTime, nullable=False),
    Column("ended_at", UtcDateTime, nullable=False),
    Column("outcome", String(32), nullable=False),
    Column("code", String(64)),
    Column("detail", Text),
)

event = Table(
    "event",
    metadata,
    Column("id", SERIAL, primary_key=True, autoincrement=True),
    Column("grid_id", ForeignKey("grid.id"), nullable=False),
    Column("run_id", ForeignKey("run.id")),
    Column("kind", String(32), nullable=False),
    Column("detail", JSON, nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Index("ix_event_grid_id_id", "grid_id", "id"),
)

idempotency = Table(
    "idempotency",
    metadata,
    Column("key", String(255), primary_key=True),
    Column("request_digest", String(64), nullable=False),
    Column("grid_id", ForeignKey("grid.id"), nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
)

leader = Table(
    "leader",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("generation", BigInteger, nullable=False),
    Column("holder", String(200), nullable=False),
    Column("workers", Integer, nullable=False),
    Column("engines", JSON, nullable=False, server_default=text("'{}'")),
    Column("artefacts_away", Boolean, nullable=False, server_default=false()),
    Column("beat_at", UtcDateTime, nullable=False),
    Column("expires_at", UtcDateTime, nullable=False),
    CheckConstraint("id = 1", name="single_row"),
)
