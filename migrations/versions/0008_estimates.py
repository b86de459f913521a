"""A row for each answer of an estimator instead of 350 columns; inputs; the kind of a run; results without a chain.

Revision ID: 0008
Revises: 0007
"""

import hashlib
import json

import sqlalchemy as sa
from alembic import op
from alembic.util.exc import CommandError

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

ESTIMATES = tuple(
    (estimator, prior)
    for estimator in ("paper", "covariance", "projected", "image")
    for prior in ("wide", "free", "fixed")
)
QUANTITIES = ("magnitude", "r_eff", "r_eff_galfit", "n", "q", "position_angle", "x", "y")
COUNTS = ("draws", "at_bound", "n_at_bound", "r_eff_at_bound", "failed")
PARTS = ("mean", "sd", "bias")
MEASURES = (*(f"{quantity}_{part}" for quantity in QUANTITIES for part in PARTS), *COUNTS)
SUMMED = ("magnitude", "r_eff", "n")
COUNTED = ("runs", "at_bound", "failed")
OF_INPUT = ("sd", "bias", "bias_runs", "shift", "shift2")
OF_GRID = ("sd", "bias", "bias2", "bias_runs")
NAMES = ("system", "camera", "mass_model", "noise_level", "noise_treatment")
VALUES = ("l_eta", "n", "r_eff", "magnitude")
KEY = (
    "system", "camera", "mass_model", "noise_level", "noise_treatment", "l_eta", "n", "r_eff", "magnitude",
    "configuration", "regularisation", "profile", "engine_digest",
)  # fmt: skip
CHAIN = {
    "ln_evidence": sa.Float(),
    "chi2": sa.Float(),
    "degrees_of_freedom": sa.Integer(),
    "condition_number": sa.Float(),
    "chain_status": sa.String(16),
    "walkers": sa.Integer(),
    "steps": sa.Integer(),
    "burn_in": sa.Integer(),
    "tau": sa.Float(),
    "effective_samples": sa.Float(),
    "acceptance": sa.Float(),
    "evaluations": sa.BigInteger(),
}
QUADS = ("HE0435", "WFI2033", "RXJ1131")
DOUBLES = ("HE1104", "SDSS1206", "HE0047", "SDSS0246", "HS2209")
SERIAL = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
AT_ONCE = 1000
LOOKED_FOR = {
    "estimate": {"run_id", "estimator", "index_prior", "input_id"},
    "input_moments": {"input_id", "estimator", "index_prior"},
    "grid_moments": {"grid_id", "estimator", "index_prior"},
    "result": {"run_id", "grid_id", "input_id", "observation_digest", *NAMES, *VALUES},
    "grid_sum": {"grid_id"},
    "input_sum": {"grid_id", *NAMES, *VALUES},
}


def _on_sqlite():
    return op.get_bind().dialect.name == "sqlite"


def _execute(statement):
    op.execute(sa.text(statement))


def _quiet(*tables):
    """Have PostgreSQL keep no statistics of columns that no query looks for rows by: see revision 0005."""
    if _on_sqlite():
        return
    inspector = sa.inspect(op.get_bind())
    for table in tables:
        names = [column["name"] for column in inspector.get_columns(table)]
        changes = ", ".join(f"ALTER COLUMN {name} SET STATISTICS 0" for name in names if name not in LOOKED_FOR[table])
        _execute(f"ALTER TABLE {table} {changes}")


def _configuration():
    """What a lens with two or four AGN images is called, by an expression over a row of run."""
    system, own = (
        ("json_extract(spec, '$.system')", "json_array_length(spec, '$.system.agn')")
        if _on_sqlite()
        else (
            "spec ->> 'system'",
            "json_array_length(spec -> 'system' -> 'agn')",
        )
    )
    kind = "json_type(spec, '$.system')" if _on_sqlite() else "json_typeof(spec -> 'system')"
    quads, doubles = (", ".join(f"'{name}'" for name in names) for names in (QUADS, DOUBLES))
    return (
        f"case when {kind} = 'object' then case {own} when 4 then 'quad' when 2 then 'double' else 'other' end "
        f"when {system} in ({quads}) then 'quad' when {system} in ({doubles}) then 'double' else 'other' end"
    )


