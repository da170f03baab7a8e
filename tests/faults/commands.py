"""Commands that write, as `tests.faults` runs them, and what they leave."""

from __future__ import annotations

import json
import socket
import sqlite3
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.mavlink_vehicle import Autopilot, messages

from rotorwatch import logs
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.fleet import Entry, Store
from rotorwatch_lab.simulation.write_dataflash import write_dataflash

ROTORWATCH = [sys.executable, "-m", "rotorwatch.commands.cli"]
LOGS: list[Path] = []
PLAN = Path(__file__).parents[2] / "plans" / "default.toml"


def prepare(folder: Path) -> None:
    """Two short logs, which are assessed in no time."""
    for sample in sorted(SAMPLES.glob("*.bin.xz")):
        LOGS.append(folder / sample.name.removesuffix(".xz"))
        write_dataflash(logs.read(sample).until(25.0), LOGS[-1])


@dataclass(frozen=True)
class Done:
    """A run. code: its exit code; said: on standard error; acknowledged: parts of the state that it said were there; state: what is there;
    waits: whether it may leave as if all were well with something refused on the way; goes_on: whether all of the state has to be there
    whatever has failed."""

    code: int
    said: str
    acknowledged: tuple
    state: tuple
    waits: bool = False
    goes_on: bool = False


@dataclass(frozen=True)
class Command:
    """A command, to be run in a folder with an environment."""

    name: str
    run: Callable[[Path, Mapping[str, str]], Done]


def _run(*words: Any, env: Mapping[str, str], limit_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*ROTORWATCH, *map(str, words)], env=env, capture_output=True, text=True, timeout=limit_s, stdin=subprocess.DEVNULL
    )


def stored(store: Path) -> tuple:
    """(name, verdict) of every flight in a store."""
    if not store.exists():
        return ()
    with closing(sqlite3.connect(store)) as base:
        try:
            return tuple(base.execute("SELECT name, verdict FROM flights ORDER BY name, verdict").fetchall())
        except sqlite3.OperationalError:  # no tables yet
            return ()


def fleet(folder: Path, env: Mapping[str, str]) -> Done:
    """`fleet add` of two logs: every line that it prints says that a flight is stored."""
    store = folder / "fleet.db"
    done = _run("fleet", "add", *LOGS, "--store", store, "--jobs", "1", env=env)
    said = [line for line in done.stdout.splitlines() if ".bin" in line]
    reported = tuple((log.name, line.split()[0]) for log in LOGS for line in said if log.name in line)
    return Done(done.returncode, done.stderr, reported, stored(store))


def delete(folder: Path, env: Mapping[str, str]) -> Done:
    """`fleet delete` of one of two flights with reports: row and report are both there or both gone, but for a report that is set aside."""
    store, (gone, _) = folder / "fleet.db", (hashes := [digit * 64 for digit in "ab"])
    if not store.exists():
        with Store(store) as made:
            made.reports.folder.mkdir()
            for hash in hashes:
                made.add(Entry(hash, "", f"{hash[:4]}.bin", 1, identity="serial 1", called="quad", verdict="healthy"))
                made.reports.path(hash).write_text("a report")
    done = _run("fleet", "delete", gone, "--yes", "--store", store, env=env)
    names, reports = stored(store), tuple(sorted(path.name for path in folder.glob("fleet-pages/*")))
    row, aside = len(names) == 2, f"{gone}.deleted" in reports
    assert aside or row == (f"{gone}.html" in reports), f"half-deleted: {names} {reports}"
    again = done.returncode == 2 and not row and "holds no flight" in done.stderr
    return Done(0 if again else done.returncode, done.stderr, (), (*names, *reports))


def campaign(folder: Path, env: Mapping[str, str]) -> Done:
    """A campaign of two flights: its summary."""
    out = folder / "campaign"
    done = _run("campaign", PLAN, "--flights", "2", "--jobs", "1", "-o", out, env=env)
    summary = out / "summary.json"
    state = ()
    if summary.exists():
        text = summary.read_text()
        state = (json.dumps({k: v for k, v in json.loads(text).items() if k != "timing"}, sort_keys=True),)
    return Done(done.returncode, done.stderr, (), state)


def serve(folder: Path, env: Mapping[str, str]) -> Done:
    """`serve` that is sent two logs and then stopped: what it answers with 201 or 200 is stored. A log that it refused is sent again."""
    store, said = folder / "fleet.db", folder.with_suffix(".said")
    with said.open("w+") as errors:
        server = subprocess.Popen(
            [*ROTORWATCH, "serve", "--port", "0", "--store", str(store), "--jobs", "1"],
            env=env, stdout=subprocess.PIPE, stderr=errors, text=True,
        )  # fmt: skip
        try:
            assert server.stdout
            address = server.stdout.readline().strip()
            reported = tuple(filter(None, (_sent(address, log) for log in LOGS))) if address else ()
            server.terminate()
            code = server.wait(60.0)
        finally:
            server.kill()
        errors.seek(0)
        text = errors.read()
    return Done(code, text, reported, stored(store), waits=True)


def _sent(address: str, log: Path) -> tuple[str, str] | None:
    """(name, verdict) of a log that was taken; None of one that was refused. Raises AssertionError for an answer without a sentence."""
    asked = urllib.request.Request(f"{address.rstrip('/')}/api/flights", data=log.read_bytes(), headers={"X-Rotorwatch-Name": log.name})
    try:
        with urllib.request.urlopen(asked, timeout=60.0) as answer:
            reported = json.load(answer)
            return reported["name"], reported["verdict"]
    except urllib.error.HTTPError as why:
        text = why.read().decode()
        assert why.code in (500, 503, 507) and str(log.parent) not in text and "Traceback" not in text, (why.code, text)
        return None
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return None


def watch(folder: Path, env: Mapping[str, str]) -> Done:
    """`watch --record` of a vehicle for some seconds: what it says of it, whatever becomes of the record."""
    flight = logs.read(SAMPLES / "quadx_healthy_hover.bin.xz").until(12.0)
    parameters = {k: v for k, v in flight.parameters.items() if k.startswith(("FRAME", "MOT_", "SERVO")) and len(k) <= 16}
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(20.0)
        vehicle = threading.Thread(target=_flies, args=(server, Autopilot(parameters), messages(flight)), daemon=True)
        vehicle.start()
        done = _run(
            "watch", f"tcp:127.0.0.1:{server.getsockname()[1]}", "--jsonl", "--record", folder / "record", "--seconds", "5", env=env
        )  # fmt: skip
    reported = [json.loads(line) for line in done.stdout.splitlines()]
    state = tuple((alert["frame"], alert["rotors"]) for alert in reported if alert["type"] == "vehicle")
    return Done(done.returncode, done.stderr + done.stdout, (), state, goes_on="cannot be reached" not in done.stderr)


def _flies(server: socket.socket, autopilot: Autopilot, said: list) -> None:
    """A vehicle that sends what it says within two seconds, then beats, to whoever is connected."""
    with suppress(OSError):
        while True:
            side, _ = server.accept()
            side.settimeout(0.002)
            beat = next(message for _, message in said if message.get_type() == "HEARTBEAT")
            with suppress(OSError):
                side.sendall(autopilot.packed(beat))
                for k in range(10**6):
                    with suppress(TimeoutError):
                        side.sendall(autopilot.answer(side.recv(4096)))
                    side.sendall(autopilot.packed(said[k][1] if k < len(said) else beat))
                    if k >= len(said):
                        time.sleep(0.05)


ALL = {c.__name__: Command(c.__name__, c) for c in (fleet, delete, campaign, serve, watch)}
