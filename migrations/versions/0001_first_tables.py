"""The first tables.

Written out, not taken from the code: this revision must stay what it was when the code goes on.

Revision ID: 0001
Revises:
"""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

ESTIMATES = ("paper_free", "paper_fixed", "projected_free", "projected_fixed")
QUANTITIES = ("magnitude", "r_eff", "n", "q", "position_angle")
LENS = ("theta_e", "q", "phi", "slope", "x", "y", "gamma1", "gamma2", "ln_lambda")
QUEUED, LEASED = sa.text("state = 'queued'"), sa.text("state = 'leased'")


def _time(name, *, nullable=False):
    return sa.Column(name, sa.DateTime(timezone=True), nullable=nullable)


def _grid_key():
    return sa.Column("grid_id", sa.String(28), nullable=False)


def _references(table, column, other):
    return sa.ForeignKeyConstraint([column], [f"{other}.id"], name=f"fk_{table}_{column}")


def _estimate_columns():
    for estimate in ESTIMATES:
        for quantity in QUANTITIES:
            for part in ("mean", "sd", "bias"):
                yield sa.Column(f"{estimate}_{quantity}_{part}", sa.Float(), nullable=part == "bias")
        for part in ("draws", "at_bound", "failed"):
            yield sa.Column(f"{estimate}_{part}", sa.Integer(), nullable=False)


def _lens_columns():
    for name in LENS:
        for part in ("mean", "sd", "truth"):
            yield sa.Column(f"lens_{name}_{part}", sa.Float())


