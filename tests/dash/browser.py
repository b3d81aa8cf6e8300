"""A real browser, headless: the system's Chromium, driven by Playwright."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from tests.waiting import wait_until

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
#: True once a cell's page is drawn.
READY = "document.querySelector('.latency .said')?.textContent"
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start the browser."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def wait_for(page: Page, expression: str) -> None:
    """Wait until an expression is true; Playwright's own way needs `unsafe-eval`."""
    wait_until(lambda: page.evaluate(f"Boolean({expression})"))


#: Counts the requests of a page that have no answer yet.
COUNTING = """{
    const plain = window.fetch;
    window.unanswered = 0;
    window.fetch = async (...words) => {
        window.unanswered += 1;
        try {
            const answer = await plain(...words);
            await answer.clone().arrayBuffer();
            return answer;
        } finally {
            window.unanswered -= 1;
        }
    };
}"""
#: Returns after a few looks in a row at which all requests have been answered.
SETTLED = """async () => {
    for (let calm = 0; calm < 5; calm = window.unanswered ? 0 : calm + 1)
        await new Promise((resolve) => setTimeout(resolve, 20));
}"""


def settled(shown: Page) -> None:
    """Wait until what was asked for is drawn."""
    shown.evaluate(SETTLED)


def played(shown: Page, for_ms: int = 300) -> float:
    """Play at speed 5 for a time of the page's clock, and pause; return the place.

    The clock only runs here, so that the page does not reach its end before the click on Pause.
    """
    shown.clock.install()
    shown.clock.pause_at(time.time() + 60)
    shown.get_by_role("combobox").select_option("5")
    begin = shown.evaluate("window.page.at")
    shown.get_by_role("button", name="Play", exact=True).click()
    shown.clock.run_for(for_ms)
    shown.get_by_role("button", name="Pause").click()
    place: float = shown.evaluate("window.page.at")
    assert begin < place <= begin + 5e-3 * for_ms
    shown.clock.resume()
    return place


@contextmanager
def opened(
    browser: Browser, address: str, *, ready: str = READY, **settings: object
) -> Iterator[Page]:
    """Open an address; the page's console has to be silent, and it may ask its own host alone.

    Parameters
    ----------
    ready : str
        What is true once the page is drawn.
    """
    context = browser.new_context(**{"viewport": {"width": 1280, "height": 1000}, **settings})  # type: ignore[arg-type]
    page = context.new_page()
    page.add_init_script(COUNTING)
    said: list[str] = []
    asked: set[str] = set()
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.add(urlsplit(request.url).netloc))
    page.goto(address)
    wait_for(page, ready)
    yield page
    context.close()
    assert said == []
    assert asked == {urlsplit(address).netloc}
