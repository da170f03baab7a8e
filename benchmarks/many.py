"""What it costs to run many things, and what is left when parts of it are killed (docs/cluster.md has the figures).

python benchmarks/many.py overhead            an item that does nothing: in line, in processes, on a Dask cluster; and exponents
python benchmarks/many.py throughput [LOG]    copies of a log by one process and by two
python benchmarks/many.py calls LOG ...       these logs in one call, against a call for each; when the first answer is there
python benchmarks/many.py workers             a real scheduler with as many workers as asked for, which do nothing
python benchmarks/many.py kills [LOG]         `kill -9` of workers, scheduler and client at random moments: the same answers?
python benchmarks/many.py kills --store postgresql DIR     the same for a fleet's store that the logs of a folder are added to
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import random
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import diagnose_many
from rotorwatch.base import many
from rotorwatch.commands.cli import SAMPLES

SAMPLE = SAMPLES / "quadx_healthy_hover.bin.xz"
COMMAND = [sys.executable, "-m", "rotorwatch.commands.cli", "diagnose"]


def nothing(item: int) -> int:
    """The least that can be asked for."""
    return item


class Cluster:
    """A scheduler and workers on this computer, each a process that can be killed and started again."""

    def __init__(self, workers: int):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.parts = {"scheduler": self._start("scheduler")}
        for k in range(workers):
            self.parts[f"worker {k}"] = self._start("worker")

    def _start(self, what: str) -> subprocess.Popen:
        own = [self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        if what == "scheduler":
            own = ["--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"]
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *own]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def kill(self, name: str) -> None:
        """Kill it."""
        self.parts[name].kill()
        self.parts[name].wait()

    def mend(self) -> None:
        """Start again what has ended, as a service manager does. Workers end with their scheduler."""
        for name, process in self.parts.items():
            if process.poll() is not None:
                self.parts[name] = self._start(name.split()[0])

    def stop(self) -> None:
        """End all of it."""
        for name in self.parts:
            self.kill(name)


@contextmanager
def cluster(workers: int) -> Iterator[Cluster]:
    """A cluster for a while."""
    made = Cluster(workers)
    try:
        yield made
    finally:
        made.stop()


def timed(work: Callable[[], object]) -> float:
    """Seconds by the clock."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def drain(count: int, **how) -> Callable[[], object]:
    """All results of `count` items that do nothing."""
    return lambda: sum(1 for _ in many.run(nothing, range(count), **how))


def spent_s(dask: Cluster | None = None) -> float:
    """Processor seconds of this process, of those that it started and that have ended, and of a cluster's."""
    own = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    total = sum(usage.ru_utime + usage.ru_stime for usage in own)
    if dask is not None:
        import psutil

        times = [psutil.Process(process.pid).cpu_times() for process in dask.parts.values()]
        total += sum(t.user + t.system for t in times)
    return total


def overhead(options: argparse.Namespace) -> None:
    """Milliseconds for an item, by the clock and of processors, and how both grow with their number. The clock says little when others use
    the computer."""
    with cluster(2) as dask:
        ways = {"in line": ({"jobs": 1}, 200), "two processes": ({"jobs": 2}, 20), "two Dask workers": ({"scheduler": dask.address}, 1)}
        for name, (how, times) in ways.items():
            over = dask if "scheduler" in how else None
            drain(200, **how)()
            rows = []
            for n in [times * k for k in (0, 500, 1000, 2000, 4000)]:
                busy = spent_s(over)
                rows.append((n, timed(drain(max(n, 2), **how)), spent_s(over) - busy))
            counts, clock, busy = np.array(rows).T
            print(f"{name}: {clock[0]:.2f} s to begin and end, load {os.getloadavg()[0]:.1f}")
            for n, c, b in zip(counts[1:], clock[1:] - clock[0], busy[1:] - busy[0], strict=True):
                print(f"  {n:8.0f} items: {1e3 * c / n:7.3f} ms each by the clock, {1e3 * b / n:7.3f} ms of processors")
            power = np.polyfit(np.log(counts[1:]), np.log(np.maximum(busy[1:] - busy[0], 1e-6)), 1)[0]
            print(f"  processor time grows with their number to the power of {power:.2f}")


