"""The post for a forum: what it says, what it does not give away, and that no text of a log becomes more than text in it."""

import csv
import html
import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import rotorwatch
from conftest import hexa_diagnosis, hexa_event, trials
from rotorwatch import report
from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Message
from rotorwatch.report import markdown, overview
from rotorwatch.report.markdown_text import APART, code, escaped, private

MarkdownIt = pytest.importorskip("markdown_it", reason="no markdown-it (it comes with rich)").MarkdownIt
RENDERER = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])
QUAD = cli.SAMPLES / "quadx_healthy_hover.bin.xz"
HOSTILE = "</details><script>alert(1)</script> @user #123 GH-7 [a](http://b.org) ![c](d) | `e` **f** ~~g~~ $h$ r/i u/j :+1: www.k.org &lt;"
SERIAL = "CubeOrange 003A0026 3131510D 34393334"
POSITION = "47.3977418 8.5455938"


def kinds(made):
    """The types of all tokens, those inside of paragraphs as well."""
    tokens = RENDERER.parse(made)
    return [t.type for t in tokens] + [c.type for t in tokens for c in t.children or ()]


LIVE = re.compile(r"@\w|#\w|://|\bwww\.|\bGH-\d|:\+1:|\b[ru]/\w")


def outside_code(made):
    """The text in which sites look for mentions and links."""
    return html.unescape(re.sub("<[^>]*>", "", re.sub("<code>.*?</code>", "", RENDERER.render(made))))


def shown(made):
    """The text that a reader sees."""
    text = re.sub(r"<[^>]*>", "", RENDERER.render(made))
    return html.unescape(text).replace(APART, "").strip()


# Escaping

INERT = {"paragraph_open", "paragraph_close", "inline", "text", "text_special", "code_inline"}


@settings(deadline=None)
@given(st.text(max_size=120))
@example(HOSTILE)
@example("1. list")
@example("- list")
@example("+ list")
@example("# title")
@example("=== ")
@example("---")
@example("--baseline *x* --vehicle")
@example("`rotorwatch info LOG` `rotorwatch <b>`")
@example("\\")
@example("\\|")
@example("    code")
@example("[x]: http://a.b")
def test_text_stays_text(text):
    """Rendered it reads as it did, and is one paragraph of nothing but text; in a table it stays in its cell."""
    made = escaped(text)
    assert set(kinds(made)) <= INERT
    if text.isprintable() and text.isascii():
        assert shown(made) == " ".join(re.sub(r"`(rotorwatch [\w .-]+)`", r"\1", text).split())
    assert "\n" not in made and not LIVE.search(outside_code(made))
    cells = kinds(markdown.table(("a", "b"), [(made, "x")]))
    assert cells.count("td_open") == 2 and not set(cells) & {"html_inline", "html_block", "link_open", "image"}


@settings(deadline=None)
@given(st.text(max_size=120))
@example(HOSTILE)
@example("`")
@example("``a`` `b`")
@example("| a |")
def test_foreign_text_is_code(text):
    made = code(text)
    assert made == "" or kinds(made) == ["paragraph_open", "inline", "paragraph_close", "code_inline"]
    assert kinds(markdown.table(("a", "b"), [(made, "x")])).count("td_open") == 2


@pytest.mark.parametrize(
    ("text", "left"),
    [
        (f"board {SERIAL}", "board CubeOrange …"),
        ("uuid 000200000000373833333430510a002c001f", "uuid …"),
        ("id 123e4567-e89b-12d3-a456-426614174000.", "id …."),
        ("serial number: AB12-99", "serial number: …"),
        ("MAC 00:1b:44:11:3a:b7", "MAC …"),
        (f"home {POSITION}", "home … …"),
        ("home_47.39774_8.54559.bin", "home_…_….bin"),
        ("lat 47.39 lon=-8.5", "lat … lon=…"),
        ("47°23'51\"N", "…"),
        ("/home/me/My-Logs/a.bin: no", "a.bin: no"),
        ("C:\\Users\\me\\a.bin", "a.bin"),
        ("~/logs/a.bin", "a.bin"),
        ("of http://me:pw@host/x?y=1 it", "of … it"),
        ("write to me@example.org", "write to …"),
        ("37 % (33–41 %) at 31.20 s, 14:03:27.2 UTC, docs/aerobatic.md, ~5 s, and/or, V4.7.0-dev (2598e9d4)", None),
        ("blackbox_log_2016-04-12_125209.TXT", None),
        ("hexax_m3_mul0.80_square_wind.bin", None),
    ],
)
def test_what_only_the_owner_should_give_away(text, left):
    assert private(text) == (text if left is None else left)


def test_what_an_autopilot_wrote_has_no_long_numbers():
    assert private("origin 473977418 -85455938", logged=True) == "origin … …"
    for position in ("47.39 N, 8.54 E", "at 47.397,8.545", "at -35.36 149.16"):
        assert not re.search(r"\d", private(position, logged=True))
    assert private("50.00 to 51.00 s, 8.0kHz/1.0kHz", logged=True) == "50.00 to 51.00 s, 8.0kHz/1.0kHz"
    assert private("known as AB12CD34EF", aircraft="serial FC AB12CD34EF") == "known as …"


