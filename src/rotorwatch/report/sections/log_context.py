"""Track, altitude, speed, battery, vibration and modes, folded; and which of them the log does not hold."""

from __future__ import annotations

from typing import Any

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import colours, lanes, markup, track
from rotorwatch.report.axes import flight_range
from rotorwatch.report.figures import assessed

name, title, order = "context", "Track, altitude, battery and vibration", 200
views = ("page",)
data = assessed
VIBRATION = (
    "Vibration: standard deviation of the accelerometer over half a second, without the motion (below about 2 Hz), along the body's "
    "axes x (forward), y (right) and z (down)."
)


def plot(data: Diagnosis) -> dict[str, Any]:
    """Those of `lanes.LANES` that the log holds, and modes."""
    return lanes.context(data, flight_range(data))


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    trace = data.trace
    assert trace is not None
    gone = lanes.absent(trace)
    note = f'<p class="note">Not in this log: {markup.text(", ".join(gone))}.</p>' if gone else ""
    picture = track.svg(data)
    if not divs and not picture:
        return note
    keys = '<span class="spot start"></span>lift-off &ensp; <span class="spot end"></span>end'
    if data.events:
        tint = colours.of_event(data.events[data.main or 0])
        keys += f' &ensp; <span class="spot numbered" style="--tint:{tint}"></span>where the event of that number began'
    _, north, east = track.flown(trace)
    facts = {"farthest from the lift-off": track.metres(track.reach(north, east))} if picture else {}
    about = markup.facts(facts | lanes.summary(trace))
    drawn = f"<figure>{picture}<figcaption>{keys}</figcaption></figure>" if picture else ""
    return (
        f'<details class="context" id="context"><summary>{title}</summary><div class="where">{drawn}{about}</div>'
        + "".join(markup.plot(*item) for item in divs.items())
        + (f'<p class="note">{VIBRATION}</p>' if "vibration" in divs else "")
        + f"{note}</details>"
    )
