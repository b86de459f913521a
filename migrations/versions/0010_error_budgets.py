"""Predicted numerical errors of estimates, whole and by stage.

Revision ID: 0010
Revises: 0009
"""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

COLUMNS = [
    f"{quantity}_error{part}"
    for quantity in ("magnitude", "r_eff", "n")
    for part in ("", "_rendering", "_psf", "_grid", "_sampling", "_draws")
]


def upgrade():
    # Results that are older have none: null, which is not the same as no error.
    with op.batch_alter_table("estimate") as batch:
        for name in COLUMNS:
            batch.add_column(sa.Column(name, sa.Float()))
    # No query looks for rows by these: see revision 0005.
    if op.get_bind().dialect.name == "postgresql":
        op.execute("ALTER TABLE estimate " + ", ".join(f"ALTER COLUMN {name} SET STATISTICS 0" for name in COLUMNS))


def downgrade():
    with op.batch_alter_table("estimate") as batch:
        for name in reversed(COLUMNS):
            batch.drop_column(name)
