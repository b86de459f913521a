"""What was computed for a result: pixels rendered, rays traced, columns solved, parameters sampled.

Revision ID: 0011
Revises: 0010
"""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_COUNTS = ("pixels_rendered", "rays_traced", "columns_solved", "parameters_sampled")


def upgrade():
    with op.batch_alter_table("result") as batch:
        for name in _COUNTS:
            batch.add_column(sa.Column(name, sa.BigInteger()))
    # No query looks for rows by these: see revision 0005.
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER TABLE result " + ", ".join(f"ALTER COLUMN {name} SET STATISTICS 0" for name in _COUNTS))


def downgrade():
    with op.batch_alter_table("result") as batch:
        for name in reversed(_COUNTS):
            batch.drop_column(name)
