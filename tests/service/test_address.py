"""Database URLs: options reach libpq as they are, and what it would not take is refused at once, in one line."""

from __future__ import annotations

from pathlib import Path

import psycopg
import pytest
from sqlalchemy import text

from service.store.address import NETWORK, AddressError, PostgresAddress, SqliteAddress, read_address
from service.store.database import Database


def options(url: str) -> dict[str, str]:
    """What is handed to libpq beyond the service's own."""
    found = read_address(url)
    assert isinstance(found, PostgresAddress)
    return {name: value for name, value in found.options.items() if NETWORK.get(name) != value}


@pytest.mark.parametrize(
    ("url", "wanted"),
    [
        ("postgresql://u:p@h:5433/n", {"user": "u", "password": "p", "host": "h", "port": "5433", "dbname": "n"}),
        ("postgres://u@h/n", {"user": "u", "host": "h", "dbname": "n"}),
        ("postgresql+psycopg://u@/n?host=/run/pg", {"user": "u", "host": "/run/pg", "dbname": "n"}),
        ("postgresql://u@[::1]:5433/n", {"user": "u", "host": "::1", "port": "5433", "dbname": "n"}),
        ("postgresql://u:a%40b%2Fc@h/n", {"user": "u", "password": "a@b/c", "host": "h", "dbname": "n"}),
        ("postgresql://u@a:1,b:2/n", {"user": "u", "host": "a,b", "port": "1,2", "dbname": "n"}),
        ("postgresql://u@a,b:2,[::1]:3/n", {"user": "u", "host": "a,b,::1", "port": ",2,3", "dbname": "n"}),
        ("postgresql://u:p@a,b/n", {"user": "u", "password": "p", "host": "a,b", "dbname": "n"}),
        ("postgresql://u@/n?host=a:1&host=b:2", {"user": "u", "host": "a,b", "port": "1,2", "dbname": "n"}),
        ("postgresql://u@/n?host=a,b&port=1,2", {"user": "u", "host": "a,b", "port": "1,2", "dbname": "n"}),
        ("postgresql:///n", {"dbname": "n"}),
        (
            "postgresql://h/n?connect_timeout=10&keepalives_idle=30&sslmode=require&application_name=x"
            "&options=-c%20statement_timeout%3D5s&target_session_attrs=read-write",
            {
                "host": "h", "dbname": "n", "connect_timeout": "10", "keepalives_idle": "30", "sslmode": "require",
                "application_name": "x", "options": "-c statement_timeout=5s", "target_session_attrs": "read-write",
            },
        ),
    ],
)  # fmt: skip
def test_urls_of_postgresql_become_what_libpq_calls_them(url: str, wanted: dict[str, str]) -> None:
    assert options(url) == wanted
    # And libpq takes it so.
    psycopg.conninfo.make_conninfo("", **wanted)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("postgresql://u:secret@h/n?colour=red", "colour"),
        # libpq would take what comes before the NUL, and so go to another server.
        ("postgresql://u:secret%00@h/n", "a NUL"),
        ("postgresql://u@h/n%00", "a NUL"),
        ("postgresql://u@h/n?options=%00", "a NUL"),
        ("postgresql://u:secret\udcff@h/n", "no Unicode"),
        ("sqlite:///a%00b?uri=true", "a NUL"),
        ("postgresql://u@" + "h" * 64 + "/n", "a host that is none"),
        ("postgresql://u@a,b..c/n", "a host that is none"),
        ("postgresql://u@/n?host=a..b", "a host that is none"),
        ("postgresql://u@/n?host=a,b..c", "a host that is none"),
        ("postgresql://u@h:99999/n", "the port '99999'"),
        ("postgresql://u@h:0/n", "the port '0'"),
        ("postgresql://u@a:1,b:99999/n", "the port '99999'"),
        ("postgresql://u@h/n?port=abc", "the port 'abc'"),
        ("postgresql://u:secret@h/n?prepare_threshold=0", "prepare_threshold"),
        ("postgresql://u:secret@h/n?connect_timeout=ten", "connect_timeout=ten; a whole number"),
        ("postgresql://u:secret@h/n?keepalives_idle=1.5", "keepalives_idle=1.5; a whole number"),
        ("postgresql://u:secret@h/n?sslmode=please", "sslmode=please; one of allow, disable"),
        ("postgresql://u:secret@h/n?target_session_attrs=rw", "target_session_attrs=rw; one of any"),
        ("postgresql://u:secret@h/n?sslmode=require&sslmode=allow", "sslmode more than once"),
        ("postgresql://u:secret@h:port/n", "is none"),
        ("postgresql://u:secret@a:1,b:x/n", "a host that is none"),
        ("mysql://u:secret@h/n", "another kind, mysql"),
        ("postgresql+asyncpg://u:secret@h/n", "another kind, postgresql"),
        ("secret", "is none"),
        ("", "is none"),
        ("sqlite://", "names no file"),
        ("sqlite:///:memory:", "names no file"),
        ("sqlite:////x.sqlite?mode=rwc", "mode=rwc; SQLite takes"),
        ("sqlite:////x.sqlite?colour=red", "colour=red; SQLite takes"),
    ],
)
def test_what_no_database_would_take_is_refused_in_one_line_without_the_password(url: str, said: str) -> None:
    with pytest.raises(AddressError) as told:
        Database(url)
    assert said in str(told.value)
    assert "\n" not in str(told.value)
    assert "secret" not in str(told.value)


def test_what_may_be_shown_of_a_url_has_no_password() -> None:
    for url in ("postgresql://u:secret@h/n", "postgresql://u@h/n?password=secret&sslpassword=secret"):
        assert "secret" not in str(read_address(url).url)
        database = Database(url)
        assert "secret" not in repr(database.engine) + repr(database.reader) + str(database.url)
        database.close()


@pytest.mark.parametrize(
    ("url", "file", "given"),
    [
        ("sqlite:////a/b.sqlite", "/a/b.sqlite", {}),
        ("sqlite:///file:/a/b.sqlite?mode=ro&uri=true", "/a/b.sqlite", {"mode": "ro"}),
        ("sqlite:////a/b.sqlite?mode=ro", "/a/b.sqlite", {"mode": "ro"}),
    ],
)
def test_urls_of_sqlite_become_a_file(url: str, file: str, given: dict[str, str]) -> None:
    assert read_address(url) == SqliteAddress(Path(file), given)


@pytest.mark.parametrize("name", ["plain", "with space", "100%", "a#b", "dé"])
def test_a_file_may_be_called_as_it_likes(tmp_path: Path, name: str) -> None:
    file = tmp_path / f"{name}.sqlite"
    database = Database(f"sqlite:///{file}", create=True)
    with database.write() as connection:
        connection.execute(text("CREATE TABLE one (id INTEGER)"))
    database.close()
    assert file.is_file()


@pytest.mark.postgres
def test_the_first_of_several_hosts_that_can_be_written_is_taken(migrated_postgres: str) -> None:
    folder = migrated_postgres.rpartition("host=")[2]
    database = Database(f"postgresql://hostlens@/store?host=127.0.0.1:1&host={folder}&target_session_attrs=read-write")
    assert database.revision() is not None
    database.close()
