"""A headless Chromium and its tabs for end-to-end tests: what a page says of itself, and what it complained of."""

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NEEDS_CHROMIUM = [pytest.mark.browser, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")]
PATIENCE_S = 300.0
# the software renderer's own remarks on reading pixels
_RENDERER_REMARKS = ("GPU stall", "GL Driver Message")


def wait(condition: Callable[[], bool], seconds: float = PATIENCE_S) -> None:
    """Until the condition holds; fails loudly when it never does."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A browser that draws without a graphics card."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    flags = ["--enable-unsafe-swiftshader"] + (["--no-sandbox"] if os.geteuid() == 0 else [])
    with playwright.sync_playwright() as run:
        browser = run.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield browser
        browser.close()


@dataclass
class Page:
    """A tab and what it complained of."""

    tab: Any
    complaints: list[str]

    @classmethod
    def opened(cls, browser: Any, address: str, host: str, *, calm: bool = False) -> "Page":
        """A new tab at an address; whatever it asks of another host than `host` (name:port) is a complaint.

        `calm` asks for reduced motion, as a user can: the camera then goes where it is sent without a flight.
        """
        tab = browser.new_page()
        if calm:
            tab.emulate_media(reduced_motion="reduce")
        tab.set_default_timeout(1000 * PATIENCE_S)
        tab.set_viewport_size({"width": 1280, "height": 800})
        page = cls(tab, [])
        own = (f"http://{host}/", f"ws://{host}/")
        tab.on("console", lambda entry: page._hear(entry.text) if entry.type in {"error", "warning"} else None)
        tab.on("pageerror", lambda error: page._hear(str(error)))
        tab.on("request", lambda sent: sent.url.startswith(own) or page._hear(f"asked for {sent.url}"))
        tab.on("websocket", lambda made: made.url.startswith(own) or page._hear(f"connected to {made.url}"))
        tab.goto(address)
        return page

    def _hear(self, text: str) -> None:
        if not any(remark in text for remark in _RENDERER_REMARKS):
            self.complaints.append(text)

    def number(self, name: str) -> Any:
        """One of the figures that the page holds ready for tests."""
        return self.tab.evaluate(f"viewer.{name}")

    def text(self, selector: str) -> str:
        """What an element says; empty when it is hidden."""
        return str(self.tab.text_content(selector)).strip() if self.tab.is_visible(selector) else ""

    def until(self, expression: str, seconds: float = PATIENCE_S) -> None:
        """Until a JavaScript expression holds; not wait_for_function, since the page's policy forbids its eval."""
        wait(lambda: bool(self.tab.evaluate(expression)), seconds)

    def settle(self) -> None:
        """Until the camera has arrived where it was sent."""
        self.until("!viewer.flying")
