"""What happened when control was lost: four sentences in every view, first, with one picture, and nowhere a sign that all was well."""

from __future__ import annotations

import io
import json
import re
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rich.console import Console
from tests import tumbling

import test_json
from agreement import walk
from conftest import hexa_event
from fleet_history import row as history_row
from rotorwatch import airframes, diagnose
from rotorwatch.answer import story
from rotorwatch.answer.conclusion import Evidence, conclude
from rotorwatch.answer.picture import MOST
from rotorwatch.fleet import assess, fleet_pages
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Diagnosis, Event
from rotorwatch.report import html, overview, terminal, upset
from test_browser_report import complaints

PLACES = ("front right", "rear left", "front left", "rear right")
HOPS = ((4.0, 60.0),)


@cache
def crash(case: str = "climb", rate: float = 50.0) -> Diagnosis:
    duration, seed = (11.0, 1) if case == "climb" else (15.0, 0)
    return diagnose(tumbling.fly("quad-x", case, seed, rate, duration, 9.0)[0], airframes.named("ardupilot-quad-x"))


@cache
def page(case: str = "climb", rate: float = 50.0) -> str:
    return html.page(crash(case, rate))


def printed(answer: Diagnosis) -> str:
    out = Console(width=200, color_system=None, highlight=False, markup=False, file=io.StringIO())
    with out.capture() as said:
        out.print(terminal.diagnosis(answer))
    return said.get()


def lost(cause: str, **more) -> Event:
    extra = {"cause": cause, "worked_until_s": [30.0] * 4, "impact_s": 33.0, "how": "falling without thrust", "evidence": []}
    given = {"rotors": (), "onset_s": 30.0, "detected_s": 31.0, "end_s": 33.0, "loss": (), "interval": (), "reason": "why"}
    return hexa_event(kind="loss_of_control", **{**given, **more, "extra": extra | more.get("extra", {})})


def reported(*events: Event, main: int | None = None) -> list[str]:
    return [s.text for s in story.narrate(events, main, 4, PLACES, HOPS)]


def test_a_crash_is_reported_from_its_flight_to_the_terminal():
    answer = crash()
    lines = printed(answer).splitlines()
    first = lines.index("What happened")
    assert not any("Rotors" in line for line in lines[:first])
    want = (
        r" 1\. The vehicle lifted off at 3\.\d\d s\.",
        r" 2\. At 5\.\d\d s rotor 3 \(front left\) lost \d\d % \(\d\d–\d+ %\) of thrust\.",
        r" 3\. Control was lost at 6\.\d\d s, tilted \d+ degrees from its setpoint; the departure began at 5\.\d\d s\.",
        r" 4\. It hit the ground at 7\.\d\d s\.",
    )
    for line, pattern in zip(lines[first + 1 : first + 5], want, strict=True):
        assert re.fullmatch(pattern, line.rstrip())
    assert [s.text for s in answer.story] == [line[4:].rstrip() for line in lines[first + 1 : first + 5]]
    assert [s.time_s for s in answer.story] == sorted(s.time_s for s in answer.story)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("case", ["climb", "disarmed"])
def test_no_view_of_a_crash_contradicts_another(case):
    assert walk(crash(case, 50.0 if case == "climb" else 10.0)) == []


def test_the_json_of_a_crash_is_documented_and_comes_back():
    answer = crash()
    found = json.loads(answer.to_json())
    table = test_json.documented("Fields")
    assert set(test_json.fields(found, table)) <= set(table)
    assert Diagnosis.from_dict(found).to_dict() == found
    assert found["story"][3] == {"time_s": round(answer.story[3].time_s, 4), "text": answer.story[3].text}


def test_the_picture_is_small_at_any_rate_and_shows_what_was_wanted():
    facts = crash().picture
    assert facts is not None
    assert facts["accused"] == [3]
    assert [m["what"] for m in facts["marks"]] == ["lift-off", "first departure", "control lost", "impact"]
    gone = next(e for e in crash().events if e.kind == "loss_of_control")
    assert facts["marks"][2]["time_s"] == gone.onset_s < facts["marks"][3]["time_s"]
    flown, wanted = (np.asarray(facts["attitude"][name]) for name in ("roll_deg", "wanted_roll_deg"))
    time = np.asarray(facts["attitude"]["time_s"])
    before, after = time < facts["marks"][1]["time_s"], time > facts["marks"][2]["time_s"]
    assert np.nanmax(np.abs(flown - wanted)[before]) < 10.0
    assert np.nanmax(np.abs(flown - wanted)[after]) > 30.0
    assert all(len(row) == len(facts["commands"]["time_s"]) <= MOST for row in facts["commands"]["share"])
    fast = crash("climb", 400.0).picture
    assert fast is not None
    assert max(len(fast[name]["time_s"]) for name in ("attitude", "commands")) <= MOST


