"""The table of kinds: every kind is said everywhere, and means the same everywhere, by its row alone."""

import ast
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from conftest import hexa_diagnosis, hexa_event
from rotorwatch.answer.ledger import believed
from rotorwatch.answer.wording import BASELINE, said
from rotorwatch.engine.bindings.event_rows import packed
from rotorwatch.engine.events import events as definition
from rotorwatch.flight import kinds
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.kinds import Kind, Span, Weight, Words
from rotorwatch.live import ground, view
from rotorwatch.live.alert_states import Changes
from rotorwatch.report import colours, terminal
from rotorwatch.report.sections import event_list

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "rotorwatch"
LABORATORY = ROOT / "src" / "rotorwatch_lab"
# Rows that nobody finds yet: a rotor that gives more than it is asked for, and so on.
PLANTED = (
    Kind(100, "gives_more", "more thrust than commanded", "", Weight.FAULT, Span.LASTS),
    Kind(101, "mount_turned", "twisted motor mount", "", Weight.FAULT, Span.STAYS, brief="turned on its mount"),
    Kind(102, "growing_loss", "growing loss", "", Weight.FAULT, Span.LASTS, weakens=True, now=Words("growing weaker since {at}")),
    Kind(103, "outside_force", "outside force", "", Weight.OUTSIDE, Span.LASTS),
    Kind(104, "unknown", "something else", "", Weight.UPSET, Span.LASTS, headline=Words("Nothing known explains it at {at}.")),
)
KINDS = tuple(kinds.table().values())
EVENT_ROWS = tuple(row for row in KINDS if row.weight is not Weight.OPEN)  # the others are no events of an answer
NAMES = (*(row.name for row in (*EVENT_ROWS, *PLANTED)), "of_another_version")
# Where a kind's name may stand besides the table: what assesses a loss of control names causes so, and ticks have a column.
ELSEWHERE = {"engine/motion/tick_table.py": {kinds.CONTACT}, "engine/definition.py": {kinds.CONTACT}}  # a file of that name


@pytest.fixture(autouse=True)
def planted(monkeypatch):
    for row in PLANTED:
        monkeypatch.setitem(kinds._TABLE, row.name, row)


def row(name):
    return next((r for r in (*KINDS, *PLANTED) if r.name == name), None) or kinds.kind_of(name)


def an_event(name, rotors=(3,), alternatives=(), end_s=None):
    """One of a kind, with what the finders of the known ones give it."""
    extra = {"times": [31.2], "durations": [0.1], "count": 1} if name == kinds.DESYNC else {"cause": "unknown"}
    rotors = (3, 4) if name == kinds.ORDER and rotors else rotors
    lost = {} if row(name).weakens else {"loss": (), "interval": ()}
    return hexa_event(kind=name, rotors=rotors, alternatives=alternatives, end_s=end_s, extra=extra, **lost)


EVENTS = [
    event
    for name in NAMES
    for event in (
        an_event(name),
        an_event(name, end_s=40.0),
        *([an_event(name, alternatives=((5,), (1, 2)))] if row(name) not in KINDS or row(name).weakens else []),
        *([an_event(name, rotors=())] if not row(name).weakens and name != kinds.DESYNC else []),
    )
]


def shown(answer: Diagnosis) -> dict[str, str]:
    written = io.StringIO()
    Console(file=written, width=400, no_color=True).print(terminal.diagnosis(answer, verbose=True))
    return {
        "terminal": written.getvalue(), "page": re.sub("<[^>]*>", " ", event_list.page(answer, {})), "markdown": answer.to_markdown(),
    }  # fmt: skip


@pytest.mark.parametrize("event", EVENTS, ids=lambda e: f"{e.kind} {e.rotors} {e.alternatives} {e.end_s}")
def test_every_kind_is_said_everywhere(event):
    row, answer = kinds.kind_of(event.kind), hexa_diagnosis(events=(event,))
    for where, text in shown(answer).items():
        assert row.noun in text.lower().replace("\u00a0", " "), where
        assert "_" not in event.kind or event.kind not in text, where
    sentences = [answer.headline, answer.reason, *answer.advice, *(r.note for r in answer.rotors)]
    assert answer.advice[0] != BASELINE  # something is to be done about each
    assert not any(brace in text for text in sentences for brace in "{}")
    assert Diagnosis.from_dict(json.loads(answer.to_json())).events == (replace(event.stated(), extra=answer.events[0].extra),)
    line = view.words(event, 50.0)
    assert "31.2 s (19 s ago)" in line and ("rotor" in line or "motor" in line or not event.rotors)
    alert = {"type": "event", "state": "announced", "vehicle": "1", "number": 1, "event": event.to_dict()}
    assert view.announced(alert).startswith(f"announced: {view.words(event)}") and event.reason in view.announced(alert)
    text, severity = ground.text_of(alert)
    assert text.isascii() and len(text) <= 50 and "_" not in text and severity in range(8)
    assert not row.brief or row.weakens or row.brief.lower() in text.lower()


@pytest.mark.parametrize("event", EVENTS, ids=lambda e: f"{e.kind} {e.rotors} {e.alternatives} {e.end_s}")
def test_what_a_kind_means_is_asked_of_its_row(event):
    row, answer = kinds.kind_of(event.kind), hexa_diagnosis(events=(event,))
    assert answer.main == (0 if row.wrong else None)
    if row.accuses:
        assert answer.verdict == ("ambiguous" if event.alternatives else "fault")
        lasts = (event.end_s is None and row.lasts) or row.span is Span.STAYS
        notes = {r.rotor for r in answer.rotors if r.status != "healthy"}
        assert notes == (set(event.suspects) if lasts else set())
    elif not row.wrong:
        assert answer.verdict == "healthy" and all(r.status == "healthy" for r in answer.rotors)
    assert (colours.of_event(event) != colours.INK) == (row.wrong and bool(event.rotors))
    assert view.lasting([event]) == ([event] if row.ongoing(event.end_s) else [])
    # Of a log that contradicts itself, and of a link that does up to 60 s, what rests on outputs is not said.
    assert hexa_diagnosis(events=(event,), doubts=("Nothing moved.",)).events == (() if row.by_outputs else (event,))
    assert believed((event,), 60.0) == (() if row.by_outputs else (event,)) and believed((event,), 10.0) == (event,)


