"""The command ``hostlens``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException

import service
from service.cli import grids, pictures
from service.cli.accuracy import accuracy
from service.cli.codes import compare_codes
from service.cli.connection import FailedError, console
from service.cli.connection import settings as _settings
from service.cli.figures import figures
from service.cli.frontier import frontier
from service.cli.measuring import measure
from service.cli.predict import predict
from service.cli.replay import replay
from service.cli.study import study
from service.cli.tokens import tokens
from service.runtime.start import CONFIGURATION, ConfigurationError

if TYPE_CHECKING:
    # What a command loads it loads itself: help and mistakes are told at once.
    from service.runtime.settings import Settings

_ARGUMENTS_WANTED = "NoArgsIsHelpError"


class _CommandLine(TyperGroup):
    """Where every refusal becomes one line on standard error, and a mistake of ours stays a traceback.

    The exit code is 2 where something else has to be asked for, 1 where the same may succeed another time.
    """

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run a command; SystemExit in any case."""
        try:
            code = super().main(*args, **{**extra, "standalone_mode": False})
        except TyperException as error:
            if type(error).__name__ == _ARGUMENTS_WANTED:
                typer.echo(error.format_message())
                raise SystemExit(CONFIGURATION) from None
            self._refuse(error.format_message(), error.exit_code)
        except ConfigurationError as error:
            self._refuse(str(error), CONFIGURATION)
        except (FailedError, OSError, typer.Abort) as error:
            self._refuse(str(error) or "given up", 1)
        raise SystemExit(code if isinstance(code, int) else 0)

    def _refuse(self, message: str, code: int) -> NoReturn:
        typer.echo(f"hostlens: {' '.join(message.split())}", err=True)
        raise SystemExit(code) from None


app = typer.Typer(
    name="hostlens",
    cls=_CommandLine,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its boxes take as long to load as all the rest of the help
    help="How faithfully can the host galaxy of a lensed quasar be reconstructed?",
)
database = typer.Typer(no_args_is_help=True, help="The database.")
app.add_typer(database, name="db")
app.add_typer(tokens, name="token")
for command in (
    *grids.COMMANDS, *pictures.COMMANDS, frontier, predict, figures, accuracy, measure, compare_codes, replay, study,
):  # fmt: skip
    app.command()(command)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(service.VERSION)
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True)] = False,
) -> None:
    """Simulate lensed quasars, reconstruct their hosts, and keep the biases."""


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Where the API listens")] = None,
    port: Annotated[int | None, typer.Option(help="Port of the API")] = None,
    workers: Annotated[int | None, typer.Option(help="Worker processes")] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Folder of database and artefacts")] = None,
) -> None:
    """Run the service (API, dispatcher, workers) until Ctrl-C."""
    from service.runtime import logs  # noqa: PLC0415 - alembic takes a while, and status needs none
    from service.runtime.supervisor import serve as supervise  # noqa: PLC0415 - as above

    settings = _settings(host=host, port=port, workers=workers, data_dir=data_dir)
    logs.configure(settings, "supervisor")
    with _migrating():
        code = supervise(settings, lambda: typer.echo(f"hostlens serves {settings.url}; Ctrl-C ends it"))
    raise typer.Exit(code)


@app.command()
def api() -> None:
    """Run one API process alone."""
    settings = _settings()
    from service.api.serve import serve as serve_api  # noqa: PLC0415 - takes long, and a mistake is told before

    serve_api(settings)


@app.command()
def dispatcher() -> None:
    """Run one dispatcher process alone; a second one stands by."""
    settings = _settings()
    from service.dispatcher.dispatch import dispatch  # noqa: PLC0415 - as above: loads Dask

    raise typer.Exit(dispatch(settings))


@app.command()
def scheduler(
    host: Annotated[str, typer.Option(help="Where it listens; whoever reaches it can run code on the workers")],
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port for dispatcher and workers")] = 8786,
    health: Annotated[str, typer.Option(help="Address of /health and /metrics")] = "127.0.0.1:8787",
) -> None:
    """Run a Dask scheduler for workers on several machines."""
    settings = _settings()
    from service.dispatcher import standalone  # noqa: PLC0415 - as above

    standalone.become(settings, standalone.scheduler_arguments(settings, host, port, health))


@app.command()
def worker(
    address: Annotated[str, typer.Argument(envvar="HOSTLENS_SCHEDULER_ADDRESS", help="Of the scheduler")],
    workers: Annotated[int, typer.Option(min=1, help="Processes, of one thread each")] = 1,
    health: Annotated[str, typer.Option(help="Address of /health and /metrics of the first")] = "127.0.0.1:0",
) -> None:
    """Run workers for a scheduler, here or on another machine."""
    settings = _settings(scheduler_address=address, cluster="address")
    from service.dispatcher import standalone  # noqa: PLC0415 - as above

    standalone.become(settings, standalone.worker_arguments(settings, address, workers, health))