def _add_configuration():
    """Each run says of which configuration its lens is, as those do that are submitted from now on."""
    what = _configuration()
    if _on_sqlite():
        _execute(
            f"update run set inputs = json_set(inputs, '$.configuration', {what}) "  # noqa: S608
            "where json_extract(inputs, '$.configuration') is null"
        )
    else:
        _execute(
            f"update run set inputs = (inputs::jsonb || jsonb_build_object('configuration', {what}))::json "  # noqa: S608
            "where inputs ->> 'configuration' is null"
        )
    value = "json_extract(inputs, '$.configuration')" if _on_sqlite() else "inputs ->> 'configuration'"
    _execute(
        f"update result set configuration = (select {value} from run where run.id = result.run_id)"  # noqa: S608
    )


def _add_observations():
    """The digest of a specification without its analysis."""
    run = sa.table("run", sa.column("id"), sa.column("spec", sa.JSON()))
    result = sa.table("result", sa.column("run_id"), sa.column("observation_digest"))
    change = result.update().where(result.c.run_id == sa.bindparam("of")).values(observation_digest=sa.bindparam("is"))
    last = ""
    while True:
        found = (
            sa.select(run.c.id, run.c.spec)
            .join(result, result.c.run_id == run.c.id)
            .where(run.c.id > last)
            .order_by(run.c.id)
            .limit(AT_ONCE)
        )
        rows = op.get_bind().execute(found).all()
        if not rows:
            return
        op.get_bind().execute(change, [{"of": row.id, "is": _digest_of(row.spec)} for row in rows])
        last = rows[-1].id


