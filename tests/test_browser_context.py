"""The fold with the track and the lanes, and the moment in the page's address, in a real browser."""

from pathlib import Path

import pytest

from browser_tab import Tab, launched, until
from conftest import hexa_diagnosis

SPANS = "Bokeh.documents.flatMap((d) => d.roots()).map((f) => f.center.find((thing) => thing.name === 'moment'))"
SPOT = "(({ cx, cy }) => [cx.baseVal.value, cy.baseVal.value])(document.querySelector('#track .moment'))"


@pytest.fixture(scope="module")
def browser(chromium):
    with launched(chromium) as browser:
        yield browser


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("context") / "report.html"
    hexa_diagnosis().to_html(path)
    return Path(path).as_uri()


def opened(browser, address, **looks):
    tab = Tab(browser, address, **looks)
    tab.page.wait_for_selector("html[data-plots]")
    return tab


def marked(page):
    """Times at which the plots mark a moment, each once; [] where none does."""
    return page.evaluate(f"[...new Set({SPANS}.map((s) => (s.visible ? s.location : null)))].filter((t) => t !== null)")


def test_the_fold_opens_by_keyboard_draws_and_locks_nobody_out(browser, address, amount):
    """On a phone and on a wide screen, light and dark."""
    tab = opened(browser, address, viewport={"width": 390, "height": 900}, color_scheme="dark")
    page = tab.page
    assert page.locator("#plot-altitude").is_hidden() and page.locator("#track").is_hidden()
    page.focus("#context summary")
    page.keyboard.press("Enter")
    until(page, "document.querySelector('#context').open")
    for name in ("altitude", "ground_speed", "voltage", "current", "vibration", "modes"):
        box = page.locator(f"#plot-{name}").bounding_box()
        assert box["height"] > 60 and box["width"] > 300, name
    until(
        page,
        """() => {
        const canvases = [];
        (function walk(node) {
            if (node.tagName === "CANVAS" && node.width) canvases.push(node);
            if (node.shadowRoot) walk(node.shadowRoot);
            for (const child of node.children) walk(child);
        })(document.getElementById("context"));
        const inked = (c) => c.getContext("2d").getImageData(0, 0, c.width, c.height).data.some((v, i) => i % 4 === 3 && v > 0);
        return canvases.filter(inked).length >= 6;
    }""",
    )
    one, other = (page.locator(f"#track {name}").bounding_box() for name in (".start", ".end"))
    assert other["x"] > one["x"] and other["y"] < one["y"], "it flew east and north"
    usual = ((390, "dark"), (1400, "light"))
    for width, looks in amount(usual, (*usual, (390, "light"), (1400, "dark"))):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=looks)
        until(page, "innerWidth - document.getElementById('plot-altitude').offsetWidth < 340")
        assert tab.violations() == [] and tab.overflow() <= 0, (width, looks)
        wide = page.locator("#plot-altitude").bounding_box()["width"]
        assert wide == pytest.approx(min(width, 1120) - (40 if width > 720 else 28), abs=2)
    assert tab.wrong == []


def test_the_address_shows_a_moment_in_every_plot(browser, address):
    tab = opened(browser, address + "#t=32.5", viewport={"width": 1200, "height": 800})
    page = tab.page
    assert marked(page) == [32.5] and page.evaluate(f"{SPANS}.every((s) => s && s.visible)")
    assert page.evaluate("document.getElementById('context').open") and page.input_value("#at-time") == "32.5"
    until(page, "scrollY > 500 && document.getElementById('context').getBoundingClientRect().top < 100")
    assert page.locator("#at").bounding_box()["y"] <= 1, "the time and the link stay in sight"
    x, y = page.evaluate(SPOT)
    corners = page.evaluate("[...document.querySelector('#track polyline').points].map((p) => [p.x, p.y])")
    (left, low), (right, high) = corners[0], corners[-1]
    assert x == pytest.approx(right, abs=0.7) and y == pytest.approx(0.5 * (low + high), abs=0.7), "half way north"
    page.evaluate("scrollTo(0, 0)")
    page.click("text=Show where it began")
    until(page, f"{SPANS}[0].location === 31.2 && scrollY > 500")
    page.evaluate("scrollTo(0, 0)")
    page.click("text=Show where it began")  # the address is the same now
    until(page, "scrollY > 500")
    page.go_back()
    until(page, f"{SPANS}[0].location === 32.5")
    assert left < right and tab.wrong == [] and tab.violations() == []
    page.evaluate("location.hash = '#t=20'")
    until(page, f"{SPANS}[0].location === 20")
    page.click("#at-clear")
    assert marked(page) == [] and page.evaluate("location.hash") == "" and page.evaluate("document.activeElement.id") == "at-time"