def throughput(options: argparse.Namespace) -> None:
    """Logs a second by one process and by two, once they are started, and what a log costs."""
    with tempfile.TemporaryDirectory() as folder:
        paths = copies(options.log, Path(folder), options.copies)
        list(diagnose_many(paths[:1], jobs=1))
        for _ in range(options.rounds):
            speeds, costs = [], []
            for jobs in (1, 2):
                busy = spent_s()
                came = [time.perf_counter() for _ in diagnose_many(paths, jobs=jobs)]
                speeds.append((len(came) - 2 * jobs) / (came[-1] - came[2 * jobs - 1]))
                costs.append((spent_s() - busy) / len(paths))
            print(
                f"{speeds[0]:.2f} logs/s by one, {speeds[1]:.2f} by two: {speeds[1] / speeds[0]:.2f} x, load {os.getloadavg()[0]:.1f}; "
                f"{costs[0]:.2f} and {costs[1]:.2f} s of processors for a log, with starting"
            )


def copies(log: Path, folder: Path, count: int) -> list[Path]:
    """As many copies of a log."""
    paths = [folder / f"{k:03d}-{log.name}" for k in range(count)]
    for path in paths:
        shutil.copyfile(log, path)
    return paths


def calls(options: argparse.Namespace) -> None:
    """One call for all, and one for each, after a call that warms caches."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "check": False}
    subprocess.run([*COMMAND, *options.logs], **quiet)
    separate = timed(lambda: [subprocess.run([*COMMAND, log], **quiet) for log in options.logs])
    together = timed(lambda: subprocess.run([*COMMAND, *options.logs, "--jobs", str(options.jobs)], **quiet))
    print(f"{len(options.logs)} logs: {separate:.1f} s in a call each, {together:.1f} s in one: {together / separate:.2f} of it")
    began = time.perf_counter()
    process = subprocess.Popen([*COMMAND, *options.logs, "--jsonl", "--jobs", str(options.jobs)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    lines = [time.perf_counter() - began for _ in process.stdout]
    print(f"the first answer after {lines[0]:.1f} s, the last after {lines[-1]:.1f} s")


def workers(options: argparse.Namespace) -> None:
    """Tasks that do nothing through a real scheduler with many workers, some hundred of them in each process."""
    import distributed

    with cluster(0) as dask:
        each = -(-options.workers // options.processes)
        command = [sys.executable, __file__, "host", dask.address, str(each)]
        hosts = [subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for _ in range(options.processes)]
        try:
            with distributed.Client(dask.address, set_as_default=False) as client:
                began = time.perf_counter()
                with suppress(TimeoutError):  # then with those that have come
                    client.wait_for_workers(each * options.processes, timeout=options.patience)
                there: Any = client.nthreads()
                print(f"{len(there)} of {each * options.processes} workers are there after {time.perf_counter() - began:.0f} s")
            for tasks in (options.workers, 4 * options.workers, 10 * options.workers):
                spent = timed(drain(tasks, scheduler=dask.address))
                print(f"{tasks} tasks: {spent:.1f} s, {1e3 * spent / tasks:.2f} ms each, load {os.getloadavg()[0]:.1f}")
        finally:
            for host in hosts:
                host.kill()
                host.wait()


def host(options: argparse.Namespace) -> None:
    """Many workers in one process."""
    from distributed import Worker

    async def go() -> None:
        made = [Worker(options.address, nthreads=1, memory_limit=0, dashboard=False) for _ in range(options.count)]
        for start in range(0, len(made), 25):
            await asyncio.gather(*made[start : start + 25])
        await asyncio.gather(*(worker.finished() for worker in made))

    asyncio.run(go())


def kills(options: argparse.Namespace) -> None:
    """Assess logs on a cluster of which parts are killed; compare with what an undisturbed call leaves."""
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name, cluster(2) as dask, outcomes(options, Path(name)) as outcome:
        count, rounds, killed = 0, 0, {"worker": 0, "scheduler": 0, "client": 0}
        whole, command, read = outcome()
        subprocess.run([*command, "--jobs", "2"], check=False)
        wanted = read(whole)
        while count < options.kills:
            out, command, read = outcome()
            command, rounds = [*command, "--scheduler", dask.address], rounds + 1
            client = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            while True:
                try:
                    client.wait(rng.uniform(options.least, options.most) if count < options.kills else None)
                except subprocess.TimeoutExpired:
                    victim = rng.choice(["client", *dask.parts])
                    if victim == "client":
                        client.kill()
                        client.wait()
                    else:
                        dask.kill(victim)
                    count += 1
                    killed[victim.split()[0]] += 1
                else:
                    if client.returncode in (0, 1, 3):
                        break
                dask.mend()
                if client.poll() is not None:  # the same command goes on
                    client = subprocess.Popen(command, stderr=subprocess.DEVNULL)
            same = read(out) == wanted
            print(f"round {rounds}: {count} kills so far ({killed}), {len(wanted)} rows, {'the same' if same else 'DIFFERENT'}", flush=True)
            if not same:
                raise SystemExit(1)


@contextmanager
def outcomes(options: argparse.Namespace, folder: Path) -> Iterator[Callable[[], tuple]]:
    """What gives, each time it is called: (where to, the command that writes there, how that is read)."""
    logs = options.log
    if not logs.is_dir():
        logs = folder / "logs"
        logs.mkdir()
        copies(options.log, logs, options.copies)
    if options.store is None:
        numbers = itertools.count()

        def lines():
            out = folder / f"{next(numbers)}.jsonl"
            return out, [*COMMAND, logs, "--jsonl", "-o", out, "--resume", "-q"], table

        yield lines
        return
    with stores(options.store, folder) as fresh:

        def store():
            url = fresh()
            return url, [*COMMAND[:-1], "fleet", "add", logs, "--store", url, "-q"], tables

        yield store


@contextmanager
def stores(kind: str, folder: Path) -> Iterator[Callable[[], str]]:
    """What gives the URL of an empty store each time it is called."""
    if kind == "sqlite":
        numbers = itertools.count()
        yield lambda: str(folder / f"{next(numbers)}.db")
        return
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from tests.postgres_server import Server

    server = Server()
    try:
        yield server.url
    finally:
        server.close()


def tables(url: str) -> list:
    """All rows of a store."""
    from rotorwatch.fleet import Store

    with Store(url) as store:
        return [(name, row) for name in store._t.metadata.tables for row in store.rows(name)]


def table(path: Path) -> list[str]:
    """The answers of a file of JSON lines, sorted by path, without the times that they took."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [json.dumps({**line, "timing": None}) for line in sorted(lines, key=lambda line: line["path"])]