def test_what_is_said_beside_a_crash_moves_no_mark_of_its_picture():
    """Reports of the autopilot stand in the story, too: before, and after the impact."""
    from rotorwatch.answer import picture

    answer = crash()
    reported = [replace(e, kind="autopilot_report", rotors=(), loss=(), interval=(), alternatives=(), onset_s=t, end_s=None)
            for e in answer.events[:1] for t in (1.0, 59.0)]  # fmt: skip
    flight, craft = Flight("log", "", {}, 60.0), airframes.named("ardupilot-quad-x")
    hops = tuple(tuple(hop) for hop in answer.flight["hops"])
    given = [picture.compose(flight, craft, events, answer.main, hops) for events in (answer.events, (*answer.events, *reported))]
    assert given[0]["marks"] == given[1]["marks"] == answer.picture["marks"]


@pytest.mark.parametrize(
    ("cause", "said"),
    [
        ("disarmed", "All 4 rotors followed their commands until 30.00 s, when the motors were disarmed in flight."),
        ("knock", "All 4 rotors followed their commands until 30.00 s, when something struck the vehicle."),
        ("power", "All 4 rotors followed their commands until 30.00 s, when the power failed."),
        ("unknown", "No rotor fault was found: as far as the log shows, all 4 rotors followed their commands until 30.00 s."),
    ],
)
def test_to_exonerate_is_reported_as_well(cause, said):
    assert reported(lost(cause), main=0) == [
        "Until 30.00 s the vehicle flew as commanded.",
        said,
        "Control was lost at 31.00 s, falling without thrust; the departure began at 30.00 s.",
        "It hit the ground at 33.00 s.",
    ]


def test_a_loss_long_before_is_the_first_departure():
    weak = hexa_event(rotors=(2,), onset_s=20.0, detected_s=21.0)
    said = reported(weak, lost("rotor", rotors=(2,)), main=0)
    assert said[0] == "Until 20.00 s the vehicle flew as commanded."
    assert said[1].startswith("At 20.00 s rotor 2 (rear left) lost ")


def test_a_loss_that_is_not_why_control_was_lost_leaves_the_cause_in_the_story():
    weak = hexa_event(rotors=(2,), onset_s=20.0, detected_s=21.0)
    said = reported(weak, lost("disarmed"), main=0)
    assert said[1].startswith("At 20.00 s rotor 2 (rear left) lost ")
    assert said[2].endswith("All 4 rotors followed their commands until 30.00 s, when the motors were disarmed in flight.")


def test_candidates_are_all_named():
    said = reported(lost("unknown", rotors=(1,), alternatives=((1,), (2,))), main=0)
    assert said[1] == "At 30.00 s rotor 1 (front right) or rotor 2 (rear left) may have failed, or something else."


def test_an_impact_before_the_loss_was_certain_stays_last():
    moments = story.narrate([lost("knock", extra={"impact_s": 30.5})], 0, 4, PLACES, HOPS)
    assert [s.time_s for s in moments] == [30.0, 30.0, 30.0, 30.5]


def test_how_it_ended_is_reported_where_nothing_was_hit():
    assert reported(lost("knock", extra={"impact_s": None}))[-1] == "Control was regained at 33.00 s."
    open_end = reported(lost("knock", end_s=None, extra={"impact_s": None}))[-1]
    assert open_end == "No impact was seen; control had not been regained by 60.00 s."
    again = reported(lost("knock", extra={"impact_s": None}), lost("knock", onset_s=40.0, detected_s=41.0))[-1]
    assert again.endswith("It was lost again at 40.00 s.")


def test_a_log_that_is_not_believed_says_nothing_of_its_rotors():
    seen = Evidence([lost("disarmed")], 4, places=PLACES, hops=HOPS)
    end = conclude(seen, ("The outputs are not those that flew.",))
    assert end.story
    assert "rotor" not in " ".join(s.text for s in end.story)


