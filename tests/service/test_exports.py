"""Exports are the rows of the database to the last bit, opened again by the programs that people open them with."""

from __future__ import annotations

import asyncio
import io
import json
import math
import random
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from threading import BoundedSemaphore
from typing import Any, BinaryIO

import numpy as np
import pandas
import pytest
from astropy.io import fits
from astropy.io.votable import parse
from astropy.table import QTable, Table
from fastapi.testclient import TestClient
from pyarrow import parquet
from sqlalchemy import update

from service.api.app import create_app
from service.exports.contents import Question, stamp
from service.exports.spool import Spool, SpoolEndedError
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.grids import GridStore
from service.store.leadership import Leadership
from service.store.queue import RunQueue
from service.store.result_filter import ResultFilter
from service.store.result_rows import ResultColumn, result_rows
from service.store.tables import run
from tests.service.conftest import empty
from tests.service.plans import result_of, submit

LABEL = 'a "label", of Grünes Ω and a 🌌'
SUFFIXES = ("csv", "ecsv", "parquet", "vot", "fits")


@dataclass(frozen=True)
class Stored:
    """An API before a database with nine results of two grids."""

    client: TestClient
    database: Database
    grids: list[str]

    def rows(self, question: Question) -> tuple[tuple[ResultColumn, ...], list[tuple[Any, ...]]]:
        columns = question.columns()
        with self.database.read() as connection:
            return columns, list(result_rows(connection, question.where, question.estimates, columns))

    def file(self, suffix: str, **query: Any) -> bytes:
        answer = self.client.get(f"/v1/results.{suffix}", params=query)
        assert answer.status_code == 200, answer.text
        return answer.content


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def stored(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stored]:
    folder = tmp_path_factory.mktemp("exports")
    if request.param == "sqlite":
        from service.store.migrate import upgrade

        url = f"sqlite:///{folder / 'exports.sqlite'}"
        upgrade(url)
    else:
        url = request.getfixturevalue("migrated_postgres")
        empty(url)
    database = Database(url)
    grids = [submit(GridStore(database), 6), submit(GridStore(database), 3, seed=100)]
    generation = Leadership(database).take("test", lambda _: True)
    assert generation is not None
    for place, lease in enumerate(RunQueue(database).claim(generation, 100)):
        payload = result_of(lease)
        changes: dict[str, Any] = {"agn_contrast": None if place % 2 else 0.1 + 0.2, "profile": "draft"}
        if place % 3 == 1:
            changes |= {"estimates": payload.estimates | {"image_wide": None}, "profile": None}
        RunQueue(database).store(lease, payload.model_copy(update=changes))
    with database.write() as connection:
        connection.execute(update(run).where(run.c.grid_id == grids[1], run.c.ordinal == 1).values(label=LABEL))
        connection.execute(update(run).where(run.c.grid_id == grids[1]).values(paper_run=17))
    with TestClient(create_app(Settings(database_url=url, data_dir=folder))) as client:
        yield Stored(client, database, grids)
    database.close()


def question(**wanted: Any) -> Question:
    estimates = wanted.pop("estimates", ("image_wide",))
    return Question(ResultFilter.read(wanted), wanted, estimates)


def assert_same(found: dict[str, list[Any]], columns: tuple[ResultColumn, ...], rows: list[tuple[Any, ...]]) -> None:
    """Every value, bit for bit; found are lists by name with None where there is no value."""
    assert list(found) == [column.name for column in columns]
    for place, column in enumerate(columns):
        assert found[column.name] == [row[place] for row in rows], column.name


def of_table(table: Table, columns: tuple[ResultColumn, ...]) -> dict[str, list[Any]]:
    """What an Astropy table holds, times as times."""
    found = {}
    for column in columns:
        values: list[Any] = [None if value is np.ma.masked else value for value in table[column.name]]
        kinds = {float: float, int: int, str: str, datetime: datetime.fromisoformat}
        read = kinds[column.kind]
        found[column.name] = [
            None if value is None or (column.kind is float and math.isnan(value)) else read(value) for value in values
        ]
    return found


