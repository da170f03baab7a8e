"""The ESC consistency check: the cause of each loss of effectiveness, as far as ESC telemetry shows it; and motors to inspect.

Before an onset the rotors were healthy: the laws of ratios.py are fitted there and compared with the last seconds of the loss. This runs
after the flight: a cause uses data from after the announcement, the announcement itself does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rotorwatch.answer.ledger import joined
from rotorwatch.answer.wording import CAUSES, listed, percent, probability, rotors
from rotorwatch.engine.events.decisions import LIKELY
from rotorwatch.engine.motion import allocation
from rotorwatch.engine.motion.tick_table import Ticks
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.esc import causes, following, ratios, stopped, telemetry
from rotorwatch.witnesses.esc import changed as watch
from rotorwatch.witnesses.esc.telemetry import Binned

CLEAR_S = 1.0  # uncertainty of an onset: left out before it
RESPONSE_S = 0.5  # after it, while controllers and motors respond
USED_S = 10.0  # the last part of a loss that is used
LEARNED_S = 60.0  # of healthy flight, the last before the onset
TAKE_OFF_S = 2.0  # spool-up and ground effect are left out
DOWN_S = 1.0  # and the last second before touch-down
NOTABLE_V = 0.3
LOADED = 0.1  # of its usual current: below, a rotor's current is no evidence


def check(
    flight: Flight, vehicle: Vehicle, air: allocation.Spans, table: Ticks, events: Sequence[Event]
) -> tuple[tuple[Event, ...], tuple[str, ...]]:
    """(events with the causes that ESC telemetry shows, and events that it alone shows, in order of announcement; sentences on unusable
    telemetry). Events are unchanged where the log has none."""
    events = tuple(events)
    if "esc" not in flight.signals:
        return events, ()
    thrust = allocation.rotor_thrusts(flight, vehicle)
    bins, notes = telemetry.read(flight, thrust, air)
    if bins is None:
        return events, tuple(notes)
    left, calm = following.departures(bins, thrust.time, air), _calm(bins, table, air)
    events = tuple(following.sooner(e, left) for e in events)
    stopped_events, stopped_notes = stopped.find(bins, events, air, _upset(bins, table))
    events = (*events, *stopped_events)
    healthy = _healthy(bins, events)
    # A loss of known rotors, whose cause is not known yet.
    open_ = [e.means.weakens and not e.alternatives and "cause" not in e.extra for e in events]
    out = [_with_cause(e, bins, calm, healthy, air) if ask else e for e, ask in zip(events, open_)]
    # Once a rotor is weak, the others work outside the range in which their laws were fitted.
    changed, warnings = watch.examine(bins, calm & healthy.all(axis=1, keepdims=True))
    return joined(out, changed), (*notes, *stopped_notes, *warnings)


def _upset(bins: Binned, table: Ticks) -> np.ndarray:
    return table.upset[np.clip(np.searchsorted(table.time, bins.time), 0, len(table.time) - 1)]


def _calm(bins: Binned, table: Ticks, air) -> np.ndarray:
    """(T, 1) bool: bins of regular flight: no take-off, no touch-down, no tumbling, no contact."""
    tick = np.clip(np.searchsorted(table.time, bins.time), 0, len(table.time) - 1)
    fine = ~_upset(bins, table)
    if table.contact is not None:
        fine &= ~table.contact[tick]
    for start, end in air:
        fine &= ~((bins.time >= start) & (bins.time < start + TAKE_OFF_S))
        fine &= ~((bins.time > end - DOWN_S) & (bins.time <= end))
    return fine[:, None]


def _healthy(bins: Binned, events: Sequence[Event]) -> np.ndarray:
    """(T, n) bool: rotors that no event names at that time; CLEAR_S before an onset is doubtful."""
    out = np.ones(bins.known.shape, bool)
    for e in events:
        if e.means.lasting_fault:
            end = np.inf if e.end_s is None else e.end_s + CLEAR_S
            during = (bins.time > e.onset_s - CLEAR_S) & (bins.time < end)
            for rotor in e.suspects:
                out[during, rotor - 1] = False
    return out


def _with_cause(event: Event, bins: Binned, calm: np.ndarray, healthy: np.ndarray, air) -> Event:
    """The event with the evidence of its rotors' ESCs; unchanged where they show nothing."""
    undisturbed = calm[:, 0] & healthy.all(axis=1)
    before = undisturbed & (bins.time < event.onset_s - CLEAR_S)
    before &= np.cumsum(before[::-1])[::-1] <= LEARNED_S / telemetry.BIN_S
    end = event.end_s if event.end_s is not None else next((b for a, b in air if a <= event.onset_s <= b), np.inf)
    after = (bins.time > event.onset_s + RESPONSE_S) & (bins.time < end)
    tumbles = not (after & calm[:, 0]).any()
    after &= calm[:, 0] | tumbles  # where the vehicle tumbles at once, the bins there are
    after &= np.cumsum(after[::-1])[::-1] <= USED_S / telemetry.BIN_S
    if before.sum() < ratios.FEWEST or not after.any():
        return event
    laws = learn(bins, before)
    entries = []
    for rotor, loss, interval in zip(event.rotors, event.loss, event.interval, strict=True):
        seen = ratios.measure(laws, bins, rotor - 1, before, after, healthy, tumbles)
        if seen is not None:
            entries.append(_entry(rotor, loss, interval, seen))
    if not entries:
        return event
    main = max(entries, key=lambda t: event.loss[event.rotors.index(t["rotor"])])
    extra = {**event.extra, "cause": main["cause"], "causes": main["causes"], "esc": entries}
    sentence = "; ".join(in_words(t) for t in entries)
    event = replace(event, reason=f"{event.reason.removesuffix('.')}; {sentence}", extra=extra)
    stands = [t for t in entries if t["thrust_of_speed"] < ratios.STANDS]
    if len(event.rotors) == 1 and stands:  # a stopped rotor gives no thrust, whatever the motion of a tumbling vehicle suggests
        event = replace(event, loss=(1.0,), interval=((stopped.LEAST_LOSS, 1.0),))
    return event


