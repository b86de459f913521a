"""Tokens, who submitted a grid, and what it should take.

Revision ID: 0009
Revises: 0008
"""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade():
    op.create_table(
        "token",
        sa.Column("id", sa.String(12), nullable=False),
        sa.Column("digest", sa.String(64), nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("scope", sa.String(16), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True)),
        sa.Column("revoked_at", sa.DateTime(timezone=True)),
        sa.CheckConstraint("scope in ('read', 'submit', 'admin')", name=op.f("ck_token_scope")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_token")),
    )
    op.add_column("grid", sa.Column("owner", sa.String(64)))
    op.add_column("grid", sa.Column("expected_wall_s", sa.Float()))


def downgrade():
    with op.batch_alter_table("grid") as batch:
        batch.drop_column("expected_wall_s")
        batch.drop_column("owner")
    op.drop_table("token")