# One flight


def test_a_fault(fault):
    made = fault.to_markdown()
    first, what, *_ = made.split("\n\n")
    assert first == "**✕ Do not fly · Fault found: Rotor 3 (front left) lost 37 % (33–41 %) of thrust at 31.20 s.**"
    assert what == "`hexa.bin` · ardupilot-hexa-x, 6 rotors · ArduPilot · 60 s, airborne 4 to 58 s"
    row = "| loss of effectiveness | rotor 3 (front left) | 31.20 s | 0.36 s | 37 % (33–41 %) | 98 % |"
    assert row in made and "![" not in made
    assert "Do not fly again until rotor 3 (front left)" in made and "`--baseline HEALTHY.LOG`" in made
    assert f"*rotorwatch {rotorwatch.__version__}. Times are in seconds" in made
    assert "The log ends in the air." in made and "- 33.00 s error: `crash check`" in made
    assert "LOITER" not in made, "messages far from the event are left out"


def test_every_verdict_has_a_post(healthy):
    nothing = hexa_diagnosis(events=(), doubts=("the log shows nothing.",))
    answers = (healthy, nothing, hexa_diagnosis(events=(hexa_event(alternatives=((5,),)),)))
    assert {a.verdict for a in answers} == {"healthy", "inconclusive", "ambiguous"}
    for answer in answers:
        made = answer.to_markdown()
        assert made.startswith(f"**{markdown.SIGNS[report.tone(answer)]} ") and tables_fit(made)
        assert replace(answer, trace=None).to_markdown().startswith(made.partition("\n")[0])


def tables_fit(made):
    """Every line of every table has as many cells as its head."""
    columns = None
    for line in made.splitlines():
        cells = len(re.findall(r"(?<!\\)\|", line)) if line.startswith("| ") else None
        if columns is not None and cells not in (None, columns):
            return False
        columns = cells
    return True


def hostile():
    """An answer in which every text that comes from a log is hostile, private and long."""
    words = f"{HOSTILE} {SERIAL} {POSITION}"
    d = hexa_diagnosis(warnings=(words,) * 40, assumptions=(words,) * 40, baseline=words)
    trace = replace(d.trace, messages=((31.0, "text", words), (31.5, "text", SERIAL)))
    flight = {**d.flight, "name": f"/home/me/{words}", "firmware": HOSTILE, "autopilot": "x", "frame": words}
    return replace(d, trace=trace, flight=flight, aircraft=f"serial {SERIAL.replace(' ', '')}", story=())


def test_nothing_of_a_log_does_anything():
    made = hostile().to_markdown()
    inside = RENDERER.render(made)
    assert not re.search(r"<(?:script|a|img|del|h\d)\b", inside)
    assert inside.count("<details>") == inside.count("</details>") == 1
    assert not LIVE.search(outside_code(made))
    assert tables_fit(made) and len(made) < 10_000


def test_only_who_asks_is_identified():
    made, identified = hostile().to_markdown(), hostile().to_markdown(identify=True)
    for word in ("003A0026", "34393334", "47.397", "/home", "home/me"):
        assert word not in made
    assert "003A0026" in identified and "47.397" in identified and len(identified) < 10_000
    utc = hexa_diagnosis(flight={**hexa_diagnosis().flight, "utc_start": "2026-11-21T07:40:36Z"})
    assert "2026-11-21 07:40:36 UTC" in utc.to_markdown(identify=True) and "2026" not in utc.to_markdown()


@settings(max_examples=trials(30), deadline=None)
@given(st.integers(0, 60), st.integers(0, 3000), st.sampled_from(["x", "&", "`", "| ", "\u202e", "ä<"]))
def test_a_post_is_bounded(events, letters, sign):
    many = tuple(hexa_event(onset_s=float(k), detected_s=k + 0.5, reason=sign * letters) for k in range(events))
    d = hexa_diagnosis(events=many, warnings=(sign * letters,) * 30, reason=sign * letters, headline=sign * letters)
    made = replace(d, advice=(sign * letters,) * 20).to_markdown(identify=True)
    assert len(made) <= markdown.MOST and tables_fit(made) and made.endswith("of the log.*\n")


def test_the_serial_number_of_a_log_is_known_and_kept():
    """ArduPilot writes it as a message; PX4 among its facts."""
    identify = import_module("rotorwatch.flight.identity").identify
    flight = Flight("dataflash", "ArduPilot", {}, 1.0, messages=(Message(0.0, "text", SERIAL),))
    known = identify(flight).text
    assert known == "serial CubeOrange 003A00263131510D34393334"
    d = hexa_diagnosis(aircraft=known)
    assert known in d.to_markdown(identify=True) and "003A" not in d.to_markdown()
    assert "aircraft" not in d.to_dict()


def test_it_is_written_with_its_picture(fault, tmp_path):
    pytest.importorskip("matplotlib")
    made = fault.to_markdown(tmp_path / "my post.md")
    assert (tmp_path / "my post.md").read_text(encoding="utf-8") == made and "](my%20post.png)" in made
    assert (tmp_path / "my post.png").read_bytes().startswith(b"\x89PNG")
    assert RENDERER.render(made).count("<img") == 1
    with pytest.raises(ConfigError):
        fault.to_markdown(tmp_path / "no" / "folder.md")


