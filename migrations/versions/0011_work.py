"""What was computed for a result: pixels rendered, rays traced, columns solved, parameters sampled.

Revision ID: 0011
Revises: 0009
"""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0009"
branch_labels = None
depends_on = None

_COUNTS = ("pixels_rendered", "rays_traced", "columns_solved", "parameters_sampled")


def upgrade():
    with op.batch_alter_table("result") as batch:
        for name in _COUNTS:
            batch.add_column(sa.Column(name, sa.BigInteger()))


def downgrade():
    with op.batch_alter_table("result") as batch:
        for name in reversed(_COUNTS):
            batch.drop_column(name)
