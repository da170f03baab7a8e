"""Report sections: found without a list, shown by every view, and those of other packages, which may fail."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from conftest import hexa_diagnosis
from rotorwatch.errors import PluginWarning
from rotorwatch.report import html, markdown, notebook, sections, terminal
from test_markdown import RENDERER, tables_fit
from test_plugins import package  # noqa: F401 - a fixture

GUIDE = Path(__file__).resolve().parents[1] / "docs" / "plug-ins.md"


@pytest.fixture(scope="module")
def example():
    """The section of the guide, as it stands there."""
    (text,) = re.findall(r"^```python\n(.*?name, title, order.*?)^```", GUIDE.read_text(), re.DOTALL | re.MULTILINE)
    return text


def screen_of(diagnosis, verbose):
    screen = terminal.console()
    with screen.capture() as out:
        screen.print(terminal.diagnosis(diagnosis, verbose))
    return out.get()


def test_a_section_of_another_package_is_in_every_view(package, example, fault):  # noqa: F811
    package({"rotorwatch.sections": {"headroom": "elsewhere"}}, example)
    page = html.page(fault)
    assert "<h2>Headroom of the commands</h2>" in page and 'id="plot-headroom"' in page
    assert page.index("<h2>Motor commands</h2>") < page.index("<h2>Headroom") < page.index("<h2>Evidence</h2>")
    assert re.search(r"<tr><td>3</td><td class=\"n\">\d+\u00a0%</td></tr>", page)
    post = fault.to_markdown()
    assert "**Headroom of the commands**" in post and re.search(r"^\| 3 \| \d+ % \|$", post, re.MULTILINE)
    assert "Headroom of the commands" in screen_of(fault, True) and "Headroom" in notebook.page(fault)
    assert "Headroom" not in screen_of(fault, False)
    bare = hexa_diagnosis(trace=None)
    assert not any("Headroom" in text for text in (html.page(bare), bare.to_markdown(), screen_of(bare, True)))


def test_its_plot_shares_the_time_axis(package, example, fault):  # noqa: F811
    package({"rotorwatch.sections": {"headroom": "elsewhere"}}, example)
    from rotorwatch.report import figures

    plots = figures.plots(fault)
    assert plots["headroom"].x_range is plots["loss"].x_range
    assert len({id(span) for p in plots.values() for span in p.center if span.name == "moment"}) == 1


@pytest.mark.parametrize(
    ("part", "source"),
    [
        ("data", "def data(diagnosis): raise KeyError('x')"),
        ("words", "def data(diagnosis): return 1\ndef words(data): return [1 / 0]"),
        ("words", "def data(diagnosis): return 1\ndef words(data): return [b'<p>']"),
        ("plot", "def data(diagnosis): return 1\ndef plot(data): return 1 / 0"),
        ("page", "def data(diagnosis): return 1\ndef page(data, divs): return 1 / 0"),
    ],
)
def test_one_that_fails_is_left_out_with_a_warning(package, fault, part, source):  # noqa: F811
    package({"rotorwatch.sections": {"odd": "elsewhere"}}, f"name, title, order = 'odd', 'Odd one', 1\n{source}\n")
    with pytest.warns(PluginWarning, match=f"report section odd of the package elsewhere 1.2 .* its {part} failed"):
        page = html.page(fault if part == "plot" else replace(fault, trace=None))  # pages without plots are made faster
    assert "Odd one" not in page and "Detections by method" in page


def test_a_name_of_ours_stays_ours(package, fault):  # noqa: F811
    package({"rotorwatch.sections": {"checks": "elsewhere"}}, "name, title, order = 'checks', 'x', 1\ndata = str\n")
    with pytest.warns(PluginWarning, match="its name is taken"):
        assert "Detections by method" in html.page(replace(fault, trace=None))


def test_every_view_renders_every_block_and_no_text_is_markup(package):  # noqa: F811
    evil = "<script>alert(1)</script> @user [a](http://b.org) | x"
    source = f"""
from rotorwatch.report.blocks import *
name, title, order, evil = "all", {evil!r}, 45, {evil!r}
def data(diagnosis): return evil
def words(data):
    return [Title("All blocks " + evil), evil, Text(evil), Bullets([evil, ("at: ", Logged("47.3977418 8.5455938 " + evil))]),
            Pairs([("pair", evil)]), Notes("noted", [evil], named=True), Notes("more", ["one"]),
            Table(("a", evil), [(Strong("bold"), evil)] * 9, right=(1,), noun="finding")]
def summary(data):
    return [Text("in short", "! ")]
"""
    package({"rotorwatch.sections": {"all": "elsewhere"}}, source)
    shown = hexa_diagnosis(verdict="healthy", events=(), warnings=(), assumptions=())
    page, post, note = html.page(shown), shown.to_markdown(), notebook.page(shown)
    for text in (page, note):
        assert "<script>alert" not in text and "All blocks &lt;script&gt;" in text
    assert "<b>bold</b>" in page and "<li>Noted: &lt;script" in page and "<li>one</li>" in page
    assert "<script" not in RENDERER.render(post) and "47.39" not in post and "**bold**" in post and tables_fit(post)
    assert "1 more finding is not shown." in post and "- Noted: " in post
    whole, short = screen_of(shown, True), screen_of(shown, False)
    assert all(word in whole for word in ("All blocks", "pair: ", "noted", "more", "bold")) and "! in short" in short


def test_sections_are_complete_and_in_order():
    found = [section for section, _ in sections.registered()]
    assert len(found) == len(list(Path(sections.__file__).parent.glob("[!_]*.py"))) > 15
    assert [s.order for s in found] == sorted({s.order for s in found})
    assert len({s.name for s in found}) == len(found)
    for section in found:
        assert all(hasattr(section, part) for part in sections.PARTS) and (hasattr(section, "words") or hasattr(section, "page"))
        assert set(getattr(section, "views", ())) <= set(sections.VIEWS)


def test_a_post_keeps_the_sections_of_a_diagnosis_that_lost_its_trace(fault):
    from dataclasses import replace

    parts, bare = markdown.prepared(fault), replace(fault, trace=None)
    assert "`crash check`" in markdown.text(bare, parts=parts) and "`crash check`" not in markdown.text(bare)
