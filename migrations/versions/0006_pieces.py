"""Grids that are stored and retried in pieces, and indices with all that is asked of them.

Revision ID: 0006
Revises: 0005
"""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

QUEUED = sa.text("state = 'queued'")
LEASED = sa.text("state = 'leased'")
ENDED = sa.text("finished_at is not null")
WORKED_ON = sa.text("finished_at is not null and leased_at is not null")


def upgrade():
    with op.batch_alter_table("grid") as batch:
        batch.add_column(sa.Column("storing", sa.Boolean(), nullable=False, server_default=sa.false()))
        batch.add_column(sa.Column("revive_from", sa.Integer()))
    op.create_index("ix_grid_state_storing", "grid", ["state", "storing"])
    _remake("ix_grid_open", "grid", ["id", "engine_digest", "storing", "cancelled_at", "paused_at"], QUEUED)
    _remake("ix_run_queue", "run", ["not_before", "id", "grid_id", "suspect"], QUEUED)
    _remake("ix_run_leased", "run", ["id", "generation", "token"], LEASED)
    op.drop_index("ix_run_grid_id_finished_at", "run")
    name = "ix_run_grid_id_finished_at_leased_at"
    _make(name, "run", ["grid_id", "finished_at", "leased_at"], WORKED_ON)


def downgrade():
    # The older code would take what is half stored for a grid, and knows no retry that is under way.
    op.execute("delete from run where grid_id in (select id from grid where storing)")
    op.execute("delete from idempotency where grid_id in (select id from grid where storing)")
    op.execute("delete from grid where storing")
    op.execute(
        "update run set state = 'queued', charged_from = attempt, finished_at = null, error_code = null, "
        "error_detail = null, suspect = false where state in ('failed', 'quarantined', 'cancelled') and "
        "exists (select 1 from grid where grid.id = run.grid_id and run.ordinal >= grid.revive_from)"
    )
    # It takes whatever is queued for to be claimed, and cancels what it has claimed of a cancelled grid.
    op.execute(
        "update run set state = 'paused' where state = 'queued' and grid_id in "
        "(select id from grid where paused_at is not null)"
    )
    op.execute(
        "update run set state = 'queued' where state = 'paused' and grid_id in "
        "(select id from grid where paused_at is null)"
    )
    op.drop_index("ix_run_grid_id_finished_at_leased_at", "run")
    _make("ix_run_grid_id_finished_at", "run", ["grid_id", "finished_at"], ENDED)
    _remake("ix_run_leased", "run", ["token"], LEASED)
    _remake("ix_run_queue", "run", ["not_before", "id"], QUEUED)
    _remake("ix_grid_open", "grid", ["engine_digest"], QUEUED)
    op.drop_index("ix_grid_state_storing", "grid")
    with op.batch_alter_table("grid") as batch:
        batch.drop_column("revive_from")
        batch.drop_column("storing")


def _make(name, table, columns, where):
    op.create_index(name, table, columns, sqlite_where=where, postgresql_where=where)


def _remake(name, table, columns, where):
    op.drop_index(name, table)
    _make(name, table, columns, where)
