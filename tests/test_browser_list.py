"""The list of flights in a real browser: filters in the address, keyboard, two flights compared, deletion in all tabs, accessibility."""

from urllib.parse import parse_qs, urlsplit

import pytest
from tests.conftest import hexa_diagnosis, hexa_event
from tests.test_browser_serve import TOKEN, Server, Tab, browser  # noqa: F401 - a fixture

from rotorwatch.fleet import Entry, Store

MANY = 60
FAULT, LATER = f"{MANY - 1:064x}", f"{MANY - 2:064x}"


def fill(place):
    """Flights of three aircraft; the newest two are hexas of which rotor 3, rotor 5 lost thrust."""
    one = hexa_diagnosis().to_dict()
    other = hexa_diagnosis(events=(hexa_event(rotors=(5,)),)).to_dict()
    well = hexa_diagnosis(events=(), verdict="healthy", headline="Nothing was found.").to_dict()
    with Store(place) as store:
        for k in range(MANY):
            found = one if k == MANY - 1 else other if k == MANY - 2 else well
            reported = {**found, "flight": {**found["flight"], "name": f"{k:04d}.bin"}}
            store.add(Entry(
                f"{k:064x}", "", f"{k:04d}.bin", 1, identity=f"uid {k % 3}", called=f"Quad {k % 3}", frame="hexa X", rotors=6,
                utc=f"2026-05-{1 + k // 24:02d}T{k % 24:02d}:00:00.000Z", duration_s=10.0 + k, airborne_s=10.0, verdict=reported["verdict"],
                headline=reported["headline"], diagnosis=reported, version="0.1.0",
            ))  # fmt: skip


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A server that deletes."""
    place = tmp_path_factory.mktemp("list") / "fleet.db"
    fill(place)
    server = Server(place)
    server.start("--allow-delete")
    yield server
    server.kill()


@pytest.fixture(scope="module")
def window(site, browser):  # noqa: F811
    one = Tab(browser, site.address, viewport={"width": 1400, "height": 900}, reduced_motion="reduce")
    yield one
    one.page.context.close()


@pytest.fixture
def tab(window, site):
    """A tab as a new one: a browser takes half a second to open one."""
    window.page.evaluate("[localStorage, sessionStorage].forEach(kept => kept.clear())")
    window.wrong.clear()
    window.page.goto("about:blank")
    window.page.goto(site.address)
    window.page.wait_for_selector("#list tbody tr")
    yield window
    assert [text for text in window.wrong if "status of" not in text] == []
    window.page.goto(site.address)


def names(page):
    return [text[:4] for text in page.locator("#list a.name").all_inner_texts()]


def found(page, text):
    page.wait_for_selector(f"#found:has-text('{text}')")


def query(page):
    return {name: values[0] for name, values in parse_qs(urlsplit(page.url).query).items()}


def focus(page):
    """What has the focus: its id, address or label."""
    return page.evaluate("(e => e.id || e.getAttribute('href') || e.getAttribute('aria-label') || e.tagName)(document.activeElement)")


def test_filters_and_order_stand_in_the_address(tab, site):
    page = tab.page
    found(page, f"{MANY} flights")
    page.select_option("#verdict", "healthy")
    found(page, f"{MANY - 2} flights found")
    page.select_option("#aircraft", "Quad 1")
    page.fill("#since", "2026-05-02")
    page.select_option("#min_duration", "60")
    found(page, "2 flights found")
    page.click("[data-sort='-duration']")
    page.wait_for_selector("th[aria-sort=descending] [data-sort='-duration']")
    page.click("[data-sort='-duration']")
    page.wait_for_selector("th[aria-sort=ascending] [data-sort='-duration']")
    shown = names(page)
    assert shown == ["0052", "0055"] and page.locator("[aria-sort]").count() == 1
    wanted = {"verdict": "healthy", "aircraft": "Quad 1", "since": "2026-05-02", "min_duration": "60", "sort": "duration"}
    assert query(page) == wanted

    page.reload()
    found(page, "2 flights found")
    assert names(page) == shown and query(page) == wanted
    assert [page.input_value(f"#{name}") for name in wanted] == list(wanted.values())
    page.go_back()
    page.wait_for_selector("th[aria-sort=descending] [data-sort='-duration']")
    page.fill("#search", "0055")
    found(page, "1 flight found")
    assert query(page)["search"] == "0055"
    page.click("#clear")
    found(page, f"{MANY} flights")
    assert query(page) == {"sort": "-duration"} and focus(page) == "search"


def test_a_link_with_what_cannot_be_asked_says_so(tab, site):
    page = tab.page
    page.goto(f"{site.address}?since=2026-05-03T09:00&min_loss=0.01#flights")
    found(page, "2 flights found")
    assert page.input_value("#since") == "2026-05-03T09:00" and page.input_value("#min_loss") == "0.01"
    for ask, says in (("aircraft=nobody", "has no aircraft nobody"), ("sort=size", "choose from"), ("until=May", "give a day")):
        page.goto(f"{site.address}?{ask}")
        found(page, says)
        assert page.locator("#list").is_hidden()
    page.click("#clear")
    found(page, f"{MANY} flights")


def test_all_flights_are_shown_in_pages_by_keyboard(tab):
    page = tab.page
    assert len(names(page)) == 50
    page.locator("#list a.name").first.focus()
    page.keyboard.press("End")
    page.keyboard.press("ArrowDown")
    assert focus(page) == "more"
    page.keyboard.press("Enter")
    page.wait_for_selector("#list tbody tr:nth-child(60)")
    assert page.locator("#more").is_hidden() and names(page) == [f"{k:04d}" for k in reversed(range(MANY))]


def test_two_flights_are_compared_by_keyboard(tab):
    page = tab.page
    page.keyboard.press("/")
    assert focus(page) == "search"
    page.keyboard.press("ArrowDown")
    assert focus(page) == f"/flights/{FAULT}"
    page.keyboard.press("c")
    assert page.locator("#chosen-count").inner_text() == "Choose two flights to compare them; none chosen."
    page.keyboard.press("x")
    assert page.locator("#chosen-count").inner_text().startswith("1 flight chosen")
    page.keyboard.press("ArrowRight")
    assert focus(page) == f"/flights/{FAULT}#t=31.2", "the moment of the loss"
    page.keyboard.press("ArrowDown")
    assert focus(page).startswith(f"/flights/{LATER}#t=")
    page.keyboard.press("x")
    assert page.locator("#chosen-count").inner_text() == "2 flights chosen"
    bar, row = page.locator("#chosen").bounding_box(), page.locator("#list tbody tr").nth(1).bounding_box()
    assert bar["y"] >= row["y"] + row["height"] or bar["y"] + bar["height"] <= row["y"], "the bar hides no focus"
    page.keyboard.press("c")
    page.wait_for_selector("#compared")
    assert query(page) == {"a": FAULT, "b": LATER}
    lead = page.locator(".lead").inner_text()
    assert lead == "They differ in rotor 3 (front left), rotor 5 (front right), events and aircraft."
    unlike = ["rotor 3 (front left)", "rotor 5 (front right)", "aircraft"]
    assert page.locator("tr.differs th").all_text_contents() == [f"≠differs: {what}" for what in unlike]
    assert page.locator("#compared .airframe").count() == 2
    # The page's script sets the colours when the page has been read to its end: later than the first drawing is there.
    page.wait_for_load_state("load")
    assert page.evaluate("getComputedStyle(document.querySelector('.degraded')).getPropertyValue('--rotor')") == "#d55e00"
    page.go_back()
    page.wait_for_selector("#list tbody tr")


def test_the_keys_are_shown_and_can_be_switched_off(tab):
    page = tab.page
    page.locator("#list a.name").nth(3).focus()
    page.keyboard.press("?")
    page.wait_for_selector("#keys[open]")
    page.keyboard.press("Escape")
    assert page.locator("#keys").is_hidden() and focus(page) == f"/flights/{MANY - 4:064x}", "the focus is where it was"
    page.click("#show-keys")
    page.uncheck("#use-keys")
    page.click("#keys-close")
    page.reload()
    page.wait_for_selector("#list tbody tr")
    page.locator("#list a.name").first.focus()
    for key in "x/?":
        page.keyboard.press(key)
    assert page.locator("#chosen").is_hidden() and page.locator("#keys").is_hidden() and focus(page) == f"/flights/{FAULT}"
    page.keyboard.press("ArrowDown")
    assert focus(page) == f"/flights/{LATER}"


def test_escape_empties_the_search_and_the_choice(tab):
    page = tab.page
    page.fill("#search", "0058")
    found(page, "1 flight found")
    page.focus("#search")
    page.keyboard.press("Escape")
    found(page, f"{MANY} flights")
    page.locator("#list .choice input").nth(0).check()
    page.locator("#list .choice input").nth(1).check()
    page.keyboard.press("Escape")
    assert page.locator("#chosen").is_hidden() and page.locator("#list input:checked").count() == 0


def test_a_link_to_a_moment_reaches_the_report(tab, site):
    page = tab.page
    page.goto(f"{site.address}compare?a={FAULT}&b={LATER}")
    page.locator(".moments a").first.click()
    page.wait_for_selector("#report")
    assert page.evaluate("[self.origin, location.hash]") == ["null", "#t=31.20"], "the sandbox has it"
    page.goto(f"{site.address}flights/{FAULT}#t=34.2")
    assert page.evaluate("location.hash") == "#t=34.2"


def test_a_report_is_downloaded(tab):
    page = tab.page
    page.locator("#list .choice input").first.check()
    with page.expect_download() as waited:
        page.click("#download")
    assert waited.value.suggested_filename == f"{MANY - 1:04d}-report.html"
    page.locator("#list a.name").nth(1).focus()
    with page.expect_download() as waited:
        page.keyboard.press("d")
    assert waited.value.suggested_filename == f"{MANY - 2:04d}-report.html"
    page.locator("#list a.name").first.click()
    with page.expect_download() as waited:
        page.click("text=Download this report")
    assert "rotor 3" in waited.value.path().read_text("utf-8")


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (1400, "dark"), (390, "light"), (390, "dark")])
def test_nobody_is_locked_out(site, browser, width, scheme):  # noqa: F811
    """axe-core on the list, with a choice, with each dialog, and on the comparison; nothing is wider than the page."""
    few = f"{site.address}?since=2026-05-03T08:00"
    tab = Tab(browser, few, viewport={"width": width, "height": 844}, color_scheme=scheme)
    page = tab.page
    page.wait_for_selector("#list tbody tr")

    def look():
        assert tab.violations() == [] and tab.overflow() <= 0

    for box in (0, 1):
        page.locator("#list .choice input").nth(box).check()
    look()
    for button, dialog in (("#delete", "#sure"), ("#show-keys", "#keys")):
        page.click(button)
        page.wait_for_selector(f"{dialog}[open]")
        look()
        page.keyboard.press("Escape")
        assert focus(page) == button[1:]
    page.click("#compare")
    page.wait_for_selector("#compared")
    look()
    a, b = (page.locator(".pair .verdict").nth(k).bounding_box() for k in (0, 1))
    assert (b["y"] > a["y"] + a["height"] - 1) if width < 700 else (b["x"] > a["x"] + a["width"] - 1)
    cells = [page.locator("#compared tbody tr").nth(2).locator("td").nth(k).bounding_box() for k in (0, 1)]
    assert (cells[0]["y"] < cells[1]["y"]) == (width < 700)
    assert tab.wrong == []
    page.context.close()


def test_everything_is_reached_by_tab_and_seen(tab):
    page = tab.page
    page.locator("#list .choice input").nth(0).check()
    page.locator("#list .choice input").nth(1).check()
    page.focus("#search")
    reached = ["search"]
    for _ in range(40):
        page.keyboard.press("Tab")
        seen = page.evaluate("""() => {
            const e = document.activeElement, around = e.closest('.button') ?? e, look = getComputedStyle(around);
            const box = around.getBoundingClientRect();
            return [e.id || e.dataset.sort || e.getAttribute('href') || e.tagName, look.outlineStyle !== 'none',
                    around.contains(document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2))];
        }""")
        reached.append(seen[0])
        assert seen[1], f"{seen[0]} does not show that it has the focus"
        assert seen[2], f"{seen[0]} has the focus and cannot be seen"
    wanted = {"SUMMARY", "verdict", "aircraft", "since", "until", "min_loss", "min_duration", "sort", "compare", "delete", "unchoose"}
    wanted |= {"-verdict", "name", "-date", "-loss", "-duration", f"/flights/{FAULT}", "INPUT"}
    assert wanted <= set(reached), wanted - set(reached)


def test_a_deleted_flight_goes_from_all_tabs(tab, site, browser):  # noqa: F811
    """Last: by keyboard, asked first; the focus goes to the flight that takes its place."""
    page = tab.page
    other = Tab(browser, site.address, viewport={"width": 390, "height": 844})
    for row in (0, 2):
        other.page.locator("#list .choice input").nth(row).check()
    other.page.locator("#list a.name").nth(1).focus()
    page.locator("#list a.name").first.focus()
    page.keyboard.press("Delete")
    page.wait_for_selector("#sure[open]")
    assert focus(page) == "sure-no" and f"{MANY - 1:04d}.bin" in page.locator("#sure").inner_text()
    page.keyboard.press("Escape")
    assert focus(page) == f"/flights/{FAULT}" and page.locator("#found").inner_text() == f"{MANY} flights"
    page.keyboard.press("Delete")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    for one in (page, other.page):
        found(one, f"{MANY - 1} flights")
        assert one.locator(f"tr[data-hash='{FAULT}']").count() == 0
    assert page.locator("#alarm").text_content() == f"{MANY - 1:04d}.bin is deleted."
    assert focus(page) == f"/flights/{LATER}"
    assert other.page.locator("#list input:checked").count() == 1, "what is gone is chosen no longer, the rest is"
    assert other.page.locator("#chosen-count").inner_text().startswith("1 flight chosen")
    assert focus(other.page) == f"/flights/{LATER}", "nobody's focus is lost"
    assert other.wrong == []

    for row in (0, 1):
        page.locator("#list .choice input").nth(row).check()
    page.route(
        "**/api/flights/" + f"{MANY - 3:064x}", lambda route: route.fulfill(status=503, json={"error": "The list cannot be written."})
    )
    page.click("#delete")
    page.click("#sure-yes")
    page.wait_for_selector("#sure-trouble:has-text('1 of 2 were deleted.')")
    assert f"{MANY - 3:04d}.bin: The list cannot be written." in page.locator("#sure-trouble").inner_text()
    page.unroute("**/api/flights/" + f"{MANY - 3:064x}")
    page.click("#sure-yes")
    found(page, f"{MANY - 3} flights")
    page.wait_for_selector("#sure", state="hidden")
    other.page.context.close()


def test_a_server_that_deletes_nothing_offers_nothing(tmp_path, browser):  # noqa: F811
    """And with a token: links lead through its form to what was asked for, with the moment."""
    fill(tmp_path / "fleet.db")
    server = Server(tmp_path / "fleet.db")
    server.start("--token", TOKEN)
    try:
        tab = Tab(browser, f"{server.address}flights/{FAULT}#t=34.2")
        page = tab.page
        page.fill("#token", TOKEN)
        page.click("button")
        page.wait_for_selector("#report")
        assert page.url == f"{server.address}flights/{FAULT}#t=34.2"
        page.click("text=All flights")
        page.locator("#list a.name").first.focus()
        page.keyboard.press("x")
        page.keyboard.press("Delete")
        assert page.locator("#delete").is_hidden() and page.locator("#sure").is_hidden()
        page.keyboard.press("?")
        page.wait_for_selector("#keys[open]")
        assert page.locator(".deletes").first.is_hidden()
        assert [w for w in tab.wrong if "status of 401" not in w] == []
    finally:
        server.kill()
