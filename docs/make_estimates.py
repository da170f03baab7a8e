"""Write the measured part of docs/estimate.md: how often the interval or bound of each method holds the truth, and plots of three logs.

    python docs/make_estimates.py measure TRUTH.csv [TRUTH.csv ..] -o RESULTS [--methods axkf,aesmf] [--draw LOG --draw LOG ..]
    python docs/make_estimates.py page RESULTS

A TRUTH.csv lies beside its logs, or names them by paths that end below its folder, and has a line for each log: `path`, and rotors, loss
and times as columns faulty_rotors, thrust_loss, start_s, end_s (or faults: rotors:loss:start:end;..), or rotors, loss, onset_s with
lists separated by ; , or expect (.. fault:2), loss, begins_s. Logs that a column real_or_sim calls real, whose loss is not known, or
where something else than a loss was done (a column kind) are left out and counted. `measure` keeps each log's figures in RESULTS as
soon as it is done, goes on from there, and says what it left out. `page` writes docs/estimates.json and the tables; without RESULTS from
that file as it is.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import sys
import textwrap
from collections import Counter
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
DATA, PAGE = HERE / "estimates.json", HERE / "estimate.md"
BEGIN, END = "<!-- measured: docs/make_estimates.py -->\n", "<!-- end of what is measured -->\n"
METHODS = ("axkf", "intermediate", "lyapunov", "mh_lyapunov", "tsukf", "atsukf", "aesmf")
LOSSES = ("healthy", "loss", "dead", "pair")
FEW = 5  # flights of a group that is shown on its own
SETTLED_S = 2.0  # after an onset, before the rotor that lost counts
GROUPS = ("healthy", "quad, one loss", "quad, two losses", "hexa, octa and tri, losses", "a rotor dead")


def flights(path: Path) -> tuple[list[tuple[Path, str, list]], Counter]:
    """(log, group, [(theta's name, loss, start s, end s)]) of the lines of a table whose truth is known, and why others are left out."""
    found, left = [], Counter()
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        log = next((log for log in _places(path.parent, row["path"]) if log.exists()), None)
        try:
            segments = _segments(row)
        except ValueError:
            segments = None
        if log is None:
            left["not there"] += 1
        elif row.get("real_or_sim") == "real":
            left["real"] += 1
        elif row.get("kind", "loss") not in LOSSES or (row.get("expect") or "").startswith("swapped"):
            left["no loss, but something else"] += 1
        elif segments is None:
            left["loss or time not known"] += 1
        else:
            found.append((log, _group(row, segments), segments))
    return found, left


def _places(folder: Path, name: str) -> list[Path]:
    """Where a log of that name may lie: below the table's folder, also by the last parts of a longer path."""
    parts = Path(name).parts
    return [folder.joinpath(*parts[k:]) for k in range(len(parts))]


def _segments(row: dict) -> list[tuple[str, float, float, float]]:
    """Raises ValueError where a loss or a time is not known."""
    if row.get("faults"):
        parts = [part.split(":") for part in row["faults"].split(";")]
        return [(f"loss_{int(r)}", float(v), float(a), float(b)) for who, v, a, b in parts for r in who.split("+")]
    named = re.search(r"(?:fault|named|ambiguous):(\d+(?:\+\d+)*)", row.get("expect", ""))
    who = named[1] if named else row.get("faulty_rotors", row.get("rotors", "")) or ""
    if not who:
        return []
    rotors = [int(r) for r in who.split("+")]
    losses = [float(v) for v in (row.get("thrust_loss") or row["loss"]).strip("[]").replace(",", ";").split(";")]
    starts = [float(v) for v in (row.get("start_s") or row.get("onset_s") or row["begins_s"]).split(";")]
    losses, starts = (values * len(rotors) if len(values) == 1 else values for values in (losses, starts))
    return [(f"loss_{r}", v, a, float("inf")) for r, v, a in zip(rotors, losses, starts, strict=True)]


def _group(row: dict, segments: list) -> str:
    if not segments:
        return GROUPS[0]
    if any(loss > 0.9 for _, loss, _, _ in segments):
        return GROUPS[4]
    if not str(row.get("frame", "")).startswith("quad"):
        return GROUPS[3]
    return GROUPS[2] if len({name for name, *_ in segments}) > 1 else GROUPS[1]


def measured(log: Path, group: str, segments: list, methods: list[str], draw: Path | None) -> dict:
    """One log's figures: of each method the share of steps in which it holds the truth, its half-width and its error."""
    import rotorwatch as rw
    from rotorwatch.diagnose import prepare
    from rotorwatch_lab.estimate import steps

    flight = rw.read(log)
    left = min((assessed.onset for assessed in prepare(flight).upsets), default=np.inf)
    found = rw.estimate(flight, methods, truth=steps(segments))
    row = {"log": log.name, "group": group, "faults": len(segments), "control_lost_s": None if left == np.inf else left, "methods": {}}
    first = min(s.time[0] for s in found.series)
    if any(start <= first for _, _, start, _ in segments):
        return row | {"left": "the loss was there before the first step"}
    for s in found.series:
        true = found.true(s)
        assert true is not None
        use = (s.status == 0) & (s.time < left)
        held = (s.lower <= true) & (true <= s.upper)
        settled = [(s.theta_names.index(n), use & (s.time > a + SETTLED_S) & (s.time < b)) for n, _, a, b in segments]
        lost = [(k, rows) for k, rows in settled if rows.any()]
        one = {
            "steps": int(use.sum()), "all": _mean(held[use]), "half_width": float(np.median(s.theta_off[use])) if use.any() else None,
            "lost": _mean(np.concatenate([held[rows, k] for k, rows in lost])) if lost else None,
            "error": _mean(np.concatenate([(s.theta - true)[rows, k] ** 2 for k, rows in lost])) if lost else None,
        }  # fmt: skip
        row["methods"][s.method] = one
    if draw is not None:
        _draw(found, draw)
    return row | {"failed": dict(found.failed)}


def _draw(found, path: Path) -> None:
    """The picture in a few colours: it is a fifth as large."""
    from PIL import Image

    found.figure().savefig(path, dpi=80)
    with Image.open(path) as image:
        image.convert("RGB").quantize(64).save(path, optimize=True)


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if values.size else None


def measure(tables: list[Path], out: Path, methods: list[str], drawn: list[str]) -> None:
    """Fill the folder."""
    from rotorwatch.errors import RotorwatchError

    out.mkdir(parents=True, exist_ok=True)
    work, left = [], Counter()
    for table in tables:
        some, gone = flights(table)
        work, left = work + some, left + gone
    for k, (log, group, segments) in enumerate(work, start=1):
        kept = out / f"{log.name}.json"
        draw = next((HERE / f"estimate-{k + 1}.png" for k, name in enumerate(drawn) if name == log.name), None)
        if kept.exists() and draw is None:
            continue
        print(f"{k} of {len(work)}: {log.name} ({group})", file=sys.stderr, flush=True)
        try:
            row = measured(log, group, segments, methods, draw)
        except RotorwatchError as why:
            row = {"log": log.name, "group": group, "methods": {}, "left": str(why)}
        kept.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
    (out / "left.json").write_text(json.dumps({"left": dict(left), "drawn": drawn}) + "\n", encoding="utf-8")


def gather(out: Path) -> dict:
    """All figures of the folder."""
    rows = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(out.glob("*.json")) if path.name != "left.json"]
    return json.loads((out / "left.json").read_text(encoding="utf-8")) | {"flights": rows}


def table(data: dict) -> str:
    """Methods x groups: means over flights of the steps that hold the truth, of all rotors and of those that lost thrust, in per cent; and
    over all flights half-width and error."""
    rows = [row for row in data["flights"] if row["methods"]]
    count = Counter(row["group"] for row in rows)
    groups = [group for group in GROUPS if count[group] >= FEW]
    heads = ["method", *(f"{g} ({count[g]})" for g in groups), "all", "half-width, error"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for method in METHODS:
        every = [row["methods"][method] for row in rows if method in row["methods"]]
        parts = [[row["methods"][method] for row in rows if method in row["methods"] and row["group"] == group] for group in groups]
        cells = [_pair(part, ("all", "lost")) for part in [*parts, every]] + [_pair(every, ("half_width", "error"), 3)]
        lines.append(f"| [`{method}`](methods/{method}.md) | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _pair(found: list[dict], keys: tuple[str, str], digits: int | None = None) -> str:
    """Means of two figures; the second one only where a rotor lost thrust. Without digits: in per cent."""
    texts = [_cell([one[key] for one in found if one.get(key) is not None], key, digits) for key in keys]
    return ", ".join(text for text in texts if text)


def _cell(values: list[float], key: str, digits: int | None) -> str:
    if not values:
        return ""
    value = float(np.mean(values)) ** (0.5 if key == "error" else 1.0)
    return f"{100 * value:.0f}" if digits is None else f"{value:.{digits}f}"


def page(data: dict) -> str:
    """The measured section."""
    used = [row for row in data["flights"] if row["methods"]]
    gone = Counter(data["left"]) + Counter(_short(row) for row in data["flights"] if row.get("left"))
    said = textwrap.fill("; ".join(f"{count} {why}" for why, count in gone.most_common()) or "none", 140)
    pictures = "\n\n".join(f"![{name}](estimate-{k}.png)" for k, name in enumerate(data["drawn"], start=1))
    return f"""{BEGIN}
## How often the interval holds the truth

{len(used)} simulated flights with known truth, flown by autopilot code (ArduPilot, PX4), estimated on `rates` up to a loss of control
(`python docs/make_estimates.py`; flight by flight in `docs/estimates.json`).
Left out:
{said}.

Steps in which a method's own interval or bound contains the truth, in per cent, mean over flights (their number in brackets; groups of
fewer than {FEW} only in *all*): of every rotor, and of the rotors that lost thrust from {SETTLED_S:g} s after the loss. Nominal: 95 for an
interval, 100 for a bound. Last column: median half-width (all steps and rotors of a flight; mean over flights), and RMS error of the
rotors that lost thrust.

{table(data)}
A covariance covers the noise that the method assumes, not wind, air through the rotors and the battery. A threshold on such an interval
accuses healthy rotors; `diagnose` decides on the direction of the missing wrench and the scatter of the flight instead. On hexas and octas
more losses are estimated than the log shows at once: AXKF's intervals widen until the commands move. AESMF's bounds hold the truth most
often, not always, and are wide.

Three of the flights, with the truth dashed:

{pictures}

{END}"""


def _short(row: dict) -> str:
    """Why a flight was left out, without its name."""
    return row["left"].removeprefix(row["log"]).split(";")[0].split(", so that")[0].strip().rstrip(".").removeprefix("was ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("measure", "page"))
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--draw", action="append", default=[])
    given = parser.parse_args()
    if given.what == "measure":
        if not given.output or not given.paths:
            parser.error("measure needs tables of truths, and -o RESULTS")
        measure(given.paths, given.output, given.methods.split(","), given.draw)
        return
    if given.paths:
        DATA.write_text(json.dumps(gather(given.paths[0]), indent=1) + "\n", encoding="utf-8")
    text, made = PAGE.read_text(encoding="utf-8"), page(json.loads(DATA.read_text(encoding="utf-8")))
    if BEGIN in text:
        text = text[: text.index(BEGIN)] + text[text.index(END) + len(END) :]
    PAGE.write_text(text.rstrip("\n") + "\n\n" + made, encoding="utf-8")


if __name__ == "__main__":
    main()
