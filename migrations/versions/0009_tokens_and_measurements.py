"""Tokens, who submitted a grid, what it should take, and measurements of images.

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
    op.create_table(
        "measurement",
        sa.Column("run_id", sa.String(36), nullable=False),
        sa.Column("stored_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("document", sa.JSON(), nullable=False),
        sa.Column("payload_digest", sa.String(64), nullable=False),
        sa.Column("engine_digest", sa.String(64), nullable=False),
        sa.Column("wall_s", sa.Float(), nullable=False),
        sa.Column("cpu_s", sa.Float(), nullable=False),
        sa.Column("figure", sa.String(200)),
        sa.Column("figure_digest", sa.String(64)),
        sa.ForeignKeyConstraint(["run_id"], ["run.id"], name=op.f("fk_measurement_run_id")),
        sa.PrimaryKeyConstraint("run_id", name=op.f("pk_measurement")),
    )
    images = sa.text("kind = 'image'")
    op.create_index("ix_run_image", "run", ["grid_id"], sqlite_where=images, postgresql_where=images)
    op.add_column("grid", sa.Column("owner", sa.String(64)))
    op.add_column("grid", sa.Column("expected_wall_s", sa.Float()))


def downgrade():
    with op.batch_alter_table("grid") as batch:
        batch.drop_column("expected_wall_s")
        batch.drop_column("owner")
    op.drop_index("ix_run_image", "run")
    op.drop_table("measurement")
    op.drop_table("token")
