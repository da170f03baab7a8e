"""The report's drawings (SVG): the airframe seen from above, and the comparison with healthy flights."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from rotorwatch import report
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.vehicle import Rotor
from rotorwatch.report import colours


def airframe(diagnosis: Diagnosis) -> str:
    """The airframe from above as inline SVG, nose up; rotors filled by loss, arrows for spin. Empty without rotors."""
    states = diagnosis.rotors
    places, looks = geometry(diagnosis), colours.looks(diagnosis)
    if not states or len(places) != len(states):
        return ""
    xy, radius, half = layout(places)
    named = f"Airframe from above: {report.frame(diagnosis)}"
    parts = [
        f'<svg class="airframe" viewBox="{-half:.0f} {-half - 14:.0f} {2 * half:.0f} {2 * half + 14:.0f}" role="img" '
        f'aria-label="{escape(named)}"><title>{escape(named)}</title>'
        '<defs><marker id="spin-tip" viewBox="0 0 8 8" refX="4" refY="4" markerWidth="6" markerHeight="6" '
        'orient="auto">'
        '<path class="tip" d="M0 0 L8 4 L0 8z"/></marker></defs>'
    ]
    parts += [f'<line class="arm" x1="0" y1="0" x2="{x:.1f}" y2="{y:.1f}"/>' for x, y in xy]
    parts.append(f'<path class="nose" d="M0 {-half - 10:.0f} l8 14 h-16z"/><circle class="body" r="15"/>')
    for (x, y), place, state in zip(xy, places, states, strict=True):
        parts.append(_rotor(float(x), float(y), radius, place, state, looks[state.rotor][0]))
    return "".join(parts) + "</svg>"


def layout(rotors: Sequence[Rotor]) -> tuple[np.ndarray, float, float]:
    """Positions of the rotors drawn nose up: centres (n, 2), x to the right, y down; radius of a disc; half the picture's width."""
    xy = np.array([(r.y, -r.x) for r in rotors], float)
    reach = max(float(np.hypot(*xy.T).max()), 1e-9)
    xy *= 100 / reach
    gaps = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(xy))
    for k in range(len(xy)):  # coaxial pairs: the second one is drawn further out
        if gaps[k, :k].size and gaps[k, :k].min() < 1:
            xy[k] *= 1.55
    gaps = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(xy))
    radius = float(np.clip(0.46 * gaps.min(), 16, 40))
    return xy, radius, float(np.abs(xy).max()) + radius + 8


def _rotor(x: float, y: float, radius: float, place: Rotor, state, tint: str) -> str:
    """A rotor: a disc that empties with the loss, its number, its loss in percent, an arrow for its spin."""
    loss = min(max(state.loss, 0.0), 1.0)
    label = {"?": "?", "none seen": "none"}.get(report.rotor_loss(state), report.percent(state.loss))
    opacity = 0.15 + 0.85 * loss if loss > 0.02 else 0.0
    # The arrow's arc runs over the top of the disc, 110 degrees of it.
    aside, up = 0.82 * radius, -0.57 * radius
    start, end, sweep = (aside, -aside, 0) if place.spin > 0 else (-aside, aside, 1)
    spin = "counter-clockwise" if place.spin > 0 else "clockwise"
    where = f", {state.place}" if state.place else ""
    title = f"Rotor {state.rotor}{where}, {spin}: {state.status}, loss {report.rotor_loss(state)}"
    return (
        f'<g class="rotor {escape(state.status)}" style="--rotor:{tint}" transform="translate({x:.1f} {y:.1f})">'
        f"<title>{escape(title)}</title>"
        f'<circle class="disc" r="{radius - 5:.1f}"/>'
        f'<circle class="lost" r="{radius - 5:.1f}" style="fill-opacity:{opacity:.2f}"/>'
        f'<path class="spin" marker-end="url(#spin-tip)" '
        f'd="M{start:.1f} {up:.1f} A{radius:.1f} {radius:.1f} 0 0 {sweep} {end:.1f} {up:.1f}"/>'
        f'<text class="number" style="font-size:{0.42 * radius:.1f}px" y="0">{state.rotor}</text>'
        f'<text class="loss" style="font-size:{0.33 * radius:.1f}px" y="{0.38 * radius:.1f}">{escape(label)}</text></g>'
    )


