"""The documents' site: it is built without a warning, has a place for every page, and explains every parameter."""

import re
import runpy
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import rotorwatch as rw
from browser_tab import launched
from rotorwatch.base import discovery
from script_files import loaded

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def make_api():
    return loaded(ROOT / "docs" / "make_api.py")


def test_every_parameter_of_a_public_name_is_explained(make_api):
    assert make_api.unexplained() == []


def test_the_reference_has_every_public_name(make_api):
    page, listed = make_api.page(), (ROOT / "docs" / "api.md").read_text()
    offered = {name for name in discovery.offered("rotorwatch.api") if callable(getattr(rw, name))}
    assert "estimate" in offered and "systems" not in offered
    for name in {*rw.__all__, *offered} - {"__version__"}:
        assert f"\n## {name}\n" in f"\n{page}" and f"`{name}`" in listed, name
    rows = [row for row in page.splitlines() if row.startswith("| `")]
    assert len(rows) > 100


@pytest.mark.parametrize(
    ("docstring", "found"),
    [
        ("First.\n\na: one, two. b (n,): three; c: four. Raises X.", {"a": "one, two.", "b": "(n,) three", "c": "four."}),
        ("First.\n\na and b: both. other: is none.", {"a": "both. other: is none.", "b": "both. other: is none."}),
        ("First: b: no start of a sentence.", {}),
    ],
)
def test_explanations_are_found_in_prose(make_api, docstring, found):
    assert make_api.explained(docstring, ["a", "b", "c"]) == found


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The site as it is published: (its folder, what Sphinx had to say, its exit code)."""
    pytest.importorskip("myst_parser")
    site = tmp_path_factory.mktemp("site")
    words = ["-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "-d", site / ".doctrees", "-c", "docs", ".", site]
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=300)
    return site, done.stderr, done.returncode


def test_the_site_is_built_without_a_warning(built):
    assert built[2] == 0, built[1]


class Article(HTMLParser):
    """Links of a page's text: neither of the navigation beside it nor of what is around it."""

    def __init__(self, page):
        super().__init__()
        self.links, self._inside, self._folder = set(), False, page.parent
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self._inside |= tag == "article"
        link = dict(attrs).get("href") if tag == "a" else None
        if self._inside and link and not urlsplit(link).scheme and urlsplit(link).path:
            self.links.add((self._folder / unquote(urlsplit(link).path)).resolve())

    def handle_endtag(self, tag):
        self._inside &= tag != "article"


def test_every_page_is_two_clicks_from_the_contents(built):
    site = built[0].resolve()
    reached = {site / "docs" / "index.html"}
    for _ in range(2):
        reached |= {link for page in reached for link in Article(page).links if link.suffix == ".html"}
    assert not [page for page in reached if not page.is_file()]
    far = set(site.rglob("*.html")) - {site / "search.html", site / "genindex.html"} - reached
    assert not far and len(reached) > 80, sorted(str(page.relative_to(site)) for page in far)


def test_the_site_is_searched_without_a_network(built, chromium):
    """From a folder, as after a download: words are found, results open, and nothing is asked of anybody."""
    asked = []
    with launched(chromium) as browser:
        page = browser.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.goto((built[0] / "docs" / "index.html").as_uri())
        page.fill("input[name=q]", "propeller")
        page.press("input[name=q]", "Enter")
        found = page.locator("#search-results ul.search > li > a")
        found.filter(has_text="A fleet over time").click()
        assert page.url.endswith("/docs/fleet.html")
        assert "exchange" in page.inner_text("article")
    assert not [url for url in asked if not url.startswith(("file:", "data:"))]


def test_every_page_has_one_place_in_the_navigation():
    """Sphinx warns of a page without a place, and of none with two."""
    conf = runpy.run_path(str(ROOT / "docs" / "conf.py"))
    made = conf["navigation"]((ROOT / "docs" / "index.md").read_text(), "docs")
    assert re.findall(r":caption: (.*)", made) == ["Start", "By task", "More"]
    trees = "\n".join(re.findall(r"```{toctree}\n(.*?)```", made, re.DOTALL))
    top = [line for line in trees.splitlines() if line.startswith("/")]
    assert {"/README", "/docs/my-log", "/docs/my-research"} <= set(top)
    placed = [*top, *(page for pages in conf["below"]().values() for page in pages)]
    assert len(placed) == len(set(placed))
