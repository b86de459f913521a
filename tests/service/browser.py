"""A real Chromium, without a window, that notes what goes wrong in its pages."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request, sync_playwright

_NAMES = ("chromium", "chromium-browser", "google-chrome")
PHONE = (375, 740)
DESKTOP = (1280, 900)


def program() -> str:
    """Where Chromium is; without one the test is skipped, except in CI, which installs it and must not go without."""
    found = next((path for name in _NAMES if (path := shutil.which(name))), None)
    if found is None:
        if "CI" in os.environ:
            pytest.fail("Chromium is not installed, and .ci/run should have done so")
        pytest.skip("Chromium is not installed (Debian: apt-get install chromium)")
    return found


class Watched:
    """A tab of a browser of its own, and all that its pages complained of or loaded from elsewhere."""

    def __init__(self, context: BrowserContext, address: str) -> None:
        self.address = address
        self.wrong: list[str] = []
        self.page: Page = context.new_page()
        self.page.on("console", self._said)
        self.page.on("pageerror", lambda error: self.wrong.append(f"error: {error}"))
        self.page.on("request", self._asked)

    def _said(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.wrong.append(f"{message.type}: {message.text}")

    def _asked(self, request: Request) -> None:
        if not request.url.startswith((self.address, "data:", "blob:")):
            self.wrong.append(f"loaded from outside: {request.url}")

    def open(self, path: str) -> Page:
        """Go to a page of the service."""
        self.page.goto(self.address + path)
        return self.page

    def overflow(self) -> int:
        """By how many pixels the page is wider than the window."""
        return int(self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth"))


@contextmanager
def chromium() -> Iterator[Browser]:
    """The browser."""
    with sync_playwright() as playwright:
        # As root, in a container, it has no sandbox; what it opens is our own.
        found = playwright.chromium.launch(executable_path=program(), args=["--no-sandbox"])
        yield found
        found.close()


@contextmanager
def tab(browser: Browser, address: str, size: tuple[int, int] = DESKTOP, *, scripts: bool = True) -> Iterator[Watched]:
    """A tab; nothing may have gone wrong in it."""
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, java_script_enabled=scripts)
    found = Watched(context, address)
    yield found
    context.close()
    assert found.wrong == []
