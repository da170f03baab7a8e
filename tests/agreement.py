"""Whether all views of one answer say the same: JSON, terminal, page, top view and plots, field by field.

`walk(diagnosis)` returns the contradictions it finds, as sentences; an empty list when there is none. Every field of the JSON has an entry
in FIELDS: a check, or the word that it is not shown. A field without an entry is itself a contradiction: nobody has decided what the
views say of it.
"""

import io
import json
import re
from html.parser import HTMLParser
from unittest import mock

import numpy as np
from rich.console import Console

from rotorwatch import report
from rotorwatch.flight.diagnosis import EXIT_CODES
from rotorwatch.flight.kinds import DESYNC, LOSS, OVERRIDE
from rotorwatch.report import blocks, colours, drawing, figures, html, sections, terminal
from rotorwatch.report.sections import grades as health_section

WIDTHS = (40, 80, 200)
EPS = 1.01e-4  # numbers in the JSON are rounded to four digits


def flat(text):
    """One line, spaces and no-break spaces alike."""
    return " ".join(text.replace("\u2060", "").replace("\u00a0", " ").split())


class Page(HTMLParser):
    """Visible text of a page; the rotor table's rows; titles and colours of the top view; colours of events and chips."""

    def __init__(self, text):
        super().__init__()
        self.words, self.raw, self.rows, self.places, self.tints, self.row = [], None, [], {}, [], None
        self.inside, self.rotor = "", None
        self.feed(text)
        self.text = flat(" ".join(self.words))

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.raw = tag if tag in ("script", "style") else self.raw
        if tag == "table":
            self.inside = attrs.get("class", "")
        if tag == "tr" and self.inside == "rotors" and "style" in attrs:
            self.row = {"status": attrs.get("class"), "tint": attrs["style"].partition(":")[2], "words": []}
            self.rows.append(self.row)
        if tag == "g" and attrs.get("class", "").startswith("rotor "):
            self.rotor = {"status": attrs["class"].split()[1], "tint": attrs["style"].partition(":")[2], "title": ""}
            self.places[len(self.places) + 1] = self.rotor
        if tag == "li" and "--tint" in attrs.get("style", ""):
            self.tints.append(attrs["style"].partition(":")[2])

    def handle_endtag(self, tag):
        self.raw = None if tag == self.raw else self.raw
        self.row = None if tag == "tr" else self.row
        self.inside = "" if tag == "table" else self.inside
        self.rotor = None if tag == "g" else self.rotor

    def handle_data(self, data):
        if self.raw:
            return
        self.words.append(data)
        if self.row is not None:
            self.row["words"].append(data)
        if self.rotor is not None:
            self.rotor["title"] += data


class Views:
    """All views of one diagnosis, made once."""

    def __init__(self, diagnosis):
        self.diagnosis = diagnosis
        self.json = json.loads(diagnosis.to_json())
        self.figures = {}
        with mock.patch.object(figures, "drawn", self._plots(figures.drawn)):
            self.page_text = html.page(diagnosis)
        self.page = Page(self.page_text)
        self.screens, self.faults = {}, []
        for width in WIDTHS:
            screen = Console(width=width, color_system=None, highlight=False, emoji=False, markup=False, file=io.StringIO())
            with screen.capture() as out:
                screen.print(terminal.diagnosis(diagnosis, verbose=True))
            self.screens[width] = flat(out.get())
            longest = max(len(line.rstrip()) for line in out.get().splitlines())
            self.expect(longest <= width, f"a line of {longest} columns on a terminal of {width}")
            self.expect("…" not in out.get() and "\x1b" not in out.get(), f"text is cut or coloured at {width} columns")

    def _plots(self, make):
        def wrapped(diagnosis, shown):
            self.figures = make(diagnosis, shown)
            return self.figures

        return wrapped

    def expect(self, fine, what):
        if not fine:
            self.faults.append(what)

    def shown(self, text, what, page=True, screen=True):
        """A text stands on the page and on every terminal."""
        text = flat(str(text))
        self.expect(not page or text in self.page.text, f"{what} is not on the page: {text}")
        for width in WIDTHS if screen else ():
            self.expect(text in self.screens[width], f"{what} is not on a terminal of {width} columns: {text}")


