"""What the server's parser lets through and HTTP does not, and how a connection ends while its client still sends."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from typing import Any

import httptools

MAX_TARGET_BYTES = 32_768
_HOST = re.compile(rb"[A-Za-z0-9._~%!$&'()*+,;=:\[\]-]*")
_DROPPED_BYTES = 2**28
_QUIET_S = 2.0
_VERSION = "Invalid HTTP version"


class RefusedError(ValueError):
    """A request that is answered without the application."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(detail)
        self.status = status


def refusal(error: httptools.HttpParserError) -> RefusedError:
    """How to answer what the parser, or a callback of it, stumbled over."""
    cause = error.__context__
    if isinstance(error, httptools.HttpParserCallbackError) and cause is not None:
        if not isinstance(cause, RefusedError):
            raise cause
        return cause
    return RefusedError(505 if str(error) == _VERSION else 400, f"not HTTP/1.1: {error}")


def require_sound_head(method: bytes, version: str, headers: list[tuple[bytes, bytes]]) -> None:
    """Refuse a head that the parser can read and that this server must not act on (RFC 9110 and 9112)."""
    if version not in {"1.0", "1.1"}:
        raise RefusedError(505, "the version is HTTP/1.1 or HTTP/1.0")
    if method == b"CONNECT":
        raise RefusedError(501, "this is no proxy")
    hosts = [value for name, value in headers if name == b"host"]
    if len(hosts) > 1 or (not hosts and version == "1.1"):
        raise RefusedError(400, "a request has one header Host")
    if hosts and not _HOST.fullmatch(hosts[0]):
        raise RefusedError(400, "the header Host is a name or an address, perhaps with a port")
    codings = [value.strip().lower() for name, value in headers if name == b"transfer-encoding"]
    if codings and version == "1.0":
        raise RefusedError(400, "HTTP/1.0 has no Transfer-Encoding")
    if codings not in ([], [b"chunked"]):
        raise RefusedError(501, "the only Transfer-Encoding is chunked")
    if any(value.lower() != b"100-continue" for name, value in headers if name == b"expect"):
        raise RefusedError(417, "the only expectation is 100-continue")


def origin_form(target: bytes) -> bytes:
    """A request target as uvicorn reads it: of an address without a path, the root."""
    try:
        parsed = httptools.parse_url(target)
    except httptools.HttpParserInvalidURLError as error:
        raise RefusedError(400, "the request target is no address") from error
    if parsed.path is not None:
        return target
    return b"/" + (b"" if parsed.query is None else b"?" + parsed.query)


def without_upgrade(method: bytes, target: bytes, version: str, headers: list[tuple[bytes, bytes]]) -> bytes:
    """A head once more, without the wish to go on in another protocol."""
    kept = (b"%s: %s\r\n" % header for header in headers if header[0] != b"upgrade")
    return b"%s %s HTTP/%s\r\n%s\r\n" % (method, target, version.encode(), b"".join(kept))


class EndingTransport(asyncio.Transport):
    """A transport that can be closed so that the client gets what was written, although it is still sending.

    Closed with bytes unread, the kernel would send a reset, upon which the client forgets the answer. What comes is
    dropped instead: until the client ends too, is quiet for 2 s, or has sent far too much.
    """

    def __init__(
        self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop, is_sent_more: Callable[[], bool]
    ) -> None:
        super().__init__()
        self._is_sent_more = is_sent_more
        self._transport = transport
        self._loop = loop
        self._is_ending = False
        self._dropped = 0
        self._quiet: asyncio.TimerHandle | None = None

    def close_gently(self) -> None:
        """Write no more, and read and drop."""
        if self.is_closing():
            return
        self.resume_reading()
        self._is_ending = True
        self._transport.write_eof()
        self.drop(0)

    def drop(self, size: int) -> None:
        """Take note of what came after the end."""
        self._dropped += size
        if self._quiet is not None:
            self._quiet.cancel()
        if self._dropped > _DROPPED_BYTES:
            self._transport.abort()
        else:
            self._quiet = self._loop.call_later(_QUIET_S, self._transport.abort)

    def release(self) -> None:
        """Wait for nothing more."""
        if self._quiet is not None:
            self._quiet.cancel()

    def is_closing(self) -> bool:
        """Whether nothing can be written any more."""
        return self._is_ending or self._transport.is_closing()

    def write(self, data: Any) -> None:
        """Write; what is said after the end is not heard."""
        if not self.is_closing():
            self._transport.write(data)

    def close(self) -> None:
        """Close once all is written."""
        if self._is_sent_more():
            self.close_gently()
        elif not self._is_ending:
            self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        self._transport.abort()

    def pause_reading(self) -> None:
        """Read no more for now."""
        if not self.is_closing():
            self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Read on."""
        if not self.is_closing():
            self._transport.resume_reading()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """What is known of the socket."""
        return self._transport.get_extra_info(name, default)