def test_a_flight_under_control_has_no_story():
    assert reported(hexa_event()) == []


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("case", ["climb", "disarmed"])
def test_no_view_of_a_crash_has_a_sign_that_all_was_well(case):
    given = case, 50.0 if case == "climb" else 10.0
    answer = crash(*given)
    text, shown = printed(answer), page(*given)
    assert answer.exit_code != 0
    assert "Health" not in text
    assert "Health of every rotor" not in shown
    assert "✓" not in shown + text
    assert 'class="verdict healthy"' not in shown
    assert not any("healthy" in r.grade or r.trend for r in answer.rotors)
    row = overview.Row("x.bin", answer.verdict, "", "", answer.headline)
    assert 'class="healthy"' not in overview._line(row)


def test_each_rotor_has_the_time_until_which_it_worked():
    notes = [r.note for r in crash("disarmed", 10.0).rotors]
    assert all(note.startswith("seen to work until 9.") for note in notes)
    assert all(note in page("disarmed", 10.0).replace("\u00a0", " ") for note in notes)


def test_a_crash_teaches_a_fleet_nothing_and_its_page_says_so():
    row = {"verdict": "inconclusive", "trim": {"lost": True}}
    assert assess._why_not(row, 4) == assess.FELL
    flown = [history_row(k, [0.0, 0.0, 0.0], 4) for k in range(2)]
    flown[1]["trim"]["lost"] = True
    for rows, state in ((flown, "fault"), (flown[::-1], "fault"), (flown[:1], "healthy")):
        standing = assess.standings({"ab": rows}, {})[0]["ab"]
        craft = {"name": "A", "key": "ab", "flights": 2, "airborne_s": 60.0, "last": None, "standing": standing, "new": {}}
        shown = fleet_pages._index([craft | {"state": standing["state"]}])
        assert f'class="{state}"' in shown and ("1 lost control" in shown) == (state == "fault")


PROBE = """<script>
(function probe(tries) {
  if (document.documentElement.dataset.plots === undefined && tries) return setTimeout(probe, 50, tries - 1);
  const box = (e) => e.getBoundingClientRect();
  const plots = [...document.querySelectorAll("#moment .plot")];
  const ink = (c) => {
    const pixels = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    let n = 0;
    for (let i = 3; i < pixels.length; i += 4) n += pixels[i] > 0;
    return n / (pixels.length / 4);
  };
  const canvases = [];
  (function walk(node) {
    if (node.tagName === "CANVAS") canvases.push(node);
    if (node.shadowRoot) walk(node.shadowRoot);
    for (const child of node.children) walk(child);
  })(document.getElementById("moment"));
  document.documentElement.dataset.probe = JSON.stringify({
    story: [...document.querySelectorAll(".story li")].map((e) => [e.textContent, box(e).top]),
    plots: plots.map((e) => [e.id, box(e).top, box(e).height]),
    inked: canvases.filter((c) => c.width && c.height).map(ink),
    table: box(document.querySelector("table.rotors")).top,
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
  });
})(200);
</script>"""


def visited(chromium, folder, width: int):
    page = folder / f"{width}.html"
    page.write_text(html.page(replace(crash(), trace=None)).replace("</body>", PROBE + "</body>"), encoding="utf-8")
    command = [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
    command += [f"--user-data-dir={folder / 'profile'}", f"--window-size={width},900", "--enable-logging=stderr"]
    done = subprocess.run(
        [*command, "--virtual-time-budget=20000", "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120
    )
    seen = re.search(r'<html[^>]* data-probe="([^"]*)"', done.stdout)
    assert seen, done.stderr[-2000:]
    assert complaints([line for line in done.stderr.splitlines() if "CONSOLE" in line]) == []
    return json.loads(seen.group(1).replace("&quot;", '"'))


def test_the_story_and_its_picture_are_the_first_that_a_browser_shows(chromium, tmp_path):
    seen = visited(chromium, tmp_path, 500)
    flat = [" ".join(text.replace("\u2060", "").replace("&nbsp;", " ").split()) for text, _ in seen["story"]]
    assert flat == [s.text for s in crash().story]
    shown = [name for name in upset.NAMES if not name.endswith(("_rate", "_speeds"))]  # flown by attitude, without ESC telemetry
    assert [name for name, *_ in seen["plots"]] == [f"plot-{name}" for name in shown]
    tops = [top for _, top in seen["story"]] + [top for _, top, _ in seen["plots"]] + [seen["table"]]
    assert tops == sorted(tops)
    assert tops[0] < 450
    assert all(height > 80 for *_, height in seen["plots"])
    assert sum(share > 0.01 for share in seen["inked"]) >= len(shown)
    assert seen["overflow"] <= 0
