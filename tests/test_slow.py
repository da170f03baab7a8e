"""Losses that grow slowly: what the trim of a whole flight says of them, and of what drifts otherwise."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from conftest import hexa_event
from rotorwatch import airframes
from rotorwatch.answer import drift as trim
from rotorwatch.answer import ledger, slow
from rotorwatch.answer.conclusion import Evidence, conclude
from rotorwatch.case.conductor import Case
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.drift import many
from rotorwatch.engine.drift.trim import Trim
from rotorwatch.engine.motion.tick_table import ASSESS
from rotorwatch.flight import Flight

QUAD = np.array([[-1.0, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1]])
HEXA = np.array([[-1.0, 1.0, 0.5, -0.5, -0.5, 0.5], [0, 0, 0.9, -0.9, 0.9, -0.9], [-1.0, 1.0, -1.0, 1.0, 1.0, -1.0], [1.0] * 6])
DT, SECONDS = 0.1, 90.0


def flight(B=QUAD, rotor=1, loss=0.0, rise=25.0, begins=30.0, seen=0.0, drift=(0, 0, 0), sag=0.0, turns=0.0, seed=0) -> Any:
    """(outputs, ticks) of a flight in moving air. loss: of a rotor, that grows for `rise` seconds from `begins` on; seen: share of it that
    the estimator has announced half way; drift (3,): torques that come as slowly; sag: by which all commands rise; turns: yaw commands that
    come and go, and a yaw gain that is off by half."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(int(SECONDS / DT))
    grown = np.clip((time - begins) / max(rise, 1e-9), 0.0, 1.0)
    lost = np.zeros((time.size, B.shape[1]))
    lost[:, rotor - 1] = loss * grown
    known = np.where((lost > 0.0) & (grown > 0.5)[:, None], seen * loss, 0.0)
    swing = turns * np.sign(np.sin(time / 2.5))
    thrust = (1.0 / (1.0 - lost) + 0.5 * np.outer(swing, B[2])) * (1.0 + sag * time / SECONDS)[:, None]
    air = 0.001 * rng.standard_normal((time.size, 4)).cumsum(axis=0) + 0.02 * rng.standard_normal((time.size, 4))
    biases = (thrust * (lost - known)) @ B.T + air
    biases[:, :3] += np.outer(grown, drift)
    biases[:, 2] += 0.5 * swing * B.shape[1]
    ticks = SimpleNamespace(
        time=time, thrust=thrust, mode=np.full(time.size, ASSESS), valid=np.ones((time.size, 4), bool),
        upset=np.zeros(time.size, bool), dt=DT, curve=(0.5, 0.1),
    )  # fmt: skip
    return SimpleNamespace(theta=known, biases=biases, pushed=np.zeros(time.size, bool)), ticks


def found(B=QUAD, **how) -> Any:
    out, ticks = flight(B, **how)
    return trim.growth(trim.look(out, ticks, B))


def but(grown, **facts) -> Any:
    """The same growth, but for this."""
    rows = grown.rows.copy()
    rows.set(**facts)
    return grown._replace(rows=rows, **{name: value for name, value in facts.items() if hasattr(grown, name)})


@pytest.mark.parametrize("B", [QUAD, HEXA])
@pytest.mark.parametrize("rise", [20.0, 40.0])
def test_a_loss_that_grows_is_its_rotors_with_its_size_at_the_end(B, rise):
    for rotor in (2, 4):
        grown = found(B, rotor=rotor, loss=0.4, rise=rise)
        assert grown.certain and grown.rotors == (rotor,)
        assert grown.interval[0][0] < 0.4 < grown.interval[0][1] < 0.6
        assert 30.0 - 2.0 < grown.start_s < 30.0 + 0.5 * rise and abs(grown.end_s - 30.0 - rise) < 8.0


@pytest.mark.parametrize(
    "how",
    [
        {}, {"sag": 0.3}, {"drift": (0.4, 0.0, 0.0)}, {"drift": (-0.3, 0.3, 0.0)}, {"drift": (0.0, 0.0, 0.8)}, {"drift": (0.3, 0.2, -0.5)},
        {"turns": 0.3}, {"turns": 0.3, "drift": (0.0, 0.3, 0.0)},
    ],
    ids=str,
)  # fmt: skip
def test_air_batteries_loads_mounts_and_turns_are_no_losses(how):
    for seed in range(4):
        assert found(seed=seed, **how) is None


def test_what_wind_may_have_done_as_well_is_not_certain():
    """A drift in a rotor's direction, of a size that is met without any rotor."""
    grown = found(loss=0.11)
    assert grown is None or not grown.certain


def test_growth_is_looked_for_between_take_offs_and_knocks():
    """What comes with a knock is part of the trim that is learned after it."""
    out, ticks = flight(loss=0.35, begins=42.0, rise=2.0)
    ticks.mode[(ticks.time > 41.0) & (ticks.time < 45.0)] = ASSESS - 1
    assert trim.growth(trim.look(out, ticks, QUAD)) is None


