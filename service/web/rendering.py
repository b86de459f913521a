"""Templates as answers: text is escaped, and a browser may load nothing from elsewhere."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from starlette.requests import Request
from starlette.responses import HTMLResponse

from service import VERSION

FOLDER = Path(__file__).parent
STATIC = FOLDER / "static"
MINUS = "\N{MINUS SIGN}"
HEADERS = {
    # No style in the page itself, no script of anybody's: what a name or a message holds stays text.
    "Content-Security-Policy": "default-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-cache",
    "Vary": "Accept",
}
_PRIORS = {"wide": "n in 0.3–8", "free": "n in 1–4", "fixed": "n fixed"}  # noqa: RUF001 - ranges
_STEPS = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))


def page(template: str, /, status: int = 200, headers: dict[str, str] | None = None, **values: Any) -> HTMLResponse:
    """A filled template."""
    text = _environment.get_template(template).render(**values)
    return HTMLResponse(text, status, HEADERS | (headers or {}))


def wants_page(request: Request) -> bool:
    """Whether a browser asks, for somebody to read the answer."""
    return "text/html" in request.headers.get("accept", "")


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many digits behind the point; an em dash where it is not known."""
    if value is None or not math.isfinite(value):
        return "\N{EM DASH}"
    return f"{value:.{digits}f}".replace("-", MINUS)


def signed(value: float | None, digits: int = 3) -> str:
    """A difference, with its sign."""
    if value is None or not math.isfinite(value):
        return "\N{EM DASH}"
    return f"{value:+.{digits}f}".replace("-", MINUS)


def count(value: int) -> str:
    """A whole number of any size, its thousands apart."""
    return f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def percent(value: float | None) -> str:
    """A share."""
    return "\N{EM DASH}" if value is None or not math.isfinite(value) else f"{100.0 * value:.0f} %"


def when(moment: datetime | str | None) -> str:
    """A moment in UTC, to the minute."""
    if moment is None:
        return "\N{EM DASH}"
    if isinstance(moment, str):
        moment = datetime.fromisoformat(moment)
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def duration(seconds: float | None) -> str:
    """A time in its two largest units."""
    if seconds is None:
        return "not known yet"
    if seconds < 10.0:
        return f"{seconds:.1f} s"
    for step, (size, unit) in enumerate(_STEPS):
        if seconds >= size:
            whole, rest = divmod(round(seconds), int(size))
            if unit == "s" or step + 1 == len(_STEPS):
                return f"{whole} {unit}"
            smaller, name = _STEPS[step + 1]
            return f"{whole} {unit} {rest // int(smaller)} {name}"
    return f"{seconds:.0f} s"


def estimate_name(name: str) -> str:
    """An estimate in words: the estimator, and what it assumes of the Sersic index."""
    estimator, _, prior = name.rpartition("_")
    return f"{estimator}, {_PRIORS[prior]}"


def _made() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(FOLDER / "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        auto_reload=False,
    )
    environment.filters |= {
        "number": number, "signed": signed, "percent": percent, "when": when, "duration": duration,
        "estimate_name": estimate_name, "count": count,
    }  # fmt: skip
    environment.globals |= {"version": VERSION}
    return environment


_environment = _made()