def learn(bins: Binned, before: np.ndarray) -> tuple[ratios.Law, ratios.Law | None]:
    """The laws of speed and current in the bins `before` (T,) bool; None for current where it is not measured."""
    y, x = ratios.log_power(bins), np.log(bins.thrust)
    turning = bins.power > 0.0
    rows = np.flatnonzero(before)
    speed = ratios.learn(y[rows], x[rows], (bins.known & turning)[rows], ratios.SPEED_POWER)
    drawing = bins.known & turning & bins.current_known & (bins.current > 0.0)
    if drawing[rows].sum(axis=0).max(initial=0) < ratios.FEWEST:
        return speed, None
    z = np.log(np.maximum(bins.current, 1e-3))
    return speed, ratios.learn(z[rows], 0.5 * y[rows], drawing[rows], ratios.CURRENT_POWER)


def _entry(rotor: int, loss: float, interval: tuple[float, float], seen: ratios.Measured) -> dict:
    """The evidence on one rotor, as it appears in the answer."""
    sd = max((interval[1] - interval[0]) / 3.92, 1e-3)
    share = ratios.causes(seen, loss, sd)
    best = max(share, key=lambda cause: share[cause])
    current = None if seen.current_change is None or seen.load < LOADED else 1.0 + seen.current_change[0] / seen.load
    cause = best if share[best] >= LIKELY else ratios.UNKNOWN
    parts, drop = ratios.parts(seen, loss, sd), None if seen.volts is None else seen.volts[0]
    return causes.entry(rotor, cause, share, parts, seen.speed_ratio[0], current, drop)


def in_words(entry: dict) -> str:
    """An ESC's evidence in words: 'ESC 3: it turns as commanded and draws 20 % less than ..., so the propeller (97 %)'."""
    share = entry["thrust_of_speed"]
    high = 1.0 - entry["speed_loss_interval"][0]
    if share < ratios.STANDS:
        phrases = ["the motor has stopped"]
    elif high < 1.0:
        phrases = [f"its speed gives {percent(share)} of the commanded thrust"]
    else:
        phrases = ["the motor turns as commanded"]
    draws = entry["current_ratio"]
    if draws is not None and abs(draws - 1.0) >= 0.1:
        direction = "more" if draws > 1.0 else "less"
        phrases.append(f"draws {percent(abs(draws - 1.0))} {direction} current than this speed needs")
    drop = entry["supply_drop_V"]
    if drop is not None and drop > NOTABLE_V:
        phrases.append(f"its supply fell {drop:.1f} V below the others'")
    cause = entry["cause"]
    if cause == ratios.UNKNOWN:
        none_fits = entry["causes"][ratios.UNKNOWN] >= LIKELY
        so = "which matches no single cause" if none_fits else "which leaves the cause open"
    else:
        so = f"so the cause is the {CAUSES[cause]} ({probability(entry['causes'][cause])})"
    return f"the ESC of {rotors([entry['rotor']])} shows that {listed(phrases)}, {so}"
