"""The map of a grid: a cell for each run, by system, that tells its state and its bias without colour alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from service.store.map_rows import MapRow
from service.web.rendering import MINUS, signed

_STEPS = ((1.25, "3"), (0.5, "2"), (0.1, "1"))
_SIGNS = {
    "leased": "▸",
    "failed": "✕",
    "quarantined": "✕",
    "cancelled": "✕",
    "not_needed": "○",
    "paused": "‖",
    "queued": "·",
}


@dataclass(frozen=True)
class Cell:
    """A cell: the class that gives its colour, the sign in it, the words behind it."""

    run_id: str
    look: str
    sign: str
    told: str


@dataclass(frozen=True)
class BiasMap:
    """Cells by system, in the grid's order; ``more`` where there are more runs than ``shown``."""

    systems: list[tuple[str, list[Cell]]]
    shown: int
    more: bool


def bias_map(runs: Iterable[MapRow], most: int) -> BiasMap:
    """The map of the first ``most`` runs."""
    systems: dict[str, list[Cell]] = {}
    shown, more = 0, False
    for run in runs:
        if shown == most:
            more = True
            break
        systems.setdefault(run.system, []).append(_cell(run))
        shown += 1
    return BiasMap(list(systems.items()), shown, more)


def _cell(run: MapRow) -> Cell:
    if run.state != "done":
        waits = dict.fromkeys(("queued", "paused", "not_needed"), "queued")
        look = {"leased": "leased", **waits}.get(run.state, "failed")
        return Cell(run.run_id, look, _SIGNS[run.state], f"{run.label}: {run.state.replace('_', ' ')}")
    if run.bias is None:
        return Cell(run.run_id, "z", "?", f"{run.label}: no answer of the recommended estimator")
    size = next((step for reach, step in _STEPS if abs(run.bias) > reach), "")
    look = ("m" if run.bias < 0.0 else "p") + size if size else "z"
    sign = (MINUS if run.bias < 0.0 else "+") if size == "3" else ""
    return Cell(run.run_id, look, sign, f"{run.label}: bias {signed(run.bias, 2)} mag")
