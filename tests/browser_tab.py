"""A page in a real browser, by Playwright: what it complained of, whom it asked, and what axe-core finds."""

import time
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest


@contextmanager
def launched(chromium):
    """A browser; the test is skipped where Playwright is missing."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright (pip install -e '.[test]')")
    arguments = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        yield browser
        browser.close()


def until(page, expression, seconds=30.0):
    """Wait until an expression is true, or a function returns what is. Playwright's own wait asks from within the page, and the page's
    policy forbids that from the second time on."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"never true: {expression}"
        time.sleep(0.02)


class Tab:
    """An open page. wrong: what the browser complained of; hosts: whom it asked."""

    def __init__(self, browser, address, **looks):
        self.page = browser.new_context(**looks).new_page()
        self.wrong, self.hosts = [], set()
        self.page.on("console", lambda m: self.wrong.append(m.text) if m.type in ("error", "warning") else None)
        self.page.on("pageerror", lambda e: self.wrong.append(str(e)))
        self.page.on("dialog", lambda d: (self.wrong.append(d.message), d.dismiss()))
        self.page.on("request", lambda r: self.hosts.add(r.url.split("/")[2]))
        self.page.goto(address)

    def violations(self):
        """What axe-core finds: (rule, elements)."""
        script = Path(find_spec("axe_playwright_python").submodule_search_locations[0], "axe.min.js").read_text()
        self.page.context.new_cdp_session(self.page).send("Runtime.evaluate", {"expression": script})
        return [(v["id"], [n["target"] for n in v["nodes"]]) for v in self.page.evaluate("axe.run()")["violations"]]

    def overflow(self):
        return self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
