"""Track over ground as a local map (SVG): metres north and east of the lift-off, without imagery and without geographic position."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from itertools import pairwise

import numpy as np

from rotorwatch import report
from rotorwatch.flight.diagnosis import Diagnosis, Trace
from rotorwatch.report import colours
from rotorwatch.report.lanes import has_track
from rotorwatch.report.thinning import within

WIDTH, LEAST_HEIGHT, MOST_HEIGHT, MARGIN, FOOT = 440.0, 180.0, 360.0, 22.0, 34.0  # SVG units; the foot is below the map
LEAST_M = 2.0
"""Least span of the map [m], so that noise in a calm hover looks small."""
TOLERANCE = 0.6
"""Largest error of the drawn line, at any time [SVG units]."""
BAR = 0.25
"""Greatest length of the scale bar, as a share of the map's width."""


@dataclass(frozen=True)
class Map:
    """Scale and place of the map in the picture. scale: SVG units per metre, north and east alike; height: of the map above its foot;
    north, east: of its centre [m]."""

    scale: float
    height: float
    north: float
    east: float

    def place(self, north, east) -> tuple[np.ndarray, np.ndarray]:
        """x to the right and y down, of places in metres."""
        x = WIDTH / 2 + self.scale * (np.asarray(east) - self.east)
        return x, self.height / 2 - self.scale * (np.asarray(north) - self.north)

    @property
    def bar(self) -> float:
        """Length of the scale bar [m]: 1, 2 or 5 times a power of ten."""
        most = BAR * WIDTH / self.scale
        power = 10.0 ** np.floor(np.log10(most))
        return float(power * max(k for k in (1, 2, 5) if k * power <= most * (1 + 1e-9)))


def fitted(north: np.ndarray, east: np.ndarray) -> Map:
    """The map that shows all these places [m], as large as it can."""
    (low_n, high_n), (low_e, high_e) = ((float(v.min()), float(v.max())) for v in (north, east))
    tall, wide = max(high_n - low_n, LEAST_M), max(high_e - low_e, LEAST_M)
    height = float(np.clip(2 * MARGIN + (WIDTH - 2 * MARGIN) * tall / wide, LEAST_HEIGHT, MOST_HEIGHT))
    scale = min((WIDTH - 2 * MARGIN) / wide, (height - 2 * MARGIN) / tall)
    return Map(scale, height, 0.5 * (low_n + high_n), 0.5 * (low_e + high_e))


