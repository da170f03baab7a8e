"""Ranks methods of several results files, and shows the ranking: a table in the terminal, a page for a browser.

Methods are ordered by the share of clear faults that they find in time at the plan's false-alarm rate, then by their delay. A rule without
a statistic has the rate that it has: where that is above the plan's it stands below those that keep to it. All methods have flown the same
flights: whether one differs from the first is tested in pairs (`summary.mcnemar`).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from rotorwatch import __version__
from rotorwatch.base import files
from rotorwatch.errors import ConfigError
from rotorwatch.report.colours import PALETTE
from rotorwatch_lab.campaign import results_file, summary
from rotorwatch_lab.campaign.page import STYLE
from rotorwatch_lab.experiments.tools import interval

COLUMNS = {
    "detected": "found",
    "delay_s": "delay, s",
    "right": "right rotor",
    "loss_rmse": "size error",
    "coverage": "coverage",
    "own_false_alarms_h": "own alarms/h",
    "us_per_step": "us a step",
}
SHARES = {"detected", "right", "coverage", "own_detected"}
DIGITS = {"loss_rmse": 3, "delay_s": 2, "own_delay_s": 2}
SURE = 0.05  # two methods differ where chance alone makes such a difference more seldom
BAR = 150  # pixels of a share of 1
MORE_STYLE = """caption{text-align:left;padding:.3rem 0}td.l,th.l{text-align:left}small{color:#555}"""


def rank(paths: Sequence[str | os.PathLike]) -> dict[str, Any]:
    """{"plan", "rows", "failed", "data": [{"name", "logs", "left_out", "rows", "failed"}], "machines"} of results files.

    rows: best first, each a method's entry with `place`, `file`, `machine`, `over` (it is above the plan's rate of false alarms) and
    `paired` ({"detected", "right"}: `summary.mcnemar` against the first, "size": `summary.closer`) and `like_first` (the flights do not
    distinguish it from the first: p >= SURE; for files without numbers of flights: the intervals overlap, and paired is None). Raises
    ConfigError for no file, one that cannot be used, and files of different plans.
    """
    if not paths:
        raise ConfigError("There is nothing to rank: give the files that `rotorwatch benchmark -o` has written.")
    read = [(path, results_file.read(path)) for path in dict.fromkeys(Path(path) for path in paths)]
    first, one = read[0]
    for path, results in read[1:]:
        if results["plan"]["sha256"] != one["plan"]["sha256"]:
            raise ConfigError(
                f"{first} is of the plan {_plan(one)} and {path} of {_plan(results)}: results of different plans cannot be ranked together."
            )
    limit = one["plan"]["false_alarms_h"]
    sets: dict[tuple[str, str], dict[str, Any]] = {}
    for path, results in read:
        for part in results["data"]:
            known = sets.setdefault((part["name"], part["index_sha256"]), {**part, "methods": []})
            known["methods"] += _entries(path, results, part["methods"])
    entries = [entry for path, results in read for entry in _entries(path, results, results["methods"])]
    return {
        "plan": one["plan"],
        **_ordered(entries, limit),
        "data": [
            {"name": part["name"], "logs": part["logs"], "left_out": part["left_out"]} | _ordered(part["methods"], limit)
            for part in sets.values()
        ],
        "machines": {path.name: results["machine"] for path, results in read},
    }


def _plan(results: dict[str, Any]) -> str:
    plan = results["plan"]
    return f"{plan['name']} version {plan['version']} ({plan['sha256'][:8]})"


def _entries(path: Path, results: dict[str, Any], methods: list[dict]) -> list[dict]:
    return [{**m, "file": path.name, "rotorwatch": results["rotorwatch"], "machine": results["machine"]} for m in methods]


def _ordered(entries: list[dict], limit: float) -> dict[str, list[dict]]:
    rows = [{**e, "over": _over(e["scores"], limit)} for e in entries if e["scores"] is not None]
    rows.sort(key=_key)
    for k, row in enumerate(rows):
        best, scores = rows[0]["scores"], row["scores"]
        paired = _paired(best, scores)
        alike = paired["detected"]["p"] >= SURE if paired else _overlap(best["detected"], scores["detected"])
        row |= {"place": k + 1, "paired": paired, "like_first": alike and not row["over"]}
    return {"rows": rows, "failed": [e for e in entries if e["scores"] is None and e["failed"]]}


def _paired(first: dict[str, Any], other: dict[str, Any]) -> dict[str, dict] | None:
    if not all("found_flights" in scores and scores["detected"] for scores in (first, other)):
        return None
    return {
        "detected": summary.mcnemar(first["found_flights"], other["found_flights"]),
        "right": summary.mcnemar(first["right_flights"], other["right_flights"]),
        "size": summary.closer(first.get("size_errors", {}), other.get("size_errors", {})),
    }


def _overlap(best: dict[str, float] | None, other: dict[str, float] | None) -> bool:
    return bool(best and other and other["high"] >= best["low"])


def _over(scores: dict[str, Any], limit: float) -> bool:
    """True if a rule without an adjustable threshold exceeds the plan's false-alarm rate."""
    rate = scores["false_alarms_h"]
    return scores["threshold"] is None and rate is not None and rate["value"] > limit


def _key(row: dict[str, Any]) -> tuple:
    detected, delay = row["scores"]["detected"], row["scores"]["delay_s"]
    return (
        row["over"], detected is None, -detected["value"] if detected else 0.0, delay["value"] if delay else float("inf"),
        row["name"], row["file"],
    )  # fmt: skip


def cell(key: str, value: dict[str, float] | None) -> str:
    """A score with its interval, as text."""
    if value is None or key in SHARES:
        return interval(value)
    return interval(value, DIGITS.get(key, 0 if value["value"] >= 10 else 1))


def _from(row: dict[str, Any]) -> str:
    return f"{row['package']} {row['version']}".strip()


def mark(row: dict[str, Any]) -> str:
    if row["over"]:
        return "over"
    return f"{row['place']}{'=' if row['like_first'] and row['place'] > 1 else ''}"


def _title(ranked: dict[str, Any]) -> str:
    plan = ranked["plan"]
    return f"Benchmark {plan['name']} version {plan['version']}: {plan['flights']} flights"


def _rule(ranked: dict[str, Any]) -> str:
    within, rate = ranked["plan"]["within_s"], ranked["plan"]["false_alarms_h"]
    return (
        f"found: share of clear faults found within {within:g} s, thresholds set to {rate:g} false alarms an hour of healthy flight. "
        f"=: these flights do not distinguish it from the first (McNemar's test, p over {SURE:g}). "
        "over: a rule with more false alarms than that. In brackets 95 % intervals."
    )


def _logs(data_set: dict[str, Any]) -> str:
    """Number of logs of a data set, and of those that could not be diagnosed."""
    missing = f", {len(data_set['left_out'])} of them left out" if data_set["left_out"] else ""
    return f"{data_set['logs']} {'log' if data_set['logs'] == 1 else 'logs'}{missing}"


def table(ranked: dict[str, Any]) -> Any:
    """The ranking for a terminal."""
    from rich.console import Group
    from rich.text import Text

    from rotorwatch.report.terminal import Fitted

    several = len(ranked["machines"]) > 1

    def part(title: str, ranked_: dict[str, Any]) -> list[Any]:
        heads = ["", "method", "from", *COLUMNS.values(), *(["file"] if several else [])]
        rows = []
        for row in ranked_["rows"]:
            cells = [mark(row), row["name"], _from(row), *(cell(key, row["scores"].get(key)) for key in COLUMNS)]
            rows.append([Text(c) for c in [*cells, *([row["file"]] if several else [])]])
        shown: list[Any] = [Fitted(title, heads, rows, right=range(3, 3 + len(COLUMNS)), wide=(2,))]
        return shown + [Text(f"{entry['name']}: {entry['failed']}") for entry in ranked_["failed"]]

    parts = [*part(_title(ranked), ranked), Text(_rule(ranked), style="dim")]
    for data_set in ranked["data"]:
        parts += [Text(""), *part(f"Data set {data_set['name']}: {_logs(data_set)}", data_set)]
    return Group(*parts)


def write_page(ranked: dict[str, Any], path: str | os.PathLike) -> None:
    """The ranking as one self-contained page without scripts."""
    title = escape(_title(ranked))
    parts = [
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}{MORE_STYLE}</style>',
        f"<h1>{title}</h1><p>{escape(_rule(ranked))}</p>",
        _html(ranked),
    ]
    for data_set in ranked["data"]:
        parts.append(f"<h2>Data set {escape(data_set['name'])}</h2><p>{_logs(data_set)}.</p>{_html(data_set)}")
        rows = "".join(f"<li>{escape(log)}: {escape(why)}</li>" for log, why in data_set["left_out"])
        parts.append(f"<details><summary>Left out</summary><ul>{rows}</ul></details>" if rows else "")
    where = "".join(f"<li>{escape(name)}: {escape(machine)}</li>" for name, machine in ranked["machines"].items())
    plan = ranked["plan"]
    parts.append(f"<h2>Where</h2><ul>{where}</ul><p>Plan {escape(plan['name'])}, SHA-256 {escape(plan['sha256'])}:</p>")
    parts.append(f"<details><summary>The plan</summary><pre>{escape(plan['text'])}</pre></details>")
    parts.append(f"<p><small>rotorwatch {__version__}</small></p></html>")
    with files.replacing(path) as unfinished:
        unfinished.write_text("\n".join(parts), encoding="utf-8")


