"""Results that wait for the artefact store, with the artefacts that it did not take from the workers.

As with the database: a result is kept until it can be stored, nothing is claimed meanwhile, nobody is charged. What can
come to wait is what the workers were at when the store went away, a megabyte or so each: of a thousand workers more
than a process should keep in memory, so the rest is in a file without a name, which is gone with the process.
"""

from __future__ import annotations

import errno
import logging
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from service.dispatcher.outcomes import lost_artefact, refused_artefact
from service.dispatcher.telemetry import DispatcherMetrics
from service.domain.payload import Payload
from service.store.artefacts import ArtefactStore, ArtefactStoreError
from service.store.leases import Lease
from service.store.queue import Failure

_LOG = logging.getLogger(__name__)
PATIENCE_S = 5.0
"""How long the loop waits for a call of the store; after a few calls that hang it does not wait at all."""
_IN_MEMORY = 256 * 2**20
"""Bytes that are kept in memory; more go to the file."""
_ON_DISK, _LEFT_FREE = 8 * 2**30, 2**30
"""Bytes in the file at most, and the room that it leaves on a disk which may be the database's too."""
_LOOK_S = 10.0
_FIRST_BACK_OFF_S, _MAX_BACK_OFF_S = 0.2, 10.0
_TURN_S = 1.0
"""How long one turn may put artefacts into the store: cancelling and reconciling go on while hundreds wait."""
_TRIES = 8
"""After so many refusals (in half a minute) of one artefact by a store that takes others, its run fails."""


class NoRoomError(RuntimeError):
    """No more results can be kept."""


class Backlog:
    """Results whose artefacts have to be in the store before they are stored themselves.

    ``away`` says why the store takes nothing now, None while it does. With nothing to put the store is asked every ten
    seconds, so that no run is started whose result could not be kept. ``folder`` is that of the file.
    """

    def __init__(self, store: ArtefactStore, folder: Path, metrics: DispatcherMetrics) -> None:
        self.away: str | None = None
        self._store = store
        self._pieces = _Pieces(folder)
        self._held: list[_Held] = []
        self._next = 0.0
        self._back_off = 0.0
        self._metrics = metrics
        metrics.results_held.set_function(lambda: len(self._held))
        metrics.artefact_store_up.set_function(lambda: self.away is None)

    @property
    def leases(self) -> list[Lease]:
        """Of the results that wait."""
        return [held.lease for held in self._held]

    def add(self, lease: Lease, payload: Payload, artefacts: dict[str, bytes]) -> None:
        """Keep a result until the store has taken its artefacts; NoRoomError where there are too many."""
        held = _Held(lease, payload, {})
        try:
            for key, data in artefacts.items():
                held.pieces[key] = self._pieces.keep(data)
        except NoRoomError:
            self._drop(held)
            raise
        self._held.append(held)
        self._metrics.artefacts_brought.inc(len(artefacts))
        if self.away is None:
            self._next = 0.0

    def take_where(self, wanted: Callable[[Lease], bool]) -> list[Lease]:
        """Drop the results that are ``wanted``; their leases."""
        taken = [held for held in self._held if wanted(held.lease)]
        self._held = [held for held in self._held if not wanted(held.lease)]
        for held in taken:
            self._drop(held)
        return [held.lease for held in taken]

    def attend(self) -> list[tuple[Lease, Payload | Failure]]:
        """Try the store if it is time to; what waits no more: results that can be stored, or why one cannot.

        Nothing waits for ever behind an artefact that is refused for what it is: others go by it.
        """
        now = time.monotonic()
        if now < self._next:
            return []
        if not self._held:
            self._next = now + _LOOK_S
            self._ask()
            return []
        ended: list[tuple[Lease, Payload | Failure]] = []
        for held in list(self._held):
            if held.due > now:
                continue
            if time.monotonic() > now + _TURN_S:
                break
            ending = self._try(held)
            if ending is not None:
                ended.append((held.lease, ending))
                self._held.remove(held)
                self._drop(held)
            elif self.away is not None:
                return ended
        self._next = min((held.due for held in self._held), default=now + _LOOK_S)
        return ended

    def _try(self, held: _Held) -> Payload | Failure | None:
        """Put the artefacts of one result into the store; None where it has to wait."""
        try:
            for key, piece in list(held.pieces.items()):
                if self._store.put(self._pieces.read(piece), key.rpartition(".")[2]).key != key:
                    return lost_artefact(f"{key} was damaged in {self._pieces.folder}")
                # What has been taken need not be put again should the next be refused.
                self._pieces.drop(held.pieces.pop(key))
        except ArtefactStoreError as error:
            if error.full:
                self._is_away(error)
            elif self._ask():
                held.refusals += 1
                held.due = time.monotonic() + min(_FIRST_BACK_OFF_S * 2.0**held.refusals, _MAX_BACK_OFF_S)
                return refused_artefact(str(error)) if held.refusals >= _TRIES else None
            return None
        except OSError as error:
            return lost_artefact(str(error))
        self._is_back()
        return held.payload

    def _ask(self) -> bool:
        """Whether the store takes anything at all."""
        try:
            self._store.probe()
        except ArtefactStoreError as error:
            self._is_away(error)
            return False
        self._is_back()
        return True

    def _is_away(self, error: ArtefactStoreError) -> None:
        if self.away is None:
            _LOG.error("the artefact store takes nothing, and nothing is claimed until it does: %s", error)
        self.away = str(error)
        self._metrics.artefact_store_errors.inc()
        self._back_off = min(max(2.0 * self._back_off, _FIRST_BACK_OFF_S), _MAX_BACK_OFF_S)
        self._next = time.monotonic() + self._back_off

    def _is_back(self) -> None:
        if self.away is not None:
            _LOG.warning("the artefact store takes artefacts again; %d results wait for it", len(self._held))
        self.away, self._back_off = None, 0.0

    def _drop(self, held: _Held) -> None:
        for piece in held.pieces.values():
            self._pieces.drop(piece)


