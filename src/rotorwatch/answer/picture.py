"""Plot data around a loss of control or a desync: its times, commanded and actual attitude or rates, the commands of every rotor, and their
speeds. Series have at most MOST samples, whatever the log's rate, so that an answer stays small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rotorwatch.answer.story import FIRST_S, initiating_event
from rotorwatch.answer.traces import angles, rates
from rotorwatch.engine.motion import allocation
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import DESYNC, LOST
from rotorwatch.flight.vehicle import Vehicle

MOST = 160  # samples of a series
BEFORE_S, AFTER_S = 1.5, 1.0  # shown before the initiating event, and after the end
# Shown before and after the loss of control began: more would make the rest too small.
EARLIEST_S, LATEST_S = 6.0, 12.0
GOOD_S = 1.0
MARGIN_S = 0.3  # before the lift-off
AROUND_S = 0.5  # of a desync
HELD_S = 3.0  # of earlier commands, which are held where outputs are logged slowly


def compose(
    flight: Flight, vehicle: Vehicle, events: Sequence[Event], main: int | None, hops: Sequence[tuple[float, float]] = ()
) -> dict[str, Any] | None:
    """The plot's data, as in docs/json.md; None without a loss of control or a desync. hops: ((take-off, landing), ..) s."""
    lost = next((e for e in events if e.kind == LOST), None)
    if lost is not None:
        return _drawn(flight, vehicle, *_fall(lost, events, main, hops))
    steps = [e for e in events if e.kind == DESYNC]
    if not steps:
        return None
    chosen = events[main] if main is not None and events[main].kind == DESYNC else steps[0]
    start, lasting = chosen.extra["times"][0], chosen.extra["durations"][0]
    marks = [("gives nothing", start), ("works again", start + lasting)]
    return _drawn(flight, vehicle, max(0.0, start - AROUND_S), start + lasting + AROUND_S, marks, set(chosen.rotors))


def _fall(lost: Event, events: Sequence[Event], main: int | None, hops: Sequence[tuple[float, float]]):
    """(start, end, marks, rotors at fault) of a loss of control."""
    first = initiating_event(events, main)
    began = lost.onset_s if first is None else min(first.onset_s, lost.onset_s)
    up = next((a for a, b in hops if a <= began <= b and began - a < FIRST_S), None)
    good = ("last good second", max(began - GOOD_S, 0.0)) if up is None else ("lift-off", up)
    impact = lost.extra.get("impact_s")
    ending = ("control back", lost.end_s) if impact is None else ("impact", impact)
    landed = max((b for _, b in hops), default=lost.detected_s)
    over = max(landed, lost.detected_s) if ending[1] is None else ending[1]
    before = began - BEFORE_S if up is None else min(began - BEFORE_S, up - MARGIN_S)
    start = max(before, lost.onset_s - EARLIEST_S, 0.0)
    end = min(over + AFTER_S, lost.onset_s + LATEST_S)
    marks = [good, ("first departure", began), ("control lost", lost.onset_s), ending]
    accused = {*lost.rotors, *(first.rotors if first is not None and not first.alternatives else ())}
    return start, end, [(what, t) for what, t in marks if t is not None and start <= t <= end], accused


def _drawn(flight: Flight, vehicle: Vehicle, start: float, end: float, marks: list[tuple[str, float]], accused: set[int]) -> dict[str, Any]:
    around = {name: s.between(start - HELD_S, end + AFTER_S) for name, s in flight.signals.items()}
    part = replace(flight, signals=around)
    return {
        "start_s": start,
        "end_s": end,
        "marks": [{"time_s": t, "what": what} for what, t in marks],
        "accused": sorted(accused),
        "attitude": _attitude(part, start, end),
        "rates": _rates(part, start, end),
        "commands": _commands(part, vehicle, start, end),
        "speeds": _speeds(part, len(vehicle.rotors), start, end),
    }


def _attitude(flight: Flight, start: float, end: float) -> dict[str, Any] | None:
    """Roll and pitch [degrees], actual and commanded, at the samples of the attitude."""
    if not flight.has("attitude"):
        return None
    time = _some(flight["attitude"].time, start, end)
    flown, wanted = (angles(flight, name, time) for name in ("attitude", "attitude_wanted"))
    if flown is None or time.size < 2:
        return None
    out: dict[str, Any] = {"time_s": time}
    for k, name in enumerate(("roll_deg", "pitch_deg")):
        out[name] = flown[:, k]
    for k, name in enumerate(("wanted_roll_deg", "wanted_pitch_deg")):
        out[name] = None if wanted is None else wanted[:, k]
    return {name: None if v is None else np.round(v, 3 if name == "time_s" else 1) for name, v in out.items()}


def _rates(flight: Flight, start: float, end: float) -> dict[str, Any] | None:
    """Rates [degrees/s], actual and commanded, of a vehicle that is flown by rates."""
    flown, wanted = rates(flight)
    if flown is None or wanted is None:
        return None
    time = _some(flown.time, start, end)
    if time.size < 2:
        return None
    out: dict[str, Any] = {"time_s": np.round(time, 3)}
    for prefix, signal in (("", flown), ("wanted_", wanted)):
        values = np.round(np.degrees(signal.values[np.searchsorted(signal.time, time, side="right") - 1]), 1)
        out |= {f"{prefix}{axis}_dps": values[:, k] for k, axis in enumerate(("roll", "pitch", "yaw"))}
    return out


def _speeds(flight: Flight, n: int, start: float, end: float) -> dict[str, Any] | None:
    """Each rotor's speed as its ESC reports it [revolutions a minute]; None where one is not reported."""
    esc = flight.signals.get("esc")
    names = [f"speed{k + 1}" for k in range(n)]
    if esc is None or not set(names) <= set(esc.columns):
        return None
    time = _some(esc.time, start, end)
    if time.size < 2:
        return None
    at, columns = np.searchsorted(esc.time, time), [esc.columns.index(name) for name in names]
    speed = np.where(esc.valid[at][:, columns], esc.values[at][:, columns], np.nan) * 60.0 / (2.0 * np.pi)
    return {"time_s": np.round(time, 3), "rpm": np.round(speed.T, 0)}


def _commands(flight: Flight, vehicle: Vehicle, start: float, end: float) -> dict[str, Any] | None:
    """Each rotor's command, as a share of its full thrust."""
    if not flight.has("motors"):
        return None
    thrust = allocation.rotor_thrusts(flight, vehicle)
    time = _some(thrust.time, start, end)
    if time.size < 2:
        return None
    at = np.searchsorted(thrust.time, time)
    share = np.where(thrust.valid[at], thrust.values[at], np.nan)
    return {"time_s": np.round(time, 3), "share": np.round(share.T, 3)}


def _some(time: np.ndarray, start: float, end: float) -> np.ndarray:
    """The times within, thinned evenly."""
    inside = time[(time >= start) & (time <= end)]
    return inside[:: max(1, -(-inside.size // MOST))]
