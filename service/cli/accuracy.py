"""``hostlens accuracy``: time against error of each knob, as a table, JSON and a figure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.outputs import PICTURES, require_apart, require_file
from service.cli.pictures import progress_bar, refusals

if TYPE_CHECKING:
    from engine import AccuracyReport

_JSON = frozenset({".json"})
_MARKDOWN = frozenset({".md"})


def accuracy(
    system: Annotated[str, typer.Argument(help="A system of the catalogue")] = "HE0435",
    stage: Annotated[str | None, typer.Argument(help="One stage, as rendering; all of them without")] = None,
    markdown: Annotated[Path | None, typer.Option(help="The tables as a Markdown file")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="All points as a JSON file")] = None,
    figure: Annotated[Path | None, typer.Option(help="The figure, as PNG, PDF or SVG")] = None,
) -> None:
    """Measure speed against error. Each setting of each knob, the Pareto front, and where the defaults stand.

    Errors are against references made another way, for the paper's host of n = 4; CPU time is of one thread. All stages
    of a system take a few minutes.
    """
    kinds = [(markdown, _MARKDOWN), (json_file, _JSON), (figure, PICTURES)]
    outputs = [(path, allowed) for path, allowed in kinds if path is not None]
    require_apart([path for path, _ in outputs])
    for path, allowed in outputs:
        require_file(path, allowed)
    with refusals():
        from engine import ACCURACY_STAGES, SpecError, load_system  # noqa: PLC0415 - as pictures

        load_system(system)
        stages = ACCURACY_STAGES if stage is None else (stage,)
        if not set(stages) <= set(ACCURACY_STAGES):
            raise SpecError("stage", stage, f"one of {', '.join(ACCURACY_STAGES)}")
        from engine import hardest_realization, measure_accuracy  # noqa: PLC0415 - after all that may be refused

        with progress_bar(f"measuring {system}", len(stages)) as advance:
            report = measure_accuracy(hardest_realization(system), stages, lambda _: advance())
    _tell(report)
    _write(report, markdown, json_file, figure)


def _tell(report: AccuracyReport) -> None:
    """The tables on the terminal."""
    from rich.table import Table  # noqa: PLC0415 - the engine takes longer

    from engine import accuracy_rows  # noqa: PLC0415 - as above
    from service.cli.connection import console  # noqa: PLC0415 - as above

    out = console()
    out.print(report.scene, markup=False)
    for peer in report.absent:
        out.print(f"{peer} is not installed here", markup=False)
    for refusal in report.refused:
        out.print(f"not measured: {refusal.setting}: {refusal.reason}", markup=False)
    for curve in report.curves:
        knob = curve.knob
        table = Table(title=f"{knob.stage}: {knob.name}", title_justify="left")
        table.add_column("setting")
        for heading in ("CPU, of the default's", f"error [{knob.unit}]"):
            table.add_column(heading, justify="right")
        table.add_column("")
        for setting, *cells in accuracy_rows(curve):
            shown = f"{setting.strip('*')} (default)" if setting.startswith("**") else setting
            table.add_row(shown, *cells)
        out.print(table)
        out.print(f"error: {knob.quantity}, against {knob.reference}", markup=False)
        if not curve.default_on_front:
            out.print(f"the default is off the front: {knob.why_off_front}", markup=False)


def _write(report: AccuracyReport, markdown: Path | None, json_file: Path | None, figure: Path | None) -> None:
    from engine import accuracy_markdown  # noqa: PLC0415 - as above

    if markdown is not None:
        markdown.write_text(accuracy_markdown(report), encoding="utf-8")
        typer.echo(markdown)
    if json_file is not None:
        json_file.write_text(json.dumps(report.to_dict(), indent=1) + "\n", encoding="utf-8")
        typer.echo(json_file)
    if figure is not None:
        from engine.figures import accuracy_figure  # noqa: PLC0415 - as above

        accuracy_figure([report]).savefig(figure)
        typer.echo(figure)
