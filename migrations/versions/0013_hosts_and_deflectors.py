"""Hosts that are no Sersic profiles, and deflectors of more than one profile and one power law.

Revision ID: 0013
Revises: 0012
"""

import sqlalchemy as sa
from alembic import op
from alembic.util.exc import CommandError

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

NAMES = ("system", "camera", "mass_model", "noise_level", "noise_treatment")
VALUES = ("l_eta", "n", "r_eff", "magnitude")
ADDED = {"host_kind": "sersic", "host_label": "sersic", "deflector": "plain"}


def upgrade():
    op.drop_index("ix_input_order", "input")
    for table in ("input", "result"):
        with op.batch_alter_table(table) as batch:
            batch.alter_column("n", existing_type=sa.Float(), nullable=True)
            for name, usual in ADDED.items():
                batch.add_column(sa.Column(name, sa.String(64), nullable=False, server_default=usual))
    op.create_index("ix_input_order", "input", ["grid_id", *NAMES, *VALUES, *ADDED, "id"])


def downgrade():
    unusual = " or ".join(f"{name} <> '{usual}'" for name, usual in ADDED.items())
    lost = op.get_bind().scalar(sa.text(f"select count(*) from result where n is null or {unusual}"))  # noqa: S608
    if lost:
        raise CommandError(f"{lost} results are of hosts or deflectors that revision {down_revision} does not know")
    op.drop_index("ix_input_order", "input")
    for table in ("input", "result"):
        with op.batch_alter_table(table) as batch:
            for name in reversed(ADDED):
                batch.drop_column(name)
            batch.alter_column("n", existing_type=sa.Float(), nullable=False)
    op.create_index("ix_input_order", "input", ["grid_id", *NAMES, *VALUES, "id"])
