"""The leader tells whether it waits for the artefact store.

Revision ID: 0007
Revises: 0006
"""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade():
    with op.batch_alter_table("leader") as batch:
        batch.add_column(sa.Column("artefacts_away", sa.Boolean(), nullable=False, server_default=sa.false()))


def downgrade():
    with op.batch_alter_table("leader") as batch:
        batch.drop_column("artefacts_away")
