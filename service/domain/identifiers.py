"""Identifiers that sort by time, so that a primary key is also the order of arrival and a page's cursor."""

from __future__ import annotations

import secrets
from datetime import UTC, datetime

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"  # Crockford's base 32: no i, l, o, u to misread
_BODY = r"[0-9a-hjkmnp-tv-z]{26}"
GRID_PATTERN = rf"^g_{_BODY}$"
RUN_PATTERN = rf"^r_{_BODY}_[0-9]{{7}}$"


def utc_now() -> datetime:
    """The present, in UTC. The store takes it as a parameter, so that tests can hold the clock."""
    return datetime.now(UTC)


def new_grid_id(now: datetime) -> str:
    """``g_`` and 26 characters: 48 bits of milliseconds, then 82 random bits."""
    number = (int(now.timestamp() * 1000) << 82) | secrets.randbits(82)
    return "g_" + "".join(_ALPHABET[(number >> shift) & 31] for shift in range(125, -1, -5))


def run_id(grid_id: str, ordinal: int) -> str:
    """Identifier of the run at place ``ordinal`` of a grid: sorts as the grid's runs do."""
    return f"r_{grid_id[2:]}_{ordinal:07d}"


def new_token() -> str:
    """A claim's token; nobody can guess another's."""
    return secrets.token_hex(16)
