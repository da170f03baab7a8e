"""Where does the time of `rotorwatch diagnose` go, stage by stage?

    python benchmarks/stages.py FOLDER [--logs 200] [--rounds 3] [--functions 15]

FOLDER: flight logs; those in folders below it count, too, and of more than `--logs` every k-th. First one process assesses all of them, as
`rotorwatch diagnose FOLDER` does, and tells for each stage what of its processor time went there; each log counts with its fastest round.
A timer stops it once a millisecond; the processor time since the last stop is the stage's whose function it stops in. Code in C is stopped
when it returns, so that its time is its caller's. Then the process itself: the interpreter, NumPy, what else a verdict imports, and the
verdict on one log of middling size, each as the least processor time of some fresh processes.
"""

from __future__ import annotations

import argparse
import bz2
import gzip
import lzma
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from types import FrameType

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command does, before NumPy is imported
STAGES = {
    "imports": ("<frozen importlib",),
    "reading": ("/logs/", "/gathering.py"),
    "airborne": ("/engine/motion/air_spans.py",),
    "mixer": ("/engine/motion/",),
    "estimator": ("/engine/",),
    "witnesses": ("/witnesses/", "/detectors/"),
    "answer": ("/answer/", "/case/", "/diagnose.py", "/report/", "/diagnose_many.py", "/airframes/"),
}
OPENERS = {".xz": lzma.open, ".gz": gzip.open, ".bz2": bz2.open}
EVERY_S = 1e-3
FRESH = 7  # processes of which the fastest counts


class Spent:
    """Processor seconds of this thread while it lasts: by stage, and by function of rotorwatch."""

    def __init__(self) -> None:
        self.stages: defaultdict[str, float] = defaultdict(float)
        self.functions: defaultdict[str, float] = defaultdict(float)

    def __enter__(self) -> Spent:
        self.last = time.thread_time()
        self._before = signal.signal(signal.SIGALRM, lambda number, frame: self.note(frame))
        signal.setitimer(signal.ITIMER_REAL, EVERY_S, EVERY_S)
        return self

    def __exit__(self, *why: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, self._before)
        self.note(None)

    def note(self, frame: FrameType | None) -> None:
        """What has passed since the last time is this frame's."""
        now = time.thread_time()
        passed, self.last = now - self.last, now
        stage = function = ""
        while frame is not None and not stage:
            file = frame.f_code.co_filename
            where = file.rpartition("/rotorwatch/")[2] if "/rotorwatch/" in file else ""
            function = function or (where and f"{where}:{frame.f_code.co_name}")
            known = f"/{where}" if where else file
            stage = next((name for name, of in STAGES.items() if known.startswith(of)), "")
            frame = frame.f_back
        self.stages[stage or "answer"] += passed
        self.functions[function or "others"] += passed


def unpacked(folder: Path, goal: Path) -> Path:
    """A copy of the folder, its files as they were before they were packed."""
    for path in sorted(folder.rglob("*")):
        if not path.is_file():
            continue
        there = goal / path.relative_to(folder)
        there.parent.mkdir(parents=True, exist_ok=True)
        opener = OPENERS.get(path.suffix)
        try:
            if opener is not None:
                with opener(path, "rb") as file:
                    there.with_suffix("").write_bytes(file.read())
                continue
        except (EOFError, OSError, lzma.LZMAError):  # damaged: as it is
            there.with_suffix("").unlink(missing_ok=True)
        shutil.copyfile(path, there)
    return goal