def upgrade():
    op.create_table(
        "grid",
        sa.Column("id", sa.String(28), nullable=False),
        sa.Column("name", sa.String(200)),
        sa.Column("request", sa.JSON(), nullable=False),
        sa.Column("n_runs", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        _time("created_at"),
        _time("finished_at", nullable=True),
        _time("cancelled_at", nullable=True),
        sa.CheckConstraint("state in ('queued', 'done', 'failed', 'cancelled')", name=op.f("ck_grid_state")),
        sa.PrimaryKeyConstraint("id", name="pk_grid"),
    )
    op.create_table(
        "run",
        sa.Column("id", sa.String(36), nullable=False),
        _grid_key(),
        sa.Column("ordinal", sa.Integer(), nullable=False),
        sa.Column("label", sa.String(200), nullable=False),
        sa.Column("paper_run", sa.Integer()),
        sa.Column("spec", sa.JSON(), nullable=False),
        sa.Column("inputs", sa.JSON(), nullable=False),
        sa.Column("digest", sa.String(64), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("charged_from", sa.Integer(), nullable=False),
        _time("not_before"),
        sa.Column("token", sa.String(32)),
        sa.Column("generation", sa.BigInteger()),
        _time("leased_at", nullable=True),
        _time("finished_at", nullable=True),
        sa.Column("error_code", sa.String(64)),
        sa.Column("error_detail", sa.Text()),
        sa.CheckConstraint(
            "state in ('queued', 'leased', 'done', 'failed', 'quarantined', 'cancelled')",
            name=op.f("ck_run_state"),
        ),
        sa.CheckConstraint("(state = 'leased') = (token is not null)", name=op.f("ck_run_lease_has_token")),
        _references("run", "grid_id", "grid"),
        sa.PrimaryKeyConstraint("id", name="pk_run"),
        sa.UniqueConstraint("grid_id", "ordinal", name="uq_run_grid_id_ordinal"),
        sa.UniqueConstraint("grid_id", "digest", name="uq_run_grid_id_digest"),
    )
    op.create_index("ix_run_grid_id_state", "run", ["grid_id", "state"])
    op.create_index("ix_run_grid_id_finished_at", "run", ["grid_id", "finished_at"])
    op.create_index("ix_run_queue", "run", ["not_before", "id"], sqlite_where=QUEUED, postgresql_where=QUEUED)
    op.create_index("ix_run_leased", "run", ["token"], sqlite_where=LEASED, postgresql_where=LEASED)
    op.create_table(
        "result",
        sa.Column("run_id", sa.String(36), nullable=False),
        _grid_key(),
        _time("stored_at"),
        *(
            sa.Column(name, sa.String(64), nullable=False)
            for name in ("system", "camera", "mass_model", "noise_level", "noise_treatment")
        ),
        *(sa.Column(name, sa.Float(), nullable=False) for name in ("l_eta", "n", "r_eff", "magnitude")),
        sa.Column("seed", sa.BigInteger(), nullable=False),
        *_estimate_columns(),
        *_lens_columns(),
        sa.Column("ln_evidence", sa.Float(), nullable=False),
        sa.Column("chi2", sa.Float(), nullable=False),
        sa.Column("degrees_of_freedom", sa.Integer(), nullable=False),
        sa.Column("condition_number", sa.Float(), nullable=False),
        sa.Column("chain_status", sa.String(16), nullable=False),
        *(sa.Column(name, sa.Integer(), nullable=False) for name in ("walkers", "steps", "burn_in")),
        *(sa.Column(name, sa.Float(), nullable=False) for name in ("tau", "effective_samples", "acceptance")),
        sa.Column("evaluations", sa.BigInteger(), nullable=False),
        sa.Column("arc_magnitude", sa.Float(), nullable=False),
        sa.Column("agn_contrast", sa.Float()),
        *(sa.Column(name, sa.Float(), nullable=False) for name in ("surface_brightness", "wall_s", "cpu_s")),
        sa.Column("stages", sa.JSON(), nullable=False),
        sa.Column("payload_digest", sa.String(64), nullable=False),
        sa.Column("engine_digest", sa.String(64), nullable=False),
        sa.Column("versions", sa.JSON(), nullable=False),
        sa.Column("warnings", sa.JSON(), nullable=False),
        sa.Column("figure", sa.String(200)),
        sa.Column("figure_digest", sa.String(64)),
        sa.Column("products", sa.String(200)),
        sa.Column("products_digest", sa.String(64)),
        _references("result", "run_id", "run"),
        _references("result", "grid_id", "grid"),
        sa.PrimaryKeyConstraint("run_id", name="pk_result"),
    )
    op.create_index("ix_result_grid_id", "result", ["grid_id"])
    op.create_table(
        "attempt",
        sa.Column("run_id", sa.String(36), nullable=False),
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("token", sa.String(32), nullable=False),
        sa.Column("generation", sa.BigInteger(), nullable=False),
        _time("started_at"),
        _time("ended_at"),
        sa.Column("outcome", sa.String(32), nullable=False),
        sa.Column("code", sa.String(64)),
        sa.Column("detail", sa.Text()),
        _references("attempt", "run_id", "run"),
        sa.PrimaryKeyConstraint("run_id", "number", name="pk_attempt"),
    )
    op.create_table(
        "event",
        sa.Column("id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), autoincrement=True, nullable=False),
        _grid_key(),
        sa.Column("run_id", sa.String(36)),
        sa.Column("kind", sa.String(32), nullable=False),
        sa.Column("detail", sa.JSON(), nullable=False),
        _time("created_at"),
        _references("event", "grid_id", "grid"),
        _references("event", "run_id", "run"),
        sa.PrimaryKeyConstraint("id", name="pk_event"),
    )
    op.create_index("ix_event_grid_id_id", "event", ["grid_id", "id"])
    op.create_table(
        "idempotency",
        sa.Column("key", sa.String(255), nullable=False),
        sa.Column("request_digest", sa.String(64), nullable=False),
        _grid_key(),
        _time("created_at"),
        _references("idempotency", "grid_id", "grid"),
        sa.PrimaryKeyConstraint("key", name="pk_idempotency"),
    )
    op.create_table(
        "leader",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("generation", sa.BigInteger(), nullable=False),
        sa.Column("holder", sa.String(200), nullable=False),
        sa.Column("workers", sa.Integer(), nullable=False),
        _time("beat_at"),
        _time("expires_at"),
        sa.CheckConstraint("id = 1", name=op.f("ck_leader_single_row")),
        sa.PrimaryKeyConstraint("id", name="pk_leader"),
    )


def downgrade():
    for table in ("leader", "idempotency", "event", "attempt", "result", "run", "grid"):
        op.drop_table(table)