def geometry(diagnosis: Diagnosis) -> tuple[Rotor, ...]:
    """Places of the rotors: from the diagnosis (flight.geometry), else from the frame's name, or none."""
    from rotorwatch import airframes
    from rotorwatch.errors import RotorwatchError

    try:
        geometry = diagnosis.flight.get("geometry")
        if geometry:
            return tuple(Rotor(float(g["x"]), float(g["y"]), int(g["spin"])) for g in geometry)
        return airframes.named(str(diagnosis.flight.get("frame", ""))).rotors
    except (RotorwatchError, KeyError, TypeError, ValueError):
        return ()


ROW, LEFT, WIDTH = 26, 118, 380  # of the baseline pictures, in SVG units


def baseline(diagnosis: Diagnosis) -> str:
    """Two pictures: loss of each rotor with its 95 % interval, and how far roll, pitch and yaw are off their usual balance, both against
    the healthy flights. Empty without a conclusive comparison."""
    facts = diagnosis.whole_flight or {}
    loss, bounds = facts.get("loss"), facts.get("interval")
    if facts.get("verdict") in (None, "inconclusive") or not loss or not bounds or len(loss) != len(diagnosis.rotors):
        return ""
    looks = colours.looks(diagnosis)
    top = max(0.1, *(float(high) for _, high in bounds))
    rows = [
        (f"{r.rotor} {r.place}", float(low), float(value), float(high), looks[r.rotor][0])
        for r, value, (low, high) in zip(diagnosis.rotors, loss, bounds, strict=True)
    ]
    out = _rows("Loss against the healthy flights", rows, 0.0, top, report.percent)
    shift, sd = facts.get("shift"), facts.get("shift_sd")
    if shift and sd:
        reach = max(max(abs(float(v)), 2.5 * float(s)) for v, s in zip(shift, sd, strict=True))
        names = ("roll", "pitch", "yaw")
        band = [(name, -2.0 * s, v, 2.0 * s, colours.INK) for name, v, s in zip(names, map(float, shift), map(float, sd), strict=True)]
        title = "Balance: torque per thrust, less that of the healthy flights; bar: where healthy flights lie (95 %)"
        out += _rows(title, band, -reach, reach, "{:+.3f}".format)
    return f'<div class="pictures">{out}</div>'


def _rows(title: str, rows: Iterable[tuple[str, float, float, float, str]], low: float, high: float, text) -> str:
    """A row for each (name, low, value, high, colour): a bar from low to high, a dot at the value."""
    rows = list(rows)

    def at(v: float) -> float:
        return LEFT + (WIDTH - LEFT - 60) * (min(max(v, low), high) - low) / (high - low)

    height = ROW * len(rows) + 12
    parts = [f'<line class="zero" x1="{at(0):.1f}" y1="2" x2="{at(0):.1f}" y2="{height - 8}"/>']
    for k, (name, a, v, b, tint) in enumerate(rows):
        y = ROW * k + 18
        parts.append(
            f'<text x="{LEFT - 10}" y="{y + 4}" class="name">{escape(name)}</text>'
            f'<line class="band" x1="{at(a):.1f}" y1="{y}" x2="{max(at(b), at(a) + 2):.1f}" y2="{y}" style="stroke:{tint}"/>'
            f'<circle class="dot" cx="{at(v):.1f}" cy="{y}" r="4.5" style="fill:{tint}"/>'
            f'<text x="{WIDTH - 52}" y="{y + 4}">{escape(text(v))}</text>'
        )
    return (
        f'<figure><figcaption>{escape(title)}</figcaption><svg class="rows" viewBox="0 0 {WIDTH} {height}" role="img" '
        f'aria-label="{escape(title)}">{"".join(parts)}</svg></figure>'
    )
