"""The command ``hostlens db prune``: shows what would go and what stays and why, asks, then deletes in pieces."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import typer
from rich.console import Console
from rich.filesize import decimal
from rich.progress import Progress
from rich.table import Table

from service.domain.identifiers import utc_now
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.orphans import Found, Orphans, oldest_kept
from service.store.retention import KINDS, Retention, Share, oldest_lease, referred_artefacts

_UNITS = {"h": timedelta(hours=1), "d": timedelta(days=1), "w": timedelta(weeks=1)}
_CENTURY = timedelta(days=36525)


def read_age(text: str) -> timedelta:
    """An age as ``90d``, ``12h`` or ``4w``, of a century at most; ValueError for anything else."""
    found = re.fullmatch(r"([1-9][0-9]{0,5})([hdw])", text)
    age = timedelta() if found is None else int(found[1]) * _UNITS[found[2]]
    # Before that there is hardly a calendar that a database could compare with, and no grid.
    if not timedelta() < age <= _CENTURY:
        raise ValueError(f"not an age: {text!r}; as 90d, 12h or 4w, a century at most")
    return age


def prune(settings: Settings, age: timedelta, console: Console, *, dry_run: bool, ask: bool) -> int:
    """Show what would go, and delete it where it is not a ``dry_run`` and whoever is asked agrees; the exit code."""
    database = Database(settings.database, pooled=False)
    try:
        pruning = look(settings, database, age, console)
        console.print(table(pruning, age))
        if dry_run or not (pruning.rows or pruning.files):
            console.print("nothing was deleted" if dry_run else "there is nothing to delete")
            return 0
        if ask and not typer.confirm("delete this?"):
            console.print("nothing was deleted")
            return 1
        rows, files, size = carry_out(pruning, console)
        console.print(f"deleted {rows:,} rows and {files:,} files of {decimal(size)}", highlight=False)
        return 0
    finally:
        database.close()


@dataclass(frozen=True)
class Pruning:
    """What there is to prune at one moment."""

    retention: Retention
    orphans: Orphans
    shares: tuple[Share, ...]
    found: Found

    @property
    def rows(self) -> int:
        """Rows that are to go."""
        return sum(share.going for share in self.shares)

    @property
    def files(self) -> list[str]:
        """Files that are to go."""
        return self.found.orphans + self.found.partial


def look(settings: Settings, database: Database, age: timedelta, console: Console) -> Pruning:
    """Look at everything and change nothing."""
    now = utc_now()
    retention = Retention(database, now - age)
    with _progress(console) as bar:
        task = bar.add_task("looking at the database", total=len(KINDS))
        shares = []
        for share in retention.shares():
            shares.append(share)
            bar.advance(task)
        # In this order: whoever is under way now is known before its files are listed, and these before what refers
        # to them. So nothing is taken for an orphan that gets its result meanwhile.
        orphans = Orphans(settings.artefacts, oldest_kept(now, now - age, oldest_lease(database)))
        task = bar.add_task("looking at the artefacts", total=None)
        listed = []
        for file in orphans.listed():
            listed.append(file)
            bar.advance(task)
        found = orphans.sort(listed, referred_artefacts(database))
    return Pruning(retention, orphans, tuple(shares), found)


def table(pruning: Pruning, age: timedelta) -> Table:
    """What would go and what stays, and why."""
    shown = Table(title=f"older than {utc_now() - age:%Y-%m-%d %H:%M} UTC")
    for heading in ("kind", "to delete", "kept", "why"):
        shown.add_column(heading, justify="right" if heading in {"to delete", "kept"} else "left")
    for share in pruning.shares:
        _add(shown, share.kind, f"{share.going:,}", [(f"{rows:,}", why) for why, rows in share.kept.items()])
    found = pruning.found
    kept = [(f"{files:,} ({decimal(size)})", why) for why, (files, size) in found.kept.items()]
    _add(shown, "artefacts", _files(found, found.orphans), kept)
    _add(shown, "half-written files", _files(found, found.partial), [])
    return shown


def carry_out(pruning: Pruning, console: Console) -> tuple[int, int, int]:
    """Delete it; rows, files and bytes that went."""
    rows = files = size = 0
    with _progress(console) as bar:
        for share in pruning.shares:
            task = bar.add_task(share.kind, total=share.going)
            for gone in pruning.retention.prune(share.kind):
                rows += gone
                bar.advance(task, gone)
        task = bar.add_task("files", total=len(pruning.files))
        for name in pruning.files:
            if pruning.orphans.remove(name):
                files, size = files + 1, size + pruning.found.sizes[name]
            bar.advance(task)
    return rows, files, size


def _add(shown: Table, kind: str, going: str, kept: list[tuple[str, str]]) -> None:
    for number, (many, why) in enumerate(kept or [("0", "")]):
        shown.add_row(*((kind, going) if number == 0 else ("", "")), many, why)


def _files(found: Found, names: Iterable[str]) -> str:
    sizes = [found.sizes[name] for name in names]
    return f"{len(sizes):,} ({decimal(sum(sizes))})"


@contextmanager
def _progress(console: Console) -> Iterator[Progress]:
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        yield bar
