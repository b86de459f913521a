"""Figures that have been drawn, kept as long as there is room, and drawn one at a time."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock


class KeptFigures:
    """Bytes of figures by what they were drawn from; the least used go first.

    Only one is drawn at a time, by one process: figures that many ask for at once are not to take the cores of the
    workers. Who asks for a figure that is being drawn waits for it, and it is not drawn again.
    """

    def __init__(self, room_bytes: int) -> None:
        self._room = room_bytes
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._size = 0
        self._lock, self._drawing = Lock(), Lock()

    def get(self, key: str, draw: Callable[[], bytes]) -> bytes:
        """The figure of a key, drawn where it is not kept."""
        found = self._find(key)
        if found is not None:
            return found
        with self._drawing:
            found = self._find(key)
            if found is None:
                found = draw()
                self._keep(key, found)
        return found

    def _find(self, key: str) -> bytes | None:
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
            return self._kept.get(key)

    def _keep(self, key: str, data: bytes) -> None:
        with self._lock:
            self._kept[key] = data
            self._size += len(data)
            while self._size > self._room:
                self._size -= len(self._kept.popitem(last=False)[1])
