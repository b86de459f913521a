"""The tables: typed, with named constraints so that Alembic can change each on every database."""

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

from service.domain.payload import COUNTS, ERRORS, LENS_PARAMETERS, QUANTITIES, WORK
from service.domain.plan import OPTICS_AXES

REVISION = "0014"
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
    # Name of the token that it was submitted with; null where none was asked for.
    Column("owner", String(64)),
    # What its runs should take on one worker, by stored runs of their kind [s]; null where there was none.
    Column("expected_wall_s", Float),
    # Where replicates end once the mean bias of their point is known: the rule, and the number of points. Run k of a
    # point is that at place k * points + place of the point.
    Column("until", JSON(none_as_null=True)),
    Column("points", Integer),
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
    # What a worker is to do with the specification.
    Column("kind", String(16), nullable=False, server_default=text("'realization'")),
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
        "state in ('queued', 'paused', 'leased', 'done', 'failed', 'quarantined', 'cancelled', 'not_needed')",
        name="state",
    ),
    CheckConstraint("kind in ('realization', 'image')", name="kind"),
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
    "l_eta", "n", "r_eff", "magnitude", "host_kind", "host_label", "deflector", *OPTICS_AXES, "seed",
)  # fmt: skip
USUAL_INPUTS: dict[str, Any] = {"host_kind": "sersic", "host_label": "sersic", "deflector": "plain", **OPTICS_AXES}
"""Of runs from before there was anything else, whose inputs do not name these."""


def _input_columns() -> list[Column[Any]]:
    types: dict[str, TypeEngine[Any]] = {
        "l_eta": Float(),
        "n": Float(),
        "r_eff": Float(),
        "magnitude": Float(),
    }
    types |= dict.fromkeys(OPTICS_AXES, Float())
    types["seed"] = BigInteger()
    usual = {name: str(value) for name, value in USUAL_INPUTS.items()}
    # A host that is no Sersic profile has no index.
    return [
        Column(name, types.get(name, String(64)), nullable=name == "n", server_default=usual.get(name))
        for name in INPUT_COLUMNS
    ]


GROUP_COLUMNS = tuple(name for name in INPUT_COLUMNS if name != "seed")
"""Runs that agree in these are runs of one input."""
KEY_COLUMNS = (*GROUP_COLUMNS, "configuration", "regularisation", "profile", "engine_digest")
"""All that a row of ``input`` has in common: what answers are grouped and filtered by."""

# What runs can have in common: few rows where there are many seeds. Answers are grouped by the columns of this table,
# so that another axis is one column here. Runs and seconds are added up as results come.
input_group = Table(
    "input",
    metadata,
    Column("id", SERIAL, primary_key=True, autoincrement=True),
    Column("grid_id", ForeignKey("grid.id"), nullable=False),
    # Made of KEY_COLUMNS by service.store.sums; some of them may be null, and nulls are never equal to a database.
    Column("digest", String(32), nullable=False),
    *(column for column in _input_columns() if column.name in GROUP_COLUMNS),
    Column("configuration", String(16), nullable=False),
    # Null where results are older than these columns, or the analysis was put together by hand.
    Column("regularisation", String(32)),
    Column("profile", String(32)),
    Column("engine_digest", String(64), nullable=False),
    Column("runs", Integer, nullable=False),
    Column("wall_s", Float, nullable=False),
    Column("cpu_s", Float, nullable=False),
    UniqueConstraint("grid_id", "digest"),
    Index("ix_input_order", "grid_id", *GROUP_COLUMNS, "id"),
)

# Of grids with a rule, how well the mean bias of each point is known that has a result.
point = Table(
    "point",
    metadata,
    Column("grid_id", ForeignKey("grid.id"), primary_key=True),
    Column("place", Integer, primary_key=True, autoincrement=False),
    Column("input_id", ForeignKey("input.id"), nullable=False),
    # With an answer of the rule's estimator.
    Column("runs", Integer, nullable=False),
    # Null of fewer than two.
    Column("standard_error", Float),
    # How many replicates it should take in all.
    Column("wanted", Integer, nullable=False),
    # When it was known well enough for the first time; from then on no replicate waits.
    Column("reached_at", UtcDateTime),
)


def _lens_columns() -> list[Column[Any]]:
    # Lower case, because PostgreSQL wants quotes round anything else; null where the system has no such parameter.
    parts = ("mean", "sd", "truth")
    return [Column(f"lens_{name.lower()}_{part}", Float) for name in LENS_PARAMETERS for part in parts]


