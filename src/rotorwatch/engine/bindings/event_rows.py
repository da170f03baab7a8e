"""From the estimator's ticks to events: the definitions of engine/events/losses.py and engine/events/events.py, in words.

The estimator decides, live, which faults occurred and which explanations remain; this module only records them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.compiling.running import Rows
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.engine.bindings.hypothesis_list import Hypotheses
from rotorwatch.engine.bindings.plant_rows import lower_rotors
from rotorwatch.engine.definition import ENGINE, craft
from rotorwatch.engine.events import calls, losses
from rotorwatch.engine.events import events as definition
from rotorwatch.engine.events.records import Found
from rotorwatch.engine.intake import deviations
from rotorwatch.engine.intake.sizes import EVENTS, RECORDS, TOGETHER
from rotorwatch.engine.motion.knocks import Contact
from rotorwatch.engine.motion.overrides import Override
from rotorwatch.engine.motion.tick_table import ASSESS, ROOM, Ticks
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import CONTACT, EVIDENCE, LOSS, OVERRIDE, UNKNOWN, kind_of

# 16-bit codes of unknown kinds, of output states and of causes: unique within the process.
_NUMBERS: dict[Any, int] = defaultdict(iter(range(1 << 8, 1 << 15)).__next__)
COLUMNS = ("theta", "theta_sd", "active", "share", "gives", "onsets", "probability", "announced")
HINDSIGHT = "hindsight"  # source name of losses in the blind time, found afterwards


def _found_in_hindsight(claim: Event, known: Event) -> bool:
    same = known.source.name == HINDSIGHT and set(claim.rotors) & set(known.rotors)
    return bool(same) and claim.onset_s <= known.detected_s


ESTIMATOR = Source("estimator", 1, _found_in_hindsight)


def _trim_explained(claim: Event, known: Event) -> bool:
    return known.means.wrong if claim.kind == EVIDENCE else known.means.accuses


TRIM = Source("trim", 10, _trim_explained)
OUTPUTS, CONTACTS = Source("outputs", 4), Source("contacts", 5)
SHOWN_S = 2.0  # after an announcement: the loss shown then


class Losses:
    """The losses of one vehicle with effectiveness B (4, n), tick by tick."""

    def __init__(self, B: np.ndarray, state: Rows | None = None):
        """state: where they are recorded; None: a new one."""
        self.craft = vehicle(B)
        self.state = ENGINE.new(losses.Losses) if state is None else state

    def add(self, ticks: Ticks, out) -> None:
        """More ticks with the estimator's stacked outputs (COLUMNS)."""
        mode = np.ascontiguousarray(ticks.mode, np.int32)
        columns = {name: np.asarray(getattr(out, name)) for name in COLUMNS}
        found = ENGINE.array(Found, ROOM)
        for first in range(0, len(mode), ROOM):
            part = slice(first, first + ROOM)
            found.fill(**{name: column[part] for name, column in columns.items()})
            rows = (ticks.time[part], ticks.command_time[part], mode[part], np.asarray(ticks.restart)[part])
            ENGINE.call(calls.announce, self.state, self.craft, len(rows[0]), *map(np.ascontiguousarray, rows), found)

    @property
    def announcements(self) -> int:
        """Number of announcements so far."""
        return int(self.state["announcements"][0])

    def events(self, flies: bool = False) -> tuple[Event, ...]:
        """The losses so far. flies: the flight continues, and a recent announcement may still turn out to be a pair."""
        return _in_words(self.rows(flies)) if self.announcements else ()

    def rows(self, flies: bool = False) -> Rows:
        """The same in the definition's form."""
        rows = ENGINE.array(definition.Event, RECORDS)
        return rows.cut(ENGINE.call(calls.losses, self.state, self.craft, flies, rows))


def vehicle(B: np.ndarray) -> Rows:
    """The data that events need of a vehicle with effectiveness B (4, n)."""
    return craft(B.shape[1], effectiveness=B, coaxial=lower_rotors(B) is not None)


def read(out, ticks: Ticks, B: np.ndarray, state: Losses | None = None) -> tuple[Event, ...]:
    """Losses of one flight of a vehicle with effectiveness B (4, n), from the estimator's stacked outputs (COLUMNS). state: where they
    are already recorded."""
    if not np.asarray(out.announced).any():
        return ()
    if state is None:
        state = Losses(B)
        state.add(ticks, out)
    assessed = np.flatnonzero(ticks.mode == ASSESS)
    final = int(assessed[-1]) if assessed.size else len(ticks.time) - 1

    def shown(event: Event) -> list[float]:
        k = min(int(np.searchsorted(ticks.time, event.detected_s)) + round(SHOWN_S / ticks.dt), final)
        # Rounded as in the JSON: page and JSON then round alike to per cent.
        return [round(float(v), 4) for v in out.theta[k, [r - 1 for r in event.rotors]]]

    return tuple(replace(e, extra={**e.extra, "loss_2s": shown(e)}) for e in state.events())


