"""A fleet as pages: a list of all aircraft, and one page for each with its rotors' losses and imbalances over the flights as SVG. They need
no network."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from rotorwatch.base import files
from rotorwatch.fleet.condition import by_urgency
from rotorwatch.fleet.store import Store

WIDTH, HEIGHT, LEFT, TOP, BOTTOM = 860, 120, 46, 8, 20
STYLE = """
:root { color-scheme: light dark; --line: #8886; --bad: #c0392b; --doubt: #b7791f; --good: #2f7d4f; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; width: 100%; } th, td { text-align: left; padding: .3rem .6rem; border-bottom: 1px solid var(--line); }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
svg { width: 100%; height: auto; display: block; } svg text { font: 11px system-ui, sans-serif; fill: currentColor; }
.fault, .worn, .damaged { color: var(--bad); font-weight: 600; } .suspect { color: var(--doubt); font-weight: 600; } .healthy { color:
var(--good); } .lead { font-size: 1.15rem; }
.of-fault { border-left: 5px solid var(--bad); } .of-suspect { border-left: 5px solid var(--doubt); }
body { overflow-wrap: anywhere; } .not-assessed { color: inherit; }
@media (max-width: 40rem) { body { margin: 1rem auto; } .more { display: none; } table, thead, tbody { display: block; }
tr { display: grid; grid-template-columns: 1fr auto auto auto; border-bottom: 1px solid var(--line); }
th, td { border: 0; padding: .2rem .3rem; }
td:last-child, th:last-child { grid-column: 1 / -1; } }
"""


def write(store: Store, folder: str | Path) -> list[Path]:
    """Write FOLDER/index.html and FOLDER/aircraft-KEY.html; returns the paths, index first. Raises ConfigError when they cannot be
    written."""
    folder = files.folder(folder, "--out")
    aircraft = by_urgency(store.aircraft())
    paths = [_put(folder / "index.html", _index(aircraft))]
    services = store.services()
    for a in aircraft:
        of_aircraft = [s for s in services if s["aircraft"] == a["key"]]
        paths.append(_put(folder / _file(a), _aircraft(a, store.points(a["key"]), of_aircraft)))
    return paths


def _file(a: Mapping) -> str:
    return f"aircraft-{re.sub('[^0-9a-f]', '', a['key'])}.html"


def _put(path: Path, text: str) -> Path:
    with files.replacing(path) as hidden:
        hidden.write_text(text, encoding="utf-8")
    return path


def _page(title: str, body: str) -> str:
    view = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    head = f"{view}<title>{escape(title)}</title><style>{STYLE}</style>"
    return f'<!doctype html><html lang="en"><head>{head}</head><body><main><h1>{escape(title)}</h1>{body}</main></body></html>\n'


def _index(aircraft: Sequence[Mapping]) -> str:
    rows = []
    for a in aircraft:
        standing = a["standing"] or {}
        headline = standing.get("headline", "Not assessed yet.")
        last = (standing.get("last") or {}).get("verdict", "-")
        new = ", ".join(f"{count} {verdict}" for verdict, count in a["new"].items()) or "-"
        state = a["state"].replace(" ", "-")
        rows.append(
            f'<tr class="of-{state}"><td><a href="{_file(a)}">{escape(a["name"])}</a></td><td class="{state}">{a["state"]}</td>'
            f'<td class="n">{a["flights"]}</td><td class="n more">{a["airborne_s"] / 3600:.1f}</td>'
            f'<td class="more">{escape((a["last"] or "-")[:10])}</td><td>{escape(last)}</td>'
            f'<td class="more">{escape(new)}</td><td>{escape(headline)}</td></tr>'
        )
    head = (
        '<tr><th>aircraft</th><th>state</th><th class="n">flights</th><th class="n more">hours</th><th class="more">last flight</th>'
        '<th>last verdict</th><th class="more">new</th><th>status</th></tr>'
    )
    return _page("Fleet", f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>")


def _aircraft(a: Mapping, points: Mapping, services: Sequence[Mapping]) -> str:
    standing = a["standing"]
    about = f"{a['flights']} flights, {a['airborne_s'] / 3600:.1f} h in the air. {a['build']}. Known by {'; '.join(a['identities'])}."
    body = [f'<p><a href="index.html">The fleet</a></p><p>{escape(about)}</p>']
    balance = _balance(points) if "imbalance" in points else ""
    if standing is None or "loss" not in points:
        headline = standing["headline"] if standing else "Not assessed yet."
        return _page(a["name"], body[0] + f'<p class="lead">{escape(headline)}</p>{balance}')
    body.append(f'<p class="lead">{escape(standing["headline"])}</p>')
    for i, r in enumerate(standing["rotors"]):
        low, high = r["interval"]
        body.append(
            f'<h2>Rotor {r["rotor"]}: <span class="{escape(r["status"])}">{escape(r["status"])}</span></h2>'
            f"<p>{100 * r['loss']:.1f} % lost, 95 % between {100 * low:.1f} and {100 * high:.1f} %.</p>"
        )
        alone = [row[i] if row else None for row in points["loss"]]
        body.append(_drawn(r["rotor"], alone, [e[i] for e in points["explained"]], standing))
    body.append(balance)
    lines = [f"<li>{escape(_service(s))}</li>" for s in services]
    body.append(f"<h2>Maintenance</h2><ul>{''.join(lines)}</ul>" if lines else "")
    left = "".join(f"<li>{escape(o['name'])}: {escape(o['why'])}</li>" for o in standing["left_out"])
    used = f"{standing['used']} of {standing['flights']} flights were used."
    body.append(f"<p>{used}</p>" + (f"<ul>{left}</ul>" if left else ""))
    return _page(a["name"], "".join(body))


def _balance(points: Mapping) -> str:
    """Imbalance of each rotor over the flights, with its intervals, on one scale."""
    flights, unit = points["imbalance"], escape(points["unit"])
    rotors = range(max(len(row) for row in flights if row))
    columns = [[row[i] if row and i < len(row) else None for row in flights] for i in rotors]
    top = 1.05 * max(one[2] for column in columns for one in column if one)
    drawn = "".join(f"<p>Rotor {i + 1}</p>{_figures(i + 1, column, top)}" for i, column in enumerate(columns) if any(column))
    return f"<h2>Balance</h2><p>Vibration once per turn over speed squared, {unit}, with 95 % intervals.</p>{drawn}"


def _figures(rotor: int, figures: Sequence[Sequence[float] | None], top: float) -> str:
    K, parts = len(figures), []

    def height(v: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (1.0 - v / top)

    for v in (0.0, 0.5 * top):
        parts.append(f'<line x1="{LEFT}" y1="{height(v):.1f}" x2="{WIDTH - 8}" y2="{height(v):.1f}" stroke="#8886"/>')
        parts.append(f'<text x="4" y="{height(v) + 4:.1f}">{v:.3g}</text>')
    for k, one in enumerate(figures):
        if one:
            x, (value, low, high) = LEFT + (WIDTH - LEFT - 8) * (k + 0.5) / K, one
            parts.append(f'<line x1="{x:.1f}" y1="{height(low):.1f}" x2="{x:.1f}" y2="{height(high):.1f}" stroke="#4a7ebb"/>')
            parts.append(f'<circle cx="{x:.1f}" cy="{height(value):.1f}" r="2" fill="#4a7ebb"/>')
    parts.append(_ends(K))
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="Imbalance of rotor {rotor} over the flights">{"".join(parts)}</svg>'


def _ends(K: int) -> str:
    last = f'<text x="{WIDTH - 8}" y="{HEIGHT - 4}" text-anchor="end">flight {K}</text>'
    return f'<text x="{LEFT}" y="{HEIGHT - 4}">flight 1</text>{last}'


def _service(s: Mapping) -> str:
    what = f"rotor {s['rotor']}" if s["rotor"] else "all rotors"
    return f"{(s['utc'] or 'after flight ' + str(s['after']) + ' of the store')[:16].replace('T', ' ')}: {what}, {s['what']}"


def _drawn(rotor: int, loss: Sequence[float | None], line: Sequence[float], standing: Mapping) -> str:
    """Single flights as dots, the fitted loss as a line, services as dashed lines."""
    K = len(loss)
    top = max(0.12, *(x for x in loss if x is not None), *line)
    bottom = min(-0.04, *(x for x in loss if x is not None), *line)

    def at(k: float, v: float) -> str:
        x = LEFT + (WIDTH - LEFT - 8) * (k + 0.5) / K
        return f"{x:.1f},{TOP + (HEIGHT - TOP - BOTTOM) * (top - v) / (top - bottom):.1f}"

    parts = []
    for v in (0.0, 0.1):
        x, y = at(-0.5, v).split(",")
        parts.append(
            f'<line x1="{x}" y1="{y}" x2="{WIDTH - 8}" y2="{y}" stroke="#8886"/><text x="4" y="{float(y) + 4:.1f}">{100 * v:.0f} %</text>'
        )
    for s in standing["services"]:
        if s["rotor"] in (0, rotor):
            x = at(s["before_flight"] - 1.5, 0.0).split(",")[0]
            ends = f'x1="{x}" y1="{TOP}" x2="{x}" y2="{HEIGHT - BOTTOM}"'
            parts.append(f'<line {ends} stroke="currentColor" stroke-dasharray="3 3"/>')
    dots = (at(k, v).split(",") for k, v in enumerate(loss) if v is not None)
    parts += [f'<circle cx="{x}" cy="{y}" r="2" fill="#4a7ebb" fill-opacity=".7"/>' for x, y in dots]
    course = " ".join(at(k, v) for k, v in enumerate(line))
    parts.append(f'<polyline points="{course}" fill="none" stroke="#c0392b" stroke-width="1.5"/>')
    parts.append(_ends(K))
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="Loss of rotor {rotor} over the flights">{"".join(parts)}</svg>'