def flown(trace: Trace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(time s, north m, east m) of the ticks from the first lift-off to the last landing at which the place is known; else all empty."""
    if not has_track(trace):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    assert trace.position is not None
    known = np.isfinite(trace.position[:, :2]).all(axis=1)
    if trace.airborne:
        known &= within(trace.time, [(trace.airborne[0][0], trace.airborne[-1][1])])
    return trace.time[known], trace.position[known, 0], trace.position[known, 1]


def thinned(time: np.ndarray, x: np.ndarray, y: np.ndarray, tolerance: float) -> np.ndarray:
    """Indices of the points between which a vehicle that goes straight on, evenly, is never further off than `tolerance`.

    So both the line and the place at any time stay correct: a curve keeps many points, a hover two.
    """
    keep = np.zeros(time.size, bool)
    keep[[0, -1]] = True
    stretches = [(0, time.size - 1)]
    while stretches:
        a, b = stretches.pop()
        if b - a < 2:
            continue
        inside = slice(a + 1, b)
        share = (time[inside] - time[a]) / max(time[b] - time[a], 1e-9)
        off = np.hypot(x[inside] - x[a] - share * (x[b] - x[a]), y[inside] - y[a] - share * (y[b] - y[a]))
        far = int(np.argmax(off))
        if off[far] > tolerance:
            keep[a + 1 + far] = True
            stretches += [(a, a + 1 + far), (a + 1 + far, b)]
    return np.flatnonzero(keep)


def svg(diagnosis: Diagnosis) -> str:
    """The map as inline SVG, north up; empty where the log has no position. Where each event began is marked in its colour, with its
    number. The page's script moves the circle of class `moment`."""
    trace = diagnosis.trace
    time, north, east = flown(trace) if trace is not None else (np.zeros(0),) * 3
    if trace is None or time.size < 2:
        return ""
    area = fitted(north, east)
    x, y = area.place(north, east)
    named = f"Track over ground, north up, within {metres(reach(north, east))} of the lift-off"
    parts = [
        f'<svg class="track" id="track" viewBox="0 0 {WIDTH:.0f} {area.height + FOOT:.0f}" role="img" aria-label="{escape(named)}">',
        f"<title>{escape(named)}</title>",
        _grid(area),
        *(_piece(time[part], x[part], y[part]) for part in _pieces(time, trace)),
        _foot(area),
        f'<g class="start"><title>lift-off, {report.seconds(time[0])}</title><circle cx="{x[0]:.1f}" cy="{y[0]:.1f}" r="8"/></g>',
        f'<g class="end"><title>end, {report.seconds(time[-1])}</title>'
        f'<rect x="{x[-1] - 4:.1f}" y="{y[-1] - 4:.1f}" width="8" height="8"/></g>',
        *_events(diagnosis, time, x, y),
        '<circle class="moment" r="11" visibility="hidden"/></svg>',
    ]
    return "".join(parts)


def reach(north: np.ndarray, east: np.ndarray) -> float:
    """Greatest distance from the lift-off [m]."""
    return float(np.hypot(north - north[0], east - east[0]).max())


def metres(length: float) -> str:
    """'0.35 m', '8.4 m', '412 m', '2.4 km'."""
    if length >= 2000:
        return f"{length / 1000:.3g} km"
    return f"{length:.2g} m" if length < 10 else f"{length:.0f} m"


def _pieces(time: np.ndarray, trace: Trace) -> list[slice]:
    """Stretches of the track without a gap."""
    step = float(np.median(np.diff(trace.time)))
    edges = [0, *(np.flatnonzero(np.diff(time) > 1.5 * step) + 1), time.size]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _piece(time: np.ndarray, x: np.ndarray, y: np.ndarray) -> str:
    kept = thinned(time, x, y, TOLERANCE)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[kept], y[kept]))
    return f'<polyline class="flown" data-times="{" ".join(f"{t:.2f}" for t in time[kept])}" points="{points}"/>'


def _grid(area: Map) -> str:
    """Faint lines, as far apart as the scale bar is long; one of each direction goes through the lift-off."""
    step = area.scale * area.bar
    x0, y0 = (float(v) for v in area.place(0.0, 0.0))
    lines = [f"M{x:.1f} 0V{area.height:.0f}" for x in np.arange(x0 % step, WIDTH, step)]
    lines += [f"M0 {y:.1f}H{WIDTH:.0f}" for y in np.arange(y0 % step, area.height, step)]
    return f'<path class="grid" d="{"".join(lines)}"/>'


def _foot(area: Map) -> str:
    """The scale bar and an arrow to the north, below the map."""
    long, down = area.scale * area.bar, area.height + 22
    text = f"{area.bar:g} m" if area.bar < 1000 else f"{area.bar / 1000:g} km"
    return (
        f'<path class="foot" d="M0 {area.height:.0f}H{WIDTH:.0f}"/>'
        f'<g class="scale"><path d="M14 {down - 5:.1f}v5h{long:.1f}v-5"/><text x="{22 + long:.1f}" y="{down + 1:.1f}">{text}</text></g>'
        f'<g class="north"><path d="M{WIDTH - 18:.0f} {down - 15:.1f}l6 20-6-5-6 5z"/>'
        f'<text x="{WIDTH - 30:.0f}" y="{down + 1:.1f}">north</text></g>'
    )


def _events(diagnosis: Diagnosis, time: np.ndarray, x: np.ndarray, y: np.ndarray) -> list[str]:
    """Markers of the onset of each event; those at the same place stand side by side."""
    out: list[str] = []
    taken = [(float(x[k]), float(y[k])) for k in (0, -1)]  # lift-off and end stay visible
    for number, event in enumerate(diagnosis.events, 1):
        k = int(np.clip(np.searchsorted(time, event.onset_s), 0, time.size - 1))
        a, b = float(x[k]), float(y[k])
        while any(np.hypot(a - c, b - d) < 17 for c, d in taken):
            a += 17.0
        taken.append((a, b))
        name = f"{number}: {event.means.noun}, {report.seconds(event.onset_s)}"
        out.append(
            f'<g class="event" style="--tint:{colours.of_event(event)}"><title>{escape(name)}</title>'
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="8"/><text x="{a:.1f}" y="{b + 4:.1f}">{number}</text></g>'
        )
    return out