def walk(diagnosis, flown=True):
    """Contradictions within one answer and between its views, as sentences. flown: its trace is of the same flight."""
    views = Views(diagnosis)
    views.flown = flown
    for path, value in leaves(views.json):
        if path not in FIELDS:
            views.faults.append(f"{path}: nobody has said how it is shown")
        elif FIELDS[path] is not None:
            FIELDS[path](views, value)
    for check in (verdict, main_event, headline, rotors, health, events, advice, page, plots, texts, one_line):
        check(views)
    return views.faults


def leaves(value, path=""):
    """(path, value) of all that is not an object, nor a list of objects; list positions as []."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from leaves(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and any(isinstance(v, (dict, list)) for v in value) and not path.endswith("interval"):
        for inner in value:
            yield from leaves(inner, f"{path}[]")
    else:
        yield path, value


# What is said


def of_kind(views, *kinds):
    return [e for e in views.json["events"] if e["kind"] in kinds]


def explanations(event):
    return [event["rotors"], *event["alternatives"]]


def named(event):
    return {r for who in explanations(event) for r in who}


def states(views):
    return {r["rotor"]: r for r in views.json["rotors"]}


def verdict(views):
    """Verdict, exit code, main event and states belong together."""
    d, expect = views.json, views.expect
    main = None if d["main_event"] is None else d["events"][d["main_event"]]
    whole = (d["whole_flight"] or {}).get("verdict")
    status = {r["status"] for r in d["rotors"]}
    expect(views.diagnosis.exit_code == EXIT_CODES[d["verdict"]], "the exit code is of another verdict")
    sure = [e for e in of_kind(views, LOSS, OVERRIDE, DESYNC) if not e["alternatives"]]
    if d["verdict"] == "healthy":
        expect(not of_kind(views, LOSS, OVERRIDE, DESYNC) and main is None, "healthy with a loss or an override")
        expect(status <= {"healthy"}, f"healthy with rotors {status}")
        expect(whole in (None, "healthy", "inconclusive"), "healthy, and the comparison says otherwise")
    if d["verdict"] == "inconclusive":
        expect(
            not of_kind(views, LOSS, OVERRIDE, DESYNC) and (main is None or main["kind"] == "loss_of_control"),
            "inconclusive with a loss or an override",
        )
        known = {r["status"] for r in d["rotors"] if r["since_takeoff"] is not None}
        expect(status <= {"unobservable"} | known and known <= {"healthy", "unobservable"}, f"inconclusive with rotors {status}")
    if d["verdict"] == "crashed":
        expect(main is not None and main["kind"] == "loss_of_control" and not sure, "crashed, and control was not lost")
        expect(status <= {"unobservable"}, f"crashed with rotors {status}")
    if d["verdict"] == "ambiguous":
        expect(not sure, "ambiguous with an event that is certain")
        over = main is not None and main["end_s"] is not None
        expect("suspect" in status or over, "ambiguous without a suspect")
        expect(not status & {"degraded", "failed"}, "ambiguous with a rotor that is called broken")
    if d["verdict"] == "fault":
        expect(bool(sure) or whole == "fault", "fault without anything certain")
        over = main is not None and main["end_s"] is not None
        expect(bool(status & {"degraded", "failed", "suspect"}) or over, "fault, and all rotors are healthy at the end")
    expect(bool(sure) <= (d["verdict"] in ("fault",)), "something certain, and no fault")


def main_event(views):
    """No sure event that is as large is earlier than the main one."""
    d = views.json
    if d["main_event"] is None:
        views.expect(not of_kind(views, LOSS, OVERRIDE, DESYNC), "events, and none of them is the main one")
        return
    main = d["events"][d["main_event"]]
    rivals = [e for e in of_kind(views, LOSS, OVERRIDE, DESYNC) if bool(e["alternatives"]) <= bool(main["alternatives"])]
    biggest = max((max(e["loss"]) for e in rivals if e["kind"] == LOSS), default=0.0)
    for e in rivals:
        if not e["alternatives"] and main["alternatives"]:
            views.expect(False, "the main event is ambiguous beside a certain one")
        if e["kind"] == LOSS and max(e["loss"]) >= 0.5 * biggest + EPS:
            views.expect(e["onset_s"] >= main["onset_s"] - 1.0 - EPS, "a large loss came before the main event")
    if main["kind"] == LOSS:
        views.expect(max(main["loss"]) >= 0.5 * biggest - EPS, "the main loss is a small one")


def headline(views):
    """Headline and reason speak of the main event and of nothing else, with its numbers."""
    d, said = views.json, views.json["headline"]
    unassessed = bool(d["rotors"]) and {r["from_takeoff"] for r in d["rotors"]} == {"not assessed"}
    hidden = "Damage present at take-off was not assessed" in said
    views.expect(hidden == (unassessed and d["verdict"] == "healthy"), "the headline and the rotors differ on take-off")
    if d["main_event"] is None or (d["verdict"] == "fault" and d["events"][d["main_event"]]["alternatives"]):
        return
    main = d["events"][d["main_event"]]
    spoken = set(map(int, re.findall(r"(\d+) \((?:front|rear|left|right|centre)", said)))
    spoken |= set(map(int, re.findall(r"rotors? (\d+)", said, re.IGNORECASE)))
    views.expect(spoken == named(main), f"the headline names rotors {spoken}, the main event {named(main)}")
    event = views.diagnosis.events[views.diagnosis.main]
    views.expect(report.seconds(event.onset_s) in said, "the headline has another time than the main event")
    views.expect(all(str(r) in d["reason"] for r in main["rotors"]), "the reason names other rotors than the main event")
    if main["kind"] == LOSS and not main["alternatives"]:
        for text in (said, d["reason"]):
            gives = event.extra.get("gives")
            wanted = report.losses(event) if gives is None else f"stuck at {gives:.1f} times"
            views.expect(wanted in text, f"the loss of the main event is not in: {text}")
        views.expect((main["end_s"] is None) == ("until" not in said), "headline and main event differ on the end")


def health(views):
    """Every rotor's grade and trend stand on the page and in the terminal, where anything was assessed; a word fits its interval."""
    states_ = views.json["rotors"]
    assessed = any(r["status"] != "unobservable" for r in states_) and not views.json["story"]
    for r in states_ if assessed else ():
        me = f"rotor {r['rotor']}"
        state = views.diagnosis.rotors[r["rotor"] - 1]
        views.shown(health_section.grade(state), f"the grade of {me}")
        views.expect(r["status"] != "failed" or "healthy" not in r["grade"], f"{me} failed and is graded {r['grade']}")
        trend = r["trend"]
        if trend is None:
            continue
        shown = next(row[3] for row in health_section.rows(views.diagnosis) if row[0] == str(r["rotor"]))
        known = shown.startswith(trend["word"])
        low, high = trend["interval"]
        views.expect(low <= trend["per_minute"] <= high, f"the trend of {me} lies outside its interval")
        sign = {"growing": low > 0, "shrinking": high < 0}.get(trend["word"])
        views.expect(sign is not False, f"the trend of {me} is {trend['word']} with {low} to {high}")
        sure = trend["word"] in ("growing", "shrinking")
        views.expect(known or (not sure and max(map(abs, trend["interval"])) > health_section.VAGUE), f"the trend of {me} is left out")
        if not known:
            continue
        views.shown(trend["word"], f"the trend of {me}")
        for end in trend["interval"] if sure else [max(trend["interval"], key=abs)]:
            views.shown(report.rate(abs(end)).split()[0], f"the trend's interval of {me}", screen=False)
        for at in (trend["start_s"], trend["end_s"]):
            views.shown(report.seconds(at), f"the span of the trend of {me}", screen=False)


