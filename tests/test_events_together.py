"""All events of a vehicle in one list - losses, outputs that left the mixer, contacts - and what is new about it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import airframes
from rotorwatch.answer.conclusion import main_event
from rotorwatch.engine import engine
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.events import calls
from rotorwatch.engine.events import changes as front_changes
from rotorwatch.engine.events import events as listed
from rotorwatch.engine.intake.craft import Vehicle
from rotorwatch.engine.intake.sizes import EVENTS
from rotorwatch.engine.motion.knocks import Contact
from rotorwatch.flight.diagnosis import Event
from rotorwatch.live.alert_states import Changes

B = airframes.named("ardupilot-hexa-x").effectiveness()
DT = 0.05


def loss(onset, rotors=(3,), size=0.3, detected=None, end=None, alternatives=(), low=None):
    sizes = (size,) * len(rotors)
    bounds = tuple((size - 0.04 if low is None else low, size + 0.04) for _ in rotors)
    when = onset + 1.0 if detected is None else detected
    return Event("loss_of_effectiveness", rotors, onset, when, end, sizes, bounds, 0.9, alternatives, "")


def override(onset, end=None, rotor=2):
    return Event("output_override", (rotor,), onset, onset + 0.3, end, (), (), 1.0, (), "", {"override": "off"})


def flown(until, air, upset=(), contacts=(), report=None, since=0.0):
    """The report of ticks up to `until` s; upset: (start, end) in which the vehicle tumbles."""
    time = np.arange(since, until, DT)
    tumbles = np.zeros(len(time), bool)
    for start, end in upset:
        tumbles |= (time >= start) & (time <= end)
    return (report or event_rows.Report(B)).add(
        SimpleNamespace(time=time, upset=tumbles, dt=DT, contacts=tuple(Contact(t, 2.0, 1) for t in contacts)), air
    )


def test_a_loss_that_begins_while_an_output_is_overridden_is_the_override():
    report = flown(30.0, ((2.0, np.inf),))
    before, during, after, later = loss(8.9), loss(9.1), loss(12.9), loss(13.1)
    assert report.events((before, during, after, later), (override(10.0, 12.0),)) == (
        before, override(10.0, 12.0), later,
    )  # fmt: skip
    assert report.events((loss(500.0),), (override(10.0),)) == (override(10.0),)  # it lasts


def test_a_loss_that_may_be_nothing_accuses_nobody_unless_it_is_one_of_several():
    report = flown(30.0, ((2.0, np.inf),))
    faint, open_ = loss(10.0, low=0.0), loss(12.0, low=0.0, alternatives=((4,),))
    assert report.events((faint, open_), ()) == (open_,)


def test_an_override_that_begins_in_the_fall_is_the_fall():
    """The vehicle tumbles from 20 s to the end at 22 s: what began before it did is reported, and no loss is laid to what came after."""
    air, early, late = ((2.0, 22.0),), override(19.0, 19.5), override(21.0)
    report = flown(30.0, air, upset=[(20.0, 22.1)]).finish(air)
    assert report.events((loss(21.2),), (early, late)) == (early, loss(21.2))
    calm = flown(30.0, air, upset=[(10.0, 20.0)]).finish(air)  # it caught itself
    assert calm.events((loss(21.2),), (late,)) == (late,)


@pytest.mark.parametrize("upset, reported", [(False, 1), (True, 0)])
def test_on_board_an_override_waits_for_the_ticks_of_its_onset(upset, reported):
    """Ticks wait near a possible landing, while outputs are compared at once: the vehicle may have fallen before it."""
    board, craft = engine.Engine(), Vehicle()
    craft.rotors = 4
    one = board.front.deviations.overrides[0]
    one.onset, one.detected, one.rotor = 12.0, 12.3, 1
    board.front.deviations.overrides_count = 1
    board.report.tick(11.0, 2.0, upset)
    board.poll(craft)
    assert board.count == 0
    board.report.tick(12.0, 2.0, upset)
    board.poll(craft)
    assert board.count == reported


def test_a_contact_is_reported_once_it_cannot_be_the_landing():
    report = flown(10.5, ((2.0, np.inf),), contacts=[10.0])
    assert report.events((), ()) == ()
    flown(11.2, ((2.0, np.inf),), contacts=[10.0], report=report, since=10.5)
    (event,) = report.events((), ())
    assert (event.kind, event.onset_s, event.extra) == ("contact", 10.0, {"size": 2.0, "unit": "g"})
    flown(14.0, ((2.0, 10.6),), contacts=[10.0], report=report, since=11.2)
    assert report.events((), ()) == ()  # the flight ended there


def test_a_contact_on_the_ground_is_none():
    report = flown(30.0, ((2.0, 10.0), (15.0, np.inf)), contacts=[12.0, 20.0])
    assert [e.onset_s for e in report.events((), ())] == [20.0]


def test_a_contact_that_turns_out_larger_is_one_contact():
    report = flown(10.5, ((2.0, np.inf),), contacts=[10.0])
    more = SimpleNamespace(time=np.arange(10.5, 12.0, DT), upset=np.zeros(30, bool), dt=DT, contacts=(Contact(10.0, 7.0, 0),))
    (event,) = report.add(more, ((2.0, np.inf),)).events((), ())
    assert event.extra["size"] == 7.0


def test_of_more_events_than_there_is_room_for_the_last_are_kept():
    report = flown(1.0, ())
    many = [loss(10.0 + k, detected=400.0 - k) for k in range(EVENTS)]
    found = report.events(many, [override(float(k), float(k)) for k in range(4000, 4008)])
    assert len(found) == EVENTS and [e.detected_s for e in found] == sorted(e.detected_s for e in found)
    assert found[-1].kind == "output_override" and found[0].detected_s == min(e.detected_s for e in many) + 8.0


@pytest.mark.parametrize(
    ("found", "place"),
    [
        ([], None),
        ([loss(10.0), loss(20.0, size=0.9)], 1),  # the first is small beside it
        ([loss(10.0, size=0.5), loss(20.0, size=0.9)], 0),  # large as well, and first
        ([loss(10.0, size=0.5), loss(10.5, size=0.9)], 1),  # they began together
        ([loss(10.0, size=0.9, alternatives=((4,),)), loss(20.0)], 1),  # sure ones first
        ([loss(10.0), override(9.0)], 1),
        ([loss(10.0), override(11.0)], 0),  # what the controller of a falling vehicle does
        ([Event("contact", (), 5.0, 5.0, 5.0, (), (), 1.0, (), "")], None),
        ([Event("loss_of_control", (), 5.0, 5.0, None, (), (), 1.0, (), "")], 0),
    ],
)
def test_the_event_that_matters_most(found, place):
    assert main_event(found) == place


# What is new


def said(changes, found, final=False):
    return [(c.number, c.what, c.event) for c in changes.since_last(found, final)]


def test_an_event_is_announced_once_and_reported_again_when_it_has_changed():
    changes, first = Changes(), loss(10.0)
    assert said(changes, [first]) == [(1, "announced", first)]
    assert said(changes, [loss(10.0, size=0.31)]) == []
    assert said(changes, [loss(10.0, size=0.33)]) == [(1, "changed", loss(10.0, size=0.33))]
    ended = loss(10.0, size=0.33, end=15.0)
    assert said(changes, [ended]) == [(1, "changed", ended)] and changes.now == {1: ended}
    assert said(changes, []) == [(1, "withdrawn", ended)] and changes.now == {}
    assert said(changes, [loss(10.0)])[0][:2] == (2, "announced")


def test_a_loss_may_turn_out_to_be_of_another_rotor_an_override_may_not():
    changes = Changes()
    said(changes, [loss(10.0), override(30.0)])
    other = loss(10.4, rotors=(5,), alternatives=((3,),))
    assert said(changes, [other, override(30.0, rotor=4)]) == [
        (2, "withdrawn", override(30.0)), (1, "changed", other), (3, "announced", override(30.0, rotor=4)),
    ]  # fmt: skip


def test_a_loss_that_lasts_is_the_same_one_when_it_is_looked_at_again():
    """What grows is reported anew at each look at the trim, with another onset and another detection: that is a change, no withdrawal."""
    changes, mount = Changes(), Event("turned_mount", (), 30.0, 60.0, None, (), (), 0.99, (), "")
    said(changes, [loss(20.0, detected=60.0), mount])
    later, turned = loss(24.0, detected=90.0, size=0.4), replace(mount, onset_s=33.0, detected_s=90.0)
    assert said(changes, [later, turned]) == [(1, "changed", later), (2, "changed", turned)]
    moved = loss(26.0, detected=120.0, size=0.4)
    assert said(changes, [moved, turned]) == [(1, "changed", moved)]
    other = loss(26.0, detected=120.0, rotors=(2,))
    again = replace(other, onset_s=60.0, detected_s=150.0)
    assert said(changes, [other, turned])[0][:2] == (1, "changed") and said(changes, [again])[1] == (1, "changed", again)
    ended = replace(again, end_s=155.0)
    assert said(changes, [ended]) == [(1, "changed", ended)]
    assert [what for _, what, _ in said(changes, [loss(170.0, rotors=(2,), detected=171.0)])] == ["withdrawn", "announced"]


def test_in_the_end_any_difference_is_reported():
    changes = Changes()
    said(changes, [loss(10.0), loss(20.0)])
    nearly = loss(10.0, size=0.301)
    assert said(changes, [nearly, loss(20.0)], final=True) == [(1, "final", nearly)]


def test_kinds_and_causes_are_never_taken_for_one_another():
    """Whatever they are called: what changes from one to the other is reported."""
    names = [f"case {k}" for k in range(1000)]
    found = [replace(loss(10.0), kind=name) for name in names]
    found += [replace(loss(10.0), extra={"override": name, "cause": "b"}) for name in names]
    found += [replace(loss(10.0), extra={"override": name, "cause": ""}) for name in [names[0] + "b", "b"]]
    rows = event_rows.packed(found)
    assert len(set(zip(rows["kind"].tolist(), rows["detail"].tolist()))) == len(found)


def test_what_ended_long_ago_and_is_forgotten_is_not_withdrawn():
    """As on board, where the list has little room."""
    known, out, withdrawn = (
        ENGINE.new(front_changes.Changes),
        ENGINE.array(front_changes.Change, 2 * EVENTS),
        ENGINE.array(listed.Event, EVENTS),
    )
    one = event_rows.packed([loss(10.0, end=15.0)])
    assert ENGINE.call(calls.changes, known, one, 1, 14.0, -1, False, withdrawn, out) == 1
    assert ENGINE.call(calls.changes, known, one, 0, 20.0, -1, False, withdrawn, out) == 0


def test_on_board_an_event_is_withdrawn_once_it_has_been_missing_for_some_time():
    """It comes back under its own number; another event in its place withdraws it at once."""
    known, out, room = front_changes.Changes(), [front_changes.Change() for _ in range(4)], [listed.Event() for _ in range(2)]
    one, other = listed.Event(), listed.Event()
    one.onset, one.detected, one.rotors = 10.0, 10.5, 1
    other.onset, other.detected, other.rotors = 14.0, 14.5, 2

    def said(now, *events):
        count = known.look(list(events), len(events), now, now - 60.0, -1, False, room, out)
        return [(out[k].number, out[k].what) for k in range(count)]

    assert said(11.0, one) == [(1, front_changes.ANNOUNCED)]
    assert said(12.0) == [] and said(13.0, one) == [] and said(14.0) == []
    assert said(14.0 + front_changes.HOLD_S) == [(1, front_changes.WITHDRAWN)] and room[0].rotors == 1
    assert said(20.0, one) == [(2, front_changes.ANNOUNCED)] and said(21.0) == []
    assert said(22.0, other) == [(2, front_changes.WITHDRAWN), (3, front_changes.ANNOUNCED)]


@example([[(0, 2, 0.5), (0, 1, 0.453125)], [(0, 1, 0.4375), (0, 1, 0.421875)]])
@settings(max_examples=trials(60), deadline=None)
@given(st.lists(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 6), st.floats(0.1, 0.9)), max_size=5), max_size=8))
def test_what_was_said_adds_up_to_the_list(steps):
    """Announced, changed and withdrawn give the events that hold, each with one number."""
    changes, held = Changes(), {}
    for step in steps:
        found = [loss(10.0 * place, rotors=(rotor,), size=size) for place, rotor, size in step]
        for number, what, event in said(changes, found):
            assert (number in held) == (what != "announced")
            if what == "withdrawn":
                del held[number]
            else:
                held[number] = event
        assert len(held) == len(found) and held == changes.now
        for event, e in zip(*(sorted(all_, key=lambda e: (e.onset_s, e.loss[0])) for all_ in (held.values(), found))):
            assert abs(e.onset_s - event.onset_s) < 1.0 and abs(e.loss[0] - event.loss[0]) < 0.02


@pytest.mark.parametrize("machine_code", [True, False])
def test_a_list_goes_on_where_another_one_was_and_leaves_that_as_it_is(machine_code, monkeypatch):
    """As a watched vehicle's does while ticks may still be withdrawn; also where Python runs the definition."""
    if not machine_code:
        monkeypatch.setitem(ENGINE.__dict__, "library", None)
    air, late = ((2.0, 22.0),), [override(21.0)]
    first = flown(18.0, air)
    more = event_rows.Report(B, first.state.copy())
    on = flown(30.0, air, upset=[(20.0, 22.1)], report=more, since=18.0).finish(air)
    assert on.events((), late) == ()  # that is the fall
    assert first.finish(air).events((), late) == tuple(late)
    assert event_rows.Losses(B, event_rows.Losses(B).state.copy()).events() == ()