def assert_described(table: Table, columns: tuple[ResultColumn, ...]) -> None:
    assert str(table["magnitude_mean"].unit) == "mag"
    assert str(table["r_eff_sd"].unit) == "arcsec"
    assert str(table["lens_phi_mean"].unit) == "rad"
    assert table["surface_brightness"].unit.to_string("vounit") == "mag.arcsec**-2"
    for column in columns:
        assert table[column.name].description.startswith(column.description)


def test_ecsv_is_read_by_astropy_with_units_descriptions_and_where_it_comes_from(stored: Stored) -> None:
    columns, rows = stored.rows(question())
    assert len(rows) == 9
    table = Table.read(stored.file("ecsv").decode().splitlines(), format="ascii.ecsv")
    assert_same(of_table(table, columns), columns, rows)
    assert_described(table, columns)
    assert table.meta["filter"] == {}
    assert table.meta["rows"] == 9
    assert table.meta["estimates"] == ["image_wide"]
    assert table.meta["service"].startswith("hostlens ")
    assert set(table.meta["engines"]) == {
        row[[column.name for column in columns].index("engine_digest")] for row in rows
    }
    datetime.fromisoformat(table.meta["picture_at"])
    quantities = QTable.read(stored.file("ecsv", specs="true").decode().splitlines(), format="ascii.ecsv")
    assert quantities["system", "magnitude", "magnitude_mean"]["magnitude_mean"].unit == "mag"


def test_csv_is_read_by_pandas(stored: Stored) -> None:
    columns, rows = stored.rows(question())
    frame = pandas.read_csv(
        io.BytesIO(stored.file("csv")), dtype={column.name: str for column in columns}, keep_default_na=False
    )
    read = {str: str, int: int, float: float, datetime: datetime.fromisoformat}
    found = {column.name: [read[column.kind](t) if t else None for t in frame[column.name]] for column in columns}
    assert_same(found, columns, rows)
    plain = pandas.read_csv(io.BytesIO(stored.file("csv")))
    place = [column.name for column in columns].index("arc_magnitude")
    assert plain["arc_magnitude"].tolist() == [row[place] for row in rows]


def test_parquet_is_read_by_pyarrow_pandas_and_astropy(stored: Stored, tmp_path: Path) -> None:
    columns, rows = stored.rows(question())
    data = stored.file("parquet")
    table = parquet.read_table(io.BytesIO(data))
    found = table.to_pydict()
    found["stored_at"] = [datetime.fromisoformat(value) for value in found["stored_at"]]
    assert_same(found, columns, rows)
    assert table.schema.field("r_eff_mean").metadata[b"unit"] == b"arcsec"
    frame = pandas.read_parquet(io.BytesIO(data))
    assert frame["magnitude_bias"].tolist()[0] == rows[0][[column.name for column in columns].index("magnitude_bias")]
    assert frame["profile"].isna().tolist() == [value is None for value in found["profile"]]
    (tmp_path / "it.parquet").write_bytes(data)
    read = Table.read(tmp_path / "it.parquet")
    assert_described(read, columns)
    assert read.meta["filter"] == {}
    for place, column in enumerate(columns):
        if column.kind is float:
            expected = [math.nan if row[place] is None else row[place] for row in rows]
            assert np.array_equal(read[column.name], expected, equal_nan=True)


def test_parquet_carries_the_votable_that_voparquet_asks_for(stored: Stored, tmp_path: Path) -> None:
    columns, _ = stored.rows(question())
    (tmp_path / "it.parquet").write_bytes(stored.file("parquet"))
    metadata = parquet.read_schema(tmp_path / "it.parquet").metadata
    assert metadata[b"IVOA.VOTable-Parquet.version"] == b"1.0"
    assert b'<PARQUET type="Parquet-local-XML"/>' in metadata[b"IVOA.VOTable-Parquet.content"]
    table = Table.read(tmp_path / "it.parquet", format="parquet.votable")
    assert len(table) == 9
    assert_described(table, columns)


