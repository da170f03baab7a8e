"""Commands that write, as `tests.faults` runs them, and what they leave."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rotorwatch.cli import SAMPLES

ROTORWATCH = [sys.executable, "-m", "rotorwatch.cli"]
LOGS = sorted(SAMPLES.glob("*.bin.xz"))
PLAN = Path(__file__).parents[2] / "plans" / "default.toml"


@dataclass(frozen=True)
class Done:
    """A run. code: its exit code; said: on standard error; acknowledged: parts of the state that it said were there; state: what is there;
    waits: whether it may leave as if all were well with something refused on the way."""

    code: int
    said: str
    acknowledged: tuple
    state: tuple
    waits: bool = False


@dataclass(frozen=True)
class Command:
    """A command, to be run in a folder with an environment."""

    name: str
    run: Callable[[Path, Mapping[str, str]], Done]


def _run(*words: Any, env: Mapping[str, str], limit_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*ROTORWATCH, *map(str, words)],
        env=env,
        capture_output=True,
        text=True,
        timeout=limit_s,
        stdin=subprocess.DEVNULL,
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
    said = [line for line in done.stdout.splitlines() if ".bin.xz" in line]
    told = tuple((log.name, line.split()[0]) for log in LOGS for line in said if log.name in line)
    return Done(done.returncode, done.stderr, told, stored(store))


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
            told = tuple(filter(None, (_sent(address, log) for log in LOGS))) if address else ()
            server.terminate()
            code = server.wait(60.0)
        finally:
            server.kill()
        errors.seek(0)
        text = errors.read()
    return Done(code, text, told, stored(store), waits=True)


def _sent(address: str, log: Path) -> tuple[str, str] | None:
    """(name, verdict) of a log that was taken; None of one that was refused. Raises AssertionError for an answer without a sentence."""
    asked = urllib.request.Request(
        f"{address.rstrip('/')}/api/flights", data=log.read_bytes(), headers={"X-Rotorwatch-Name": log.name}
    )
    try:
        with urllib.request.urlopen(asked, timeout=60.0) as answer:
            told = json.load(answer)
            return told["name"], told["verdict"]
    except urllib.error.HTTPError as why:
        text = why.read().decode()
        assert why.code in (500, 503, 507) and str(log.parent) not in text and "Traceback" not in text, (why.code, text)
        return None
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return None


ALL = {c.name: c for c in (Command("fleet", fleet), Command("campaign", campaign), Command("serve", serve))}
