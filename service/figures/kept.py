"""Figures that have been drawn, kept as long as there is room, and drawn one at a time."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

from service.runtime.kept import KeptBytes


class KeptFigures:
    """Bytes of figures by what they were drawn from.

    Only one is drawn at a time, by one process: figures that many ask for at once are not to take the cores of the
    workers. Who asks for a figure that is being drawn waits for it, and it is not drawn again.
    """

    def __init__(self, room_bytes: int) -> None:
        self._kept = KeptBytes(room_bytes)
        self._drawing = Lock()

    def get(self, key: str, draw: Callable[[], bytes]) -> bytes:
        """The figure of a key, drawn where it is not kept."""
        found = self._kept.find(key)
        if found is not None:
            return found
        with self._drawing:
            found = self._kept.find(key)
            if found is None:
                found = draw()
                self._kept.keep(key, found)
        return found