def rotor_sets(hyp: Hypotheses, probability: np.ndarray) -> dict[tuple[int, ...], float]:
    """Probability of each rotor set: a rotor alone and with a common shift of thrust are the same set."""
    sets: dict[tuple[int, ...], float] = {}
    for who, fault, p in zip(hyp.rotors, hyp.fault, probability):
        if fault:
            sets[who] = sets.get(who, 0.0) + float(p)
    return dict(sorted(sets.items(), key=lambda item: -item[1]))


def opposites(B: np.ndarray) -> dict[int, tuple[int, ...]]:
    """For each rotor the rotors that cancel its roll and pitch torque: a loss shared with those is hardly visible."""
    known = vehicle(B)
    return {i: _rotors(ENGINE.call(losses.opposite_of, known, i)) for i in range(B.shape[1])}


def sd_of(theta: np.ndarray, sd: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Standard deviation of losses (any shape), including the model uncertainty of a vehicle with effectiveness B (4, n)."""
    theta, sd = np.broadcast_arrays(np.asarray(theta, float), np.asarray(sd, float))
    flat, out = (np.ascontiguousarray(theta.ravel()), np.ascontiguousarray(sd.ravel())), np.empty(theta.size)
    ENGINE.call(losses.spread, vehicle(B), theta.size, *flat, out)
    return out.reshape(theta.shape)


class Report:
    """Falls and contacts of one vehicle with effectiveness B (4, n), tick by tick, and all events together."""

    def __init__(self, B: np.ndarray, state: Rows | None = None, contacts: tuple[Contact, ...] = ()):
        """state: where they are recorded; None: a new one. contacts: of the ticks before."""
        self.craft = vehicle(B)
        self.state = ENGINE.new(definition.Report) if state is None else state
        self._contacts = contacts

    def add(self, table: Ticks, air: Sequence[tuple[float, float]]) -> Report:
        """Add ticks. air: all flights so far, (start, end) s, infinite end while airborne. Returns this report."""
        same = next((k for k, (a, b) in enumerate(zip(self._contacts, table.contacts)) if a != b), len(self._contacts))
        fresh, self._contacts = table.contacts[same:], table.contacts
        hits = np.array([(c.time, c.push, c.size) for c in fresh], float).reshape(-1, 3).T
        self._follow(table.time, table.upset, table.dt, air, hits)
        return self

    def finish(self, air: Sequence[tuple[float, float]]) -> Report:
        """No ticks follow. Returns this report."""
        self._follow(np.empty(0), np.empty(0, bool), 0.0, air, np.empty((3, 0)), final=True)
        return self

    def _follow(self, time: np.ndarray, upset: np.ndarray, dt: float, air, hits: np.ndarray, final: bool = False) -> None:
        starts, ends = np.minimum(np.array(air, float).reshape(-1, 2).T, LASTS)
        rows = len(time), *map(np.ascontiguousarray, (time, upset)), float(dt), len(starts), starts.copy(), ends.copy()
        ENGINE.call(calls.follow, self.state, *rows, hits.shape[1], hits[0].copy(), hits[1].astype(np.int32), hits[2].copy(), final)

    def events(self, lost: Sequence[Event], overridden: Sequence[Event]) -> tuple[Event, ...]:
        """All events, in the order in which they were detected: the losses that accuse and that no overridden output explains, the
        outputs that left the mixer, and the contacts, except those that are the fall or the landing."""
        rows, outputs = (ENGINE.array(definition.Event, EVENTS), ENGINE.array(deviations.Override, max(1, len(overridden))))
        outputs.fill(
            onset=np.array([o.onset_s for o in overridden]), detected=np.array([o.detected_s for o in overridden]),
            end=np.array([_end(o) for o in overridden]), rotor=np.array([o.rotors[0] - 1 for o in overridden], int),
            shared=np.array([shared(o) for o in overridden], bool),
        )  # fmt: skip
        arguments = packed(lost), len(lost), outputs, len(overridden)
        rows = rows.cut(ENGINE.call(calls.events, self.state, self.craft, *arguments, rows))
        found, names = [], ("kind", "source", "detail", "onset", "size")
        for kind, source, detail, onset, size in zip(*(rows[name].tolist() for name in names)):
            if kind == definition.CONTACT:
                found.append(_contact(Contact(onset, size, detail)))
            elif kind == definition.OUTPUT_OVERRIDE:
                found.append(overridden[source])
            else:
                found.append(_one_arm(lost[source]) if detail == definition.ONE_ARM else lost[source])
        return tuple(found)


def shared(event: Event) -> bool:
    """Return whether several outputs left the mixer together: the log is wrong, not a rotor. That is no event, and explains losses."""
    return bool(event.extra.get("shared"))


def overridden(one: Override) -> Event:
    """An output that does not follow the mixer, as an event."""
    times = one.onset, one.detected, one.end
    extra = {"override": one.kind, **({"shared": True} if one.shared else {})}
    return Event(OVERRIDE, (one.rotor,), *times, (), (), 1.0, (), one.reason, extra, OUTPUTS)


def _contact(one: Contact) -> Event:
    reason = f"an external disturbance {one.what}, by {one.size:.1f} {one.unit}"
    extra = {"size": one.size, "unit": one.unit}
    return Event(CONTACT, (), one.time, one.time, one.time, (), (), 1.0, (), reason, extra, CONTACTS)


def _one_arm(event: Event) -> Event:
    """The event of two rotors on one arm, with each alone among its explanations."""
    if event.alternatives:
        return event
    reason = f"{event.reason}, but only one of them may have failed: the two share an arm"
    return replace(event, alternatives=tuple((r,) for r in event.rotors), reason=reason)


def packed(events: Sequence[Event], room: int = 1) -> Rows:
    """Events in the definitions' form, in `room` rows at least; detail: a code of the output's state, of a cause or a trouble; source:
    the index of each."""
    rows = ENGINE.array(definition.Event, max(room, len(events)))
    if not events:
        return rows

    def lists(name: str, values: list[list[float]]) -> np.ndarray:
        width = max(map(len, values), default=0)
        return np.array([[*row, *[0] * (width - len(row))] for row in values]).reshape(len(events), -1)

    def kind(event: Event) -> int:
        known = kind_of(event.kind).number
        return _NUMBERS[event.kind] if known == UNKNOWN else known

    def detail(event: Event) -> int:
        what = event.extra.get("override", ""), event.extra.get("cause", event.extra.get("trouble", ""))
        return _NUMBERS[what] if any(what) else definition.PLAIN

    rows.fill(
        onset=np.array([e.onset_s for e in events]), detected=np.array([e.detected_s for e in events]),
        end=np.array([_end(e) for e in events]), probability=np.array([e.probability for e in events]),
        rotors=np.array([_mask(e.rotors) for e in events]), kind=np.array([kind(e) for e in events]),
        size=np.array([e.extra.get("gives", 0.0) for e in events]), source=np.arange(len(events)),
        alternative_count=np.array([len(e.alternatives) for e in events]), detail=np.array([detail(e) for e in events]),
        loss=lists("loss", [list(e.loss[:TOGETHER]) for e in events]),
        lower=lists("lower", [[low for low, _ in e.interval[:TOGETHER]] for e in events]),
        upper=lists("upper", [[high for _, high in e.interval[:TOGETHER]] for e in events]),
        alternatives=lists("alternatives", [[_mask(a) for a in e.alternatives] for e in events]),
    )  # fmt: skip
    return rows


def _end(event: Event) -> float:
    return LASTS if event.end_s is None else event.end_s


def _mask(rotors: Iterable[int]) -> int:
    """A set of rotors, counted from 1."""
    return sum(1 << (r - 1) for r in rotors)


def _rotors(mask: int, first: int = 0) -> tuple[int, ...]:
    """The rotors of a set, counted from `first`."""
    return tuple(k + first for k in range(int(mask).bit_length()) if mask >> k & 1)


def _in_words(rows: Rows) -> tuple[Event, ...]:
    """Losses in readable form."""
    return tuple(_loss(_Row(*values)) for values in zip(*(rows[name].tolist() for name in _Row._fields)))


class _Row(NamedTuple):
    """A loss in the compiled layout: sets of rotors as masks, lists of fixed capacity."""

    onset: float
    detected: float
    end: float
    rotors: int
    probability: float
    detail: bool
    alternative_count: int
    alternatives: list[int]
    loss: list[float]
    lower: list[float]
    upper: list[float]
    size: float


def _loss(row: _Row) -> Event:
    onset, rotors = row.onset, _rotors(row.rotors, 1)
    alternatives = tuple(_rotors(mask, 1) for mask in row.alternatives[: row.alternative_count])
    names = " and ".join(map(str, rotors))
    if alternatives:
        reason = (
            f"commands and motion changed at {onset:.1f} s as if rotor {names} had lost thrust, but "
            + ", ".join("+".join(map(str, a)) for a in alternatives)
            + " would look the same"
            + (", and so would a sudden drop of battery voltage or more weight" if row.detail else "")
        )
    elif row.size > 0.0:
        reason = (
            f"since {onset:.1f} s rotor {names} has been stuck at about {row.size:.1f} times hover thrust, whatever the command: "
            "it has lost all effectiveness"
        )
    else:
        reason = (
            f"since {onset:.1f} s part of the commanded torque and thrust has been missing from the motion; the "
            f"missing part has the direction of rotor {names}"
        )
    n = len(rotors)
    return Event(
        LOSS, rotors, onset, row.detected, None if row.end >= LASTS else row.end, tuple(row.loss[:n]),
        tuple(zip(row.lower[:n], row.upper[:n])), row.probability, alternatives, reason,
        {"gives": round(row.size, 2)} if row.size > 0.0 else {},
        source=ESTIMATOR,
    )  # fmt: skip