def rotors(views):
    """Every rotor's state follows from the events: nothing more is claimed, nothing less."""
    d, expect = views.json, views.expect
    whole = d["whole_flight"] or {}
    for k, r in states(views).items():
        low, high = r["interval"]
        me = f"rotor {k} ({r['status']})"
        lasting = [e for e in of_kind(views, LOSS) if k in named(e) and e["end_s"] is None]
        sure = [e for e in lasting if not e["alternatives"]]
        claims = [e for e in of_kind(views, LOSS, OVERRIDE, DESYNC) if k in named(e)]
        expect(0 <= low <= high <= 1 and low - EPS <= r["loss"] <= high + EPS, f"{me}: loss {r['loss']} outside {r['interval']}")
        expect(r["status"] in ("healthy", "degraded", "failed", "suspect", "unobservable"), f"{me}: unknown status")
        if d["verdict"] in ("inconclusive", "crashed"):
            continue
        for e in lasting:
            expect(r["status"] not in ("healthy", "unobservable"), f"{me} although an event that lasts names it")
            if e["alternatives"]:
                expect(
                    r["status"] == "suspect" or bool(sure) or r["from_takeoff"] == "damaged", f"{me} although one of several explanations"
                )
                top = e["interval"][e["rotors"].index(k)][1] if k in e["rotors"] else max(h for _, h in e["interval"])
                expect(high >= top - EPS, f"{me}: the interval does not cover an explanation")
                expect(bool(sure) or low == 0 or r["from_takeoff"] == "damaged", f"{me}: the interval leaves out that another rotor did it")
        if sure:
            e = sure[-1]
            j = e["rotors"].index(k)
            expect(r["status"] == ("failed" if e["loss"][j] > 0.8 else "degraded"), f"{me} with a certain loss of {e['loss'][j]}")
            expect(abs(r["loss"] - e["loss"][j]) < EPS, f"{me}: another loss than its event's")
            expect(low <= e["interval"][j][0] + EPS and high >= e["interval"][j][1] - EPS, f"{me}: a smaller interval than its event's")
        if r["status"] in ("degraded", "failed"):
            expect(bool(sure) or (whole.get("verdict") == "fault" and k in whole["rotors"]), f"{me} without anything certain")
        if r["status"] == "suspect":
            expect(bool(r["note"]), f"{me}: no word why")
            # Its own evidence, an unassessed landing, an override, the trim or the comparison: at least one must have named it.
            by_evidence = any(words in r["note"] for words in ("no event explains", "or the wind changed then"))
            why = bool(claims) or r["from_takeoff"] == "suspect" or by_evidence
            expect(why, f"{me} although nothing names it")
        if r["status"] == "healthy":
            expect(r["since_takeoff"] is not None, f"{me}: no word on what could have hidden")
            expect(all(e["end_s"] is not None for e in claims), f"{me} although something about it lasts")
            expect(r["from_takeoff"] != "bounded" or not whole, f"{me} is bounded by any healthy vehicle beside its own flights")
            if r["from_takeoff"] == "not assessed":
                expect([low, high] == list(r["since_takeoff"]), f"{me}: an interval of more than was assessed")
            else:
                expect(high >= r["since_takeoff"][1] - EPS, f"{me}: less could hide in all than since take-off")
            lost = any(e["kind"] == "loss_of_control" for e in d["events"])
            expect(bool(claims) == bool(r["note"]) or (lost and not claims), f"{me}: note and events differ")
        expect((r["from_takeoff"] == "damaged") <= (r["status"] in ("degraded", "failed")), f"{me} and damaged from take-off")