def _html(ranked: dict[str, Any]) -> str:
    heads = ("", "method", "from", "", *COLUMNS.values(), "file")
    head = "".join(f'<th class="l">{h}</th>' if k in (0, 1, 2, 3) else f"<th>{h}</th>" for k, h in enumerate(heads))
    body = []
    for row in ranked["rows"]:
        name = f'<b title="{escape(row["path"])}">{escape(row["name"])}</b><br><small>{escape(row["about"])}</small>'
        cells = "".join(f"<td>{escape(cell(key, row['scores'].get(key)))}</td>" for key in COLUMNS)
        body.append(
            f'<tr><td>{mark(row)}</td><td class="l">{name}</td><td class="l">{escape(_from(row))}</td>'
            f'<td class="l">{_bar(row["scores"]["detected"])}</td>{cells}<td>{escape(row["file"])}</td></tr>'
        )
    failed = "".join(f"<li>{escape(e['name'])}: {escape(e['failed'])}</li>" for e in ranked["failed"])
    return f"<table><tr>{head}</tr>{''.join(body)}</table>" + (f"<p>Not run:</p><ul>{failed}</ul>" if failed else "")


def _bar(share: dict[str, float] | None) -> str:
    """A share as a bar with its interval as a line over it."""
    if share is None:
        return ""
    low, value, high = (BAR * share[key] for key in ("low", "value", "high"))
    return (
        f'<svg width="{BAR}" height="14" role="img" aria-label="{100 * share["value"]:.0f} %"><rect width="{BAR}" height="14" fill="#eee"/>'
        f'<rect width="{value:.1f}" height="14" fill="{PALETTE[4]}"/>'
        f'<path d="M{low:.1f} 7H{high:.1f}M{low:.1f} 3v8M{high:.1f} 3v8" stroke="{PALETTE[0]}" stroke-width="2"/></svg>'
    )