def test_votable_is_read_by_astropy(stored: Stored) -> None:
    columns, rows = stored.rows(question())
    file = parse(io.BytesIO(stored.file("vot")), verify="exception")
    table = file.get_first_table().to_table(use_names_over_ids=True)
    # Astropy reads the bit that says of a number that it is not there, and of a text it does not.
    found = {
        name: [None if value == "" else value for value in values] for name, values in of_table(table, columns).items()
    }
    assert_same(found, columns, rows)
    assert_described(table, columns)
    infos = {info.name: info.value for info in file.resources[0].infos}
    assert json.loads(infos["estimates"]) == ["image_wide"]
    assert infos["rows"] == "9"


def test_fits_is_read_by_astropy(stored: Stored) -> None:
    columns, rows = stored.rows(question())
    data = stored.file("fits")
    with fits.open(io.BytesIO(data)) as units:
        units.verify("exception")
        header = units["RESULTS"].header
        assert json.loads(header["FILTER"]) == {}
        assert header["CREATOR"].startswith("hostlens ")
        assert len(json.loads(header["ENGINES"])) == 1
    assert len(data) % 2880 == 0
    table = Table.read(io.BytesIO(data), format="fits", hdu="RESULTS")
    escaped = LABEL.encode("ascii", "backslashreplace").decode()
    expected = [tuple(escaped if value == LABEL else value for value in row) for row in rows]
    assert_same(of_table(table, columns), columns, expected)
    assert_described(table, columns)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_has_the_filter_the_estimates_and_the_specs_that_were_asked_for(
    stored: Stored, suffix: str, tmp_path: Path
) -> None:
    query = {"grid": stored.grids[1], "estimator": "all", "specs": "true"}
    (tmp_path / f"it.{suffix}").write_bytes(stored.file(suffix, **query))
    formats = {"csv": "ascii.csv", "ecsv": "ascii.ecsv", "parquet": "parquet", "vot": "votable", "fits": "fits"}
    table = Table.read(tmp_path / f"it.{suffix}", format=formats[suffix])
    assert len(table) == 3
    assert set(table["grid_id"]) == {stored.grids[1]}
    first = stored.client.get(f"/v1/runs/{table['run_id'][0]}").json()
    assert json.loads(table["spec"][0]) == first["spec"]
    assert json.loads(table["versions"][0]) == first["result"]["versions"]
    assert table["paper_fixed_magnitude_mean"][0] == first["result"]["estimates"]["paper_fixed"]["magnitude"]["mean"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_nothing_found_is_a_file_without_rows(stored: Stored, suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"it.{suffix}").write_bytes(stored.file(suffix, system="HE9999"))
    formats = {"csv": "ascii.csv", "ecsv": "ascii.ecsv", "parquet": "parquet", "vot": "votable", "fits": "fits"}
    table = Table.read(tmp_path / f"it.{suffix}", format=formats[suffix])
    assert len(table) == 0
    assert table.colnames == [column.name for column in question().columns()]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_head_names_the_file_and_its_type(stored: Stored, suffix: str) -> None:
    head = stored.client.head(f"/v1/results.{suffix}", params={"grid": stored.grids[0]})
    assert (head.status_code, head.content) == (200, b"")
    name = head.headers["content-disposition"]
    assert name.startswith(f'attachment; filename="hostlens-{stored.grids[0]}-')
    assert name.endswith(f'Z.{suffix}"')
    assert head.headers["content-type"]


def test_what_cannot_be_asked_is_a_problem_before_the_first_byte(stored: Stored) -> None:
    for query in ("magnitude=bright", "colour=red", "estimator=none", "limit=3", "specs=maybe"):
        answer = stored.client.get(f"/v1/results.fits?{query}")
        assert answer.status_code == 422
        assert answer.headers["content-type"] == "application/problem+json"
    assert stored.client.get("/v1/results.xlsx").status_code == 404


def test_what_is_stored_while_it_is_written_is_not_in_it(stored: Stored, monkeypatch: pytest.MonkeyPatch) -> None:
    from service.exports import contents

    pieces = contents.pieces
    late = "a name that was given later"

    def after_first(connection: Any, asked: Question, columns: Any) -> Iterator[Any]:
        with stored.database.write() as writer:
            writer.execute(update(run).where(run.c.grid_id == stored.grids[0]).values(label=late))
        yield from pieces(connection, asked, columns)

    monkeypatch.setattr("service.api.exports.pieces", after_first)
    assert late.encode() not in stored.file("csv")
    monkeypatch.undo()
    assert late.encode() in stored.file("csv")


def test_times_are_all_of_one_length() -> None:
    from datetime import UTC

    assert {len(stamp(datetime(2026, 1, 1, 0, 0, second, tzinfo=UTC))) for second in (0, 59)} == {32}


def test_a_writer_ends_when_its_reader_has_gone() -> None:
    async def go() -> BaseException | None:
        spool, ended = Spool(60.0), []

        def endless(sink: BinaryIO) -> None:
            try:
                while True:
                    sink.write(b"x" * 2**16)
            except OSError as error:
                ended.append(error)
                raise

        with ThreadPoolExecutor(1) as threads:
            writing = threads.submit(spool.fill, endless)
            await spool.begun()
            spool.abandon()
            await asyncio.wrap_future(writing)
        return ended[0] if ended else None

    assert isinstance(asyncio.run(asyncio.wait_for(go(), 60)), SpoolEndedError)


def test_what_goes_wrong_on_the_way_ends_the_file_and_says_so() -> None:
    async def go(before: int) -> bytes:
        spool = Spool(60.0)

        def broken(sink: BinaryIO) -> None:
            sink.write(b"x" * before)
            raise LookupError("on purpose")

        with ThreadPoolExecutor(1) as threads:
            threads.submit(spool.fill, broken)
            await spool.begun()
            return b"".join([data async for data in spool.read_all()])

    for before in (0, 2**20):
        with pytest.raises(LookupError, match="on purpose"):
            asyncio.run(go(before))


def test_a_picture_is_not_held_for_longer_than_allowed() -> None:
    async def go() -> None:
        spool = Spool(0.0)
        with ThreadPoolExecutor(1) as threads:
            threads.submit(spool.fill, lambda sink: sink.write(b"x"))
            await spool.begun()

    with pytest.raises(SpoolEndedError, match="longer than is allowed"):
        asyncio.run(go())


def test_a_reader_gets_every_byte_whether_it_is_faster_or_slower() -> None:
    wanted = random.Random(1).randbytes(3 * 2**20 + 17)

    async def go(pause_s: float) -> bytes:
        spool = Spool(60.0)
        with ThreadPoolExecutor(1) as threads:
            threads.submit(
                spool.fill, lambda sink: [sink.write(wanted[at : at + 1000]) for at in range(0, len(wanted), 1000)]
            )
            await spool.begun()
            found = []
            async for data in spool.read_all():
                found.append(data)
                await asyncio.sleep(pause_s)
            return b"".join(found)

    for pause_s in (0.0, 0.01):
        assert asyncio.run(go(pause_s)) == wanted


def test_more_exports_at_a_time_than_there_are_places_are_told_to_come_again(
    stored: Stored, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = BoundedSemaphore(1)
    monkeypatch.setattr("service.api.exports._places", places)
    assert places.acquire(blocking=False)
    full = stored.client.get("/v1/results.csv")
    assert (full.status_code, full.headers["retry-after"]) == (503, "5")
    places.release()
    for _ in range(3):
        assert stored.client.get("/v1/results.csv").status_code == 200
        assert places.acquire(timeout=60), "a place was not given back"
        places.release()


def test_a_database_that_is_away_is_a_problem_before_the_first_byte(tmp_path: Path) -> None:
    with TestClient(
        create_app(Settings(database_url=f"sqlite:///{tmp_path / 'none.sqlite'}", data_dir=tmp_path))
    ) as client:
        answer = client.get("/v1/results.parquet")
    assert (answer.status_code, answer.headers["content-type"]) == (503, "application/problem+json")
