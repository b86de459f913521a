"""Figures by HTTP: drawn from what is stored, named by their content, refused with a reason."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from fastapi.testclient import TestClient
from PIL import Image

from service.api.app import create_app
from service.domain.identifiers import new_grid_id, utc_now
from service.figures.apart import DrawingProcess
from service.figures.kept import KeptFigures
from service.figures.question import FIGURE_KINDS
from service.runtime.settings import Settings
from service.store.artefacts import ArtefactStore
from service.store.database import Database
from service.store.leadership import Leadership
from service.store.queue import RunQueue
from tests.service.plans import BODY, result_of
from tests.service.service_process import ROOT, eventually

TWO = {"preset": "h0licow-vi", "systems": ["HE0435", "RXJ1131"], "n": [2], "l_eta": [1.0]}


@pytest.fixture
def settings(url: str, tmp_path: Path) -> Settings:
    return Settings(database_url=url, data_dir=tmp_path)


@pytest.fixture
def api(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def grid(api: TestClient, body: object) -> str:
    return str(api.post("/v1/grids", json=body).json()["id"])


def work(settings: Settings, most: int = 1000) -> None:
    """Do what is queued, with small arrays as products."""
    plane = np.ones((9, 9))
    data = io.BytesIO()
    arrays = dict.fromkeys(("image", "noise", "model", "arc_model", "residual"), plane)
    np.savez_compressed(data, **arrays, mask=plane > 0.0, pixel_scale=0.08)
    products = ArtefactStore(settings.artefacts).put(data.getvalue(), "npz")
    database = Database(settings.database)
    generation = Leadership(database).take("worker", lambda _: True)
    assert generation is not None
    queue = RunQueue(database)
    for lease in queue.claim(generation, most):
        queue.store(lease, result_of(lease).model_copy(update={"products": products}))
    database.close()


def detail(answer: object, status: int) -> str:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return str(answer.json()["detail"])


# What is drawn comes from the same models on both; what is asked of a database is asked below.
@pytest.mark.parametrize("url", ["sqlite"], indirect=True)
def test_every_figure_of_a_grid_is_drawn_as_svg_and_png(api: TestClient, settings: Settings) -> None:
    grid_id = grid(api, {**TWO, "name": "two <systems>"})
    work(settings)
    for kind in FIGURE_KINDS:
        query = "?system=HE0435" if kind == "bias" else ""
        svg = api.get(f"/v1/grids/{grid_id}/figures/{kind}.svg{query}")
        assert (svg.status_code, svg.headers["content-type"]) == (200, "image/svg+xml"), svg.text[:300]
        assert "two &lt;systems&gt;" in svg.text
        png = api.get(f"/v1/grids/{grid_id}/figures/{kind}.png{query}")
        assert png.headers["content-type"] == "image/png"
        assert Image.open(io.BytesIO(png.content)).width > 400
        if kind != "montage":
            assert api.get(f"/v1/figures/{kind}.svg?system=HE0435").status_code == 200


def test_the_title_of_a_grid_without_a_name_is_not_its_identifier(api: TestClient, settings: Settings) -> None:
    grid_id = grid(api, {**BODY, "replicates": 2})
    work(settings)
    for kind in ("bias", "montage"):
        assert grid_id not in api.get(f"/v1/grids/{grid_id}/figures/{kind}.svg").text


def test_a_figure_shows_the_runs_that_the_filter_means(api: TestClient, settings: Settings) -> None:
    one, other = (grid(api, {**TWO, "seed": seed}) for seed in (0, 100))
    work(settings)
    for query in ("", f"&grid={one}", f"&grid={one}&grid={other}", "&magnitude=20.5"):
        meant = len(api.get(f"/v1/results?limit=1000&system=HE0435{query}").json()["items"])
        assert meant > 0
        assert f"{meant} runs" in api.get(f"/v1/figures/bias.svg?system=HE0435{query}").text


def test_a_figure_has_an_etag_that_changes_with_the_results_alone(api: TestClient, settings: Settings) -> None:
    address = f"/v1/grids/{grid(api, {**BODY, 'replicates': 4})}/figures/bias.svg"
    work(settings, 2)
    first = api.get(address)
    assert api.get(address).content == first.content
    same = api.get(address, headers={"If-None-Match": first.headers["etag"]})
    assert (same.status_code, same.content) == (304, b"")
    assert api.get(address + "?columns=1").headers["etag"] != first.headers["etag"]
    work(settings, 2)
    later = api.get(address, headers={"If-None-Match": first.headers["etag"]})
    assert later.status_code == 200
    assert later.headers["etag"] != first.headers["etag"]


def test_what_cannot_be_drawn_is_refused_with_the_reason(api: TestClient, settings: Settings) -> None:
    grid_id = grid(api, TWO)
    address = f"/v1/grids/{grid_id}/figures"
    assert "no result yet" in detail(api.get(f"{address}/bias.svg"), 404)
    assert "no result yet" in detail(api.get(f"{address}/montage.png"), 404)
    work(settings)
    assert "system: got HE0435, RXJ1131" in detail(api.get(f"{address}/bias.svg"), 422)
    assert "there is no grid" in detail(api.get(f"/v1/grids/{new_grid_id(utc_now())}/figures/bias.svg"), 404)
    assert "groups: got" not in api.get(f"{address}/pull.svg").text
    for wrong in ("pie.svg", "bias.gif", "bias.svg?colour=red", f"bias.svg?grid={grid_id}", "pull.svg?by=digest"):
        detail(api.get(f"{address}/{wrong}"), 422)
    detail(api.get("/v1/figures/montage.svg"), 422)


def test_figures_are_drawn_one_at_a_time_once_each_and_kept_in_bounds() -> None:
    kept = KeptFigures(100)
    drawn: list[str] = []
    inside = 0

    def draw(name: str, size: int = 40) -> bytes:
        nonlocal inside
        inside += 1
        assert inside == 1
        time.sleep(0.02)
        drawn.append(name)
        inside -= 1
        return name.encode() * size

    threads = [threading.Thread(target=kept.get, args=(name, lambda name=name: draw(name))) for name in "aabbab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(drawn) == ["a", "b"]
    kept.get("a", lambda: draw("a"))
    kept.get("c", lambda: draw("c"))  # the least used goes: b
    kept.get("a", lambda: draw("a"))
    kept.get("b", lambda: draw("b"))
    assert drawn[2:] == ["c", "b"]
    assert len(kept.get("d", lambda: draw("d", 1000))) == 1000  # larger than the room: given, not kept
    kept.get("d", lambda: draw("d", 1000))
    assert drawn.count("d") == 2


def test_figures_are_drawn_in_a_process_of_their_own_which_is_begun_anew_where_it_was_killed() -> None:
    drawing = DrawingProcess()
    first = drawing.call(os.getpid)
    assert drawing.call(os.getpid) == first != os.getpid()
    with pytest.raises(ValueError, match="invalid literal"):
        drawing.call(int, "none")
    os.kill(first, signal.SIGKILL)
    assert drawing.call(os.getpid) not in (first, os.getpid())


def test_the_process_that_draws_ends_with_the_one_that_asks_even_where_that_is_killed() -> None:
    program = (
        "import os\nfrom service.figures.apart import DrawingProcess\n"
        "print(DrawingProcess().call(os.getpid), flush=True)\nos.kill(os.getpid(), 9)"
    )
    told = subprocess.run([sys.executable, "-c", program], check=False, stdout=subprocess.PIPE, cwd=ROOT)
    number = int(told.stdout)

    def is_gone() -> bool:
        # One that nobody has asked for its end is none any more.
        return not psutil.pid_exists(number) or psutil.Process(number).status() == psutil.STATUS_ZOMBIE

    eventually(is_gone, what="the end of the process that draws")
