"""Does the C library on board say what `diagnose` says of the same flight?

    python benchmarks/board_agreement.py FOLDER|LOG... [--hz 100] [--rows OUT.csv] [--build FOLDER]

Every flight goes through the library in single precision as a loop of --hz feeds it (tests/onboard_law.py), polled ten times a second.
Compared are losses, overridden outputs and turned mounts: rotors, onset within ONSET_S, end within END_S, size within SIZE; and changes of
mind in flight: events withdrawn. A flight that differs is printed with its reason. Needs gcc.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import hashlib
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))  # what it imports calls its neighbours by their own names
from tests import board, onboard_law

from rotorwatch import logs
from rotorwatch.base.compiling.structs import LASTS
from rotorwatch.diagnose import diagnose
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import vehicle_file
from rotorwatch.flight.diagnosis import Diagnosis

ONSET_S, END_S, SIZE = 0.1, 1.0, 0.03
EVERY = 10  # polls a second
MOST, NEWS = 64, 4000
FLAGS = ("-std=c99", "-O1", "-fPIC", "-DROTORWATCH_FLOAT", "-DRW_CONTACTS=8", "-w")
DRIVER = (
    onboard_law.COMMON
    + """
static void put(double *to, const rw_event *e)
{
    to[0] = e->kind; to[1] = e->onset; to[2] = e->detected; to[3] = e->end; to[4] = e->rotors; to[5] = (double)e->loss[0];
    to[6] = (double)e->lower[0]; to[7] = (double)e->upper[0]; to[8] = (double)e->size; to[9] = e->alternative_count;
    to[10] = (double)e->loss[1];
}
int drive(int rows, const double *table, double until, double every, double *found, double *news, int most, int *reported);
int drive(int rows, const double *table, double until, double every, double *found, double *news, int most, int *reported)
{
    double due = table[1];
    const rw_event *events;
    *reported = 0;
    rw_diagnoser_init(&d, &rw_vehicle_default, &rw_plan_default);
    for (int i = 0; i <= rows; i++) {
        if (i < rows) feed_row(table + (long)i * WIDTH);
        else rw_diagnoser_finish(&d, until);
        const double now = i < rows ? table[(long)i * WIDTH + 1] : until;
        if (now < due && i < rows) continue;
        due = now + every;
        const int count = rw_diagnoser_poll(&d, notifications);
        for (int k = 0; k < count && *reported < most; k++) {
            double *row = news + (long)(*reported)++ * WIDTH;
            row[0] = now; row[1] = notifications[k].number; row[2] = notifications[k].kind;
            put(row + 3, notifications[k].event);
        }
    }
    const int count = rw_diagnoser_events(&d, &events);
    for (int k = 0; k < count; k++) put(found + (long)k * WIDTH, &events[k]);
    return count;
}
"""
)


class One(NamedTuple):
    """An event. end: LASTS while it lasts; loss: of the first rotor, or hover thrusts of a stuck one; how: where `diagnose` has it from."""

    kind: int
    rotors: int
    onset: float
    end: float
    loss: float
    unsure: bool
    how: str = ""

    def __str__(self) -> str:
        who = "+".join(str(k + 1) for k in range(16) if self.rotors >> k & 1)
        over = "" if self.end >= LASTS else f" to {self.end:.1f}"
        kind = {0: "lost", 1: "overridden", 9: "turned"}[self.kind]
        more = (" or others" if self.unsure else "") + (f" ({self.how})" if self.how else "")
        return f"{who} {kind} {self.loss:.2f} since {self.onset:.1f}{over}{more}"


def library(what: onboard_law.Flown, folder: Path) -> ctypes.CDLL:
    """The library and the driver. What does not depend on the vehicle is compiled once for each set of sizes."""
    texts = what.texts | {"driver.c": DRIVER}
    same = "".join(text for name, text in sorted(texts.items()) if name != "rw_config.c")
    place = folder / hashlib.sha256(same.encode()).hexdigest()[:16]
    place.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (place / name).write_text(text)
    objects = []
    for name in (n for n in texts if n.endswith(".c")):
        goal = place / f"{name}.o"
        if name == "rw_config.c" or not goal.exists():
            subprocess.run(["gcc", *FLAGS, "-c", str(place / name), "-o", str(goal)], check=True)
        objects.append(str(goal))
    with tempfile.TemporaryDirectory() as linked:  # a name of its own: a library that is loaded stays
        subprocess.run(["gcc", "-shared", *objects, "-lm", "-o", f"{linked}/board.so"], check=True)
        return ctypes.CDLL(f"{linked}/board.so")


def fly(what: onboard_law.Flown, folder: Path) -> tuple[list[One], np.ndarray]:
    """(the events at the end, changes as rows: time, number, what, event)."""
    samples = np.ascontiguousarray(what.table)
    found, news, reported = np.zeros((MOST, onboard_law.WIDTH)), np.zeros((NEWS, onboard_law.WIDTH)), ctypes.c_int()
    pointers = [a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in (samples, found, news)]
    until, every = ctypes.c_double(what.until), ctypes.c_double(1.0 / EVERY)
    count = library(what, folder).drive(len(samples), pointers[0], until, every, *pointers[1:], NEWS, ctypes.byref(reported))
    events = [_one(row) for row in found[:count]]
    return [e for e in events if e.kind in board.ACCUSING], news[: reported.value]


def _one(row: np.ndarray) -> One:
    return One(int(row[0]), int(row[4]), row[1], row[3], float(row[8] if row[0] == 0 and row[8] > 0 else row[5]), bool(row[9]))


def of_desk(reported: Diagnosis) -> list[One]:
    """The events of `diagnose`, of the kinds that a board knows."""
    events = [e for e in reported.events if e.kind in board.KINDS and board.KINDS[e.kind] in board.ACCUSING]
    return [
        One(
            board.KINDS[e.kind], board.mask(e.rotors), e.onset_s, LASTS if e.end_s is None else e.end_s,
            float(e.extra.get("gives", e.loss[0] if e.loss else 0.0)), bool(e.alternatives),
            "" if e.extra.get("live", True) else e.source.name,
        )
        for e in events
    ]  # fmt: skip


def compared(desk: list[One], found: list[One]) -> list[str]:
    """How the events on board differ, each with a word for the kind of difference."""
    left, said = list(found), []
    for e in desk:
        same = min((b for b in left if (b.kind, b.rotors) == (e.kind, e.rotors)), key=lambda b: abs(b.onset - e.onset), default=None)
        if same is None:
            said.append(f"missing: {e}")
            continue
        left.remove(same)
        if abs(same.onset - e.onset) > ONSET_S:
            said.append(f"onset: {e}, on board {same}")
        if (same.end < LASTS) != (e.end < LASTS) or (e.end < LASTS and abs(same.end - e.end) > END_S):
            said.append(f"end: {e}, on board {same}")
        if e.kind == 0 and abs(same.loss - e.loss) > SIZE * max(1.0, e.loss):
            said.append(f"size: {e}, on board {same}")
    return said + [f"extra: {b}" for b in left]


def reason(reported: Diagnosis) -> str:
    """What `diagnose` alone knows of such a flight."""
    kinds = {e.kind for e in reported.events}
    if reported.doubts:
        return "the log contradicts itself"
    if "loss_of_control" in kinds:
        return "control is lost"
    if any(not e.extra.get("live", True) for e in reported.events if e.kind in board.KINDS):
        return "evidence of the whole flight"
    return "-"


def rows(given: list[Path], hz: float, folder: Path):
    """(name, reason, differences, number of withdrawals, what was withdrawn) of each flight that both can assess."""
    found = [p for one in given for p in (sorted(one.rglob("*")) if one.is_dir() else [one])]
    for path in found:
        if not path.is_file() or not path.name.removesuffix(".xz").endswith((".bin", ".ulg", ".csv")) or "truth" in path.name:
            continue
        own = path.parent / "vehicle.toml"
        try:
            vehicle = vehicle_file.read(own) if own.exists() else None
            flight = logs.read(path)
            what = onboard_law.on_board(flight, hz, vehicle)
            if what.dt > 0.251:
                continue
            reported = diagnose(flight, vehicle=vehicle)
        except (RotorwatchError, IndexError, KeyError, ValueError, AttributeError) as why:
            print(f"{path.name}: {str(why)[:100]}", file=sys.stderr)
            continue
        events, news = fly(what, folder)
        gone = [row for row in news if row[2] == 2 and row[3] in board.ACCUSING]
        yield path.name, reason(reported), compared(of_desk(reported), events), [f"{row[0]:.1f}: {_one(row[3:])}" for row in gone]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+", metavar="FOLDER|LOG")
    parser.add_argument("--hz", type=float, default=100.0)
    parser.add_argument("--rows", type=Path, help="CSV of all differences")
    parser.add_argument("--build", type=Path, help="folder in which compiled files are kept for the next run")
    given = parser.parse_args()
    counts, why, kinds, written = Counter(), Counter(), Counter(), []
    with tempfile.TemporaryDirectory() as folder:
        for name, known, differs, gone in rows(given.logs, given.hz, given.build or Path(folder)):
            words = {d.partition(":")[0] for d in differs} | ({"withdrawn"} if gone else set())
            counts["flights"] += 1
            counts["the same"] += not words
            kinds.update(words)
            why[known] += bool(differs)
            for text in (*differs, *(f"withdrawn: {g}" for g in gone)):
                print(f"{name} [{known}] {text}", flush=True)
                written.append((name, known, *text.split(": ", 1)))
    print("\n| flights | the same | " + " | ".join(sorted(kinds)) + " |\n|" + "---|" * (2 + len(kinds)))
    print(f"| {counts['flights']} | {counts['the same']} | " + " | ".join(str(kinds[k]) for k in sorted(kinds)) + " |\n")
    for text, count in why.most_common():
        if count:
            print(f"{count} differ, {text}")
    if given.rows:
        with given.rows.open("w", newline="") as to:
            csv.writer(to).writerows(written)


if __name__ == "__main__":
    main()
