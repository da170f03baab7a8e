"""The served page in a real browser: live vehicles, uploads, two tabs, a reload in the middle, a server that is killed, accessibility."""

import os
import subprocess
import sys

import pytest

from browser_tab import Tab, launched
from rotorwatch.commands import cli

SAMPLES = cli.SAMPLES
HEXA, QUAD = SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz", SAMPLES / "quadx_healthy_hover.bin.xz"
HOSTILE = "<img src=x onerror=alert(1)>\u202e.bin"
DRAWN = "article[data-state=FAULT] .bands .line[d^=M]"
TOKEN = "a-token-of-enough-letters"


class Server:
    """A server in a process of its own."""

    def __init__(self, store):
        self.store, self.port, self.process, self.address = store, 0, None, ""

    def start(self, *arguments):
        command = [sys.executable, "-m", "rotorwatch.commands.cli", "serve", "--port", str(self.port), "--store", str(self.store)]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("ROTORWATCH_")}
        self.process = subprocess.Popen([*command, *map(str, arguments)], stdout=subprocess.PIPE, text=True, env=environment)
        self.address = self.process.stdout.readline().strip()
        assert self.address.startswith("http://127.0.0.1:"), "the server did not start"
        self.port = int(self.address.rstrip("/").rpartition(":")[2])

    def kill(self):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A server that replays two flights."""
    server = Server(tmp_path_factory.mktemp("serve") / "fleet.db")
    server.start("--speed", "8", HEXA, QUAD)
    yield server
    server.kill()


@pytest.fixture(scope="module")
def browser(chromium):
    with launched(chromium) as browser:
        yield browser


@pytest.fixture(scope="module")
def tab(site, browser):
    return Tab(browser, site.address, viewport={"width": 1200, "height": 900})


@pytest.fixture(scope="module")
def other(site, browser):
    return Tab(browser, site.address, viewport={"width": 390, "height": 844}, color_scheme="dark")


def points(tab):
    """How many points the first rotor's line has."""
    script = "(document.querySelector('.bands .line')?.getAttribute('d') ?? '').split(/[ML]/).length - 1"
    return tab.page.evaluate(script)


def test_a_live_fault_is_shown_and_a_reload_loses_nothing(tab):
    page = tab.page
    page.wait_for_selector(DRAWN, timeout=60_000, state="attached")
    assert page.locator("article").count() == 2 and page.locator("#overview a").count() == 2
    card = page.locator("article[data-state=FAULT]")
    assert "Rotor 3 lost" in card.locator(".sentence").inner_text()
    assert "degraded" in card.locator("g.rotor").nth(2).get_attribute("class")
    assert "rotor 3: lost" in card.locator("svg.airframe title").text_content()
    assert "fault" in page.locator("#alarm").text_content(), "a screen reader is informed"
    before = points(tab)
    page.reload()
    page.wait_for_selector(DRAWN, state="attached")
    assert points(tab) >= before > 20, "the band from before the reload is there again"


def test_a_second_tab_shows_the_same(tab, other):
    other.page.wait_for_selector(DRAWN, state="attached")
    assert points(other) > 20
    assert other.page.locator("article h3").all_inner_texts() == tab.page.locator("article h3").all_inner_texts()


def test_uploads_good_bad_and_hostile(tab, other):
    page = tab.page
    files = [
        {"name": HOSTILE, "mimeType": "", "buffer": b"this is no log"},
        {"name": QUAD.name, "mimeType": "", "buffer": QUAD.read_bytes()},
    ]
    page.set_input_files("#choose", files)
    page.wait_for_selector("#uploads li.refused")
    refused = page.locator("#uploads li.refused").inner_text()
    assert "not a flight log of a known kind" in refused and "<img src=x" in refused
    page.wait_for_selector("#uploads li.healthy", timeout=60_000)
    assert page.locator("#uploads img").count() == 0
    for one in (tab, other):  # the second tab without being asked
        one.page.wait_for_selector("#list tbody tr")
        assert QUAD.name in one.page.locator("#list tbody").inner_text()
    page.fill("#search", "nothing of this name")
    page.wait_for_selector("text=No flight has all these words.")
    page.fill("#search", "QUAD healthy")
    page.wait_for_selector("text=1 flight found")
    assert [w for w in tab.wrong if "status of 422" not in w] == []


@pytest.mark.parametrize("looks", ["light", "dark"])
def test_nobody_is_locked_out(tab, other, looks):
    """axe-core, with vehicles, an upload and a list on the page; wide and light, narrow and dark."""
    one = {"light": tab, "dark": other}[looks]
    one.page.evaluate("document.getElementById('messages').open = true")
    assert one.violations() == []
    assert one.overflow() <= 0