def main() -> None:
    """Do what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="what", required=True)
    kinds.add_parser("overhead").set_defaults(go=overhead)
    one = kinds.add_parser("throughput")
    one.add_argument("log", nargs="?", type=Path, default=SAMPLE)
    one.add_argument("--copies", type=int, default=40)
    one.add_argument("--rounds", type=int, default=3)
    one.set_defaults(go=throughput)
    one = kinds.add_parser("calls")
    one.add_argument("logs", nargs="+")
    one.add_argument("--jobs", type=int, default=2)
    one.set_defaults(go=calls)
    one = kinds.add_parser("workers")
    one.add_argument("--workers", type=int, default=1000)
    one.add_argument("--processes", type=int, default=4)
    one.add_argument("--patience", type=float, default=600.0)
    one.set_defaults(go=workers)
    one = kinds.add_parser("host")
    one.add_argument("address")
    one.add_argument("count", type=int)
    one.set_defaults(go=host)
    one = kinds.add_parser("kills")
    one.add_argument("log", nargs="?", type=Path, default=SAMPLE, help="copied so many times, or a folder of logs")
    one.add_argument("--copies", type=int, default=30)
    one.add_argument("--store", choices=["sqlite", "postgresql"], help="add to the store of a fleet")
    one.add_argument("--kills", type=int, default=200)
    one.add_argument("--least", type=float, default=0.5, help="seconds between two kills, at least")
    one.add_argument("--most", type=float, default=8.0)
    one.add_argument("--seed", type=int, default=1)
    one.set_defaults(go=kills)
    options = parser.parse_args()
    options.go(options)


if __name__ == "__main__":
    main()
