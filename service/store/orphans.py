"""Artefacts that no result refers to: of runs whose result came too late, of workers that died before they answered.

An artefact is written before the result that refers to it, so one without a result may be about to get one. It stays as
long as any run is under way that had been claimed when it was written; every writer writes it anew, so that its time is
that of the last. A store belongs to one database: what another's results refer to would be an orphan here.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

import fsspec

from service.store.artefacts import KEY

REFERRED, YOUNG, FOREIGN = "a result refers to it", "younger, or of a run that is under way", "not of hostlens"
DAMAGED = "in a folder that lay where an artefact belongs"
_PARTIAL = re.compile(r"\.partial$|^\.probe$")
"""What a write, or a look whether the store takes one, may leave behind."""
_DAMAGED = re.compile(r"\.damaged(/|$)")
_DAY = timedelta(days=1)
_CLOCKS = timedelta(hours=1)
"""By so much the clocks of store, database and dispatcher may disagree."""
_TIMES = ("mtime", "LastModified", "last_modified", "updated", "created")
"""What the drivers call the time when a file was written."""


def oldest_kept(now: datetime, before: datetime, oldest_lease: datetime | None) -> datetime:
    """Files from then on stay, whether anything refers to them or not: the last day's at least."""
    limits = [before, now - _DAY]
    if oldest_lease is not None:
        limits.append(oldest_lease - _CLOCKS)
    return min(limits)


@dataclass
class Found:
    """What lies in a store: number and bytes that are to go, and that stay for each reason."""

    orphans: list[str] = field(default_factory=list)
    partial: list[str] = field(default_factory=list)
    sizes: dict[str, int] = field(default_factory=dict)
    kept: dict[str, tuple[int, int]] = field(default_factory=dict)

    def keep(self, reason: str, size: int) -> None:
        """Count a file that stays."""
        files, total = self.kept.get(reason, (0, 0))
        self.kept[reason] = (files + 1, total + size)


class Orphans:
    """The files of an artefact store: a local folder or whatever fsspec has a driver for."""

    def __init__(self, url: str, until: datetime) -> None:
        self._files, self._root = fsspec.core.url_to_fs(url)
        self._until = until

    def listed(self) -> Iterator[tuple[str, int, bool]]:
        """Name within the store, bytes, and whether it is old, of every file; folder by folder."""
        self._files.invalidate_cache()
        if not self._files.isdir(self._root):
            return
        folders = [self._root]
        while folders:
            for entry in self._files.ls(folders.pop(), detail=True):
                if entry["type"] == "directory":
                    folders.append(entry["name"])
                else:
                    name = str(entry["name"]).removeprefix(f"{self._root}/")
                    yield name, int(entry["size"] or 0), self._written_at(entry) < self._until

    def sort(self, listed: Iterable[tuple[str, int, bool]], referred: set[str]) -> Found:
        """Tell what is to go from what stays. ``referred`` is read after the listing, and so knows of all it saw."""
        found = Found()
        for name, size, old in listed:
            is_artefact, is_partial = KEY.match(name) is not None, _PARTIAL.search(name) is not None
            if name in referred:
                found.keep(REFERRED, size)
            elif not (is_artefact or is_partial):
                found.keep(DAMAGED if _DAMAGED.search(name) else FOREIGN, size)
            elif not old:
                found.keep(YOUNG, size)
            else:
                (found.orphans if is_artefact else found.partial).append(name)
                found.sizes[name] = size
        return found

    def remove(self, name: str) -> bool:
        """Remove a file unless it has gone or been written anew since it was listed; whether it was removed."""
        path = f"{self._root}/{name}"
        try:
            self._files.invalidate_cache()
            if self._written_at(self._files.info(path)) >= self._until:
                return False
            self._files.rm_file(path)
        except FileNotFoundError:
            return False
        return True

    def _written_at(self, entry: dict[str, Any]) -> datetime:
        told = next((entry[name] for name in _TIMES if entry.get(name) is not None), None)
        if told is None:
            told = self._files.modified(entry["name"])
        if isinstance(told, str):
            told = datetime.fromisoformat(told)
        if isinstance(told, (int, float)):
            return datetime.fromtimestamp(told, UTC)
        return told if told.tzinfo is not None else told.replace(tzinfo=UTC)
