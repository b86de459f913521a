"""Replicates that end once the mean bias of their point is known.

Revision ID: 0012
Revises: 0011
"""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

STATES = "state in ('queued', 'paused', 'leased', 'done', 'failed', 'quarantined', 'cancelled')"
STATES_WITH_NOT_NEEDED = STATES.replace("'cancelled'", "'cancelled', 'not_needed'")


def _allow_states(allowed):
    with op.batch_alter_table("run") as batch:
        batch.drop_constraint(op.f("ck_run_state"), type_="check")
        batch.create_check_constraint(op.f("ck_run_state"), allowed)


def upgrade():
    with op.batch_alter_table("grid") as batch:
        batch.add_column(sa.Column("until", sa.JSON()))
        batch.add_column(sa.Column("points", sa.Integer()))
    _allow_states(STATES_WITH_NOT_NEEDED)
    op.create_table(
        "point",
        sa.Column("grid_id", sa.String(28), nullable=False),
        sa.Column("place", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("input_id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.Column("runs", sa.Integer(), nullable=False),
        sa.Column("standard_error", sa.Float()),
        sa.Column("wanted", sa.Integer(), nullable=False),
        sa.Column("reached_at", sa.DateTime(timezone=True)),
        sa.ForeignKeyConstraint(["grid_id"], ["grid.id"], name=op.f("fk_point_grid_id")),
        sa.ForeignKeyConstraint(["input_id"], ["input.id"], name=op.f("fk_point_input_id")),
        sa.PrimaryKeyConstraint("grid_id", "place", name=op.f("pk_point")),
    )


def downgrade():
    # To the older code they are runs that nobody wants any more; what it wrote down of their grids it counts anew.
    spared = "select grid_id from run where state = 'not_needed'"
    op.execute(f"update grid set ending = null where id in ({spared})")  # noqa: S608
    op.execute(f"update grid set state = 'cancelled' where state = 'done' and id in ({spared})")  # noqa: S608
    op.execute("update run set state = 'cancelled' where state = 'not_needed'")
    op.drop_table("point")
    _allow_states(STATES)
    with op.batch_alter_table("grid") as batch:
        batch.drop_column("points")
        batch.drop_column("until")
