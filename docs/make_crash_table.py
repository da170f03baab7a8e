"""Diagnoses vehicles that fell or met a failsafe, and tabulates what happened and the answer in docs/loss-of-control.md:

    python docs/make_crash_table.py FOLDER

FOLDER holds the logs `crash/` with `expect.csv` (path, note) and of `open/` those whose name has `failsafe`, with `truth.csv` (path, what).
They are not part of the project. Five more are made here: tests/tumbling.py flies them, with a model independent of the diagnosis, and the
messages that an autopilot would have written are added.
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
PAGE = ROOT / "docs" / "loss-of-control.md"
START, END = "<!-- table made by docs/make_crash_table.py -->\n", "<!-- end of the table -->\n"


def recorded(folder: Path) -> Iterator[tuple[str, str, object]]:
    """(name, what happened and the source of the log, flight) of the logs of the folder."""
    from rotorwatch import logs

    for place, table, column, kept in (("crash", "expect.csv", "note", ""), ("open", "truth.csv", "what", "failsafe")):
        with (folder / place / table).open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                if kept in row["path"] and (folder / place / row["path"]).exists():
                    name = row["path"].split(".")[0]
                    source = row.get("source") or "own data"
                    what = re.sub(r"[;,][^;,]*called healthy.*", "", row[column])  # an earlier answer
                    what += "" if source == "own data" else f" ({source}, {row['original']})"
                    yield name, what, logs.read(folder / place / row["path"])


def made() -> Iterator[tuple[str, str, object]]:
    """The same for five flights of a model, with the messages of an autopilot."""
    from tests import tumbling

    from rotorwatch.flight import Message, Signal

    def flown(case: str, seed: int, *said: tuple[float, str, str]):
        flight, truth = tumbling.fly("quad-x", case, seed, 50.0)
        messages = [*flight.messages, *(Message(truth.begins_s + after, kind, text) for after, kind, text in said)]
        return replace(flight, messages=tuple(sorted(messages, key=lambda m: m.time))), truth

    flight, truth = flown("gyro", 4, (-4.0, "text", "EKF3 lane switch 1"), (2.0, "error", "crash check: error 1"))
    yield "made: estimator", f"the estimator changes its core, and at {truth.begins_s:.0f} s a gyro turns wrong", flight
    flight, truth = flown("disarmed", 5, (0.0, "event", "disarmed: crash protection"))
    yield "made: crash protection", f"the autopilot stops the motors in the air at {truth.begins_s:.0f} s", flight
    flight, truth = flown("power", 6, (-6.0, "text", "Battery 1 is low 13.10V used 1800 mAh"))
    yield "made: power", f"low battery, then all rotors fade from {truth.begins_s:.0f} s on", flight
    flight, truth = flown("hover", 7, (-5.0, "text", "Radio Failsafe"), (0.8, "text", "EKF3 lane switch 1"))
    yield "made: rotor", f"radio lost, and at {truth.begins_s:.0f} s rotor {truth.rotors[0]} dies", flight
    flight, truth = flown("calm", 8)
    end = 20.0
    time = np.arange(0.0, end, 0.1)
    amps = 20.0 + 2.0 * np.sin(time)
    volts = 16.0 - 0.01 * time - 0.05 * amps - np.where(time > end - 1.5, 5.0, 0.0)
    battery = Signal(time, np.column_stack([volts, amps]), ("voltage", "current"), "V,A")
    flight = replace(flight, signals={**flight.signals, "battery": battery}).until(end)
    yield ("made: brown-out", f"the voltage collapses at {end - 1.5:.1f} s, and the log ends at {end:.1f} s, in the air", flight)


def rows(folder: Path) -> Iterator[str]:
    """Lines of the table."""
    from rotorwatch import airframes, diagnose

    seen: set[object] = set()
    for name, what, flight in (*recorded(folder), *made()):
        kind = re.sub(r"-\d+$", "", name)
        if kind in seen:
            continue  # the same fault of another rotor
        seen.add(kind)
        craft = airframes.named("ardupilot-quad-x") if name.startswith("made:") else None
        answer = diagnose(flight, craft)  # pyright: ignore[reportArgumentType]
        ends = any(w.startswith("The log ends in the air") for w in answer.warnings)
        if not ends and not any(e.kind in ("loss_of_control", "autopilot_report") for e in answer.events):
            continue  # control was kept, nothing was reported, and it landed
        causes = [e.extra["cause"] for e in answer.events if e.kind == "loss_of_control"]
        answers = (answer.verdict, *causes, any(e.kind == "autopilot_report" for e in answer.events), ends)
        if answers in seen:
            continue  # another flight with this answer is in the table
        seen.add(answers)
        yield "| " + " | ".join(text.replace("|", "/") for text in (what, answered(answer, ends))) + " |\n"


def answered(answer, ends: bool) -> str:
    """Verdict, rotors with their losses, cause of the loss of control, kinds of the autopilot's reports."""
    parts = []
    for event in answer.events:
        rotors = "+".join(map(str, event.rotors))
        if event.kind == "loss_of_effectiveness":
            parts.append(f"rotor {rotors} {'/'.join(f'{100 * loss:.0f}' for loss in event.loss)} %")
        elif event.kind == "motor_order":
            parts.append(f"motors {rotors} swapped")
        elif event.kind == "loss_of_control":
            parts.append(f"cause `{event.extra['cause']}`")
    reports = dict.fromkeys(e.extra["trouble"] for e in answer.events if e.kind == "autopilot_report")
    parts += [f"reported: {', '.join(reports)}"] * bool(reports) + ["the log ends in the air"] * ends
    return "; ".join([f"`{answer.verdict}`", *parts])


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    page = PAGE.read_text(encoding="utf-8")
    head = "| what happened | answer |\n|---|---|\n"
    table = head + "".join(rows(Path(sys.argv[1])))
    PAGE.write_text(page[: page.index(START) + len(START)] + table + page[page.index(END) :], encoding="utf-8")
