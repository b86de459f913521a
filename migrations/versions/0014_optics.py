"""How the PSF of a run's sky departs from the one that the analysis was given.

Revision ID: 0014
Revises: 0013
"""

import hashlib
import json

import sqlalchemy as sa
from alembic import op
from alembic.util.exc import CommandError

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

ADDED = {"defocus_nm": "0.0", "jitter": "0.0", "colour": "0.0", "residual": "0.0", "coarse": "1"}
ORDER = "ix_input_order"
USUAL = {"host_kind": "sersic", "host_label": "sersic", "deflector": "plain"}
NO_KEYS = ("id", "grid_id", "digest", "runs", "wall_s", "cpu_s")


def upgrade():
    before = _columns_of_order()
    op.drop_index(ORDER, "input")
    for table in ("input", "result"):
        with op.batch_alter_table(table) as batch:
            for name, usual in ADDED.items():
                batch.add_column(sa.Column(name, sa.Float(), nullable=False, server_default=usual))
    op.create_index(ORDER, "input", [*before[:-1], *ADDED, "id"])
    _carry_over()


def _carry_over():
    """Results of grids with spoilt optics, which were one for all runs and stood in the request alone."""
    bind = op.get_bind()
    tables = sa.MetaData()
    tables.reflect(bind, only=("grid", "run", "result", "input"))
    grid, run, result, group = (tables.tables[name] for name in ("grid", "run", "result", "input"))
    for grid_id, request in bind.execute(sa.select(grid.c.id, grid.c.request.cast(sa.Text))).all():
        optics = json.loads(request).get("optics")
        told = {name: float(optics[name]) for name in ADDED if optics.get(name)} if isinstance(optics, dict) else {}
        if not told:
            continue
        runs = sa.select(run.c.id).where(run.c.grid_id == grid_id)
        bind.execute(result.update().where(result.c.run_id.in_(runs)).values(told))
        for row in bind.execute(sa.select(group).where(group.c.grid_id == grid_id)).mappings().all():
            keys = {**{name: value for name, value in row.items() if name not in NO_KEYS and name not in ADDED}, **told}
            digest = _input_digest(keys)
            bind.execute(group.update().where(group.c.id == row["id"]).values(**told, digest=digest))


def _input_digest(keys):
    """What the service knows an input by: of numbers as floating-point ones, null and usual left out."""
    named = {
        name: float(value) if isinstance(value, int) else value
        for name, value in keys.items()
        if value is not None and value != USUAL.get(name)
    }
    return hashlib.sha256(json.dumps(named, sort_keys=True).encode()).hexdigest()[:32]


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
