"""A temporary file between what is written as fast as the database gives it and a client that takes its time.

So a client that is slow, or stops reading, holds neither a picture of the database nor memory.
"""

from __future__ import annotations

import asyncio
import io
import os
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from typing import Any, BinaryIO, cast

_AT_ONCE = 2**18


class SpoolEndedError(OSError):
    """Nothing more is to be written: the client has gone, or it took too long."""


class Spool(io.RawIOBase):
    """Written by one thread, read by one task of the event loop that made it."""

    def __init__(self, longest_s: float) -> None:
        super().__init__()
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by who comes last
        self._loop = asyncio.get_running_loop()
        self._news = asyncio.Event()
        self._until = time.monotonic() + longest_s
        self._buffer = bytearray()
        self._written = 0
        self._flushed = 0
        self._is_complete = False
        self._is_abandoned = False
        self._error: BaseException | None = None

    def fill(self, write: Callable[[BinaryIO], None]) -> None:
        """Write all of it; the thread that does so is not told what went wrong, but the reader is."""
        try:
            write(cast("BinaryIO", self))
            self._flush()
            self._is_complete = True
        except BaseException as error:  # noqa: BLE001 - raised again where it is read
            self._error = error
        finally:
            if self._is_abandoned:
                self._file.close()
            self._loop.call_soon_threadsafe(self._news.set)

    def writable(self) -> bool:
        """As a file."""
        return True

    def tell(self) -> int:
        """Bytes so far."""
        return self._written

    def write(self, data: Any) -> int:
        """Take some bytes; a SpoolEndedError where nobody wants them any more, or for longer than is allowed."""
        if self._is_abandoned or time.monotonic() > self._until:
            raise SpoolEndedError("the client has gone" if self._is_abandoned else "it takes longer than is allowed")
        size = memoryview(data).nbytes
        self._buffer += data
        self._written += size
        if len(self._buffer) >= _AT_ONCE:
            self._flush()
        return size

    async def begun(self) -> None:
        """Wait for the first bytes; raises what went wrong before them."""
        while not self._flushed and not self._is_complete:
            self._raise()
            await self._more()

    async def read_all(self) -> AsyncIterator[bytes]:
        """Every byte; raises what went wrong, after which what has come is not whole."""
        at = 0
        while True:
            is_complete = self._is_complete
            data = os.pread(self._file.fileno(), _AT_ONCE, at)
            if data:
                at += len(data)
                yield data
            elif is_complete:
                return
            else:
                self._raise()
                await self._more()

    def abandon(self) -> None:
        """Nobody reads on: let go of the file, and have the writer end."""
        self._is_abandoned = True
        if self._is_complete or self._error is not None:
            self._file.close()

    def _flush(self) -> None:
        self._file.write(self._buffer)
        self._file.flush()
        self._flushed += len(self._buffer)
        self._buffer.clear()
        self._loop.call_soon_threadsafe(self._news.set)

    async def _more(self) -> None:
        await self._news.wait()
        self._news.clear()

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error