@app.command()
def demo(
    data_dir: Annotated[Path, typer.Option(help="Folder of the demo's database and figures")] = Path("var/demo"),
) -> None:
    """Four runs of HE0435-1223 through the whole system. Exit code 0 only if all four were stored."""
    from service.cli.demo import demo as run_demo  # noqa: PLC0415 - alembic takes a while, and status needs none

    _silence_migrations()
    raise typer.Exit(run_demo(_settings(data_dir=data_dir), console()))


@app.command()
def check(
    database_url: Annotated[
        str | None, typer.Option("--database", help="URL of an empty database; a SQLite file of its own without")
    ] = None,
) -> None:
    """See whether this installation keeps its promise. Processes are killed, each result is stored once; 2 minutes."""
    from service.cli.check import check as carry_out  # noqa: PLC0415 - loads SQLAlchemy
    from service.runtime import preflight  # noqa: PLC0415 - as above

    _silence_migrations()
    if database_url is not None:
        preflight.require_database(_settings(database_url=database_url))
    with _migrating():
        code = carry_out(console(), database_url)
    raise typer.Exit(code)


@database.command("upgrade")
def db_upgrade(revision: Annotated[str, typer.Argument(help="Which; the newest without")] = "head") -> None:
    """Bring the database to a newer schema, by default the newest; may be repeated, by several at once."""
    from service.store import migrate  # noqa: PLC0415 - alembic takes a while, and status needs none

    _require_revision(revision, "head")
    settings = _database_settings()
    with _migrating():
        migrate.upgrade(settings.database, revision)
    typer.echo(f"the database is at revision {migrate.current(settings.database)}")


@database.command("downgrade")
def db_downgrade(
    revision: Annotated[str, typer.Argument(help="Which, or base: no tables at all")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask")] = False,
) -> None:
    """Take the database back to an older schema; what only the newer one has is lost. Stop the service first."""
    from service.store import migrate  # noqa: PLC0415 - alembic takes a while, and status needs none

    _require_revision(revision, "base")
    settings = _database_settings()
    if not yes:
        typer.confirm(f"take the database back to revision {revision}?", abort=True)
    with _migrating():
        migrate.downgrade(settings.database, revision)
    typer.echo(f"the database is at revision {migrate.current(settings.database) or 'base'}")


@database.command("current")
def db_current() -> None:
    """Revision of the database, and the one that this hostlens expects."""
    from service.store import migrate  # noqa: PLC0415 - alembic takes a while, and status needs none

    with _migrating():
        found = migrate.current(_database_settings().database)
    typer.echo(f"database {found or 'base'}, code {migrate.revisions()[-1]}")


@database.command("check")
def db_check() -> None:
    """Whether the database is what this hostlens expects; exit code 1 where it is not."""
    from service.store import migrate  # noqa: PLC0415 - alembic takes a while, and status needs none

    with _migrating():
        found = migrate.differences(_database_settings().database)
    if found is not None:
        raise FailedError(found)
    typer.echo("the database is what the code expects")


def _silence_migrations() -> None:
    import logging  # noqa: PLC0415 - help needs none

    logging.getLogger("alembic").setLevel(logging.WARNING)


def _require_revision(revision: str, other: str) -> None:
    from service.store import migrate  # noqa: PLC0415 - alembic takes a while, and status needs none

    allowed = (*migrate.revisions(), other)
    if revision not in allowed:
        raise typer.BadParameter(f"there is no revision {revision!r}: allowed is one of {', '.join(allowed)}")


def _database_settings() -> Settings:
    """The settings, with a database that can be used as far as this machine is concerned."""
    from service.runtime import preflight  # noqa: PLC0415 - loads SQLAlchemy

    settings = _settings()
    if settings.database_url is None:
        preflight.require_data(settings)
    preflight.require_database(settings)
    return settings


@database.command("prune")
def db_prune(
    older_than: Annotated[str, typer.Option("--older-than", metavar="AGE", help="As 90d, 12h or 4w")],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would go, and delete nothing")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask")] = False,
) -> None:
    """Delete old events, attempts and keys of grids that have ended, and files that no result refers to.

    First it shows what would go, and what stays and why. The service may run meanwhile.
    """
    from service.cli import pruning  # noqa: PLC0415 - loads fsspec
    from service.runtime import preflight  # noqa: PLC0415 - loads fsspec

    try:
        age = pruning.read_age(older_than)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--older-than") from error
    settings = _database_settings()
    preflight.require_artefacts(settings)
    with _migrating():
        raise typer.Exit(pruning.prune(settings, age, console(), dry_run=dry_run, ask=not yes))


@contextmanager
def _migrating() -> Iterator[None]:
    """Where a refusal of the database or of a migration ends the command with a line instead of a traceback."""
    from sqlalchemy.exc import DBAPIError  # noqa: PLC0415 - as alembic

    from service.store.faults import AWAY, MigrationError, one_line  # noqa: PLC0415 - as above

    _silence_migrations()
    try:
        yield
    except MigrationError as error:
        raise FailedError(str(error)) from error
    except DBAPIError as error:
        told = error if isinstance(error, AWAY) else one_line(error.orig or error)
        raise FailedError(f"the database refuses: {told}") from error
