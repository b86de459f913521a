"""How long exports of very many results take, and how much memory.

``python -m benchmarks.exports [--results 100000] [--url URL]`` fills a database as :mod:`benchmarks.summaries` does,
then asks a process of the API for each format, as a file on the disk. First the file must hold what /v1/results gives
of the same runs; then come the seconds, the CPU seconds of the process, its peak memory above what it had before the
first export, and the size of the file.
"""

from __future__ import annotations

import argparse
import binascii
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
from astropy.io import fits
from pyarrow import csv, parquet

from benchmarks.summaries import fill
from service.exports.formats import FORMATS
from service.store.database import Database
from service.store.migrate import upgrade
from tests.drills.installation import free_port

CHECKED = ("run_id", "magnitude_bias", "arc_magnitude")
FEW = 100


def expected(client: httpx.Client) -> dict[str, list[Any]]:
    items = client.get("/v1/results", params={"limit": FEW}).raise_for_status().json()["items"]
    return {name: [item[name] for item in items] for name in CHECKED}


def held(suffix: str, file: Path) -> tuple[int, dict[str, list[Any]]]:
    """Rows of a file, and the first values of some columns."""
    if suffix == "fits":
        with fits.open(file, memmap=True) as units:
            table = units[1].data
            found = {
                name: [value.item() if hasattr(value, "item") else value for value in table[name][:FEW]]
                for name in CHECKED
            }
            return len(table), found
    if suffix == "vot":
        return _of_votable(file)
    if suffix == "parquet":
        columns = parquet.read_table(file, columns=list(CHECKED))
    else:
        skipped = sum(1 for line in file.open() if line.startswith("#")) if suffix == "ecsv" else 0
        options = csv.ConvertOptions(include_columns=list(CHECKED))
        columns = csv.read_csv(file, csv.ReadOptions(skip_rows=skipped), convert_options=options)
    return columns.num_rows, columns.slice(0, FEW).to_pydict()


def _of_votable(file: Path) -> tuple[int, dict[str, list[Any]]]:
    """By its columns' sizes: Astropy takes minutes for so many rows."""
    head, _, rest = file.read_text().partition('<STREAM encoding="base64">')
    fields = [(field["name"], field["datatype"], int(field.get("arraysize", 1))) for field in _fields(head)]
    sizes = {"double": ">f8", "long": ">i8"}
    kinds = [(name, sizes.get(kind) or f"S{size}") for name, kind, size in fields]
    record = np.dtype([("missing", "u1", ((len(fields) + 7) // 8,)), *kinds])
    rows = np.frombuffer(binascii.a2b_base64(rest.partition("</STREAM>")[0]), dtype=record)
    found = {name: rows[name][:FEW].tolist() for name in CHECKED}
    return len(rows), found | {"run_id": [value.decode() for value in found["run_id"]]}


def _fields(head: str) -> list[dict[str, str]]:
    return [dict(re.findall(r'(\w+)="([^"]*)"', field)) for field in re.findall(r"<FIELD ([^>]*)>", head)]


def peak(process: psutil.Process) -> float:
    """Largest resident memory of a process so far [MB]."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def measure(port: int, pid: int, folder: Path, results: int) -> None:
    process = psutil.Process(pid)
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=600) as client:
        known = expected(client)
        for suffix in FORMATS:  # what is loaded for a format is no part of its memory
            client.get(f"/v1/results.{suffix}", params={"system": "none"}).raise_for_status()
        print(f"{'format':8s} {'wall [s]':>9s} {'CPU [s]':>8s} {'memory [MB]':>12s} {'size [MB]':>10s}", flush=True)
        for suffix in FORMATS:
            file = folder / f"results.{suffix}"
            Path(f"/proc/{pid}/clear_refs").write_text("5")
            memory, cpu = process.memory_info().rss / 2**20, sum(process.cpu_times()[:2])
            began = time.perf_counter()
            with client.stream("GET", f"/v1/results.{suffix}") as answer, file.open("wb") as out:
                answer.raise_for_status()
                for data in answer.iter_raw():
                    out.write(data)
            wall, cpu = time.perf_counter() - began, sum(process.cpu_times()[:2]) - cpu
            rows, found = held(suffix, file)
            assert rows == results
            assert found["run_id"] == known["run_id"]
            for name in CHECKED[1:]:
                assert np.array_equal(found[name], known[name])
            size = file.stat().st_size / 2**20
            print(f"{suffix:8s} {wall:9.2f} {cpu:8.2f} {peak(process) - memory:12.0f} {size:10.0f}", flush=True)
            file.unlink()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Seconds and memory of exports of very many results.")
    parser.add_argument("--results", type=int, default=100_000)
    parser.add_argument("--url", help="A database that was filled already; a new SQLite file without")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        url = chosen.url or f"sqlite:///{folder / 'many.sqlite'}"
        if chosen.url is None:
            upgrade(url)
            with closing(Database(url)) as database:
                fill(database, chosen.results)
        port = free_port()
        settings = {
            "HOSTLENS_DATABASE_URL": url,
            "HOSTLENS_DATA_DIR": name,
            "HOSTLENS_PORT": str(port),
            "HOSTLENS_LOG_LEVEL": "WARNING",
        }
        api = subprocess.Popen([sys.executable, "-m", "service", "api"], env={**os.environ, **settings})
        try:
            _await(port)
            measure(port, api.pid, folder, chosen.results)
        finally:
            api.terminate()
            api.wait()


def _await(port: int) -> None:
    for _ in range(600):
        try:
            httpx.get(f"http://127.0.0.1:{port}/healthz").raise_for_status()
        except httpx.TransportError:
            time.sleep(0.1)
        else:
            return
    raise TimeoutError("the API does not answer")


if __name__ == "__main__":
    main()
