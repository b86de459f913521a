"""Logs of every process: one line an event, bound to the run that it is about; text for people, JSON for machines.

Modules log as ever, by ``logging.getLogger(__name__)``; what is bound here comes along on every line that the same
thread or request writes. ``--preload service.runtime.logs`` makes ``dask scheduler`` and ``dask worker`` write the same
lines.
"""

from __future__ import annotations

import logging
import sys
from contextlib import AbstractContextManager
from types import TracebackType
from typing import TYPE_CHECKING, Any

import structlog
from structlog.typing import EventDict, Processor

from service.runtime.log_stream import PatientHandler
from service.runtime.settings import LogSettings, read_settings

if TYPE_CHECKING:
    from service.store.leases import Lease

Fields = dict[str, str | int]
_ACCESS = "uvicorn.access"
_PROBES = frozenset({"/healthz", "/readyz", "/metrics"})
# They come with handlers of their own, or may get them when they are imported.
_FOREIGN = ("distributed", "distributed.client", "distributed.gc", "bokeh", "tornado", "tornado.application", "uvicorn")


def configure(settings: LogSettings, process: str) -> None:
    """Write the logs of this process, called ``process`` on every line, to standard error as the settings say.

    It never waits for whoever reads them: see :class:`~service.runtime.log_stream.PatientHandler`.
    """
    handler = PatientHandler()
    handler.setFormatter(_formatter(settings, process))
    logging.root.handlers = [handler]
    logging.root.setLevel(settings.log_level)
    for name in _FOREIGN:
        foreign = logging.getLogger(name)
        foreign.handlers.clear()
        foreign.propagate = True
    # httpx tells of every request, Alembic of every look, Dask of every worker that comes; none of it is news.
    for name in ("httpx", "alembic", "distributed"):
        logging.getLogger(name).setLevel(max(logging.WARNING, logging.root.level))
    if logging.root.level > logging.DEBUG:
        logging.getLogger(_ACCESS).addFilter(_is_no_probe)
    logging.captureWarnings(capture=True)
    sys.excepthook = _log_uncaught


def fields_of(lease: Lease) -> Fields:
    """What a line about a run carries: its grid, its own name, the attempt and the dispatcher's generation."""
    return {
        "grid": lease.grid_id,
        "run": lease.run_id,
        "attempt": lease.attempt,
        "generation": lease.generation,
    }


def bound(**fields: str | int) -> AbstractContextManager[None]:
    """Put these fields on every line that this thread or request writes while the context lasts."""
    return structlog.contextvars.bound_contextvars(**fields)


def bind(**fields: str | int) -> None:
    """Put these fields on every further line of this thread or request."""
    structlog.contextvars.bind_contextvars(**fields)


def dask_setup(server: Any) -> None:
    """Configure the process of a Dask scheduler or worker, which preloads this module."""
    configure(read_settings(LogSettings), type(server).__name__.lower())


def _formatter(settings: LogSettings, process: str) -> logging.Formatter:
    def name_process(_logger: Any, _method: str, line: EventDict) -> EventDict:
        line["process"] = process
        line["pid"] = line["_record"].process
        return line

    chain: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.ExtraAdder(),
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        _read_access,
        name_process,
    ]
    clean = structlog.stdlib.ProcessorFormatter.remove_processors_meta
    last: list[Processor]
    if settings.log_format == "json":
        last = [clean, structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    else:
        traceback = structlog.dev.plain_traceback
        last = [clean, structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=traceback)]
    return structlog.stdlib.ProcessorFormatter(foreign_pre_chain=chain, processors=last, pass_foreign_args=True)


def _read_access(_logger: Any, _method: str, line: EventDict) -> EventDict:
    """Take uvicorn's line on a request apart, so that its status is a number and not a piece of text."""
    line.pop("color_message", None)
    arguments = line.pop("positional_args", ())
    if line["logger"] == _ACCESS and len(arguments) == 5:
        client, method, path, _, status = arguments
        line.update(event=f"{method} {path} {status}", client=client, method=method, path=path, status=status)
    return line


def _is_no_probe(record: logging.LogRecord) -> bool:
    """Whether a request came from somebody, not from a machine that asks every few seconds."""
    if not isinstance(record.args, tuple) or len(record.args) != 5:
        return True
    return str(record.args[2]).partition("?")[0] not in _PROBES


def _log_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)
        return
    logging.getLogger(__name__).critical("this process ends by an exception", exc_info=(kind, error, trace))
