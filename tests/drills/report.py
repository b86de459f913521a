"""What a drill found: figures, and the claims that they support or refute."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table


@dataclass(frozen=True)
class Figure:
    """One measured number (or name) with its unit."""

    name: str
    value: float | int | str
    unit: str = ""


@dataclass(frozen=True)
class Claim:
    """What must hold, and whether it did."""

    text: str
    holds: bool


@dataclass(frozen=True)
class Report:
    """Figures and claims of one drill."""

    drill: str
    conditions: str
    """What was run, on what: a figure means nothing without."""
    figures: tuple[Figure, ...]
    claims: tuple[Claim, ...]

    @property
    def holds(self) -> bool:
        """Whether every claim held."""
        return all(claim.holds for claim in self.claims)

    def value(self, name: str) -> float | int | str:
        """A figure by its name; KeyError where there is none."""
        for figure in self.figures:
            if figure.name == name:
                return figure.value
        raise KeyError(name)

    def document(self) -> dict[str, Any]:
        """For machines."""
        return {**asdict(self), "holds": self.holds}

    def to_json(self) -> str:
        """The document as text."""
        return json.dumps(self.document(), indent=2)

    def table(self) -> Table:
        """For people."""
        table = Table(title=f"drill {self.drill}", caption=self.conditions, title_justify="left")
        table.add_column("figure")
        table.add_column("value", justify="right")
        table.add_column("unit")
        for figure in self.figures:
            table.add_row(figure.name, _shown(figure.value), figure.unit)
        table.add_section()
        for claim in self.claims:
            table.add_row(claim.text, "holds" if claim.holds else "DOES NOT HOLD", "")
        return table


def _shown(value: float | int | str) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def quantile(values: Sequence[float], share: float) -> float:
    """The value below which ``share`` of the values lie (the nearest rank); ValueError where there are none."""
    if not values:
        raise ValueError("no values to take a quantile of")
    ordered = sorted(values)
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)]
