"""How connections are treated: what must come within which time, how many there may be, and how they end."""

from __future__ import annotations

import asyncio
import logging
import resource
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from socket import socket
from typing import Any

import httptools
import uvicorn
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.config import STARTUP_FAILURE
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from service.api.problems import problem
from service.api.wire import (
    MAX_TARGET_BYTES,
    EndingTransport,
    RefusedError,
    origin_form,
    refusal,
    require_sound_head,
    without_upgrade,
)
from service.runtime import start
from service.runtime.settings import Settings

_LOG = logging.getLogger(__name__)
_MAX_HEAD_BYTES = 65_536
_CHUNK_OVERHEAD = 8
"""Bytes around a chunk of a single byte, rounded up: what is not body may be so many times as much as the body."""
_RESERVED = 64
"""Connections and open files beyond the limit: for the probes, and to tell others that there are too many."""
_GRACE_S = 5
"""How long answers may take to come to their end once the server is to end."""
_PROBES = frozenset({"/healthz", "/readyz", "/metrics"})


class Protocol(HttpToolsProtocol):
    """A connection that cannot be held without being used.

    A request has to come whole within ``request_s`` of its first byte, the first one of the connection's beginning.
    An answer that waits for so long until the client takes any more of it is given up. What remains of an unfinished
    request is a disconnect to the application, never a body.
    """

    def __init__(self, *arguments: Any, request_s: float, max_connections: int, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._request_s = request_s
        self._max_connections = max_connections
        self._receiving = False
        self._in_head = True
        self._head_bytes = 0
        self._bytes = 0
        self._body_bytes = 0
        self._late: asyncio.TimerHandle | None = None
        self._unread: asyncio.TimerHandle | None = None
        self._refusal: RefusedError | None = None
        self._is_repeated = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first request, if there is room for one more."""
        self._ending = EndingTransport(transport, self.loop, self._is_sent_more)
        super().connection_made(self._ending)
        if len(self.connections) > self._max_connections + _RESERVED:
            self._write_refusal(RefusedError(503, "too many connections"))
            # At once: a connection that is one too many is not kept to be read to its end.
            transport.close()
        else:
            self._late = self.loop.call_later(self._request_s, self._is_late)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing more."""
        for timer in (self._late, self._unread):
            if timer is not None:
                timer.cancel()
        self._ending.release()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take what came, and see that the rest of a request follows in time."""
        if self._ending.is_closing():
            self._ending.drop(len(data))
            return
        if self._refusal is not None:
            return
        self._unset_keepalive_if_required()
        self._bytes += len(data)
        try:
            self._parse(data)
        except httptools.HttpParserError as error:
            self._refuse(refusal(error))
        else:
            if self._receiving and self._bytes > _MAX_HEAD_BYTES + _CHUNK_OVERHEAD * self._body_bytes:
                self._refuse(_long_head())
        if self.transport.is_closing():
            return
        if self._refusal is None and (self._receiving or not self._is_answering()):
            # Also after stray bytes between requests, which have stopped the clock of idle connections.
            self._late = self._late or self.loop.call_later(self._request_s, self._is_late)
        elif self._late is not None:
            self._late.cancel()
            self._late = None

    def _parse(self, data: bytes) -> None:
        try:
            self.parser.feed_data(data)
        except httptools.HttpParserUpgrade as upgrade:
            # The parser ends with a head that would go on in another protocol. None is spoken here, so the request
            # is one like any other (RFC 9110, 7.8), and its body and what follows are left to another parser.
            head = without_upgrade(
                self.parser.get_method(), self.url, self.parser.get_http_version(), list(self.headers)
            )
            self.parser = httptools.HttpRequestParser(self)
            self.parser.set_dangerous_leniencies(lenient_data_after_close=True)
            self._is_repeated = True
            self.parser.feed_data(head)
            self._parse(data[upgrade.args[0] :])

    def on_message_begin(self) -> None:
        """Take the first byte of a request."""
        if not self._is_repeated:
            self._receiving = self._in_head = True
            self._head_bytes = 0
            super().on_message_begin()

    def on_url(self, url: bytes) -> None:
        """Take a piece of the request target."""
        if not self._is_repeated:
            super().on_url(url)
            if len(self.url) > MAX_TARGET_BYTES:
                raise RefusedError(414, f"a request target may have {MAX_TARGET_BYTES} bytes")

    def on_header(self, name: bytes, value: bytes) -> None:
        """Keep a header; one that follows a chunked body is of no use here, and could be as long as it likes."""
        if self._in_head:
            self._head_bytes += len(name) + len(value) + 4
            if self._head_bytes > _MAX_HEAD_BYTES:
                raise _long_head()
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Start the application on a request."""
        if self._is_repeated:
            self._is_repeated = False
            return
        version = self.parser.get_http_version()
        require_sound_head(self.parser.get_method(), version, self.headers)
        self.url = origin_form(self.url)
        self.expect_100_continue &= version == "1.1"
        self._in_head = False
        super().on_headers_complete()
        if self.expect_100_continue:
            # A client that is answered before it was told to go on may send its body, or another request.
            self.cycle.keep_alive = False

    def on_body(self, body: bytes) -> None:
        """Give a piece of the body on."""
        self._body_bytes += len(body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Take the last byte of a request."""
        if self.parser.should_upgrade():
            return
        self._receiving = False
        self._bytes = self._body_bytes = 0
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Go on with the next request, or with what is wrong with it."""
        super().on_response_complete()
        if self._refusal is not None:
            self._refuse(self._refusal)

    def pause_writing(self) -> None:
        """Give a client that takes no more of an answer time to do so."""
        super().pause_writing()
        self._unread = self.loop.call_later(self._request_s, self.transport.abort)

    def resume_writing(self) -> None:
        """Go on with an answer."""
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def timeout_keep_alive_handler(self) -> None:
        """Close an idle connection, whether or not the client has taken the last answer."""
        super().timeout_keep_alive_handler()
        self.loop.call_later(self._request_s, self.transport.abort)

    def shutdown(self) -> None:
        """Let the answers under way come to their end; a request that is not whole gets none."""
        if self._receiving and self._may_refuse():
            self.transport.abort()
        else:
            super().shutdown()

    def _is_late(self) -> None:
        self._late = None
        if self.transport.is_closing():
            return
        if not self._receiving or (not self._in_head and self.cycle.response_started):
            self.transport.close()
        elif self._may_refuse():
            self._refuse(RefusedError(408, f"a request has to come whole within {self._request_s:g} s"))
        else:
            # It came behind others, whose answers go first.
            self._late = self.loop.call_later(self._request_s, self._is_late)

    def _is_sent_more(self) -> bool:
        return self._receiving or bool(self.pipeline) or self._refusal is not None

    def _is_answering(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _may_refuse(self) -> bool:
        """Whether what is written now would be the answer to the request that is coming in."""
        if self._in_head or not self._receiving:
            return not self._is_answering()
        return not self.pipeline and not self.cycle.response_started

    def _refuse(self, error: RefusedError) -> None:
        """Answer without the application, once what came before is answered, and close the connection."""
        if self._may_refuse():
            self._write_refusal(error)
            self._ending.close_gently()
            if self._receiving and not self._in_head:
                self.cycle.disconnected = True
                self.cycle.message_event.set()
        elif not self._in_head and self._receiving and not self.pipeline:
            # Its answer has begun.
            self._ending.close_gently()
        else:
            self._refusal = error

    def _write_refusal(self, error: RefusedError) -> None:
        again = {"Retry-After": "5"} if error.status == 503 else {}
        answer = problem(None, error.status, str(error), headers={"Connection": "close", **again})
        headers = (b"%s: %s\r\n" % header for header in (*self.server_state.default_headers, *answer.raw_headers))
        self.transport.write(b"".join((STATUS_LINE[error.status], *headers, b"\r\n", answer.body)))


def _long_head() -> RefusedError:
    return RefusedError(431, f"a head may have {_MAX_HEAD_BYTES} bytes")


class Admission:
    """What stands before the application: too many connections are told so, except by the probes."""

    def __init__(self, app: ASGIApp, max_connections: int) -> None:
        self.app = app
        self.max_connections = max_connections
        self.server: uvicorn.Server | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        server = self.server
        if scope["type"] != "http" or server is None:
            await self.app(scope, receive, send)
            return
        if len(server.server_state.connections) > self.max_connections and scope["path"] not in _PROBES:
            await _away(scope, "there are too many connections")(scope, receive, send)
            return
        try:
            await self.app(scope, receive, send)
        except asyncio.CancelledError:
            if not server.should_exit:
                raise
            # It has outlived the grace time, and the server would log a traceback of its being cancelled.
            _LOG.warning("ended before its answer: %s %s", scope["method"], scope["path"])
            with suppress(RuntimeError):
                await _away(scope, "the service is being stopped")(scope, receive, send)


def _away(scope: Scope, detail: str) -> Response:
    return problem(Request(scope), 503, detail, headers={"Retry-After": "5", "Connection": "close"})


class Server(uvicorn.Server):
    """A server that ends what waits for events before it waits for what is under way."""

    def __init__(self, config: uvicorn.Config, stopping: Callable[[], None]) -> None:
        super().__init__(config)
        self._stopping = stopping

    async def shutdown(self, sockets: list[socket] | None = None) -> None:
        """End."""
        self._stopping()
        await super().shutdown(sockets)


def run(app: ASGIApp, settings: Settings, stopping: Callable[[], None], listener: socket | None = None) -> None:
    """Serve until SIGINT or SIGTERM, on ``listener`` or where the settings say.

    ``stopping`` is called in the server's loop once it accepts no more connections.
    """
    _allow_open_files(settings.max_connections + 2 * _RESERVED)

    def protocol(**options: Any) -> Protocol:
        return Protocol(request_s=settings.request_timeout_s, max_connections=settings.max_connections, **options)

    admission = Admission(app, settings.max_connections)
    config = uvicorn.Config(
        admission,
        host=settings.host,
        port=settings.port,
        http=protocol,  # type: ignore[arg-type]  # it makes what the class would
        ws="none",
        log_config=None,
        timeout_graceful_shutdown=_GRACE_S,
    )
    server = admission.server = Server(config, stopping)
    # Uvicorn sends itself the signals that ended it once more, for whoever handled them before: also the server.
    for number in start.STOPS:
        signal.signal(number, server.handle_exit)
    server.run(None if listener is None else [listener])
    if not server.started:
        sys.exit(STARTUP_FAILURE)


def _allow_open_files(wanted: int) -> None:
    """Raise this process's limit of open files as far as it may, or connections would be refused before their limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