def events(views):
    """Events are in themselves consistent, and shown with the same numbers everywhere."""
    for e, event in zip(views.json["events"], views.diagnosis.events, strict=True):
        me = f"event {e['kind']} at {e['onset_s']}"
        views.expect(e["onset_s"] <= e["detected_s"] + EPS, f"{me}: announced before it began")
        views.expect(e["end_s"] is None or e["end_s"] >= e["onset_s"] - EPS, f"{me}: over before it began")
        views.expect(len(e["loss"]) == len(e["interval"]) and len(e["loss"]) in (0, len(e["rotors"])), f"{me}: loss of other rotors")
        views.expect(all(set(a) != set(e["rotors"]) for a in e["alternatives"]), f"{me}: an alternative that is none")
        views.expect(e["kind"] != "contact" or not e["rotors"], f"{me}: a contact accuses a rotor")
        views.shown(event.means.noun, f"{me}: its kind")
        views.shown(report.candidates(event), f"{me}: its rotors", page=False)
        views.shown(report.candidates(event, report.places(views.diagnosis)), f"{me}: its rotors", screen=False)
        views.shown(report.seconds(event.onset_s), f"{me}: its beginning")
        views.shown(report.seconds(event.detected_s), f"{me}: its announcement")
        views.shown(report.probability(event.probability), f"{me}: its probability")
        if event.end_s is not None:
            views.shown(report.seconds(event.end_s), f"{me}: its end")
        views.shown(report.size(event), f"{me}: its size")
        if event.kind == LOSS:
            for text in report.losses(event).split(", "):
                views.shown(text, f"{me}: its loss")
    tints = [colours.of_event(e) for e in views.diagnosis.events]
    views.expect(views.page.tints == tints, "the events' colours are not those of their verdicts")