def test_without_a_picture_it_shows_none(fault, tmp_path, monkeypatch):
    why = markdown.write(replace(fault, trace=None), tmp_path / "a.md").why
    assert "Nothing to draw" in why and "![" not in (tmp_path / "a.md").read_text()

    def lacking(*_):
        raise ConfigError("The picture of a post needs matplotlib.")

    monkeypatch.setattr(markdown.optional, "library", lacking)
    assert "matplotlib" in markdown.write(fault, tmp_path / "b.md").why
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["a.md", "b.md"]


# Several flights


@pytest.mark.parametrize("count", [1, 3, 60])
def test_several_logs_are_one_post(count, tmp_path):
    post = markdown.Several()
    for k in range(count):
        d = hexa_diagnosis() if k % 2 else hexa_diagnosis(events=())
        d = replace(d, flight={**d.flight, "name": f"flight-{k:02}.bin"})
        post.add(overview.row(f"/home/me/flight-{k:02}.bin", d.to_dict()), replace(d, trace=None), (), b"png")
    post.add(overview.row("/home/me/x.bin", {"error": "/home/me/x.bin: no log.", "flight": {"name": "x.bin"}}))
    post.write(tmp_path / "post.md")
    made = (tmp_path / "post.md").read_text(encoding="utf-8")
    assert len(made) <= 10_000 and tables_fit(made) and "/home" not in made
    assert made.startswith(f"**{count + 1} logs: 1 error") and "| ! error | `x.bin` | no log. |" in made
    sections, pictures = made.count("\n---\n"), list(tmp_path.glob("*.png"))
    assert sections == len(pictures) == made.count("![") and min(count, 3) <= sections <= markdown.SECTIONS
    assert ("have no section here" in made) == (count > sections)
    assert made.index("Fault found:") < made.index("Healthy:") if count == 3 else True


# The command


@pytest.fixture(scope="module")
def quad(tmp_path_factory):
    """A folder with a copy of the healthy sample."""
    folder = tmp_path_factory.mktemp("posts")
    (folder / "quad.bin.xz").write_bytes(QUAD.read_bytes())
    return folder


def test_the_command_writes_a_post(quad, run, monkeypatch):
    monkeypatch.chdir(quad)
    code_, out, err = run("diagnose", "quad.bin.xz", "--markdown", "out/post.md")
    made = (quad / "out" / "post.md").read_text(encoding="utf-8")
    assert code_ == 0 and "HEALTHY" in out and "post written to out/post.md" in err
    assert made.startswith("**✓ Fly · Healthy: ") and "`quad.bin.xz`" in made and str(quad) not in made
    code_, out, err = run("diagnose", quad / "quad.bin.xz", "--markdown", "-", "--quiet")
    again = re.sub(r"!\[.*\n\n", "", made)
    assert (code_, out, err) == (0, again, "")
    code_, out, _ = run("diagnose", quad / "quad.bin.xz", "broken.bin", "--jobs", "1", "-q", "--markdown")
    assert code_ == 2 and out.startswith("**2 logs: 1 error, 1 healthy**") and "no such file" in out


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (("--markdown", "a.bin", "b.bin"), "--markdown a.bin: give a name that ends in .md"),
        (("a.bin", "--identify"), "needs --markdown"),
        (("a.bin", "--markdown", "--json"), "cannot both go to standard output"),
        (("a.bin", "--markdown", "-", "--jsonl"), "cannot both go to standard output"),
        (("a.bin", "b.bin", "--markdown", "{name}.bin"), "ends in .md"),
    ],
)
def test_what_does_not_go_together_is_said_before_the_work(argv, words, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.bin", "b.bin"):
        Path(name).write_bytes(b"x")
    code_, out, err = run("diagnose", *argv)
    assert code_ == 2 and words in err and out == "" and Path("a.bin").read_bytes() == b"x"


SHARED = Path(__file__).parents[2] / "shared" / "flights"


@pytest.mark.skipif(not (SHARED / "crash" / "expect.csv").exists(), reason="no flight logs here")
@pytest.mark.parametrize("name", ["crash/quad-off-1.bin.xz", "crash/flips-1.bin.xz"])
def test_real_logs_give_nothing_away(name):
    from rotorwatch import logs

    flight = logs.read(SHARED / name)
    made = rotorwatch.diagnose(flight).to_markdown()
    gives_away(made, flight)


def gives_away(made, flight):
    """No position of the log in degrees, no serial number, and nothing long."""
    assert len(made) < 10_000 and tables_fit(made)
    known = import_module("rotorwatch.flight.identity").identify(flight).text
    for word in re.findall(r"[0-9A-Za-z]{8,}", known):
        assert word.lower() not in made.lower()
    assert not re.search(r"\d{1,3}\.\d{4,}|\d{8,}", re.sub(r"\(\w{7,}\)", "", made))
    assert not [r for r in csv.reader(made.splitlines()) if "/home" in "".join(r)]
