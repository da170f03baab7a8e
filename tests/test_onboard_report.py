"""The list of events in C, what is new about it and its words: what motion/outside.py, live/changes.py and live/ground.py make of it."""

import numpy as np
import pytest

from embedded_c_parts import LASTS, Part
from rotorwatch.answer.conclusion import main_event
from rotorwatch.diagnosis import Event
from rotorwatch.live import ground
from rotorwatch.live.changes import ANNOUNCED, CHANGED, WITHDRAWN, Changes
from rotorwatch.motion import outside
from rotorwatch.motion.contact import Contact
from rotorwatch.motion.departures import Override

DT = 0.05
STATES = (ANNOUNCED, CHANGED, WITHDRAWN)
KINDS = ("loss_of_effectiveness", "output_override", "contact")
WAYS = ("stuck", "off", "overridden")
VERDICTS = ("inconclusive", "healthy", "fault", "ambiguous")


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    sources = ("rw_report.c", "rw_text.c")
    return Part(tmp_path_factory.mktemp("report"), "drive_report.c", sources, 6)


def mask(rotors):
    return sum(1 << (r - 1) for r in rotors)


def end_of(event):
    return LASTS if event.end_s is None else event.end_s


def a_loss(rng, now):
    rotors = tuple(sorted(int(r) + 1 for r in rng.choice(6, rng.integers(1, 3), replace=False)))
    loss = rng.uniform(0.02, 0.98, len(rotors))
    others = [tuple(sorted(int(r) + 1 for r in rng.choice(6, 2, replace=False))) for _ in range(rng.integers(0, 4))]
    detected = now - rng.uniform(0.0, 6.0)
    onset = detected - rng.uniform(0.0, 3.0)
    return Event(
        "loss_of_effectiveness", rotors, onset, detected, None if rng.random() < 0.6 else detected + rng.uniform(0, 2),
        tuple(loss.tolist()), tuple((max(0.0, x - 0.05), min(1.0, x + 0.05)) for x in loss.tolist()), 0.9,
        tuple(others) if rng.random() < 0.5 else (), "",
    )  # fmt: skip


def moved(rng, event):
    """More is known of it: another size, another end, another rotor."""
    size = rng.normal(0.0, 0.015)
    loss = tuple(float(np.clip(x + size, 0.01, 0.99)) for x in event.loss)
    rotors = event.rotors if rng.random() < 0.8 else tuple(r % 6 + 1 for r in event.rotors[:1])
    return Event(
        event.kind, rotors, event.onset_s, event.detected_s, event.end_s if rng.random() < 0.7 else event.detected_s + 2.5,
        loss[: len(rotors)], event.interval[: len(rotors)], 0.9, event.alternatives, "",
    )  # fmt: skip


def packed_loss(event):
    row = [event.onset_s, event.detected_s, end_of(event)]
    for k in range(2):
        row += [event.loss[k], *event.interval[k]] if k < len(event.loss) else [0.0, 0.0, 0.0]
    return [*row, mask(event.rotors), len(event.alternatives), *(mask(a) for a in event.alternatives)]


def flown(seed):
    """Rows for the C, and what Python says at each row of kind 3."""
    rng = np.random.default_rng(seed)
    air = ((2.0, 2.0 + rng.uniform(3.0, 20.0)), (30.0, 30.0 + rng.uniform(3.0, 20.0)))
    time = np.arange(0.0, 60.0, DT)
    upset = np.zeros(len(time), bool)
    for _ in range(4):
        first = rng.integers(len(time))
        upset[first : first + rng.integers(1, 80)] = True
    for _, end in air:  # one of two flights ends in a fall
        upset[(time > end - rng.uniform(0.1, 2.0)) & (time <= end + DT)] |= rng.random() < 0.5
    aloft = [k for k, t in enumerate(time) if any(a + 1.0 <= t <= b for a, b in air)]
    hits = sorted(rng.choice(aloft, 5, replace=False).tolist())
    rows, expected, changes, contacts, landed = [], [], Changes(), [], set()
    losses, overrides = [], []
    for k, t in enumerate(time.tolist()):
        for span in air:
            if t > span[1] + DT and span not in landed:
                landed.add(span)
                rows.append([1.0, span[1]])
        inside = [a for a, b in air if a <= t <= b + DT]
        rows.append([0.0, t, inside[0] if inside else LASTS, upset[k]])
        if k in hits:
            contacts.append(Contact(t, float(rng.uniform(0.5, 3.0)), "g", ""))
            rows.append([2.0, t, 1, contacts[-1].size])
        if k % 97 or any(b < t <= b + DT for _, b in air):
            continue
        losses = [moved(rng, e) if rng.random() < 0.5 else e for e in losses if rng.random() < 0.9]
        losses += [a_loss(rng, t) for _ in range(rng.integers(0, 2)) if len(losses) < 4]
        losses.sort(key=lambda e: e.detected_s)
        if rng.random() < 0.3 and len(overrides) < 4:
            onset = t - rng.uniform(0.5, 2.0)
            end = None if rng.random() < 0.5 else onset + 0.4
            way = WAYS[rng.integers(3)]
            overrides.append(Override(int(rng.integers(6)) + 1, way, onset, onset + 0.3, end, ""))
        overrides.sort(key=lambda o: o.detected)
        rows.append([3.0, -LASTS, 1.0, len(losses), *(x for e in losses for x in packed_loss(e)), len(overrides)])
        for o in overrides:
            rows.append([o.rotor - 1, WAYS.index(o.kind), o.onset, o.detected, LASTS if o.end is None else o.end])
        known = tuple((a, min(b, t)) for a, b in air if a <= t)
        told = outside.as_events(overrides, outside.falls_in(time[: k + 1], upset[: k + 1], DT, known))
        found = (*outside.unexplained(losses, told), *told, *outside.contacts_in(contacts, known))
        found = tuple(sorted(found, key=lambda e: e.detected_s))
        expected.append((found, changes.of(found)))
    return rows, expected