def test_other_addresses_are_ignored(browser, address):
    tab = opened(browser, f"{address}#t=999")
    page = tab.page
    for wrong in "t=999 t= t=abc t=-5 t=1e1 t=12,5 t=NaN t=5%00 t=10<b> x=10 t=10&t=20 t=0x10 t=12345678901234567890".split():
        page.evaluate("(hash) => (location.hash = hash)", wrong)
        page.wait_for_timeout(20)
        assert marked(page) == [] and not page.evaluate("document.getElementById('context').open"), wrong
    assert page.evaluate("scrollY") == 0 and tab.wrong == []
    page.evaluate("location.hash = 't=10'")
    until(page, "document.getElementById('context').open")


def test_a_moment_is_chosen_by_a_click_on_the_map_and_by_keyboard(browser, address):
    tab = opened(browser, address, viewport={"width": 1200, "height": 900})
    page = tab.page
    plot = page.locator("#plot-loss")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    start, end = page.evaluate("(({ start, end }) => [start, end])(Bokeh.documents[0].roots().find((f) => f.name === 'loss').x_range)")
    page.mouse.click(box["x"] + 0.5 * (72 + box["width"]), box["y"] + 150)
    until(page, f"{SPANS}[0].visible")
    (time,) = marked(page)
    assert time == pytest.approx(0.5 * (start + end), abs=0.6) and page.evaluate("location.hash") == f"#t={time:g}"
    assert not page.evaluate("document.getElementById('context').open"), "a click leaves the reader where they are"
    page.focus("#at-time")
    page.keyboard.press("Control+A")
    page.keyboard.type("45.25")
    assert marked(page) == [45.25] and page.evaluate("location.hash") == "#t=45.25"
    page.keyboard.press("ArrowUp")
    assert marked(page)[0] > 45.25
    page.keyboard.press("Control+A")
    page.keyboard.type("1000")
    assert marked(page)[0] < 59, "a time beyond the flight is not shown"
    page.keyboard.press("Tab")
    assert float(page.input_value("#at-time")) == pytest.approx(59.98), "and becomes its end"
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.get_by_role("button", name="Copy link to this moment").focus()
    page.keyboard.press("Enter")
    page.wait_for_selector("#at-status:has-text('Copied.')")
    assert page.evaluate("navigator.clipboard.readText()") == page.evaluate("location.href")
    page.evaluate("void (navigator.clipboard.writeText = () => Promise.reject(), document.execCommand = () => false)")
    page.keyboard.press("Enter")
    page.wait_for_selector("#at-status:has-text('address bar')")
    assert page.locator("#post").is_hidden()
    page.evaluate("document.getElementById('context').open = true")
    corner = page.evaluate("[...document.querySelector('#track polyline').points].map((p) => [p.x, p.y])[0]")
    box = page.locator("#track").bounding_box()
    scale = box["width"] / 440
    page.locator("#track").click(position={"x": (corner[0] + 40) * scale, "y": (corner[1] - 20) * scale})
    (time,) = marked(page)
    assert 10.0 < time < 25.0, "on the leg to the east"
    assert tab.wrong == []
