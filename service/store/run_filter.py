"""Which runs of a grid are meant, whether they have a result or not."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from sqlalchemy import Connection, select

from service.domain.states import RunState
from service.store.result_filter import ResultFilter, axes_of_run, profile_of_spec
from service.store.tables import grid, run

_AT_ONCE = 1000


@dataclass(frozen=True)
class RunFilter:
    """Runs in one of ``states`` that failed with one of ``error_codes`` and lie where ``axes`` want them.

    Whatever is empty is no condition.
    """

    states: Collection[RunState] = ()
    error_codes: Collection[str] = ()
    axes: ResultFilter = field(default_factory=ResultFilter)

    def runs(self, connection: Connection, grid_id: str, among: Collection[RunState]) -> list[str]:
        """Ids of the runs of a grid in one of the states ``among`` that are meant, in the grid's order."""
        states = sorted(set(among).intersection(self.states or among))
        analysis = run.c.spec["analysis"]
        asked = (
            select(
                run.c.id,
                run.c.inputs,
                profile_of_spec().label("profile"),
                analysis["regularisation"].as_string().label("regularisation"),
                grid.c.engine_digest,
            )
            .join(grid, grid.c.id == run.c.grid_id)
            .where(run.c.grid_id == grid_id, run.c.state.in_(states))
            .order_by(run.c.ordinal)
        )
        if self.error_codes:
            asked = asked.where(run.c.error_code.in_(self.error_codes))
        with connection.execution_options(yield_per=_AT_ONCE).execute(asked) as rows:
            return [
                row.id
                for row in rows
                if self.axes.accepts(
                    axes_of_run(row.inputs, grid_id, row.profile, row.regularisation, row.engine_digest)
                )
            ]
