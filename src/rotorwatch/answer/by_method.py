"""An answer by a published method, beside that of the common decision.

The events, their losses and intervals are those of the decision that all methods share, made from the method's estimates. The method's own
estimate AFTER_S after the announcement is added.
"""

from __future__ import annotations

from dataclasses import replace

from rotorwatch.answer.conclusion import Conclusion
from rotorwatch.answer.wording import headline, interval, percent, rotors, seconds
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import LOSS
from rotorwatch.flight.method_series import SET, MethodSeries

AFTER_S = 2.0


def reported(end: Conclusion, itself: MethodSeries) -> Conclusion:
    """The conclusion with the method's name in its headline, and its own estimate at every loss."""
    events = tuple(_with_own(event, itself) for event in end.events)
    return end._replace(headline=_headline(end, events, itself), events=events)


def _with_own(event: Event, itself: MethodSeries) -> Event:
    """The event with the method's own estimate of its rotors; unchanged where it is no loss, or where the method had not yet begun."""
    row = itself.at(event.detected_s + AFTER_S)
    if event.kind != LOSS or row is None:
        return event
    at = [itself.rotors[rotor] for rotor in event.rotors]
    estimate = {
        "own_loss": [float(itself.theta[row, k]) for k in at],
        "own_interval": [[float(itself.lower[row, k]), float(itself.upper[row, k])] for k in at],
        "own_at_s": float(itself.time[row]),
    }
    return replace(event, extra={**event.extra, **estimate})


def _headline(end: Conclusion, events: tuple[Event, ...], itself: MethodSeries) -> str:
    main = None if end.main is None else events[end.main]
    first = f"{itself.method}: {end.headline}"
    if main is None or "own_loss" not in main.extra:
        return first
    kind = "its set" if itself.says == SET else "95 % by its covariance"
    losses = [
        f"{rotors([r])} {percent(loss)} ({interval(*bounds)}, {kind})"
        for r, loss, bounds in zip(main.rotors, main.extra["own_loss"], main.extra["own_interval"])
    ]
    second = f"{itself.method} itself estimated {', '.join(losses)} at {seconds(main.extra['own_at_s'])}."
    return headline([first, second])
