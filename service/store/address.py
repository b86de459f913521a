"""Where a database is: a URL taken apart into what SQLite or libpq want to know, and refused where they would not."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError

_SQLITE, _POSTGRES = (
    frozenset({"sqlite", "sqlite+pysqlite"}),
    frozenset({"postgresql", "postgres", "postgresql+psycopg"}),
)
_SQLITE_OPTIONS = {"uri": {"true", "1"}, "mode": {"ro", "rw"}, "immutable": {"0", "1"}, "nolock": {"0", "1"}}
_SURROGATE = re.compile("[\ud800-\udfff]")
"""Half a character, which stands for bytes that are no text."""
_HOSTS = re.compile(r"(?P<before>[\w+]+://(?:[^@]*@)?)(?P<hosts>[^@/?]*,[^@/?]*)(?P<after>[/?].*)?", re.DOTALL)
_HOST = re.compile(r"(?P<host>\[[^\]]*\]|[^:]*)(?::(?P<port>\d*))?")
_NUMBERS = frozenset(
    {
        "connect_timeout", "keepalives", "keepalives_idle", "keepalives_interval", "keepalives_count",
        "tcp_user_timeout",
    }
)  # fmt: skip
_CHOICES = {
    "sslmode": {"disable", "allow", "prefer", "require", "verify-ca", "verify-full"},
    "gssencmode": {"disable", "prefer", "require"},
    "channel_binding": {"disable", "prefer", "require"},
    "load_balance_hosts": {"disable", "random"},
    "target_session_attrs": {"any", "read-write", "read-only", "primary", "standby", "prefer-standby"},
}
NETWORK = {
    "connect_timeout": "5",
    # A server whose machine is gone says nothing more: after half a minute without an answer to what was sent, or to
    # three questions whether it is there, it is taken for away. The system's own patience is up to two hours.
    "keepalives_idle": "10",
    "keepalives_interval": "5",
    "keepalives_count": "3",
    "tcp_user_timeout": "30000",
}


class AddressError(ValueError):
    """A database URL that is not acceptable; the text is one line without the password."""


class DriverMissingError(AddressError):
    """PostgreSQL without the extra that brings its driver: nothing can be said of the URL's options."""


@dataclass(frozen=True)
class SqliteAddress:
    """A file, and SQLite's own options for it."""

    file: Path
    options: Mapping[str, str]

    @property
    def url(self) -> URL:
        """What may be shown."""
        return URL.create("sqlite", database=str(self.file))


@dataclass(frozen=True)
class PostgresAddress:
    """Options of libpq by their names, several hosts as libpq writes them."""

    options: Mapping[str, str]

    @property
    def url(self) -> URL:
        """What may be shown: without password and options."""
        host, name = self.options.get("host"), self.options.get("dbname")
        return URL.create("postgresql+psycopg", self.options.get("user"), host=host, database=name)


def read_address(text: str) -> SqliteAddress | PostgresAddress:
    """Take a database URL apart.

    Besides SQLAlchemy's form that of libpq is taken (``//user@first:5432,second:5432/name``), with its options.

    Raises
    ------
    AddressError
        Another kind of database, or an option that is unknown or has no such value.
    """
    # What follows a NUL the drivers' C code does not see: the host, say.
    if "\x00" in unquote(text) or _SURROGATE.search(text):
        raise AddressError("the database URL has a NUL or what is no Unicode")
    several = _HOSTS.fullmatch(text)
    try:
        url = make_url(text if several is None else several["before"] + (several["after"] or ""))
    except (ArgumentError, ValueError):
        # Neither the text nor SQLAlchemy's own words for it: a password may be anywhere in them.
        raise AddressError(
            "the database URL is none: sqlite:///file or postgresql://user@host/name is expected"
        ) from None
    if url.drivername in _SQLITE:
        return _sqlite(url)
    if url.drivername in _POSTGRES:
        return _postgres(url, [] if several is None else several["hosts"].split(","))
    raise AddressError(f"the database URL is of another kind, {url.drivername}: sqlite or postgresql is expected")


