"""Every write, flush, rename, lock and connection of a command made to fail once: `python -m tests.faults --runs 1000 [--jobs 2]`.

A library that is preloaded (failing.c) lets one call to the system fail, as a full disk, a broken one, a signal or somebody's lock do. Of
each run it is asked: one sentence and no traceback; an exit code that is true; what was acknowledged is there; and after the same
command once more, undisturbed, all is as if nothing had happened, nothing twice.
"""

from __future__ import annotations

import argparse
import errno
import os
import random
import shutil
import subprocess
import sys
import tempfile
from array import array
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tests.faults import commands

ERRORS = {
    "write": (errno.ENOSPC, errno.EIO, errno.EINTR),
    "sync": (errno.EIO, errno.ENOSPC),
    "rename": (errno.EIO, errno.ENOSPC),
    "lock": (errno.EAGAIN, errno.EINTR, errno.EIO),
    "connect": (errno.ECONNREFUSED, errno.ETIMEDOUT, errno.EINTR),
}


@dataclass(frozen=True)
class Fault:
    """The number-th call of a kind fails with an error."""

    kind: str
    number: int
    error: int

    def __str__(self):
        return f"{self.kind} {self.number} {errno.errorcode[self.error]}"


def library(folder: Path) -> Path:
    """failing.c, built."""
    made = folder / "failing.so"
    source = Path(__file__).with_name("failing.c")
    subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", made, source, "-ldl"], check=True)
    return made


def environment(preload: Path, place: Path, count: Path, fault: Fault | None) -> dict[str, str]:
    """In which calls are counted, and one of them fails, if there is a fault."""
    count.write_bytes(bytes(8 * len(ERRORS)))
    named = {"FAULT_PLACE": f"{place}/", "FAULT_COUNT": str(count), "LD_PRELOAD": str(preload), "PYTHONUNBUFFERED": ""}
    if fault:
        named |= {"FAULT_KIND": fault.kind, "FAULT_AT": str(fault.number), "FAULT_ERRNO": str(fault.error)}
    return {**os.environ, **named}


def undisturbed(command: commands.Command, preload: Path, folder: Path) -> tuple[commands.Done, dict[str, int]]:
    """What the command does when nothing fails, and how many calls of each kind it makes."""
    place = folder / f"wanted-{command.name}"
    place.mkdir()
    count = Path(f"{place}.count")
    done = command.run(place, environment(preload, place, count, None))
    return done, dict(zip(ERRORS, array("q", count.read_bytes()), strict=True))


def tried(command: commands.Command, preload: Path, folder: Path, fault: Fault, wanted: commands.Done) -> str:
    """What went wrong with the command under a fault; empty where nothing did."""
    place = Path(tempfile.mkdtemp(dir=folder))
    count = Path(f"{place}.count")
    try:
        done = command.run(place, environment(preload, place, count, fault))
        wrong = _first(done, wanted)
        if not wrong:
            again = command.run(place, dict(os.environ))
            lost = [one for one in done.acknowledged if one not in again.state]
            if lost:
                wrong = f"acknowledged, and lost: {lost}"
            elif again.code != wanted.code or again.state != wanted.state:
                wrong = f"the second run left {again.code} {again.state}, said {again.said[-200:]!r}"
        return wrong
    except AssertionError as why:
        return str(why)
    finally:
        shutil.rmtree(place, ignore_errors=True)
        count.unlink(missing_ok=True)


def _first(done: commands.Done, wanted: commands.Done) -> str:
    """What is wrong with the run that met the fault."""
    if "Traceback" in done.said or "internal error of rotorwatch" in done.said:
        return f"said {done.said[-400:]!r}"
    if done.code not in (wanted.code, 2):
        return f"left with {done.code}: {done.said[-200:]!r}"
    if done.code == 2 and wanted.code != 2 and not any(word in done.said for word in ("rotorwatch: ", '"error"')):
        return "left with 2 and said nothing"
    if done.goes_on and done.state != wanted.state:
        return f"did not go on: {done.state}: {done.said[-300:]!r}"
    missing = [one for one in done.acknowledged if one not in done.state]
    if missing:
        return f"acknowledged, and not there: {missing}"
    if done.code == wanted.code and done.state != wanted.state and not done.waits:
        return f"left with {done.code} as if all were well, but {done.state}: {done.said[-200:]!r}"
    return ""


def plan(counted: dict[tuple[str, str], int], runs: int, seed: int) -> list[tuple[str, Fault]]:
    """(command, fault): each call of a kind is as likely as any other, each command and kind gets its share."""
    rng, out = random.Random(seed), []
    cells = [cell for cell, count in counted.items() if count]
    for k in range(runs):
        name, kind = cells[k % len(cells)]
        out.append((name, Fault(kind, rng.randint(1, counted[name, kind]), rng.choice(ERRORS[kind]))))
    return out


def main(argv: list[str] | None = None) -> int:
    """Count, fail, ask, print; the exit code is 1 when anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=list(commands.ALL), action="append")
    given = parser.parse_args(argv)
    chosen = {name: commands.ALL[name] for name in given.only or commands.ALL}
    wrong: Counter[tuple[str, str]] = Counter()
    met: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(given.jobs) as pool:
        folder = Path(scratch)
        preload = library(folder)
        commands.prepare(folder)
        wanted: dict[str, commands.Done] = {}
        counted: dict[tuple[str, str], int] = {}
        for name, command in chosen.items():
            wanted[name], found = undisturbed(command, preload, folder)
            counted |= {(name, kind): number for kind, number in found.items()}
        todo = plan(counted, given.runs, given.seed)
        results = pool.map(lambda x: tried(chosen[x[0]], preload, folder, x[1], wanted[x[0]]), todo)
        for (name, fault), said in zip(todo, results):
            met[name, fault.kind] += 1
            if said:
                wrong[name, fault.kind] += 1
                print(f"{name}: {fault}: {said}", flush=True)
            if met.total() % 50 == 0:
                print(f"{met.total()} of {given.runs}, {wrong.total()} wrong", flush=True)
    print("| command | calls that fail | there are | runs | wrong |\n|---|---|---|---|---|")
    for (name, kind), count in met.items():
        print(f"| {name} | {kind} | {counted[name, kind]} | {count} | {wrong[name, kind]} |")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