def test_a_step_announced_within_a_ramp_is_its_beginning():
    grown = found(loss=0.4, seen=0.3)
    event = hexa_event(rotors=(1,), loss=(0.12,), interval=((0.06, 0.18),), onset_s=41.0, detected_s=42.0)
    (joined,) = slow.join((event,), grown)
    assert joined.rotors == (1,) and joined.onset_s < 41.0 and joined.detected_s == 42.0 and joined.extra["live"]
    assert joined.interval[0][0] < 0.4 < joined.interval[0][1] and joined.extra["grew_until_s"] > 50.0
    unsure = replace(event, alternatives=((2,),))
    assert slow.join((unsure,), grown) == (joined,)


def test_growth_leaves_alone_what_is_known_better():
    """A step of the same size, and certain losses of other rotors."""
    grown = found(loss=0.4)
    for event in (
        hexa_event(rotors=(1,), loss=(0.4,), interval=((0.33, 0.47),)),
        hexa_event(rotors=(2,), loss=(0.2,), interval=((0.15, 0.25),)),
    ):
        assert slow.join((event,), grown) == (event,)
    assert slow.join((), None) == () == slow.join((), but(grown, odds=5.0))
    faint = hexa_event(rotors=(1,), loss=(0.1,), interval=((0.0, 0.2),))
    (event,) = slow.join((faint,), grown)
    assert event.rotors == (1,) and event.extra == {
        "live": False, "loss_2s": [round(event.loss[0], 4)], "grew_until_s": grown.end_s,
    }  # fmt: skip


def test_a_loss_is_over_where_its_trim_is():
    """Announced on, off, and on again, by what manoeuvres did, while it lasted; and one that ended."""
    lasts = found(loss=0.3, rise=0.0)
    spells = [
        hexa_event(rotors=(1,), loss=(0.3,), interval=((0.2, 0.4),), onset_s=a, detected_s=a + 0.3, end_s=b)
        for a, b in ((30.0, 36.0), (38.0, 41.0), (50.0, 62.0))
    ]
    (joined,) = slow.join(spells, lasts)
    assert joined.onset_s == 30.0 and joined.detected_s == 30.3 and joined.end_s is None and "its apparent end" in joined.reason
    assert joined.interval[0][0] < 0.3 < joined.interval[0][1] and "grew_until_s" not in joined.extra
    late = [*spells[:2], replace(spells[2], end_s=84.0)]
    assert slow.join(late, lasts) == tuple(late)  # too little is left of the flight to tell
    ended = but(lasts, lost=np.where(lasts.rows["time"][0] < 62.0, lasts.rows["lost"][0], 0.02))
    assert slow.join(spells, ended) == tuple(spells)


def test_the_answer_says_that_it_grew_and_how_much_it_is_now():
    (event,) = slow.join((), found(loss=0.4))
    end = conclude(Evidence((event,), 4, hidden=np.full(4, 0.02), assessed_s=80.0))
    assert end.verdict == "fault" and end.rotors[0].status == "degraded" and end.rotors[0].loss == event.loss[0]
    for text in (end.headline, end.reason):
        assert f"gradually from {event.onset_s:.2f} s to {event.extra['grew_until_s']:.2f} s" in text


def test_growth_that_is_not_certain_makes_its_rotor_a_suspect():
    grown = but(found(loss=0.4), odds=5.0)
    (spell,) = slow.suspected(grown)
    assert (spell.rotors, spell.onset_s, spell.end_s) == ((1,), grown.start_s, grown.looked_s)
    assert spell.interval == grown.interval and spell.log_odds == pytest.approx(np.log(5.0))
    end = conclude(Evidence((), 4, hidden=np.full(4, 0.02), assessed_s=80.0, claims=ledger.open_claims((spell,), ())))
    assert end.verdict == "ambiguous" and [r.status for r in end.rotors] == ["suspect", "healthy", "healthy", "healthy"]
    assert ledger.open_claims((spell,), (hexa_event(),)) == () == slow.suspected(None)


def test_a_link_says_it_while_the_vehicle_flies():
    """Looked at again and again."""
    out, ticks = flight(loss=0.4)
    losses = SimpleNamespace(announcements=0, events=lambda flies: ())
    state, craft = ENGINE.new(Trim), event_rows.vehicle(QUAD)
    diagnoser: Any = SimpleNamespace(losses=losses, contacts=(), overrides=(), trim=state)
    case = Case(Flight("test", "test", {}, 0.0), airframes.named("ardupilot-quad-x"))
    case.driver.diagnoser = diagnoser
    seen = []
    for a in range(0, ticks.time.size, 50):
        part = slice(a, a + 50)
        rows = (ticks.time[part], np.full(50, ASSESS, np.int32), np.ones(50, bool), out.biases[part, :3], ticks.thrust[part])
        ENGINE.call(many.pass_on, state, craft, DT, 50, *map(np.ascontiguousarray, rows))
        case._look_at_trim(diagnoser)
        seen.append(case.grown is not None and case.grown.certain)
    assert not seen[0] and seen[-1] and case.grown is not None and case.grown.rotors == (1,) and case.revision == 1