def advice(views):
    """What to do names every rotor that is broken or suspected, and no other."""
    d = views.json
    text = " ".join(d["advice"])
    spoken = set(map(int, re.findall(r"(\d+) \((?:front|rear|left|right|centre)", text)))
    concerned = {k for k, r in states(views).items() if r["status"] in ("degraded", "failed", "suspect")}
    over = set() if d["main_event"] is None else named(d["events"][d["main_event"]])
    views.expect(concerned <= spoken, f"rotors {concerned - spoken} are not in the advice")
    views.expect(spoken <= concerned | over, f"the advice names rotors {spoken - concerned - over}")


def page(views):
    """The rotor table, the top view and the embedded JSON of the page; the rotor table of every terminal."""
    d, looks = views.diagnosis, colours.looks(views.diagnosis)
    views.expect(len(views.page.rows) == len(d.rotors), "the page's rotor table has other rows")
    for row, r in zip(views.page.rows, d.rotors, strict=False):
        words = flat(" ".join(row["words"]))
        cells = (r.rotor, r.place, r.status, report.sentence(r.note), report.rotor_loss(r), report.rotor_interval(r))
        views.expect(words == flat(" ".join(map(str, cells))), f"the page's row says {words}, not {cells}")
        views.expect((row["status"], row["tint"]) == (r.status, looks[r.rotor][0]), f"rotor {r.rotor}: the row's look")
        if r.status == "healthy" and r.from_takeoff == "not assessed":
            views.expect("%" not in words.replace(report.rotor_interval(r), ""), words)
        for width, screen in views.screens.items():
            wide = " ".join(map(str, (r.rotor, r.place, r.status, report.rotor_loss(r), report.rotor_interval(r)))).strip()
            lines = f"rotor {r.rotor}, {r.place}, {r.status}, loss {report.rotor_loss(r)}"
            views.expect(wide in screen or lines in screen, f"rotor {r.rotor}: not on a terminal of {width} columns: {wide}")
    if drawing.airframe(d):
        for r in d.rotors:
            drawn = views.page.places[r.rotor]
            views.expect((drawn["status"], drawn["tint"]) == (r.status, looks[r.rotor][0]), f"rotor {r.rotor}: the top view's look")
            title = f"{r.status}, loss {report.rotor_loss(r)}"
            views.expect(title in flat(drawn["title"]), f"rotor {r.rotor}: the top view says {drawn['title']}")
    found = re.search(r'<script type="application/json" id="diagnosis">(.*?)</script>', views.page_text, re.DOTALL)
    views.expect(bool(found) and json.loads(found.group(1)) == views.json, "the page carries another JSON")
    bad = set(colours.faulty(d))
    for k, (tint, _) in looks.items():
        views.expect((tint == colours.FAULT) == (k in bad), f"rotor {k} is {tint}")
    broken = {r.rotor for r in d.rotors if r.status in ("degraded", "failed")}
    views.expect(broken <= bad and (d.verdict == "fault" or not bad), "colours of faulty rotors without a fault")


def plots(views):
    """Lines have the rotors' colours, and the bands end where the rotor table says."""
    d, looks = views.diagnosis, colours.looks(views.diagnosis)
    if d.trace is None or d.trace.time.size < 2:
        return
    drawn = views.figures
    for name in ("loss", "command"):
        for line in drawn[name].renderers:
            if (line.name or "").startswith("rotor ") and hasattr(line.glyph, "line_color") and not hasattr(line.glyph, "fill_color"):
                k = int(line.name.split()[1])
                views.expect(line.glyph.line_color == looks[k][0], f"rotor {k} has another colour in the plot of {name}")
    if not views.flown:
        return
    last = np.flatnonzero(~np.isnan(d.trace.loss[:, 0]))[-1]
    for r in d.rotors:
        top = float(d.trace.upper[last, r.rotor - 1])
        if r.status == "suspect":
            views.expect(top >= r.loss - 0.05, f"rotor {r.rotor}: the plot ends at {top}, the table at {r.interval}")


