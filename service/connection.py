"""A connection to a service: requests as they can be sent, refusals as errors, and repetitions."""

from __future__ import annotations

import json
import re
import time
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

_TIMEOUT_S = 60.0
_PAUSE_S = 0.1
"""Before the first repetition of a request that did not get through; twice as long before each further one."""

T = TypeVar("T", bound=BaseModel)


class ClientError(RuntimeError):
    """The service did not do what it was asked for."""


class ApiError(ClientError):
    """The API refused a request; ``problem`` is its answer."""

    def __init__(self, status: int, problem: dict[str, Any]) -> None:
        # The places say what the detail says as a whole.
        places = map(_told, _places(problem))
        super().__init__("; ".join(places) or str(problem.get("detail") or problem.get("title") or f"status {status}"))
        self.status = status
        self.problem = problem


class AnswerError(ClientError):
    """Whatever answers there is no hostlens, or one that this client does not know."""


class RequestError(ClientError, ValueError):
    """The request cannot be sent: the address, the key or a value is not one."""


class Connection:
    """Carries requests to one service; see :class:`service.client.Client` for the parameters and the errors."""

    def __init__(self, url: str, transport: httpx.BaseTransport | None, token: str | None, retries: int) -> None:
        _require_address(url)
        self.url = _without_password(url)
        self._retries = retries
        headers = {} if token is None else {"Authorization": f"Bearer {printable('token', token)}"}
        self._http = httpx.Client(
            base_url=url, timeout=_TIMEOUT_S, transport=transport, trust_env=False, headers=headers
        )

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def call(self, kind: type[T], method: str, address: str, repeatable: bool = False, **options: Any) -> T:
        """What the service answers; ``repeatable`` is a request that may be carried out twice, as each GET is."""
        answer = self._answer(method, address, repeatable, **options)
        try:
            return kind.model_validate_json(answer.content)
        except ValidationError:
            said = f"status {answer.status_code}, {answer.headers.get('content-type', 'no content type')}"
            raise AnswerError(f"what answers at {self.url} is not hostlens as this client knows it: {said}") from None

    def file(self, address: str) -> bytes:
        """A file that the service gives."""
        answer = self._answer("GET", address)
        if answer.status_code != httpx.codes.OK:
            raise AnswerError(f"what answers at {self.url} is not hostlens: status {answer.status_code}")
        return answer.content

    def _answer(self, method: str, address: str, repeatable: bool = False, **options: Any) -> httpx.Response:
        left = self._retries if repeatable or method == "GET" else 0
        pause = _PAUSE_S
        while True:
            try:
                answer = self._http.request(method, address, **options)
            except (httpx.NetworkError, httpx.RemoteProtocolError):
                # The latter where a connection ends before the answer does: the process that gave it has ended.
                if not left:
                    raise
            else:
                if answer.is_error:
                    raise ApiError(answer.status_code, _problem(answer))
                return answer
            time.sleep(pause)
            left, pause = left - 1, 2 * pause


def printable(what: str, text: str) -> str:
    """A header as it can be sent."""
    if not (text.isascii() and text.isprintable()):
        # A token is a secret, even one that is none.
        given = "" if what == "token" else f" is {text!r},"
        raise RequestError(f"the {what}{given or ' has others;'} allowed are printable ASCII characters")
    return text


def _require_address(url: str) -> None:
    try:
        parsed = httpx.URL(url)
        acceptable = parsed.scheme in {"http", "https"} and bool(parsed.host) and (parsed.port or 1) < 65536
    except (httpx.InvalidURL, ValueError, TypeError):
        acceptable = False
    if not acceptable:
        raise RequestError(
            f"the address of the service is {_without_password(url)!r}, allowed is one as http://127.0.0.1:8421"
        )


def _without_password(url: str) -> str:
    return re.sub(r"//[^/]*@", "//***@", url)


def as_json(request: dict[str, Any]) -> bytes:
    """A body."""
    try:
        return json.dumps(request, ensure_ascii=False, allow_nan=False).encode()
    except UnicodeEncodeError:
        raise RequestError("the request holds text that is not Unicode") from None
    except TypeError as error:
        raise RequestError(f"the request holds what JSON cannot say: {error}") from None
    except (ValueError, RecursionError):
        raise RequestError("the request holds a number that is not finite, or is nested too deeply") from None


def _problem(answer: httpx.Response) -> dict[str, Any]:
    """What the API says of an error; where something else answers, the words of its status."""
    plain = {"title": f"status {answer.status_code} {answer.reason_phrase}".strip()}
    if not answer.headers.get("content-type", "").startswith("application/problem+json"):
        return plain
    try:
        said = answer.json()
    except (ValueError, RecursionError):
        return plain
    return said if isinstance(said, dict) else plain


def _told(place: dict[str, Any]) -> str:
    """Where something is wrong and what, without the place where the message begins with it anyway."""
    where, message = str(place.get("pointer") or place.get("in")), str(place.get("message"))
    field = re.escape(where.strip("/").partition("/")[0])
    return message if re.match(rf"{field}(\W\S*)?: ", message) else f"{where}: {message}"


def _places(problem: dict[str, Any]) -> list[dict[str, Any]]:
    places = problem.get("errors")
    return [place for place in places if isinstance(place, dict)] if isinstance(places, list) else []