def _sqlite(url: URL) -> SqliteAddress:
    options = {name: _once(name, value) for name, value in url.query.items()}
    for name, value in options.items():
        if value not in _SQLITE_OPTIONS.get(name, ()):
            allowed = "; ".join(f"{known}={'|'.join(sorted(values))}" for known, values in _SQLITE_OPTIONS.items())
            raise AddressError(f"the database URL has {name}={value}; SQLite takes {allowed}")
    name = url.database or ""
    if options.pop("uri", None) is not None:
        name = unquote(name.removeprefix("file:"))
    if name in {"", ":memory:"}:
        raise AddressError("the database URL names no file: API and dispatcher could not share it")
    return SqliteAddress(Path(name).absolute(), options)


def _postgres(url: URL, hosts: list[str]) -> PostgresAddress:
    try:
        from psycopg.pq import Conninfo  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise DriverMissingError(f"PostgreSQL needs hostlens with its extra postgres: {error}") from None
    known = {option.keyword.decode() for option in Conninfo.get_defaults()}
    query = dict(url.query)
    given = query.pop("host", ())
    options = {name: _once(name, value) for name, value in query.items()}
    for name, value in options.items():
        if name not in known:
            raise AddressError(f"the database URL has an option that libpq does not know: {name}")
        if name in _NUMBERS and not re.fullmatch(r"\s*-?\d+\s*", value):
            raise AddressError(f"the database URL has {name}={value}; a whole number is expected")
        if name == "port":
            _require_ports(value.split(","))
        if name in _CHOICES and value not in _CHOICES[name]:
            allowed = ", ".join(sorted(_CHOICES[name]))
            raise AddressError(f"the database URL has {name}={value}; one of {allowed} is expected")
    plain = {"user": url.username, "password": url.password, "dbname": url.database}
    options = {**{name: str(value) for name, value in plain.items() if value}, **options}
    if not hosts and url.host is not None:
        port = "" if url.port is None else url.port
        hosts = [f"[{url.host}]:{port}" if ":" in url.host else f"{url.host}:{port}"]
    hosts = hosts or ([given] if isinstance(given, str) else list(given))
    return PostgresAddress({**NETWORK, **options, **_hosts(hosts)})


def _hosts(hosts: list[str]) -> dict[str, str]:
    """``host`` and ``port`` of libpq, with as many entries each where there are several."""
    if len(hosts) == 1 and (hosts[0].startswith("/") or "," in hosts[0]):
        _require_hosts([name for name in hosts[0].split(",") if not name.startswith("/")])
        return {"host": hosts[0]}  # a socket's folder, or what libpq takes as it is
    found = [_HOST.fullmatch(host) for host in hosts]
    if None in found:
        raise AddressError("the database URL has a host that is none")
    names = [match["host"].strip("[]") for match in found if match is not None]
    ports = [match["port"] or "" for match in found if match is not None]
    _require_hosts(names)
    _require_ports(ports)
    return {**({"host": ",".join(names)} if names else {}), **({"port": ",".join(ports)} if any(ports) else {})}


def _require_hosts(names: list[str]) -> None:
    """Names that can be asked for: each label of 1 to 63 characters."""
    for name in names:
        try:
            name.encode("idna")
        except UnicodeError:
            raise AddressError(f"the database URL has a host that is none: {name[:80]!r}") from None


def _require_ports(ports: list[str]) -> None:
    for port in ports:
        if port and not (re.fullmatch(r"[0-9]{1,5}", port) and 0 < int(port) < 65536):
            raise AddressError(f"the database URL has the port {port[:80]!r}; one of 1 to 65535 is expected")


def _once(name: str, value: str | tuple[str, ...]) -> str:
    if not isinstance(value, str):
        raise AddressError(f"the database URL has the option {name} more than once")
    return value
