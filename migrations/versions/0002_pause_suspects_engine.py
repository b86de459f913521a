"""Paused runs, the suspect lane, and whose results a grid takes.

Revision ID: 0002
Revises: 0001
"""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

STATES = "state in ('queued', 'leased', 'done', 'failed', 'quarantined', 'cancelled')"
STATES_WITH_PAUSED = "state in ('queued', 'paused', 'leased', 'done', 'failed', 'quarantined', 'cancelled')"


def _allow_states(batch, allowed):
    batch.drop_constraint(op.f("ck_run_state"), type_="check")
    batch.create_check_constraint(op.f("ck_run_state"), allowed)


def upgrade():
    with op.batch_alter_table("grid") as batch:
        batch.add_column(sa.Column("paused_at", sa.DateTime(timezone=True)))
        batch.add_column(sa.Column("engine_digest", sa.String(64)))
    queued = sa.text("state = 'queued'")
    op.create_index("ix_grid_open", "grid", ["engine_digest"], sqlite_where=queued, postgresql_where=queued)
    with op.batch_alter_table("run") as batch:
        batch.add_column(sa.Column("suspect", sa.Boolean(), nullable=False, server_default=sa.false()))
        _allow_states(batch, STATES_WITH_PAUSED)
    op.create_index(
        "ix_run_suspect",
        "run",
        ["not_before", "id"],
        sqlite_where=sa.text("state = 'queued' and suspect = 1"),
        postgresql_where=sa.text("state = 'queued' and suspect"),
    )
    with op.batch_alter_table("leader") as batch:
        batch.add_column(sa.Column("engines", sa.JSON(), nullable=False, server_default=sa.text("'{}'")))


def downgrade():
    # The older code knows no paused runs; in its eyes they wait.
    op.execute("update run set state = 'queued' where state = 'paused'")
    with op.batch_alter_table("leader") as batch:
        batch.drop_column("engines")
    op.drop_index("ix_run_suspect", "run")
    with op.batch_alter_table("run") as batch:
        _allow_states(batch, STATES)
        batch.drop_column("suspect")
    op.drop_index("ix_grid_open", "grid")
    with op.batch_alter_table("grid") as batch:
        batch.drop_column("engine_digest")
        batch.drop_column("paused_at")