@dataclass
class _Held:
    lease: Lease
    payload: Payload
    pieces: dict[str, _Piece]
    refusals: int = 0
    due: float = 0.0


@dataclass(frozen=True)
class _Piece:
    """Bytes in memory, or where they are in the file."""

    length: int
    data: bytes | None = None
    offset: int = 0


class _Pieces:
    """Bytes that wait: in memory while there is room, then in the file."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._file: IO[bytes] | None = None
        self._in_memory = self._end = self._in_file = 0

    def keep(self, data: bytes) -> _Piece:
        if self._in_memory + len(data) <= _IN_MEMORY:
            self._in_memory += len(data)
            return _Piece(len(data), data)
        try:
            return self._write(data)
        except OSError as error:
            raise NoRoomError(str(error)) from error

    def read(self, piece: _Piece) -> bytes:
        if piece.data is not None or self._file is None:
            return piece.data or b""
        self._file.seek(piece.offset)
        return self._file.read(piece.length)

    def drop(self, piece: _Piece) -> None:
        if piece.data is not None:
            self._in_memory -= piece.length
            return
        self._in_file -= 1
        if self._file is not None and not self._in_file:
            self._file.close()
            self._file, self._end = None, 0

    def _write(self, data: bytes) -> _Piece:
        self.folder.mkdir(parents=True, exist_ok=True)
        if self._end + len(data) > _ON_DISK or shutil.disk_usage(self.folder).free < _LEFT_FREE + len(data):
            raise NoRoomError(f"no room for {len(data)} bytes in {self.folder}")
        if self._file is None:
            self._file = tempfile.TemporaryFile(dir=self.folder, buffering=0)  # noqa: SIM115 - open while something is in it
        self._file.seek(self._end)
        if self._file.write(data) != len(data):
            raise OSError(errno.ENOSPC, f"no room in {self.folder}")
        piece = _Piece(len(data), offset=self._end)
        self._end += len(data)
        self._in_file += 1
        return piece
