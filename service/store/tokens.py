"""Tokens: what lets a request in. Their holders alone know them; here lie digests."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import Row, insert, select, update

from service.domain.access import Caller, Scope
from service.domain.identifiers import utc_now
from service.store.database import Database
from service.store.tables import token

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
_FORM = re.compile(r"hl_([a-z0-9]{12})_([A-Za-z0-9_-]{43})")
_NOBODY = "0" * 64
_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"


@dataclass(frozen=True)
class TokenView:
    """A token as its administrator sees it."""

    id: str
    name: str
    scope: Scope
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None

    def is_valid(self, now: datetime) -> bool:
        """Whether it lets anybody in at that moment."""
        return self.revoked_at is None and (self.expires_at is None or now < self.expires_at)


class TokenStore:
    """Tokens in the database.

    A token is ``hl_``, an id by which it is found and revoked, and 256 random bits. Those are their own salt, so a
    plain SHA-256 of the whole is kept; it is compared in constant time. Tokens of one name are one person's.
    """

    def __init__(self, database: Database, clock: Callable[[], datetime] = utc_now) -> None:
        self._database = database
        self._clock = clock

    def create(self, name: str, scope: Scope, lifetime: timedelta | None = None) -> str:
        """Make a token: what is returned is shown once and kept nowhere.

        Raises
        ------
        ValueError
            The name is none, or the lifetime is not above zero.
        """
        if not NAME.fullmatch(name):
            raise ValueError(f"the name is {name!r}; allowed are 1 to 64 letters, digits and . _ @ -, no sign first")
        if lifetime is not None and lifetime <= timedelta():
            raise ValueError(f"the lifetime is {lifetime}; allowed is one above zero")
        now = self._clock()
        number = "".join(secrets.choice(_ALPHABET) for _ in range(12))
        made = f"hl_{number}_{secrets.token_urlsafe(32)}"
        row = {"id": number, "digest": _digest(made), "name": name, "scope": scope, "created_at": now}
        with self._database.write() as connection:
            connection.execute(insert(token).values(expires_at=lifetime and now + lifetime, **row))
        return made

    def caller(self, given: str) -> Caller | None:
        """Whose token it is; None for one that is not valid, whatever is wrong with it."""
        form = _FORM.fullmatch(given)
        if form is None:
            return None
        with self._database.read() as connection:
            row = connection.execute(select(token).where(token.c.id == form[1])).one_or_none()
        is_same = hmac.compare_digest(_NOBODY if row is None else row.digest, _digest(given))
        if row is None or not is_same or not _view(row).is_valid(self._clock()):
            return None
        return Caller(row.name, Scope(row.scope))

    def tokens(self) -> list[TokenView]:
        """All of them, oldest first."""
        with self._database.read() as connection:
            return [_view(row) for row in connection.execute(select(token).order_by(token.c.created_at, token.c.id))]

    def any_valid(self) -> bool:
        """Whether anybody could come in."""
        now = self._clock()
        return any(found.is_valid(now) for found in self.tokens())

    def revoke(self, wanted: str) -> int:
        """Let a token in no more, by its id, or all of a name; how many had been valid until now."""
        now = self._clock()
        these = [found.id for found in self.tokens() if wanted in (found.id, found.name) and found.is_valid(now)]
        with self._database.write() as connection:
            still = token.c.id.in_(these) & token.c.revoked_at.is_(None)
            return connection.execute(update(token).where(still).values(revoked_at=now)).rowcount


def _digest(given: str) -> str:
    return hashlib.sha256(given.encode()).hexdigest()


def _view(row: Row[*tuple[object, ...]]) -> TokenView:
    fields = dict(row._mapping)
    del fields["digest"]
    return TokenView(**{**fields, "scope": Scope(row.scope)})
