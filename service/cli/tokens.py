"""The commands ``hostlens token``: who may come in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from service.domain.access import Scope

if TYPE_CHECKING:
    from service.store.tokens import TokenStore

tokens = typer.Typer(no_args_is_help=True, help="Tokens, which let people and programs in.")


@tokens.command()
def create(
    name: Annotated[str, typer.Argument(help="Of who gets it: the owner of the grids that it submits")],
    scope: Annotated[Scope, typer.Option(help="Each allows what those before it do")] = Scope.SUBMIT,
    expires: Annotated[str | None, typer.Option(metavar="AGE", help="As 90d, 12h or 4w; never without")] = None,
) -> None:
    """Make a token. It is shown this once: the database keeps a digest."""
    from service.cli.pruning import read_age  # noqa: PLC0415 - loads the store

    try:
        lifetime = None if expires is None else read_age(expires)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--expires") from error
    with _store() as store:
        try:
            typer.echo(store.create(name, scope, lifetime))
        except ValueError as error:
            raise typer.BadParameter(str(error), param_hint="NAME") from error


@tokens.command("list")
def show() -> None:
    """All tokens, oldest first, with their ids; never the tokens themselves."""
    from rich.console import Console  # noqa: PLC0415 - as all that a command needs
    from rich.table import Table  # noqa: PLC0415 - as above

    from service.domain.identifiers import utc_now  # noqa: PLC0415 - as above

    shown = Table("id", "name", "scope", "created", "expires", "state")
    now = utc_now()
    with _store() as store:
        for found in store.tokens():
            state = "revoked" if found.revoked_at else "valid" if found.is_valid(now) else "expired"
            expires = "never" if found.expires_at is None else f"{found.expires_at:%Y-%m-%d %H:%M}"
            shown.add_row(found.id, found.name, found.scope, f"{found.created_at:%Y-%m-%d %H:%M}", expires, state)
    Console().print(shown)


@tokens.command()
def revoke(wanted: Annotated[str, typer.Argument(help="A token's id, or the name of all that are to go")]) -> None:
    """Let a token in no more, from the next request on."""
    with _store() as store:
        revoked = store.revoke(wanted)
    if not revoked:
        raise typer.BadParameter(f"there is no valid token of the id or name {wanted!r}")
    typer.echo(f"{revoked} revoked")


@contextmanager
def _store() -> Iterator[TokenStore]:
    """The tokens of the database that the settings name."""
    from sqlalchemy.exc import DBAPIError  # noqa: PLC0415 - as all that a command needs

    from service.runtime import preflight  # noqa: PLC0415 - as above
    from service.runtime.settings import Settings, read_settings  # noqa: PLC0415 - as above
    from service.store.database import Database  # noqa: PLC0415 - as above
    from service.store.faults import AWAY, one_line  # noqa: PLC0415 - as above
    from service.store.tokens import TokenStore  # noqa: PLC0415 - as above

    settings = read_settings(Settings)
    preflight.require_database(settings)
    database = Database(settings.database, pooled=False)
    try:
        database.require_schema()
        yield TokenStore(database)
    except DBAPIError as error:
        told = error if isinstance(error, AWAY) else one_line(error.orig or error)
        raise ConnectionError(f"the database refuses: {told}") from error
    finally:
        database.close()
