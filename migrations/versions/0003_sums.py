"""Sums over results, kept with each of them; the counts of ended grids; an index for runs by state.

Revision ID: 0003
Revises: 0002
"""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

ESTIMATES = ("paper_free", "paper_fixed", "projected_free", "projected_fixed")
QUANTITIES = ("magnitude", "r_eff", "n", "q", "position_angle")
COUNTED = ("at_bound", "failed")
NAMES = ("system", "camera", "mass_model", "noise_level", "noise_treatment")
VALUES = ("l_eta", "n", "r_eff", "magnitude")
OF_INPUT = ("sd", "bias", "bias_runs", "shift", "shift2")
OF_GRID = ("sd", "bias", "bias2", "bias_runs")


def _sum_columns(parts):
    yield sa.Column("runs", sa.Integer(), nullable=False)
    for estimate in ESTIMATES:
        yield from (sa.Column(f"{estimate}_{name}", sa.BigInteger(), nullable=False) for name in COUNTED)
        for quantity in QUANTITIES:
            for part in parts:
                kind = sa.Integer() if part == "bias_runs" else sa.Float()
                yield sa.Column(f"{estimate}_{quantity}_{part}", kind, nullable=False)


def _fill(table, keys, parts):
    """Add up what is stored already."""
    sums = {"runs": "count(*)"}
    for estimate in ESTIMATES:
        sums |= {f"{estimate}_{name}": f"sum({estimate}_{name})" for name in COUNTED}
        for quantity in QUANTITIES:
            name = f"{estimate}_{quantity}"
            shift = f"({name}_mean - {quantity})" if quantity in VALUES else f"{name}_mean"
            known = {
                "sd": f"sum({name}_sd)",
                "bias": f"coalesce(sum({name}_bias), 0.0)",
                "bias2": f"coalesce(sum({name}_bias * {name}_bias), 0.0)",
                "bias_runs": f"count({name}_bias)",
                "shift": f"sum({shift})",
                "shift2": f"sum({shift} * {shift})",
            }
            sums |= {f"{name}_{part}": known[part] for part in parts}
    by = ", ".join(keys)
    columns, values = ", ".join(sums), ", ".join(sums.values())
    op.execute(f"insert into {table} ({by}, {columns}) select {by}, {values} from result group by {by}")  # noqa: S608


def upgrade():
    op.create_table(
        "input_sum",
        sa.Column("grid_id", sa.String(28), nullable=False),
        *(sa.Column(name, sa.String(64), nullable=False) for name in NAMES),
        *(sa.Column(name, sa.Float(), nullable=False) for name in VALUES),
        *_sum_columns(OF_INPUT),
        sa.ForeignKeyConstraint(["grid_id"], ["grid.id"], name="fk_input_sum_grid_id"),
        sa.PrimaryKeyConstraint("grid_id", *NAMES, *VALUES, name="pk_input_sum"),
    )
    op.create_table(
        "grid_sum",
        sa.Column("grid_id", sa.String(28), nullable=False),
        *_sum_columns(OF_GRID),
        sa.ForeignKeyConstraint(["grid_id"], ["grid.id"], name="fk_grid_sum_grid_id"),
        sa.PrimaryKeyConstraint("grid_id", name="pk_grid_sum"),
    )
    _fill("input_sum", ("grid_id", *NAMES, *VALUES), OF_INPUT)
    _fill("grid_sum", ("grid_id",), OF_GRID)
    op.add_column("grid", sa.Column("ending", sa.JSON()))
    op.drop_index("ix_run_grid_id_state", "run")
    op.create_index("ix_run_grid_id_state_ordinal", "run", ["grid_id", "state", "ordinal"])
    op.drop_index("ix_run_grid_id_finished_at", "run")
    ended = sa.text("finished_at is not null")
    op.create_index(
        "ix_run_grid_id_finished_at", "run", ["grid_id", "finished_at"], sqlite_where=ended, postgresql_where=ended
    )


def downgrade():
    op.drop_index("ix_run_grid_id_finished_at", "run")
    op.create_index("ix_run_grid_id_finished_at", "run", ["grid_id", "finished_at"])
    op.drop_index("ix_run_grid_id_state_ordinal", "run")
    op.create_index("ix_run_grid_id_state", "run", ["grid_id", "state"])
    with op.batch_alter_table("grid") as batch:
        batch.drop_column("ending")
    op.drop_table("grid_sum")
    op.drop_table("input_sum")
