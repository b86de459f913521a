"""Biases by group for people and for programs: a table of eighty columns, and CSV with everything."""

from __future__ import annotations

import csv
import io
from typing import Any

from rich import box
from rich.table import Table

from service.domain.answers import BiasView, GroupView, SummaryAnswer

_NAMES = {"magnitude": "mag", "r_eff": "R_eff", "noise_treatment": "noise", "regularisation": "regular.",
          "configuration": "config.", "noise_level": "noise level"}  # fmt: skip


_NUMBERS = ("runs", "bias +- error", "rmse", "sd", "68 %", "95 %", "failed")


def bias_table(found: SummaryAnswer) -> Table:
    """A line for each group; bias with its own error, scatter, what the runs state, and whether that holds.

    What all groups share is said once, above them.
    """
    question = found.question
    axes = [axis for axis in question.group_by if len({row.group[axis] for row in found.rows}) != 1]
    table = Table(
        box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title_justify="left", caption_justify="left"
    )
    table.title = _title(found, [axis for axis in question.group_by if axis not in axes])
    lines = [[*(_value(row.group[axis]) for axis in axes), *_numbers(row), str(row.failed or "")] for row in found.rows]
    names = [*(_NAMES.get(axis, axis) for axis in axes), *_NUMBERS]
    for place, name in enumerate(names):
        longest = max(len(name), *(len(line[place]) for line in lines), 0)
        is_text = place < len(axes) and any(isinstance(row.group[axes[place]], str) for row in found.rows)
        # Where it is too wide a name gives way, and no number.
        table.add_column(
            name,
            justify="left" if is_text else "right",
            no_wrap=not is_text,
            overflow="ellipsis",
            min_width=None if is_text else longest,
        )
    for line in lines:
        table.add_row(*line)
    table.caption = (
        "bias: recovered minus true; rmse: of one run; sd: as the runs state it; 68 and 95 %: part of the runs whose "
        "interval holds the truth"
        + (f"; {found.failed_elsewhere} failed in other groups" if found.failed_elsewhere else "")
    )
    return table


def _title(found: SummaryAnswer, shared: list[str]) -> str:
    question = found.question
    title = f"Bias of {question.quantity}" + ("" if question.unit is None else f" ({question.unit})")
    title += f" by {question.estimator}, n {question.index_prior}"
    title += " (recommended)" if question.recommended else ""
    told = [f"{axis} = {_value(found.rows[0].group[axis])}" for axis in shared]
    return "\n".join([title, *([", ".join(told)] if told else [])])


def _numbers(row: GroupView) -> list[str]:
    bias = row.bias
    if bias is None:
        return [f"0/{row.stored}", *[""] * 5]
    runs = str(bias.runs) if bias.runs == row.stored else f"{bias.runs}/{row.stored}"
    error = "" if bias.standard_error is None else f" +- {bias.standard_error:.3f}"
    shares = [f"{100 * bias.coverage[level].fraction:.0f}" for level in sorted(bias.coverage)]
    return [runs, f"{bias.mean:+.3f}{error}", f"{bias.rmse:.3f}", f"{bias.stated_sd:.3f}", *shares]


def _value(value: Any) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def bias_csv(found: SummaryAnswer) -> str:
    """A line for each group with all its numbers; empty where there is none."""
    question = found.question
    rows = [
        {
            **row.group,
            "quantity": question.quantity, "unit": question.unit,
            "estimator": question.estimator, "index_prior": question.index_prior,
            "stored": row.stored, "answered": row.answered, "failed": row.failed, "cpu_s": row.cpu_s,
            **({} if row.bias is None else _flat(row.bias)),
        }
        for row in found.rows
    ]  # fmt: skip
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _flat(bias: BiasView) -> dict[str, Any]:
    """Numbers within numbers as ``coverage_68_low``."""
    out: dict[str, Any] = {}

    def put(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for name, part in value.items():
                put(f"{prefix}_{name}" if prefix else name, part)
        else:
            out[prefix] = value

    put("", bias.model_dump())
    return out
