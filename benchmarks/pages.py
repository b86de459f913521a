"""What each page costs with 100,000 results stored: asserted to be the page, then timed.

``python -m benchmarks.pages`` prints wall and CPU time of this process, which serves what it asks for.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from fastapi.testclient import TestClient

from benchmarks.summaries import fill
from service.api.app import create_app
from service.runtime.settings import Settings
from service.store.database import Database
from service.store.migrate import upgrade


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=int, default=100_000)
    parser.add_argument("--url", help="an empty database; a file that is removed afterwards where none is given")
    parser.add_argument("--repeats", type=int, default=10)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        url = options.url or f"sqlite:///{folder}/pages.sqlite"
        upgrade(url)
        database = Database(url)
        fill(database, options.results)
        with TestClient(
            create_app(Settings(database_url=url, data_dir=Path(folder))), base_url="http://localhost"
        ) as client:
            grid = client.get("/v1/grids").json()["items"][0]["id"]
            run = client.get(f"/v1/grids/{grid}/runs", params={"limit": 1}).json()["items"][0]["id"]
            pages = {
                "/": "Grids",
                f"/grids/{grid}": f"Summarise {options.results} results",
                f"/grids/{grid}/progress": "runs",
                f"/runs/{run}": "put in and recovered",
                "/submit": "Submit a grid",
                "/compare": "Compare two analyses",
                "/status": "Queue",
            }
            print(f"{options.results} results; load {os.getloadavg()[0]:.1f}")
            print(f"{'':24s} first   best wall   best CPU of this process [ms]      kB")
            for path, held in pages.items():
                times, spent = [], []
                for _ in range(options.repeats):
                    began, cpu = time.perf_counter(), time.process_time()
                    answer = client.get(path, headers={"Accept": "text/html"})
                    times.append(time.perf_counter() - began)
                    spent.append(time.process_time() - cpu)
                    assert answer.status_code == 200, answer.text
                    assert held in answer.text, path
                name = path.replace(grid, "{id}").replace(run, "{id}")
                size = len(answer.content) / 1e3
                print(
                    f"{name:22s} {1e3 * times[0]:7.0f} {1e3 * min(times):11.0f} {1e3 * min(spent):10.0f} {size:32.0f}"
                )
        database.close()


if __name__ == "__main__":
    main()
