"""How the PSF of a run's sky departs from the one that the analysis was given.

Revision ID: 0014
Revises: 0013
"""

import sqlalchemy as sa
from alembic import op
from alembic.util.exc import CommandError

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

ADDED = {"defocus_nm": "0.0", "jitter": "0.0", "colour": "0.0", "residual": "0.0", "coarse": "1"}
ORDER = "ix_input_order"


def upgrade():
    # Runs that were simulated with spoilt optics before this have it in their specifications alone.
    before = _columns_of_order()
    op.drop_index(ORDER, "input")
    for table in ("input", "result"):
        with op.batch_alter_table(table) as batch:
            for name, usual in ADDED.items():
                batch.add_column(sa.Column(name, sa.Float(), nullable=False, server_default=usual))
    op.create_index(ORDER, "input", [*before[:-1], *ADDED, "id"])


def downgrade():
    unusual = " or ".join(f"{name} <> {usual}" for name, usual in ADDED.items())
    lost = op.get_bind().scalar(sa.text(f"select count(*) from result where {unusual}"))  # noqa: S608
    if lost:
        raise CommandError(f"{lost} results are of optics that revision {down_revision} does not know")
    before = _columns_of_order()
    op.drop_index(ORDER, "input")
    for table in ("input", "result"):
        with op.batch_alter_table(table) as batch:
            for name in reversed(ADDED):
                batch.drop_column(name)
    op.create_index(ORDER, "input", [name for name in before if name not in ADDED])


def _columns_of_order():
    """What answers are sorted by so far."""
    (found,) = (index for index in sa.inspect(op.get_bind()).get_indexes("input") if index["name"] == ORDER)
    return found["column_names"]