def _digest_of(spec):
    observed = {name: value for name, value in spec.items() if name != "analysis"}
    return hashlib.sha256(json.dumps(observed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _input_digest(values):
    named = {name: value for name, value in values.items() if value is not None}
    return hashlib.sha256(json.dumps(named, sort_keys=True).encode()).hexdigest()[:32]


def _add_inputs():
    columns = ", ".join(("grid_id", *KEY))
    counted = f"select {columns}, count(*) as runs, sum(wall_s) as wall_s, sum(cpu_s) as cpu_s"
    found = op.get_bind().execute(sa.text(f"{counted} from result group by {columns} order by {columns}"))
    names = ("grid_id", "digest", *KEY, "runs", "wall_s", "cpu_s")
    into = sa.table("input", *(sa.column(name) for name in names))
    rows = [dict(row._mapping) for row in found]
    for row in rows:
        row["digest"] = _input_digest({name: row[name] for name in KEY})
    for first in range(0, len(rows), AT_ONCE):
        op.get_bind().execute(into.insert(), rows[first : first + AT_ONCE])
    nullable = ("regularisation", "profile")
    alike = [f"input.{name} = result.{name}" for name in ("grid_id", *KEY) if name not in nullable]
    alike += [f"coalesce(input.{name}, '') = coalesce(result.{name}, '')" for name in nullable]
    _execute(f"update result set input_id = (select id from input where {' and '.join(alike)})")  # noqa: S608


def _create_tables():
    op.create_table(
        "input",
        sa.Column("id", SERIAL, autoincrement=True, nullable=False),
        sa.Column("grid_id", sa.String(28), nullable=False),
        sa.Column("digest", sa.String(32), nullable=False),
        *(sa.Column(name, sa.String(64), nullable=False) for name in NAMES),
        *(sa.Column(name, sa.Float(), nullable=False) for name in VALUES),
        sa.Column("configuration", sa.String(16), nullable=False),
        sa.Column("regularisation", sa.String(32)),
        sa.Column("profile", sa.String(32)),
        sa.Column("engine_digest", sa.String(64), nullable=False),
        sa.Column("runs", sa.Integer(), nullable=False),
        sa.Column("wall_s", sa.Float(), nullable=False),
        sa.Column("cpu_s", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(["grid_id"], ["grid.id"], name="fk_input_grid_id"),
        sa.PrimaryKeyConstraint("id", name="pk_input"),
        sa.UniqueConstraint("grid_id", "digest", name="uq_input_grid_id_digest"),
    )
    op.create_index("ix_input_order", "input", ["grid_id", *NAMES, *VALUES, "id"])
    op.create_table(
        "estimate",
        sa.Column("run_id", sa.String(36), nullable=False),
        sa.Column("estimator", sa.String(16), nullable=False),
        sa.Column("index_prior", sa.String(16), nullable=False),
        sa.Column("input_id", SERIAL, nullable=False),
        *(sa.Column(f"{quantity}_{part}", sa.Float()) for quantity in QUANTITIES for part in PARTS),
        *(sa.Column(part, sa.Integer()) for part in COUNTS),
        sa.ForeignKeyConstraint(["run_id"], ["result.run_id"], name="fk_estimate_run_id"),
        sa.ForeignKeyConstraint(["input_id"], ["input.id"], name="fk_estimate_input_id"),
        sa.PrimaryKeyConstraint("run_id", "estimator", "index_prior", name="pk_estimate"),
    )
    op.create_index(
        "ix_estimate_answer",
        "estimate",
        [
            "estimator", "index_prior", "input_id",
            *(f"{quantity}_{part}" for quantity in SUMMED for part in ("bias", "sd")),
        ],
    )  # fmt: skip
    for owner, parts in (("input", OF_INPUT), ("grid", OF_GRID)):
        kind = SERIAL if owner == "input" else sa.String(28)
        op.create_table(
            f"{owner}_moments",
            sa.Column(f"{owner}_id", kind, autoincrement=False, nullable=False),
            sa.Column("estimator", sa.String(16), nullable=False),
            sa.Column("index_prior", sa.String(16), nullable=False),
            *(sa.Column(name, sa.BigInteger(), nullable=False) for name in COUNTED),
            *(sa.Column(f"{quantity}_{part}", _kind(part), nullable=False) for quantity in SUMMED for part in parts),
            sa.ForeignKeyConstraint([f"{owner}_id"], [f"{owner}.id"], name=f"fk_{owner}_moments_{owner}_id"),
            sa.PrimaryKeyConstraint(f"{owner}_id", "estimator", "index_prior", name=f"pk_{owner}_moments"),
        )


def _kind(part):
    return sa.Integer() if part.endswith("bias_runs") else sa.Float()


def _sums(prefix, parts):
    """What is added up of one estimator's answers, by column; its own columns begin with ``prefix``."""
    sums = {"runs": f"count({prefix}magnitude_mean)"}
    sums |= {name: f"coalesce(sum({prefix}{name}), 0)" for name in COUNTED[1:]}
    for quantity in SUMMED:
        name = f"{prefix}{quantity}"
        shift = f"({name}_mean - result.{quantity})"
        known = {
            "sd": f"coalesce(sum({name}_sd), 0.0)",
            "bias": f"coalesce(sum({name}_bias), 0.0)",
            "bias2": f"coalesce(sum({name}_bias * {name}_bias), 0.0)",
            "bias_runs": f"count({name}_bias)",
            "shift": f"coalesce(sum({shift}), 0.0)",
            "shift2": f"coalesce(sum({shift} * {shift}), 0.0)",
        }
        sums |= {f"{quantity}_{part}": known[part] for part in parts}
    return sums


def _fill_moments():
    for owner, parts in (("input", OF_INPUT), ("grid", OF_GRID)):
        sums = _sums("estimate.", parts)
        columns, values = ", ".join(sums), ", ".join(sums.values())
        _execute(
            f"insert into {owner}_moments ({owner}_id, estimator, index_prior, {columns}) "  # noqa: S608
            f"select result.{owner}_id, estimator, index_prior, {values} "
            "from estimate join result on result.run_id = estimate.run_id "
            f"group by result.{owner}_id, estimator, index_prior"
        )


def _wide(name):
    return sa.Integer() if name in COUNTS else sa.Float()


def upgrade():
    with op.batch_alter_table("run") as batch:
        batch.add_column(sa.Column("kind", sa.String(16), nullable=False, server_default=sa.text("'realization'")))
        batch.create_check_constraint(op.f("ck_run_kind"), "kind in ('realization', 'image')")
    op.drop_table("grid_sum")
    op.drop_table("input_sum")
    _create_tables()
    for name, kind in (
        ("input_id", SERIAL),
        ("observation_digest", sa.String(64)),
        ("configuration", sa.String(16)),
    ):
        op.add_column("result", sa.Column(name, kind))
    _add_configuration()
    _add_observations()
    _add_inputs()
    for estimator, prior in ESTIMATES:
        own = ", ".join(f"{estimator}_{prior}_{measure}" for measure in MEASURES)
        _execute(
            f"insert into estimate (run_id, estimator, index_prior, input_id, {', '.join(MEASURES)}) "  # noqa: S608
            f"select run_id, '{estimator}', '{prior}', input_id, {own} "
            f"from result where {estimator}_{prior}_magnitude_mean is not null"
        )
    _fill_moments()
    with op.batch_alter_table("result") as batch:
        for estimator, prior in ESTIMATES:
            for measure in MEASURES:
                batch.drop_column(f"{estimator}_{prior}_{measure}")
        for name, kind in CHAIN.items():
            batch.alter_column(name, existing_type=kind, nullable=True)
        batch.alter_column("input_id", existing_type=SERIAL, nullable=False)
        batch.alter_column("observation_digest", existing_type=sa.String(64), nullable=False)
        batch.alter_column("configuration", existing_type=sa.String(16), nullable=False)
        batch.create_foreign_key(op.f("fk_result_input_id"), "input", ["input_id"], ["id"])
    op.create_index("ix_result_input_id_run_id", "result", ["input_id", "run_id"])
    op.create_index("ix_result_observation_digest", "result", ["observation_digest"])
    _quiet("estimate", "input_moments", "grid_moments", "result")


def _create_sums():
    for table, keys, parts in (("input_sum", (*NAMES, *VALUES), OF_INPUT), ("grid_sum", (), OF_GRID)):
        sums = {"runs": ("count(*)", sa.Integer())}
        for estimator, prior in ESTIMATES:
            prefix = f"{estimator}_{prior}_"
            for name, value in _sums(prefix, parts).items():
                sums[f"{prefix}{name}"] = (value, sa.BigInteger() if name in COUNTED else _kind(name))
        by = ("grid_id", *keys)
        op.create_table(
            table,
            sa.Column("grid_id", sa.String(28), nullable=False),
            *(sa.Column(name, sa.Float() if name in VALUES else sa.String(64), nullable=False) for name in keys),
            *(sa.Column(name, kind, nullable=False) for name, (_, kind) in sums.items()),
            sa.ForeignKeyConstraint(["grid_id"], ["grid.id"], name=f"fk_{table}_grid_id"),
            sa.PrimaryKeyConstraint(*by, name=f"pk_{table}"),
        )
        columns, values = ", ".join(sums), ", ".join(value for value, _ in sums.values())
        key = ", ".join(by)
        _execute(f"insert into {table} ({key}, {columns}) select {key}, {values} from result group by {key}")  # noqa: S608


def downgrade():
    lacking = " or ".join(f"{name} is null" for name in CHAIN)
    lost = op.get_bind().scalar(sa.text(f"select count(*) from result where {lacking}"))  # noqa: S608
    if lost:
        raise CommandError(f"{lost} results have no chain, which revision {down_revision} needs: it cannot hold them")
    known = " or ".join(f"(estimator = '{estimator}' and index_prior = '{prior}')" for estimator, prior in ESTIMATES)
    lost = op.get_bind().scalar(sa.text(f"select count(*) from estimate where not ({known})"))  # noqa: S608
    if lost:
        raise CommandError(f"{lost} estimates are of estimators for which revision {down_revision} has no columns")
    lost = op.get_bind().scalar(sa.text("select count(*) from run where kind <> 'realization'"))
    if lost:
        raise CommandError(f"{lost} runs are of kinds that revision {down_revision} does not know")
    op.drop_index("ix_result_observation_digest", "result")
    op.drop_index("ix_result_input_id_run_id", "result")
    with op.batch_alter_table("result") as batch:
        for estimator, prior in ESTIMATES:
            for measure in MEASURES:
                batch.add_column(sa.Column(f"{estimator}_{prior}_{measure}", _wide(measure)))
        for name, kind in CHAIN.items():
            batch.alter_column(name, existing_type=kind, nullable=False)
        batch.drop_constraint("fk_result_input_id", type_="foreignkey")
        for name in ("input_id", "observation_digest", "configuration"):
            batch.drop_column(name)
    for estimator, prior in ESTIMATES:
        values = ", ".join(f"{estimator}_{prior}_{measure} = estimate.{measure}" for measure in MEASURES)
        _execute(
            f"update result set {values} from estimate where estimate.run_id = result.run_id "  # noqa: S608
            f"and estimator = '{estimator}' and index_prior = '{prior}'"
        )
    for table in ("grid_moments", "input_moments", "estimate", "input"):
        op.drop_table(table)
    _create_sums()
    with op.batch_alter_table("run") as batch:
        batch.drop_constraint(op.f("ck_run_kind"), type_="check")
        batch.drop_column("kind")
    _quiet("result", "input_sum", "grid_sum")
