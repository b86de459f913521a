"""Who asks, and what he may do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Scope(StrEnum):
    """What a token is for; each allows what those before it do.

    ``read`` looks, ``submit`` starts grids and stops or retries those of the same name, ``admin`` those of everybody.
    """

    READ = "read"
    SUBMIT = "submit"
    ADMIN = "admin"

    def allows(self, wanted: Scope) -> bool:
        """Whether this scope is, or is above, the one that is wanted."""
        order = list(Scope)
        return order.index(self) >= order.index(wanted)


class ForbiddenError(PermissionError):
    """Who asks is known, and may not do this; ``scope`` is the one that could."""

    def __init__(self, detail: str, scope: Scope) -> None:
        super().__init__(detail)
        self.scope = scope


@dataclass(frozen=True)
class Caller:
    """Who sent a request: the name of his token, None where the service asks for none."""

    name: str | None
    scope: Scope

    def require(self, wanted: Scope) -> None:
        """Let only those pass whose token allows it; a ForbiddenError for the others."""
        if not self.scope.allows(wanted):
            raise ForbiddenError(f"the token is for {self.scope}; this needs {wanted}", wanted)

    def require_owner(self, owner: str | None, what: str) -> None:
        """Let the owner of a grid pass, and the administrator; a ForbiddenError for others."""
        self.require(Scope.SUBMIT)
        if self.scope is not Scope.ADMIN and self.name != owner:
            whose = "nobody" if owner is None else owner
            raise ForbiddenError(f"{what} belongs to {whose}; only they and an administrator may do this", Scope.ADMIN)


ANYBODY = Caller(None, Scope.ADMIN)
"""Of a service that asks for no token."""