def chosen(folder: Path, count: int) -> list[Path]:
    """The logs, evenly chosen of all."""
    from rotorwatch import gathering

    found = sorted(map(Path, gathering.Gathered([folder])))
    return found[:: max(1, len(found) // count)][:count]


def assessed(paths: list[Path], rounds: int) -> tuple[dict[str, float], dict[str, float], int]:
    """(seconds by stage, by function, logs with an answer): all logs, one after the other, the fastest round of each."""
    from rotorwatch.diagnose_many import diagnose_many

    stages, functions, answers = defaultdict(float), defaultdict(float), 0
    list(diagnose_many(paths[:1], jobs=1))
    for path in paths:
        tries = [once(path) for _ in range(rounds)]
        best, answered = min(tries, key=lambda one: sum(one[0].stages.values()))
        for into, found in ((stages, best.stages), (functions, best.functions)):
            for name, seconds in found.items():
                into[name] += seconds
        answers += answered
    return stages, functions, answers


def once(path: Path) -> tuple[Spent, bool]:
    """What a log takes, and whether it has an answer."""
    from rotorwatch.diagnose_many import diagnose_many

    with Spent() as spent:
        answered = [answer.error is None for answer in diagnose_many([path], jobs=1)]
    return spent, all(answered)


def size(path: Path) -> float:
    """Megabytes of a log, all files of it where it is a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file()) / 1e6


def fresh(command: list[str]) -> tuple[float, float]:
    """(least processor seconds, least seconds by the clock) of some processes."""
    spent, passed = [], []
    for _ in range(FRESH):
        began = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _, _, used = os.wait4(process.pid, 0)
        process.returncode = 0
        spent.append(used.ru_utime + used.ru_stime)
        passed.append(time.perf_counter() - began)
    return min(spent), min(passed)


def imported(command: list[str]) -> list[str]:
    """Modules that a command imports, in this order."""
    done = subprocess.run([sys.executable, "-X", "importtime", *command[1:]], capture_output=True, text=True, check=False)
    return [m[1] for line in done.stderr.splitlines() if (m := re.match(r"import time:\s+\d+ \|\s+\d+ \|\s+([\w.]+)$", line))]


def process(path: Path) -> list[tuple[str, float, float]]:
    """(what, processor seconds, seconds by the clock) of one verdict, each without what stands above it."""
    command = [sys.executable, "-m", "rotorwatch", "diagnose", str(path), "--quiet"]
    modules = [m for m in imported(command) if m.partition(".")[0] in {"rotorwatch", "click", "rich"} and m != "rotorwatch.__main__"]
    steps = [
        ("interpreter", [sys.executable, "-c", "pass"]),
        ("NumPy", [sys.executable, "-c", "import numpy"]),
        ("other imports", [sys.executable, "-c", f"import numpy, {', '.join(modules)}"]),
        ("reading to answer", command),
    ]
    rows, before = [], (0.0, 0.0)
    for name, step in steps:
        now = fresh(step)
        rows.append((name, now[0] - before[0], now[1] - before[1]))
        before = now
    return [*rows, ("the command", *before)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--functions", type=int, default=0, help="list so many functions, too")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        paths = chosen(unpacked(options.folder, Path(scratch)), options.logs)
        stages, functions, answers = assessed(paths, options.rounds)
        total, megabytes = sum(stages.values()), sum(map(size, paths))
        print(f"{len(paths)} logs, {answers} with an answer, {megabytes:.0f} MB: {total:.1f} s of one processor, ", end="")
        print(f"{len(paths) / total:.1f} logs and {megabytes / total:.1f} MB a second\n")
        print("| stage | s | share | ms a log |\n|---|---|---|---|")
        for name in STAGES:
            print(f"| {name} | {stages[name]:.2f} | {stages[name] / total:.0%} | {1e3 * stages[name] / len(paths):.1f} |")
        for name, seconds in sorted(functions.items(), key=lambda row: -row[1])[: options.functions]:
            print(f"{1e3 * seconds / len(paths):7.2f} ms a log  {name}")
        log = statistics.median_low([(size(path), path) for path in paths if path.is_file()])[1]
        print(f"\n| one process: {log.name}, {size(log):.1f} MB | processor ms | clock ms |\n|---|---|---|")
        for name, spent, passed in process(log):
            print(f"| {name} | {1e3 * spent:.0f} | {1e3 * passed:.0f} |")


if __name__ == "__main__":
    main()
