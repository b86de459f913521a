"""How a command reaches the service, and how it tells that it could not."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.runtime.start import ConfigurationError

if TYPE_CHECKING:
    # What a command loads it loads itself: help and mistakes are told at once.
    from rich.console import Console

    from service.client import Client
    from service.runtime.settings import Settings

Url = Annotated[str | None, typer.Option("--url", envvar="HOSTLENS_URL", help="Address of the service")]
Token = Annotated[
    str | None,
    typer.Option(
        "--token", envvar="HOSTLENS_TOKEN", show_envvar=True, help="Who asks, where the service wants to know"
    ),
]


class FailedError(RuntimeError):
    """What was asked for could not be done, and may be another time."""


def console() -> Console:
    """Where results are shown."""
    from rich.console import Console  # noqa: PLC0415 - as all that a command needs

    return Console()


def settings(**changes: Any) -> Settings:
    """The settings of this machine's service; a ConfigurationError names what is wrong with them."""
    from service.runtime.settings import Settings, read_settings  # noqa: PLC0415 - as above

    return read_settings(Settings, **changes)


@contextmanager
def connected(url: str | None, token: str | None = None) -> Iterator[Client]:
    """A client of the service; where it is not served, the command ends with a line."""
    import httpx  # noqa: PLC0415 - as above

    from service.client import Client, ClientError, RequestError  # noqa: PLC0415 - as above

    try:
        # Without repetitions: who sits before a terminal wants to be told at once.
        with Client(settings().url if url is None else url, token=token, retries=0) as client:
            yield client
    except RequestError as error:
        raise ConfigurationError(str(error)) from error
    except ClientError as error:
        raise FailedError(str(error)) from error
    except httpx.RequestError as error:
        raise FailedError(f"the service does not answer: {error}") from error
