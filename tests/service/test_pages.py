"""The pages in a real browser, on a real service: submitted, watched, cancelled, without scripts, on a phone."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from tests.service.browser import DESKTOP, PHONE, Watched, chromium, tab
from tests.service.service_process import eventually, serving

OWN = Path(__file__).resolve().parents[2] / "docs" / "examples" / "my_double.json"
PATIENCE_MS = 120_000
POINT = {"preset": "h0licow-vi/HE0435", "n": "2", "magnitude": "20.5", "l_eta": "1.0", "r_eff": "0.39"}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def address(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    # The browser first: without one no service is started.
    with serving(tmp_path_factory.mktemp("pages"), HOSTLENS_DRILL_SLEEP="0.5") as found:
        yield f"http://127.0.0.1:{found.port}"


@pytest.fixture(scope="module")
def done(address: str) -> str:
    """A grid with four results."""
    body = {"preset": POINT["preset"], "n": [2, 4], "magnitude": [20.5, 21.5], "l_eta": [1.0], "r_eff": [0.39]}
    answer = httpx.post(f"{address}/v1/grids", json={**body, "name": "four <b>bold</b>"})
    grid = str(answer.json()["id"])
    eventually(lambda: httpx.get(f"{address}/v1/grids/{grid}").json()["state"] == "done", what="the end")
    return grid


def fill(opened: Watched, **more: str) -> None:
    page = opened.open("/submit")
    page.get_by_label("preset").select_option(POINT["preset"])
    for name, value in {**POINT, **more}.items():
        if name != "preset":
            page.locator(f"[name={name}]").fill(value)


def test_a_grid_is_submitted_by_page_and_seen_to_its_end_with_its_figure(browser: Browser, address: str) -> None:
    with tab(browser, address) as opened:
        fill(opened, name="by page", replicates="12")
        page = opened.page
        page.get_by_role("button", name="Check, start nothing").click()
        expect(page.locator("#dry-run")).to_contain_text("This would be 12 runs")
        expect(page.locator("[name=replicates]")).to_have_value("12")
        page.get_by_role("button", name="Submit").click()
        page.wait_for_url("**/grids/g_*")
        expect(page.get_by_role("heading", name="by page")).to_be_visible()
        # By the stream of events, on the page as it stands.
        page.evaluate("document.body.dataset.mine = 'kept'")
        expect(page.locator("#live .counts")).to_contain_text(re.compile(r"[1-9] done"), timeout=PATIENCE_MS)
        assert page.evaluate("document.body.dataset.mine") == "kept"
        expect(page.locator("#live .badge")).to_have_text("done", timeout=PATIENCE_MS)
        image = page.locator("#figures img")
        expect(image).to_be_visible(timeout=PATIENCE_MS)
        image.scroll_into_view_if_needed()
        eventually(lambda: image.evaluate("image => image.complete && image.naturalWidth") > 400, what="the figure")
        expect(page.locator(".cells li")).to_have_count(12)
        expect(page.locator("#answers tbody tr")).to_contain_text("HE0435")
        page.get_by_label("Quantity").select_option("r_eff")
        expect(page.locator("#answers caption")).to_contain_text("r_eff [arcsec]")


def test_errors_of_a_form_stand_at_their_fields_with_what_was_typed(browser: Browser, address: str) -> None:
    with tab(browser, address) as opened:
        fill(opened, n="2, many", seed="-1")
        page = opened.page
        page.get_by_role("button", name="Submit").click()
        expect(page.get_by_role("alert")).to_contain_text("Nothing was submitted")
        for name in ("n", "seed"):
            expect(page.locator(f"[name={name}]")).to_have_attribute("aria-invalid", "true")
        expect(page.locator("#e-n")).to_contain_text("n[1]: got 'many'")
        expect(page.locator("#e-seed")).to_contain_text("a number of at least 0")
        expect(page.locator("[name=n]")).to_have_value("2, many")
        # The status of such an answer is an error to the browser, too.
        assert all("422" in said for said in opened.wrong)
        opened.wrong.clear()


def test_a_lens_of_ones_own_is_submitted_by_page_to_the_figure_of_its_biases(browser: Browser, address: str) -> None:
    with tab(browser, address) as opened:
        page = opened.open("/submit")
        for name, value in {"n": "2, 4", "magnitude": "21", "l_eta": "1", "r_eff": "0.35", "name": "my own"}.items():
            page.locator(f"[name={name}]").fill(value)
        page.locator("[name=systems]").fill(OWN.read_text())
        page.get_by_role("button", name="Check, start nothing").click()
        expect(page.locator("#dry-run")).to_contain_text("This would be 2 runs")
        page.get_by_role("button", name="Submit").click()
        page.wait_for_url("**/grids/g_*")
        expect(page.locator("#live .badge")).to_have_text("done", timeout=PATIENCE_MS)
        image = page.locator("#figures img")
        expect(image).to_be_visible(timeout=PATIENCE_MS)
        image.scroll_into_view_if_needed()
        eventually(lambda: image.evaluate("image => image.complete && image.naturalWidth") > 400, what="the figure")


def test_a_grid_is_paused_resumed_and_cancelled_by_page(browser: Browser, address: str) -> None:
    with tab(browser, address) as opened:
        fill(opened, name="to be cancelled", replicates="400", seed="1000")
        page = opened.page
        page.get_by_role("button", name="Submit").click()
        page.wait_for_url("**/grids/g_*")
        page.get_by_role("button", name="Pause").click()
        expect(page.locator("#live .badge")).to_have_text("paused", timeout=PATIENCE_MS)
        page.get_by_role("button", name="Resume").click()
        page.get_by_role("button", name="Cancel").click()
        expect(page.locator("#live .badge")).to_have_text("cancelled", timeout=PATIENCE_MS)
        expect(page.get_by_role("button", name="Try again")).to_be_visible(timeout=PATIENCE_MS)


def test_without_scripts_a_grid_is_submitted_and_seen_to_its_end(browser: Browser, address: str) -> None:
    with tab(browser, address, scripts=False) as opened:
        fill(opened, name="no scripts", replicates="3", seed="2000")
        page = opened.page
        page.get_by_role("button", name="Submit").click()
        page.wait_for_url("**/grids/g_*")
        # The page loads itself anew.
        expect(page.locator("#live .badge")).to_have_text("done", timeout=PATIENCE_MS)
        expect(page.locator("#figures img")).to_be_visible()
        page.get_by_label("Grouped by").select_option("n")
        page.get_by_role("button", name="Show").click()
        expect(page.locator("#answers thead th").first).to_have_text("n")


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_every_page_is_as_wide_as_its_window_and_complete(
    browser: Browser, address: str, done: str, size: tuple[int, int]
) -> None:
    run = f"r_{done[2:]}_0000000"
    compared = "/compare?by=index_prior&left=wide&right=fixed"
    paths = ("/", f"/grids/{done}", f"/grids/{done}?figure=coverage", f"/runs/{run}", "/submit", compared, "/status")
    with tab(browser, address, size) as opened:
        for path in paths:
            page = opened.open(path)
            for details in page.locator("details").all():
                details.evaluate("found => { found.open = true }")
            assert opened.overflow() <= 0, path
            for image in page.locator("img").all():
                image.scroll_into_view_if_needed()
                eventually(lambda image=image: image.evaluate("i => i.complete && i.naturalWidth > 0"), what=path)
            assert page.locator("h1").count() == 1
            assert page.title().endswith("hostlens")
            unnamed = page.evaluate(
                "[...document.querySelectorAll('input:not([type=hidden]), select, textarea, img')]"
                ".filter(e => !(e.labels?.length || e.alt || e.ariaLabel)).map(e => e.outerHTML)"
            )
            assert unnamed == [], path
            assert page.evaluate("[...document.querySelectorAll('table')].every(t => t.querySelector('thead th'))")


def test_a_name_is_shown_as_it_is_and_never_as_markup(browser: Browser, address: str, done: str) -> None:
    with tab(browser, address) as opened:
        for path in ("/", f"/grids/{done}"):
            page = opened.open(path)
            expect(page.get_by_text("four <b>bold</b>").first).to_be_visible()
            assert page.locator("b", has_text="bold").count() == 0


def test_a_browser_is_told_of_errors_by_a_page(browser: Browser, address: str) -> None:
    with tab(browser, address) as opened:
        page = opened.open("/grids/g_" + "0" * 26)
        expect(page.get_by_role("heading", name="Not Found")).to_be_visible()
        expect(page.get_by_text("there is no grid")).to_be_visible()
        opened.wrong.clear()


def test_a_form_of_another_site_is_refused(address: str, done: str) -> None:
    for headers in ({"Origin": "http://elsewhere.example"}, {"Sec-Fetch-Site": "cross-site"}):
        for path in (f"/grids/{done}/cancel", "/submit"):
            answer = httpx.post(address + path, data={"name": "x"}, headers=headers)
            assert answer.status_code == 403, path


def test_pages_allow_nothing_from_elsewhere(address: str, done: str) -> None:
    for path in ("/", "/submit", f"/grids/{done}", "/status", "/nowhere"):
        answer = httpx.get(address + path, headers={"Accept": "text/html"})
        assert answer.headers["content-type"].startswith("text/html")
        assert answer.headers["content-security-policy"].startswith("default-src 'self'")
        assert "style=" not in answer.text
        assert "<script>" not in answer.text
