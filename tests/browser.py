"""A real browser for tests: Debian's Chromium without a window, driven by Playwright."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest
from playwright.sync_api import Page, sync_playwright

__all__ = ["Visit", "visited"]

REQUIRED = "BROWSER_TESTS"  # "required" in CI, where the browser must be there


@dataclass
class Visit:
    """A page that a browser shows.

    Attributes:
        page: To act on.
        complaints: Errors and warnings of its console, and exceptions of its scripts.
        requests: Addresses that it has asked for.
    """

    page: Page
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


@contextmanager
def visited(address: str, width: int = 1400) -> Iterator[Visit]:
    """Open a page in a window of some width; skips the test where there is no browser."""
    browser = shutil.which("chromium")
    if browser is None:
        if os.environ.get(REQUIRED) == "required":
            pytest.fail("there is no chromium; apt-get install chromium")
        pytest.skip("there is no chromium; apt-get install chromium")
    with sync_playwright() as playwright:
        # The sandbox needs rights that root in a container has not.
        options = ["--no-sandbox"] if os.geteuid() == 0 else []
        chromium = playwright.chromium.launch(executable_path=browser, args=options)
        try:
            page = chromium.new_page(viewport={"width": width, "height": 900})
            visit = Visit(page)
            page.on("console", lambda said: visit.complaints.append(f"{said.type}: {said.text}"))
            page.on("pageerror", lambda error: visit.complaints.append(str(error)))
            page.on("request", lambda request: visit.requests.append(request.url))
            page.goto(address)
            yield visit
        finally:
            chromium.close()