result = Table(
    "result",
    metadata,
    Column("run_id", ForeignKey("run.id"), primary_key=True),
    Column("grid_id", ForeignKey("grid.id"), nullable=False, index=True),
    Column("input_id", ForeignKey("input.id"), nullable=False),
    # Of all that was observed: runs of one observation differ in their analysis, or in their engine.
    Column("observation_digest", String(64), nullable=False),
    Column("stored_at", UtcDateTime, nullable=False),
    *_input_columns(),
    Column("configuration", String(16), nullable=False),
    *_lens_columns(),
    # Null in results that are older than these columns; the aperture also where no map has light in it.
    Column("aperture_radius", Float),
    *(Column(f"aperture_magnitude_{part}", Float) for part in ("mean", "sd", "bias")),
    Column("aperture_coverage", Float),
    Column("aperture_draws", Integer),
    Column("aperture_failed", Integer),
    Column("regularisation", String(32)),
    Column("profile", String(32)),
    # From here on null where the run needed no chain.
    Column("r_hat", Float),
    Column("ln_evidence", Float),
    Column("chi2", Float),
    Column("degrees_of_freedom", Integer),
    Column("condition_number", Float),
    Column("chain_status", String(16)),
    Column("walkers", Integer),
    Column("steps", Integer),
    Column("burn_in", Integer),
    Column("tau", Float),
    Column("effective_samples", Float),
    Column("acceptance", Float),
    Column("evaluations", BigInteger),
    # Up to here.
    Column("arc_magnitude", Float, nullable=False),
    Column("agn_contrast", Float),
    Column("surface_brightness", Float, nullable=False),
    Column("wall_s", Float, nullable=False),
    Column("cpu_s", Float, nullable=False),
    Column("stages", JSON, nullable=False),
    # Null in results that are older; evaluations of the evidence stand with the chain.
    *(Column(name, BigInteger) for name in WORK),
    Column("payload_digest", String(64), nullable=False),
    Column("engine_digest", String(64), nullable=False),
    Column("versions", JSON, nullable=False),
    Column("warnings", JSON, nullable=False),
    Column("figure", String(200)),
    Column("figure_digest", String(64)),
    Column("products", String(200)),
    Column("products_digest", String(64)),
    Index("ix_result_input_id_run_id", "input_id", "run_id"),
    Index("ix_result_observation_digest", "observation_digest"),
)


# What was found in uploaded images: until it is pruned.
measurement = Table(
    "measurement",
    metadata,
    Column("run_id", ForeignKey("run.id"), primary_key=True),
    Column("stored_at", UtcDateTime, nullable=False),
    Column("document", JSON, nullable=False),
    Column("payload_digest", String(64), nullable=False),
    Column("engine_digest", String(64), nullable=False),
    Column("wall_s", Float, nullable=False),
    Column("cpu_s", Float, nullable=False),
    Column("figure", String(200)),
    Column("figure_digest", String(64)),
)
# The runs that measure images, in the order of their grids: few among many.
Index("ix_run_image", run.c.grid_id, sqlite_where=text("kind = 'image'"), postgresql_where=text("kind = 'image'"))


def _quantity_columns() -> list[Column[Any]]:
    # All null where results are older than a quantity; the bias also where there is no truth.
    return [Column(f"{quantity}_{part}", Float) for quantity in QUANTITIES for part in ("mean", "sd", "bias")]


SUMMED = ("magnitude", "r_eff", "n")
"""What a summary of a grid shows; the other quantities stand with each result."""

# One answer of one estimator under one prior of n; where it has none there is no row.
estimate = Table(
    "estimate",
    metadata,
    Column("run_id", ForeignKey("result.run_id"), primary_key=True),
    Column("estimator", String(16), primary_key=True),
    Column("index_prior", String(16), primary_key=True),
    Column("input_id", ForeignKey("input.id"), nullable=False),
    *_quantity_columns(),
    *(Column(part, Integer) for part in COUNTS),
    # Null in results that are older than these columns, and where the error could not be predicted.
    *(Column(name, Float) for name in ERRORS),
    # Answers over many runs of one estimator are read from here alone, without the table.
    Index(
        "ix_estimate_answer",
        "estimator",
        "index_prior",
        "input_id",
        *(f"{quantity}_{part}" for quantity in SUMMED for part in ("bias", "sd")),
    ),
)

COUNTED = ("runs", "at_bound", "failed")
"""Runs with an answer of the estimator, and draws of those runs."""


def _moments(owner: str, parts: tuple[str, ...]) -> tuple[Column[Any], ...]:
    """Sums over one estimator's answers, for each row of the table ``owner``."""
    return (
        Column(f"{owner}_id", ForeignKey(f"{owner}.id"), primary_key=True, autoincrement=False),
        Column("estimator", String(16), primary_key=True),
        Column("index_prior", String(16), primary_key=True),
        *(Column(name, BigInteger, nullable=False) for name in COUNTED),
        *(
            Column(f"{quantity}_{part}", Integer if part == "bias_runs" else Float, nullable=False)
            for quantity in SUMMED
            for part in parts
        ),
    )


# Sums over the answers of one input and of a whole grid, written by service.store.sums alone.
input_moments = Table("input_moments", metadata, *_moments("input", ("sd", "bias", "bias_runs", "shift", "shift2")))
grid_moments = Table("grid_moments", metadata, *_moments("grid", ("sd", "bias", "bias2", "bias_runs")))

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

# Who may come in. The token itself is known to its holder alone.
token = Table(
    "token",
    metadata,
    Column("id", String(12), primary_key=True),
    Column("digest", String(64), nullable=False),
    Column("name", String(64), nullable=False),
    Column("scope", String(16), nullable=False),
    Column("created_at", UtcDateTime, nullable=False),
    Column("expires_at", UtcDateTime),
    Column("revoked_at", UtcDateTime),
    CheckConstraint("scope in ('read', 'submit', 'admin')", name="scope"),
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