def test_everything_is_reached_by_keyboard(tab):
    page = tab.page
    page.focus(".skip")
    reached = []
    for _ in range(30):
        page.keyboard.press("Tab")
        seen = page.evaluate("""() => {
            const e = document.activeElement, around = e.closest('.button') ?? e, look = getComputedStyle(around);
            return [e.id || e.getAttribute('href') || e.tagName, look.outlineStyle !== 'none' || e.classList.contains('skip')];
        }""")
        if seen[0] in ("BODY", reached[0] if reached else ""):
            break
        reached.append(seen[0])
        assert seen[1], f"{seen[0]} does not show that it has the focus"
    wanted = {"#flights", "#live", "#vehicle-1", "#vehicle-2", "choose", "choose-folder", "search"}
    assert wanted <= set(reached) and any(r.startswith("/flights/") for r in reached), reached


def test_the_report_opens_in_its_sandbox(tab, site, browser):
    link = tab.page.locator("#list tbody a").first
    report = Tab(browser, site.address.rstrip("/") + link.get_attribute("href"))
    report.page.wait_for_selector("html[data-plots]")
    assert report.page.evaluate("self.origin") == "null"
    assert report.page.evaluate("fetch('/api/flights').then(() => 'let in', () => 'refused')") == "refused"
    assert report.page.evaluate("document.getElementById('context').open") is False
    moment = Tab(browser, report.page.url + "#t=30.5")
    page = moment.page
    page.wait_for_selector("html[data-plots]")
    assert page.evaluate("document.getElementById('context').open") and page.input_value("#at-time") == "30.5"
    page.fill("#at-time", "31.2")
    assert page.evaluate("location.hash") == "#t=31.2", "the address may be changed in the sandbox"
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.click("#at-copy")
    page.wait_for_selector("#at-status:has-text('Copied.')")
    assert moment.wrong == []
    report.page.click("text=All flights")
    report.page.wait_for_selector("#list tbody tr")


def test_the_post_of_a_flight_is_copied(tab, site, browser):
    """By keyboard on a phone's width: where the clipboard may be used, where it may not, and where a browser copies nothing at all."""
    path = tab.page.locator("#list tbody a").first.get_attribute("href")
    report = Tab(browser, site.address.rstrip("/") + path, viewport={"width": 390, "height": 844})
    page = report.page
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    button = page.get_by_role("button", name="Copy for a forum")
    box = page.locator("#post")
    refuse = "void (navigator.clipboard.writeText = () => Promise.reject())"
    for forbidden in ("0", refuse):
        page.evaluate(forbidden)
        button.focus()
        page.keyboard.press("Enter")
        page.wait_for_selector("#copied:has-text('Copied')")
        assert box.is_hidden() and page.evaluate("document.activeElement.id") == "copy-markdown"
        other = page.context.new_page()
        other.goto(site.address)
        other.bring_to_front()
        other.focus("#search")
        copied = other.evaluate("navigator.clipboard.readText()")
        assert copied.startswith("**✓ Fly · Healthy: ") and QUAD.name in copied and copied.endswith("first record of the log.*\n")
        other.evaluate("navigator.clipboard.writeText('nothing')")
        other.close()
        page.bring_to_front()
    page.evaluate("void (document.execCommand = () => false)")
    button.click()
    page.wait_for_selector("#copied:has-text('Ctrl+C')")
    assert box.is_visible() and page.evaluate("getSelection().toString()").startswith("**✓ Fly · Healthy")
    assert report.violations() == [] and report.overflow() <= 0 and report.wrong == []


def test_a_killed_server_loses_no_flight_and_pages_come_back(tab, other, site):
    site.kill()
    for one in (tab, other):
        one.page.wait_for_selector("body.lost")
    site.start()
    for one in (tab, other):
        one.page.wait_for_selector("body:not(.lost)", timeout=20_000)
        one.page.wait_for_selector("text=No vehicle is watched")
        assert one.page.locator("article").count() == 0
        one.page.wait_for_selector("#list tbody tr")
        assert QUAD.name in one.page.locator("#list tbody").inner_text()
    assert tab.hosts == other.hosts == {f"127.0.0.1:{site.port}"}, "nobody else is asked"
    assert tab.violations() == []


def test_a_page_opens_with_the_token(site, browser, tmp_path):
    guarded = Server(tmp_path / "fleet.db")
    guarded.start("--token", TOKEN)
    try:
        tab = Tab(browser, guarded.address)
        assert tab.violations() == []
        tab.page.fill("#token", "not the one that is wanted")
        tab.page.click("button")
        tab.page.wait_for_selector("text=Wrong token")
        tab.page.fill("#token", TOKEN)
        tab.page.click("button")
        tab.page.wait_for_selector("text=No vehicle is watched")
        tab.page.wait_for_selector("text=No flight yet")
        assert TOKEN not in tab.page.url and [w for w in tab.wrong if "status of 401" not in w] == []
    finally:
        guarded.kill()
