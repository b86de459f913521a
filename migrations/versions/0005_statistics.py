"""PostgreSQL keeps no statistics of columns that no query looks for rows by.

Of four hundred columns of results it took ten seconds of a core, every minute in which results came.

Revision ID: 0005
Revises: 0004
"""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

NAMES = ("system", "camera", "mass_model", "noise_level", "noise_treatment")
VALUES = ("l_eta", "n", "r_eff", "magnitude")
LOOKED_FOR = frozenset({"run_id", "grid_id", *NAMES, *VALUES})


def _set_statistics(target):
    if op.get_context().dialect.name != "postgresql":
        return
    inspector = sa.inspect(op.get_bind())
    for table in ("result", "input_sum", "grid_sum"):
        names = [column["name"] for column in inspector.get_columns(table) if column["name"] not in LOOKED_FOR]
        changes = ", ".join(f"ALTER COLUMN {name} SET STATISTICS {target}" for name in names)
        op.execute(f"ALTER TABLE {table} {changes}")


def upgrade():
    _set_statistics(0)


def downgrade():
    _set_statistics(-1)
