"""Logs: one line an event, with the run that it is about on it, from every process."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator

import pytest
from pydantic import ValidationError

from service.runtime import logs
from service.runtime.settings import LogSettings


@pytest.fixture
def restored() -> Iterator[None]:
    """The process's logging, as it was, after a test has configured it."""
    root = logging.root
    handlers, level, hook = root.handlers[:], root.level, sys.excepthook
    yield
    root.handlers, sys.excepthook = handlers, hook
    root.setLevel(level)
    logging.captureWarnings(capture=False)
    logging.getLogger("uvicorn.access").filters.clear()
    for name in ("httpx", "alembic", "distributed"):
        logging.getLogger(name).setLevel(logging.NOTSET)


ACCESS = '%s - "%s %s HTTP/%s" %d'


@pytest.mark.usefixtures("restored")
def test_a_line_of_json_holds_what_was_bound_what_was_said_and_where(capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure(LogSettings(log_format="json"), "tests")
    with logs.bound(grid="g_1", run="r_1", attempt=2, generation=3):
        logging.getLogger("some.module").warning("%d of \u03b8_E", 5, extra={"code": "x"})
    logging.getLogger("some.module").debug("not said")
    logging.getLogger("some.module").info("later")
    first, second = map(json.loads, capsys.readouterr().err.splitlines())
    fields = ("event", "level", "logger", "process", "grid", "run", "attempt", "generation", "code")
    told = ("5 of \u03b8_E", "warning", "some.module", "tests", "g_1", "r_1", 2, 3, "x")
    assert tuple(first[name] for name in fields) == told
    assert first["timestamp"].endswith("Z")
    assert "grid" not in second


@pytest.mark.usefixtures("restored")
def test_a_request_is_told_in_fields_and_a_probe_only_when_debugging(capsys: pytest.CaptureFixture[str]) -> None:
    access = logging.getLogger("uvicorn.access")
    logs.configure(LogSettings(log_format="json"), "api")
    access.info(ACCESS, "127.0.0.1:1", "GET", "/v1/grids?limit=1", "1.1", 200)
    access.info(ACCESS, "127.0.0.1:1", "GET", "/healthz", "1.1", 200)
    (line,) = map(json.loads, capsys.readouterr().err.splitlines())
    assert (line["method"], line["path"], line["status"]) == ("GET", "/v1/grids?limit=1", 200)
    access.filters.clear()
    logs.configure(LogSettings(log_format="json", log_level="DEBUG"), "api")
    access.info(ACCESS, "127.0.0.1:1", "GET", "/healthz", "1.1", 200)
    assert "/healthz" in capsys.readouterr().err


@pytest.mark.usefixtures("restored")
@pytest.mark.parametrize("log_format", ["text", "json"])
def test_an_exception_is_told_whole_whatever_it_says(capsys: pytest.CaptureFixture[str], log_format: str) -> None:
    logs.configure(LogSettings.model_validate({"log_format": log_format}), "tests")
    try:
        int("a\x00b")
    except ValueError as error:
        logging.getLogger("x").exception("it broke")
        sys.excepthook(type(error), error, error.__traceback__)
    said = capsys.readouterr().err
    assert said.count("Traceback (most recent call last)") == 2
    assert "it broke" in said


def test_a_level_may_be_written_small_and_an_unknown_one_is_refused() -> None:
    assert LogSettings.model_validate({"log_level": "warning"}).log_level == "WARNING"
    with pytest.raises(ValidationError, match="log_level"):
        LogSettings.model_validate({"log_level": "loud"})
