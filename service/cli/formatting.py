"""Tables for people: what the CLI and the demo print."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rich.table import Table

from service.domain.payload import EstimateName
from service.domain.views import (
    Cost,
    DryRun,
    GridView,
    Interval,
    RunView,
    Summary,
    SummaryEstimate,
    SummaryValue,
)

if TYPE_CHECKING:
    from engine import Conclusion

_USUAL = ("sersic", "plain")
_INPUT = (("l_eta", "l_eta"), ("n", "n"), ("r_eff", "R_eff"), ("magnitude", "mag"))
ROWS: tuple[tuple[EstimateName, str, str], ...] = (
    ("image_wide", "magnitude", "magnitude"),
    ("image_wide", "r_eff", "R_eff"),
    ("image_wide", "n", "n"),
    ("projected_wide", "magnitude", "magnitude (projected)"),
    ("covariance_wide", "magnitude", "magnitude (covariance)"),
    ("paper_free", "magnitude", "magnitude (paper)"),
    ("paper_fixed", "magnitude", "  n fixed"),
    ("paper_free", "r_eff", "R_eff (paper)"),
    ("paper_free", "n", "n (paper)"),
)
"""What is shown of each input: by ``image`` with n in 0.3-8 where nothing is said, by ``paper`` with n in 1-4."""


_SHOWN_LABELS = 10
_SHOWN_KINDS = 3


def value_of(estimate: SummaryEstimate, quantity: str) -> SummaryValue:
    """One quantity of an estimate by its name."""
    value = getattr(estimate, quantity)
    if not isinstance(value, SummaryValue):
        raise KeyError(quantity)
    return value


def summary_table(summary: Summary) -> Table:
    """Input against recovered, a few lines for each input; narrow enough for eighty columns."""
    table = Table(title=f"Grid {summary.grid_id}\n{summary.n_stored} of {summary.n_runs} runs stored")
    table.add_column("input")
    table.add_column("quantity")
    for title in ("true", "recovered +- sd", "bias"):
        table.add_column(title, justify="right", no_wrap=True)
    for row in summary.rows:
        named = [f"{row.input['system']} ({row.n_runs} run{'s' * (row.n_runs > 1)})"]
        named += [f"{title} = {row.input[name]:g}" for name, title in _INPUT if row.input[name] is not None]
        named += [f"{name} {row.input[name]}" for name in ("host_label", "deflector") if row.input[name] not in _USUAL]
        named += [""] * (len(ROWS) - len(named))
        for place, (cell, (estimate, quantity, title)) in enumerate(zip(named, ROWS, strict=True)):
            last = place == len(ROWS) - 1
            found = row.estimates[estimate]
            if found is None:
                table.add_row(cell, title, "", "no estimate", "", end_section=last)
                continue
            value = value_of(found, quantity)
            true, bias = _number(value.input, "{:g}"), _number(value.bias, "{:+.3f}")
            table.add_row(cell, title, true, f"{value.mean:.3f} +- {value.sd:.3f}", bias, end_section=last)
    table.caption = (
        "bias: recovered minus true; sd: spread of the draws of a run; by the image estimator where none is named; "
        "n in 1-4 for paper"
    )
    return table


def conclusions_table(found: Iterable[Conclusion]) -> Table:
    """The paper's conclusions, and whether a study bears them out."""
    from engine import verdict  # noqa: PLC0415 - only here

    table = Table("section", "the paper says", "with paper", "with image", title="The paper's conclusions")
    for one in found:
        cells = [f"{verdict(finding)}: {finding.told}" for finding in (one.paper, one.recommended)]
        table.add_row(one.statement.section, one.statement.says, *cells, end_section=True)
    return table


def _number(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def runs_table(runs: Iterable[RunView]) -> Table:
    """Runs with their states."""
    table = Table("run", "label", "state", "attempt", "error")
    for run in runs:
        table.add_row(run.id, run.label, run.state, str(run.attempt), "" if run.error is None else run.error.code)
    return table


def grid_line(grid: GridView) -> str:
    """One line on how far a grid is."""
    parts = [f"{grid.id} {grid.state}: {grid.counts.done}/{grid.n_runs} stored"]
    for state in ("leased", "paused", "failed", "quarantined", "cancelled", "not_needed"):
        number = getattr(grid.counts, state)
        if number:
            parts.append(f"{number} {'running' if state == 'leased' else state.replace('_', ' ')}")
    if grid.until is not None:
        until = grid.until
        parts.append(f"{until.reached} of {until.points} points known to {until.error:g} in {until.quantity}")
    if grid.rate_per_s:
        parts.append(f"{60 * grid.rate_per_s:.2g} runs/min")
    if grid.eta_seconds and grid.finished_at is None:
        parts.append(f"{duration(grid.eta_seconds)} left")
    return ", ".join(parts) + ("" if grid.name is None else f" ({grid.name})")


def dry_run_lines(found: DryRun) -> list[str]:
    """What a request would start, the first runs by name."""
    shown = found.labels[:_SHOWN_LABELS]
    more = found.n_runs - len(shown)
    least = "" if found.least_runs == found.n_runs else f"{found.least_runs} to "
    return [
        f"{least}{found.n_runs} run{'' if found.n_runs == 1 else 's'}",
        *shown,
        *([f"... and {more} more"] if more else []),
        *_cost_lines(found.cost),
    ]


def _cost_lines(cost: Cost) -> list[str]:
    """What they should take, or of which kind too few runs are stored to say so."""
    if cost.cpu_s is None:
        kinds = [f"{kind.camera}, {kind.configuration}, {kind.profile or 'max_error'}" for kind in cost.unknown]
        more = [f"and {len(kinds) - _SHOWN_KINDS} more"] if len(kinds) > _SHOWN_KINDS else []
        told = "; ".join(kinds[:_SHOWN_KINDS] + more)
        return [f"cost not known: fewer than five stored runs of {told}"]
    lines = [f"CPU time {_interval(cost.cpu_s)}, by {cost.stored_runs} stored runs of its kind"]
    workers = f"{cost.workers} worker{'' if cost.workers == 1 else 's'}"
    return [*lines, "no worker now" if cost.wall_s is None else f"time {_interval(cost.wall_s)}, on {workers}"]


def _interval(found: Interval) -> str:
    return f"{duration(found.expected)} ({duration(found.low)} to {duration(found.high)})"


def duration(seconds: float) -> str:
    """Seconds for people."""
    whole = round(seconds)
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {whole % 60:02d} s" if minutes else f"{whole} s"