def texts(views):
    """Sentences of the sections, on the page and in the terminal."""
    for view in ("page", "terminal"):
        for one in sections.shown(views.diagnosis, view):
            for block in one.blocks():
                if isinstance(block, blocks.Text) and not one.has("page"):
                    views.shown(block.text, one.section.name, view == "page", view == "terminal")


def one_line(views):
    """One flight of several on a line: the same verdict and headline."""
    text = flat(terminal.line("x.bin", views.diagnosis).plain)
    views.expect(text == flat(f"{report.VERDICTS[views.json['verdict']].lower()} x.bin {views.json['headline']}"), text)


# Every field of the JSON


def word(name):
    return lambda views, value: views.shown(value, name)


def sentence(name):
    return lambda views, value: views.shown(report.sentence(value), name) if value else None


def every(name, screen=True):
    return lambda views, value: [views.shown(v, name, screen=screen) for v in value]


SHOWN = None  # by a check above, together with the fields it belongs to
HIDDEN = None  # for programs only
FIELDS = {
    "schema": lambda views, value: views.expect(value == 3, "another schema"),
    "flight.name": word("the name"),
    "flight.format": lambda views, value: views.shown(value, "the format", screen=False),
    "flight.autopilot": word("the autopilot"),
    "flight.firmware": HIDDEN,
    "flight.frame": word("the frame"),
    "flight.rotors": lambda views, value: views.expect(value == len(views.json["rotors"]), "another number of rotors"),
    "flight.geometry[].x": SHOWN,
    "flight.geometry[].y": SHOWN,
    "flight.geometry[].spin": SHOWN,
    "flight.boot_s": lambda views, value: value and views.shown(f"{value:.2f} s since boot", "the clock", screen=False),
    "flight.utc_start": lambda views, value: value and views.shown(report.day(views.diagnosis), "UTC"),
    "flight.duration_s": lambda views, value: views.shown(f"{value:.1f} s", "the duration", screen=False),
    "flight.airborne_s": lambda views, value: [views.shown(f"{v:.1f}", "take-off or landing", screen=False) for v in value],
    "flight.hops[]": HIDDEN,
    "flight.hops": HIDDEN,
    "flight.profile": word("the rates"),
    **{f"fit_to_fly.{name}": every("a step") for name in ("checks", "surer")},
    "fit_to_fly.word": lambda views, value: (
        views.shown(report.sentence(value), "the word", screen=False),
        views.shown(value.upper(), "the word", page=False),
    ),
    "causes": HIDDEN,
    **{f"causes[].{name}": HIDDEN for name in ("name", "rotors", "probability", "evidence")},  # events and reasons, for programs
    "verdict": lambda views, value: (
        views.shown(report.VERDICTS[value], "the verdict", screen=False),
        views.shown(report.VERDICTS[value].upper(), "the verdict", page=False),
    ),
    "headline": word("the headline"),
    "reason": sentence("the reason"),
    "story": lambda views, value: views.expect(not of_kind(views, "loss_of_control"), "control was lost, and no story"),
    "story[].time_s": HIDDEN,
    "picture": SHOWN,
    "picture.start_s": SHOWN,
    "picture.end_s": SHOWN,
    "picture.marks[].time_s": SHOWN,
    "picture.marks[].what": SHOWN,
    "picture.accused": lambda views, value: views.expect(
        {*value} <= {r for e in views.json["events"] for r in e["rotors"]}, "the picture accuses a rotor that no event names"
    ),
    "picture.attitude": SHOWN,
    **{f"picture.attitude.{name}": SHOWN for name in ("time_s", "roll_deg", "pitch_deg", "wanted_roll_deg", "wanted_pitch_deg")},
    "picture.rates": SHOWN,
    **{
        f"picture.rates.{name}": SHOWN
        for name in ("time_s", *(f"{wanted}{axis}_dps" for wanted in ("", "wanted_") for axis in ("roll", "pitch", "yaw")))
    },
    "picture.speeds": SHOWN,
    "picture.speeds.time_s": SHOWN,
    "picture.speeds.rpm[]": SHOWN,
    "picture.commands": SHOWN,
    "picture.commands.time_s": SHOWN,
    "picture.commands.share[]": SHOWN,
    "story[].text": word("the story"),
    "advice": every("the advice"),
    "main_event": SHOWN,
    "rotors": SHOWN,
    "rotors[].rotor": SHOWN,
    "rotors[].place": SHOWN,
    "rotors[].loss": SHOWN,
    "rotors[].interval": SHOWN,
    "rotors[].status": SHOWN,
    "rotors[].since_takeoff": SHOWN,
    "rotors[].from_takeoff": SHOWN,
    "rotors[].grade": SHOWN,
    "rotors[].trend": SHOWN,
    "rotors[].trend.per_minute": SHOWN,
    "rotors[].trend.interval": SHOWN,
    "rotors[].trend.start_s": SHOWN,
    "rotors[].trend.end_s": SHOWN,
    "rotors[].trend.word": SHOWN,
    "rotors[].trend.beyond": HIDDEN,
    "rotors[].imbalance": SHOWN,
    "rotors[].imbalance.value": lambda views, value: views.shown(f"{value:.2f}", "an imbalance"),
    "rotors[].imbalance.interval": lambda views, value: views.shown("{:.2f}–{:.2f}".format(*value), "an imbalance's interval"),
    "rotors[].imbalance.unit": word("the unit of an imbalance"),
    **{f"rotors[].imbalance.{name}": HIDDEN for name in ("windows", "speed_rad_s", "blade_passing", "together")},
    "rotors[].note": lambda views, value: value and views.shown(value[1:], "a rotor's note"),
    "events": SHOWN,
    "events[].kind": SHOWN,
    "events[].rotors": SHOWN,
    "events[].alternatives": SHOWN,
    "events[].alternatives[]": SHOWN,
    "events[].onset_s": SHOWN,
    "events[].detected_s": SHOWN,
    "events[].end_s": SHOWN,
    "events[].loss": SHOWN,
    "events[].interval": SHOWN,
    "events[].probability": SHOWN,
    "events[].reason": lambda views, value: value and views.shown(value[1:], "an event's reason"),
    "events[].loss_2s": lambda views, value: [views.shown(report.percent(v), "the loss 2 s later", screen=False) for v in value],
    "events[].override": lambda views, value: views.shown(value, "the kind of override", screen=False),
    "events[].size": SHOWN,
    "events[].gives": HIDDEN,  # in words in the event's reason, to one digit
    "events[].grew_until_s": HIDDEN,  # in the headline
    "events[].yaw": HIDDEN,  # of a mount that turned: in the event's reason, to one digit
    "events[].yaw_interval": HIDDEN,
    "events[].trouble": HIDDEN,  # of a report of the autopilot: in words in its reason
    "events[].texts": HIDDEN,  # the first in its reason
    "events[].least_v": HIDDEN,  # in its reason, to one digit
    "events[].limit_v": HIDDEN,
    # Numbers of notices and reports: in their reasons.
    "events[].asked": HIDDEN,
    "events[].before": HIDDEN,
    "events[].before[].trouble": HIDDEN,
    "events[].before[].time_s": HIDDEN,
    "events[].most": HIDDEN,
    "events[].limit": HIDDEN,
    "events[].usual_v": HIDDEN,
    "events[].causes": HIDDEN,
    "events[].causes.propeller": HIDDEN,
    "events[].causes.motor_or_esc": HIDDEN,
    "events[].causes.bearing": HIDDEN,
    "events[].causes.unknown": HIDDEN,
    "events[].esc": HIDDEN,
    "events[].esc[].rotor": HIDDEN,
    "events[].esc[].cause": HIDDEN,
    "events[].esc[].causes": HIDDEN,
    "events[].esc[].speed_loss": HIDDEN,
    "events[].esc[].speed_loss_interval": HIDDEN,
    "events[].esc[].propeller_loss": HIDDEN,
    "events[].esc[].propeller_loss_interval": HIDDEN,
    "events[].esc[].thrust_of_speed": HIDDEN,
    "events[].esc[].current_ratio": HIDDEN,
    "events[].esc[].supply_drop_V": HIDDEN,
    "events[].change": HIDDEN,
    "events[].change_interval": HIDDEN,
    "events[].motors": HIDDEN,
    "events[].seconds": HIDDEN,
    "events[].of_s": HIDDEN,
    "events[].longest_s": HIDDEN,
    "events[].hover_share": HIDDEN,
    "events[].harder": HIDDEN,
    "events[].more": HIDDEN,
    "events[].yaw_share": HIDDEN,
    "events[].output": HIDDEN,
    "events[].thrust": HIDDEN,
    "events[].given": HIDDEN,
    "events[].sank_m": HIDDEN,
    "events[].lift": HIDDEN,
    "events[].lift_without_yaw": HIDDEN,
    "events[].shared": HIDDEN,
    # Of oscillations and steps: in the reason.
    **{f"events[].{name}": HIDDEN for name in ("axis", "gain", "frequency_hz", "swing", "first_loss", "stepped_s")},
    "events[].unit": word("the unit of a contact"),
    "events[].times": HIDDEN,  # the first in the headline, all in the report's JSON
    "events[].durations": HIDDEN,  # the shortest and the longest in the event's reason
    "events[].count": SHOWN,
    "events[].rpm": HIDDEN,
    "events[].cause": HIDDEN,  # in words in the event's reason
    "events[].live": HIDDEN,  # likewise
    "events[].yaw_reversed": HIDDEN,
    "events[].worked_until_s": HIDDEN,  # in the notes of the rotors
    "events[].worked_until_s[]": HIDDEN,
    "events[].impact_s": HIDDEN,
    "events[].how": word("how control was lost"),
    "events[].evidence": every("what speaks for a cause"),
    "compared": HIDDEN,
    **{
        f"compared[].{name}": HIDDEN
        for name in ("onset_s", "rotors", "rotors[]", "named", "alternatives", "alternatives[]", "origin", "grows", "said", "said[]")
    },
    **{f"compared[].{name}": HIDDEN for name in ("decision", "probability", "probability_none", "explanations")},
    **{f"compared[].explanations[].{name}": HIDDEN for name in ("name", "beside", "rotors", "rotors[]", "weak", "weak[]", "nats")},
    "common_mode": HIDDEN,
    "common_mode.thrust_shift": SHOWN,
    "common_mode.interval": HIDDEN,
    "common_mode.unit": HIDDEN,
    "whole_flight": SHOWN,
    "whole_flight.verdict": lambda views, value: views.shown(report.VERDICTS[value].lower(), "the comparison's verdict"),
    "whole_flight.reason": word("the comparison's reason"),
    "whole_flight.flights": lambda views, value: views.shown(f"{value} healthy flight", "the number of healthy flights"),
    "whole_flight.causes": SHOWN,
    "whole_flight.causes[].kind": SHOWN,
    "whole_flight.causes[].rotors": SHOWN,
    "whole_flight.causes[].probability": lambda views, value: value >= 0.05 and views.shown(report.probability(value), "a cause"),
    **{f"whole_flight.{k}": HIDDEN for k in ("rotors", "loss", "interval", "p_value", "shift", "shift_sd", "common", "false_alarm_rate")},
    "baseline": word("the baseline"),
    "estimator": lambda views, value: views.shown(value, "the estimator", screen=False),
    "comparison": SHOWN,
    "comparison[].detector": word("another check"),
    "comparison[].rotor": SHOWN,
    "comparison[].time_s": lambda views, value: views.shown(report.seconds(value), "the time of another check"),
    "comparison[].reason": word("the reason of another check"),
    "assumptions": every("an assumption"),
    "warnings": every("a warning"),
    "timing": HIDDEN,
    **{f"timing.{k}": HIDDEN for k in ("read_s", "baseline_s", "prepare_s", "estimate_s", "events_s", "comparison_s", "total_s")},
}
