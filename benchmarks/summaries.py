"""How long a grouped summary of very many results takes.

``python -m benchmarks.summaries [--results 100000] [--url URL]`` fills an empty database with a grid of so many runs of
960 inputs, ten grids if there are more than 100,000, each with the answers of all twelve estimates, written by the
database itself; then asks /v1/summary of a real application in this process, by system, by n and magnitude, over all of
it and over one grid. First of all the numbers must be those that numpy gives of the same rows.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from fastapi.testclient import TestClient
from sqlalchemy import Connection, insert, select, text

from service.api.app import create_app
from service.domain.payload import COUNTS, ERRORS, ESTIMATES, QUANTITIES, estimator_and_prior
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.migrate import upgrade
from service.store.tables import estimate, grid, input_group, result

INPUTS = 960
SYSTEMS = ("HE0435", "RXJ1131", "WFI2033", "HE0047", "HE1104", "SDSS0246", "HS2209", "SDSS1206")
GRIDS = 10
ASKED = {
    "by system, everything": {"group_by": "system"},
    "by n and magnitude, everything": {"group_by": "n,magnitude"},
    "by system, one grid": {"group_by": "system", "grid": "g_0000000000000000000000000a"},
    "by system, the n of paper_free": {
        "group_by": "system",
        "quantity": "n",
        "estimator": "paper",
        "index_prior": "free",
    },
    "by system, a quantity beside the index": {"group_by": "system", "quantity": "q"},
}


def fill(database: Database, results: int) -> None:
    """So many results, their numbers drawn by numpy, the other rows by the database."""
    dice = np.random.default_rng(1)
    grids = [f"g_0000000000000000000000000{letter}" for letter in "abcdefghjk"[: 1 if results <= 100_000 else GRIDS]]
    each = results // len(grids)
    with database.write() as connection:
        for number, grid_id in enumerate(grids):
            _grid(connection, grid_id, number, each)
            _answers(connection, grid_id, each, dice)
    with database.write() as connection:
        connection.execute(text("ANALYZE"))


def _grid(connection: Connection, grid_id: str, number: int, runs: int) -> None:
    stamp = "2026-01-01 00:00:00+00:00" if connection.dialect.name == "postgresql" else "2026-01-01 00:00:00"
    ended = {"counts": {"done": runs}, "rate_per_s": 1.0}
    row = {
        "id": grid_id,
        "request": {},
        "n_runs": runs,
        "state": "done",
        "created_at": datetime(2026, 1, 1, tzinfo=UTC),
    }
    connection.execute(insert(grid).values(**row, ending=ended, storing=False))
    inputs = [
        {
            "id": number * INPUTS + place + 1,
            "grid_id": grid_id,
            "digest": f"{place:032x}",
            **_input(place),
            "configuration": "quad" if place % 8 < 3 else "double",
            "profile": "draft",
            "regularisation": "curvature",
            "engine_digest": "0" * 64,
            "runs": runs // INPUTS,
            "wall_s": 1.0,
            "cpu_s": 1.0,
        }
        for place in range(INPUTS)
    ]
    connection.execute(insert(input_group), inputs)
    own = {"grid": grid_id, "head": f"r_{grid_id[2:]}_", "first": number * INPUTS + 1, "runs": runs, "at": stamp}
    numbered = "with recursive k(i) as (select 0 union all select i + 1 from k where i + 1 < :runs) "
    padded = "substr('0000000' || cast(k.i as varchar(7)), -7)"
    if connection.dialect.name == "postgresql":
        numbered, padded = "with k(i) as (select generate_series(0, :runs - 1)) ", "lpad(k.i::text, 7, '0')"
    columns = "id, grid_id, ordinal, label, spec, inputs, digest, state, attempt, charged_from, not_before"
    values = f"(:head || {padded}), :grid, k.i, 'a run', '{{}}', '{{}}', cast(k.i as varchar(9)), 'done', 1, 0, :at"
    _write(connection, f"insert into run ({columns}) {numbered} select {values} from k", own)  # noqa: S608
    plain = [column for column in result.columns if not column.nullable]
    made = {
        "run_id": f"(:head || {padded})", "grid_id": ":grid", "input_id": f":first + k.i % {INPUTS}",
        "stored_at": ":at", "observation_digest": "cast(k.i as varchar(9))",
        "stages": "'[]'", "versions": "'{}'", "warnings": "'[]'",
        "seed": "k.i",
    }  # fmt: skip
    shared = [column.name for column in input_group.columns if column.name in result.c and column.name not in made]
    of_input = {name: f"input.{name}" for name in shared}
    chosen = made | of_input | {"cpu_s": "1.0", "wall_s": "1.0"}
    names = ", ".join(column.name for column in plain)
    values = ", ".join(chosen.get(column.name, "'x'" if column.type.python_type is str else "20.0") for column in plain)
    source = f"from k join input on input.id = :first + k.i % {INPUTS}"
    _write(connection, f"insert into result ({names}) {numbered} select {values} {source}", own)


def _write(connection: Connection, statement: str, parameters: dict[str, Any]) -> None:
    used = {name: value for name, value in parameters.items() if f":{name}" in statement}
    if connection.dialect.name == "postgresql":
        statement = statement.replace(":at", "cast(:at as timestamptz)")
    # JSON columns take text on both.
    if connection.dialect.name == "postgresql":
        for empty in ("'{}'", "'[]'"):
            statement = statement.replace(empty, f"{empty}::json")
    connection.execute(text(statement), used)


def _input(place: int) -> dict[str, Any]:
    return {
        "system": SYSTEMS[place % 8], "camera": "WFC3-IR_F160W", "mass_model": "recommended", "noise_level": "author",
        "noise_treatment": "covariance", "l_eta": 0.8 + 0.2 * (place // 8 % 3), "n": 1.0 + place // 24 % 4,
        "r_eff": 0.2 + 0.1 * (place // 96 % 2), "magnitude": 20.0 + 0.5 * (place // 192),
    }  # fmt: skip


def _answers(connection: Connection, grid_id: str, runs: int, dice: np.random.Generator) -> None:
    """Twelve answers of each run: one drawn here in pieces, the others copied from it by the database."""
    first = connection.scalar(select(input_group.c.id).where(input_group.c.grid_id == grid_id).order_by("id").limit(1))
    names = [f"{quantity}_{part}" for quantity in QUANTITIES for part in ("mean", "sd", "bias")]
    known = "image", "wide"
    for begin in range(0, runs, 10_000):
        ordinals = range(begin, min(begin + 10_000, runs))
        drawn = dice.normal(0.02, 0.2, (len(ordinals), len(names)))
        drawn[:, 1::3] = 0.05 + np.abs(drawn[:, 1::3])
        rows = [
            {
                "run_id": f"r_{grid_id[2:]}_{ordinal:07d}",
                "estimator": known[0],
                "index_prior": known[1],
                "input_id": first + ordinal % INPUTS,
                **dict(zip(names, values, strict=True)),
                **dict.fromkeys(COUNTS, 1),
                **dict.fromkeys(ERRORS, 0.01),
            }
            for ordinal, values in zip(ordinals, drawn.tolist(), strict=True)
        ]
        connection.execute(insert(estimate), rows)
    columns = ", ".join(("run_id", "input_id", *names, *COUNTS, *ERRORS))
    mine = f"estimator = 'image' and index_prior = 'wide' and input_id between {first} and {first + INPUTS - 1}"
    for name in ESTIMATES:
        other = estimator_and_prior(name)
        if other != known:
            values = f"select '{other[0]}', '{other[1]}', {columns} from estimate where {mine}"  # noqa: S608
            connection.execute(text(f"insert into estimate (estimator, index_prior, {columns}) {values}"))


def check(database: Database, answer: dict[str, Any], quantity: str = "magnitude") -> None:
    """The numbers of a summary by system, against numpy."""
    columns = (input_group.c.system, estimate.c[f"{quantity}_bias"], estimate.c[f"{quantity}_sd"])
    mine = (estimate.c.estimator == "image") & (estimate.c.index_prior == "wide")
    with database.read() as connection:
        rows = connection.execute(
            select(*columns).join(input_group, input_group.c.id == estimate.c.input_id).where(mine)
        )
        found = np.array(rows.all(), dtype=object)
    for row in answer["rows"]:
        bias, sd = found[found[:, 0] == row["group"]["system"], 1:].astype(float).T
        expected = [
            len(bias),
            bias.mean(),
            np.median(bias),
            *np.percentile(bias, [16, 84]),
            np.std(bias, ddof=1),
            sd.mean(),
        ]
        told = [row["bias"][name] for name in ("runs", "mean", "median", "p16", "p84", "scatter", "stated_sd")]
        assert np.allclose(told, expected, rtol=1e-5), (told, expected)
        assert np.isclose(
            row["bias"]["coverage"]["68"]["fraction"], np.mean(np.abs(bias) <= 0.9944578832 * sd), rtol=1e-5
        )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=int, default=100_000)
    parser.add_argument("--url", help="an empty database; a file that is removed afterwards where none is given")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        url = options.url or f"sqlite:///{folder}/summaries.sqlite"
        upgrade(url)
        database = Database(url)
        began = time.perf_counter()
        fill(database, options.results)
        print(
            f"{options.results} results written in {time.perf_counter() - began:.0f} s; load {os.getloadavg()[0]:.1f}"
        )
        with TestClient(
            create_app(Settings(database_url=url, data_dir=Path(folder))), base_url="http://localhost"
        ) as client:
            check(database, client.get("/v1/summary", params={"group_by": "system"}).json())
            print(f"{'':42s} first   best wall   best CPU of this process [ms]")
            for name, query in ASKED.items():
                times, spent = [], []
                for _ in range(options.repeats):
                    began, cpu = time.perf_counter(), time.process_time()
                    answer = client.get("/v1/summary", params=query)
                    times.append(time.perf_counter() - began)
                    spent.append(time.process_time() - cpu)
                    assert answer.status_code == 200, answer.text
                print(f"{name:40s} {1e3 * times[0]:7.0f} {1e3 * min(times):11.0f} {1e3 * min(spent):10.0f}", flush=True)
        database.close()


if __name__ == "__main__":
    main()