def test_a_rotor_that_follows_no_command_is_said_so_everywhere():
    event = hexa_event(end_s=None, loss=(0.98,), interval=((0.9, 1.0),), extra={"gives": 2.14})
    answer = hexa_diagnosis(events=(event,))
    for text in (answer.headline, answer.reason, view.words(event, 50.0)):
        assert "stuck at 2.1 times hover thrust" in text and "98 %" not in text
    alert = {"type": "event", "state": "announced", "vehicle": "1", "number": 1, "event": event.to_dict()}
    assert ground.text_of(alert)[0] == "rotorwatch: rotor 3 stuck at 2.1x hover"
    for gives, words in ((0.04, "0.0x"), (3.3, "3.3x"), (9.96, "10x"), (10.0, "10x"), (33.4, "33x"), (2000.0, "999x")):
        alert["event"]["gives"] = gives
        assert ground.text_of(alert)[0] == f"rotorwatch: rotor 3 stuck at {words} hover"


def test_what_a_stuck_rotor_gives_is_reported_again_when_it_is_another_thrust():
    """The first estimate was 1.9 times hover, and that of the whole log 3.3."""
    event = hexa_event(end_s=None, loss=(0.98,), interval=((0.9, 1.0),), extra={"gives": 1.94})
    changes, alert = Changes(), {"type": "event", "state": "announced", "vehicle": "1", "number": 1}
    assert [c.what for c in changes.since_last((event,))] == ["announced"]
    reported = ground.gist({**alert, "event": event.to_dict()})
    for gives, new, worth in ((1.97, [], False), (2.1, ["changed"], False), (3.3, ["changed"], True)):
        event = replace(event, extra={"gives": gives})
        assert [c.what for c in changes.since_last((event,))] == new
        assert ground.worth_sending(reported, {**alert, "state": "changed", "event": event.to_dict()}) is worth


def test_a_kind_without_words_of_its_own_has_the_plain_ones():
    (row,) = (r for r in PLANTED if r.name == "gives_more")
    answer = hexa_diagnosis(events=(an_event(row.name),))
    assert answer.headline == "More thrust than commanded of rotor 3 (front left) at 31.20 s."
    assert answer.advice[0].startswith("Do not fly again until rotor 3 (front left) has been inspected")
    assert answer.rotors[2].note == "more thrust than commanded since 31.20 s"
    assert said(row.began, an_event(row.name), over="") == "At 31.20 s more thrust than commanded of rotor 3."


def test_the_number_of_a_kind_is_for_ever_and_not_its_place():
    """Boards send it: a row that is put above others changes nothing."""
    given = definition.LOSS, definition.OUTPUT_OVERRIDE, definition.CONTACT, definition.TURNED_MOUNT
    assert [kinds.number(name) for name in (kinds.LOSS, kinds.OVERRIDE, kinds.CONTACT, kinds.TURNED)] == list(given)
    assert [kinds.number(name) for name in (kinds.LOST, kinds.ORDER, kinds.DESYNC, kinds.SLOW, kinds.HIGH, kinds.LOW)] == list(range(3, 9))
    assert len({row.number for row in (*KINDS, *PLANTED)}) == len((*KINDS, *PLANTED))
    found = packed([an_event(name) for name in NAMES])["kind"].tolist()
    assert found[:-1] == [row(name).number for name in NAMES[:-1]] and found[-1] not in found[:-1]


def test_the_document_has_every_kind_and_no_other():
    text = (ROOT / "docs" / "json.md").read_text(encoding="utf-8").split("The kinds of events are")[1].split("\n\n")[1]
    assert re.findall(r"^\| `(\w+)` \| (.*) \|$", text, re.MULTILINE) == [(r.name, r.meaning) for r in EVENT_ROWS]


def spelled(path):
    """The names of kinds that a source file spells out."""
    if path.suffix != ".py":
        return {name for name in [r.name for r in KINDS] if "_" in name and name in path.read_text(encoding="utf-8")}
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return {n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)} & {r.name for r in KINDS}


def test_no_other_source_spells_out_kinds():
    files = [p for folder in (SOURCE, LABORATORY) for p in folder.rglob("*") if p.suffix in (".py", ".js", ".html")]
    names = {p: p.relative_to(SOURCE.parent).as_posix().removeprefix("rotorwatch/") for p in files}
    found = {names[p]: spelled(p) for p in files if p.name != "kinds.py"}
    found = {name: names for name, names in found.items() if names}
    assert "flight/kinds.py" not in found and spelled(SOURCE / "flight" / "kinds.py") == {r.name for r in KINDS}
    assert all(names <= ELSEWHERE.get(name, set()) for name, names in found.items()), found


def test_some_part_of_the_assessing_makes_each_kind():
    rooms = ("engine", "witnesses", "answer")
    trees = [ast.parse(p.read_text(encoding="utf-8")) for room in rooms for p in (SOURCE / room).rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    constants = {name: value for name, value in vars(kinds).items() if isinstance(value, str)}
    made = {constants.get(node.id) for node in nodes if isinstance(node, ast.Name)}
    made |= {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert {r.name for r in KINDS} <= made