def verdict(events):
    """As conclusion.py has it of events alone."""
    order = [e for e in events if e.kind != "contact"]
    return "healthy" if not order else "ambiguous" if all(e.alternatives for e in order) else "fault"


def alert(change):
    e = change.event
    told = dict(
        kind=e.kind, rotors=e.rotors, alternatives=e.alternatives, end_s=e.end_s, loss=e.loss, interval=e.interval
    )
    return {"type": "event", "number": change.number, "state": change.what, "event": told}


@pytest.mark.parametrize("precision", ["double", "float"])
def test_the_list_its_news_and_their_words_are_those_of_python(part, precision):
    counted, news = 0, 0
    for seed in range(12):
        rows, expected = flown(seed)
        said = part.run([np.asarray(row, float) for row in rows], precision)
        for block, (events, changes) in zip(said, expected, strict=True):
            which, main = block[0].split()
            assert VERDICTS[int(which)] == verdict(events)
            best = main_event(events)
            assert int(main) == (-1 if best is None else best)
            ours = [line.split()[1:] for line in block if line.startswith("event")]
            theirs = [(KINDS.index(e.kind), mask(e.rotors), e.onset_s, e.detected_s, end_of(e)) for e in events]
            assert [tuple(map(float, line[:5])) for line in ours] == theirs
            for line, e in zip(ours, events):
                assert float(line[5]) == pytest.approx(e.extra.get("size", 0.0), rel=1e-6)
            words = [line[5:] for line in block if line.startswith("news")]
            wanted = []
            for c in changes:
                text = ground.words(alert(c))
                wanted.append(f"{STATES.index(c.what)} {c.number} {ground.severity(alert(c))} {len(text)}|{text}")
            if precision == "double":
                assert words == wanted
            counted, news = counted + len(events), news + len(wanted)
    assert counted > 100 and news > 100


def told(part, events, settled=-LASTS):
    """News of lists of losses, one after the other."""
    rows = [[3.0, settled, 0.0, len(now), *(x for e in now for x in packed_loss(e)), 0] for now in events]
    return [[line.split("|")[-1] for line in block if line.startswith("news")] for block in part.run(rows, "float")]


def loss(rotors, size, end=None, alternatives=()):
    bounds = tuple((x - 0.04, x + 0.04) for x in size)
    return Event("loss_of_effectiveness", rotors, 10.0, 11.0, end, size, bounds, 0.9, alternatives, "")


def test_words_fit_a_statustext(part):
    first, second, third = (
        loss((3,), (0.32,)), loss((3,), (0.32,), None, ((1, 3), (5,))), loss((1, 4), (0.5, 0.41), None, ((2, 3), (5, 6), (1, 2, 3))),
    )  # fmt: skip
    said = told(part, [[first], [second], [third], [loss((1, 4), (0.5, 0.41), 20.0)], []])
    assert said == [
        ["rotorwatch: rotor 3 lost 32 % (28-36)"],
        ["rotorwatch: rotor 3 lost 32 % (28-36) or 1+3,5"],
        ["rotorwatch: rotors 1+4 lost 50/41 % or others"],
        ["rotorwatch: rotors 1+4 lost 50/41 % is over"],
        ["rotorwatch: rotors 1+4 lost 50/41 % taken back"],
    ]


def test_what_ended_long_ago_and_is_forgotten_is_not_taken_back(part):
    assert told(part, [[loss((3,), (0.3,), 15.0)], []], settled=20.0)[1] == []


def test_nothing_is_said_before_anything_was_judged(part):
    assert part.run([[3.0, 0.0, 0.0, 0, 0]], "double") == [["0 -1"]]
