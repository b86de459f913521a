"""Four estimators with three priors of n, each of which may have no answer; aperture, R-hat, regularisation, profile.

Revision ID: 0004
Revises: 0003
"""

import sqlalchemy as sa
from alembic import op
from alembic.util.exc import CommandError

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

OLD_ESTIMATES = ("paper_free", "paper_fixed", "projected_free", "projected_fixed")
OLD_QUANTITIES = ("magnitude", "r_eff", "n", "q", "position_angle")
OLD_COUNTS = ("draws", "at_bound", "failed")
ESTIMATES = tuple(
    f"{estimator}_{prior}"
    for estimator in ("paper", "covariance", "projected", "image")
    for prior in ("wide", "free", "fixed")
)
QUANTITIES = ("magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y")
COUNTS = ("draws", "at_bound", "n_at_bound", "r_eff_at_bound", "failed")
PARTS = ("mean", "sd", "bias")
SUMMED = ("magnitude", "r_eff", "n")
NAMES = ("system", "camera", "mass_model", "noise_level", "noise_treatment")
VALUES = ("l_eta", "n", "r_eff", "magnitude")
OF_INPUT = ("sd", "bias", "bias_runs", "shift", "shift2")
OF_GRID = ("sd", "bias", "bias2", "bias_runs")


def _old_columns():
    """What an estimate could not be without, and what it had besides."""
    needed = {}
    for estimate in OLD_ESTIMATES:
        for quantity in OLD_QUANTITIES:
            needed |= {f"{estimate}_{quantity}_{part}": sa.Float() for part in ("mean", "sd")}
        needed |= {f"{estimate}_{part}": sa.Integer() for part in OLD_COUNTS}
    return needed, {f"{estimate}_{quantity}_bias" for estimate in OLD_ESTIMATES for quantity in OLD_QUANTITIES}


def _new_columns():
    needed, optional = _old_columns()
    columns = {}
    for estimate in ESTIMATES:
        for quantity in QUANTITIES:
            columns |= {f"{estimate}_{quantity}_{part}": sa.Float() for part in PARTS}
        columns |= {f"{estimate}_{part}": sa.Integer() for part in COUNTS}
    columns |= {"aperture_radius": sa.Float(), "aperture_coverage": sa.Float()}
    columns |= {f"aperture_magnitude_{part}": sa.Float() for part in PARTS}
    columns |= {"aperture_draws": sa.Integer(), "aperture_failed": sa.Integer()}
    columns |= {"regularisation": sa.String(32), "profile": sa.String(32), "r_hat": sa.Float()}
    return {name: kind for name, kind in columns.items() if name not in needed and name not in optional}


def _create_sums(estimates, quantities, counted):
    for table, keys, parts in (("input_sum", (*NAMES, *VALUES), OF_INPUT), ("grid_sum", (), OF_GRID)):
        sums = [sa.Column("runs", sa.Integer(), nullable=False)]
        for estimate in estimates:
            sums += [sa.Column(f"{estimate}_{name}", sa.BigInteger(), nullable=False) for name in counted]
            sums += [
                sa.Column(
                    f"{estimate}_{quantity}_{part}", sa.Integer() if part == "bias_runs" else sa.Float(), nullable=False
                )
                for quantity in quantities
                for part in parts
            ]
        op.create_table(
            table,
            sa.Column("grid_id", sa.String(28), nullable=False),
            *(sa.Column(name, sa.Float() if name in VALUES else sa.String(64), nullable=False) for name in keys),
            *sums,
            sa.ForeignKeyConstraint(["grid_id"], ["grid.id"], name=f"fk_{table}_grid_id"),
            sa.PrimaryKeyConstraint("grid_id", *keys, name=f"pk_{table}"),
        )
        _fill(table, ("grid_id", *keys), estimates, quantities, counted, parts)


def _fill(table, keys, estimates, quantities, counted, parts):
    """Add up what is stored already; a result without an estimate counts as nothing in its sums."""
    sums = {"runs": "count(*)"}
    for estimate in estimates:
        for name in counted:
            total = f"count({estimate}_magnitude_mean)" if name == "runs" else f"coalesce(sum({estimate}_{name}), 0)"
            sums[f"{estimate}_{name}"] = total
        for quantity in quantities:
            name = f"{estimate}_{quantity}"
            shift = f"({name}_mean - {quantity})" if quantity in VALUES else f"{name}_mean"
            known = {
                "sd": f"coalesce(sum({name}_sd), 0.0)",
                "bias": f"coalesce(sum({name}_bias), 0.0)",
                "bias2": f"coalesce(sum({name}_bias * {name}_bias), 0.0)",
                "bias_runs": f"count({name}_bias)",
                "shift": f"coalesce(sum({shift}), 0.0)",
                "shift2": f"coalesce(sum({shift} * {shift}), 0.0)",
            }
            sums |= {f"{name}_{part}": known[part] for part in parts}
    by = ", ".join(keys)
    columns, values = ", ".join(sums), ", ".join(sums.values())
    op.execute(f"insert into {table} ({by}, {columns}) select {by}, {values} from result group by {by}")  # noqa: S608


def _drop_sums():
    op.drop_table("grid_sum")
    op.drop_table("input_sum")


def upgrade():
    _drop_sums()
    needed, _ = _old_columns()
    with op.batch_alter_table("result") as batch:
        for name, kind in needed.items():
            batch.alter_column(name, existing_type=kind, nullable=True)
        for name, kind in _new_columns().items():
            batch.add_column(sa.Column(name, kind))
    sqlite = op.get_bind().dialect.name == "sqlite"
    value = "json_extract(spec, '$.analysis.regularisation')" if sqlite else "spec->'analysis'->>'regularisation'"
    op.execute(
        f"update result set regularisation = (select {value} from run where run.id = result.run_id)"  # noqa: S608
    )
    _create_sums(ESTIMATES, SUMMED, ("runs", "at_bound", "failed"))


def downgrade():
    needed, _ = _old_columns()
    # The older tables need every number of the four older estimates.
    lacking = " or ".join(f"{name} is null" for name in needed)
    lost = op.get_bind().scalar(sa.text(f"select count(*) from result where {lacking}"))  # noqa: S608
    if lost:
        raise CommandError(f"{lost} results lack an estimate that revision {down_revision} needs: it cannot hold them")
    _drop_sums()
    with op.batch_alter_table("result") as batch:
        for name in _new_columns():
            batch.drop_column(name)
        for name, kind in needed.items():
            batch.alter_column(name, existing_type=kind, nullable=False)
    _create_sums(OLD_ESTIMATES, OLD_QUANTITIES, ("at_bound", "failed"))
