"""A benchmark's results as a file: JSON, checked on writing and on reading. docs/benchmark.md has the schema in words.

format, format_version     "rotorwatch-benchmark", 1
rotorwatch                 version that made it
plan                       name, version, sha256 of text, flights, false_alarms_h, within_s, text
machine                    one line
methods                    a list of: name, kind, about, package, version, path, failed (None or a sentence), scores (None or SCORES)
data                       a list of: name, index_sha256, logs, left_out [[log, why]], methods as above
"""

from __future__ import annotations

import json
import math
import os
from typing import Any

from rotorwatch.base import files
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import benchmark_plan

FORMAT, VERSION = "rotorwatch-benchmark", 1
MAX_BYTES = 50_000_000

COUNTS = ("flights", "clear_faults")
NUMBERS = ("healthy_h", "threshold")
MEASURES = {
    "false_alarms_h": "false alarms per healthy hour at the threshold that methods are compared at",
    "detected": "share of clear faults found in time at that threshold",
    "delay_s": "median delay at that threshold [s]",
    "own_false_alarms_h": "events in healthy time per hour, at the method's own threshold",
    "own_detected": "share of clear faults found, at its own threshold",
    "own_delay_s": "median delay, at its own threshold [s]",
    "right": "share of clear faults whose first event names that rotor alone, at its own threshold",
    "loss_rmse": "RMS error of announced losses ten seconds after the onset",
    "coverage": "share of those whose 95 % interval holds the loss",
    "us_per_step": "microseconds of one step",
}
"""Scores with an interval: {"value", "low", "high", "n"}, or None where it is not defined."""
FLIGHTS = {"found_flights": "flights behind `detected`", "right_flights": "flights behind `right`"}
"""Scores that are lists of numbers of flights, by which methods are compared in pairs; and `size_errors`, flight -> estimated less true
loss. Files of before they existed have none."""
PLAN: dict[str, Any] = {
    "name": str, "version": int, "sha256": str, "flights": int, "false_alarms_h": (int, float), "within_s": (int, float), "text": str,
}  # fmt: skip
METHOD: dict[str, Any] = {
    "name": str, "kind": str, "about": str, "package": str, "version": str, "path": str, "failed": (str, type(None)),
    "scores": (dict, type(None)),
}  # fmt: skip
DATA: dict[str, Any] = {"name": str, "index_sha256": str, "logs": int, "left_out": list, "methods": list}
TOP: dict[str, Any] = {"rotorwatch": str, "plan": dict, "machine": str, "methods": list, "data": list}


def write(results: dict[str, Any], path: str | os.PathLike) -> None:
    """Write results. Raises ConfigError."""
    check(results, f"{path}")
    with files.replacing(path) as unfinished:
        unfinished.write_text(json.dumps(results, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read(path: str | os.PathLike) -> dict[str, Any]:
    """The results in a file. Raises ConfigError with one sentence: no such file, another format or version, a plan that was edited, fields
    that are missing or wrong."""
    files.no_address(path)
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as why:
        raise ConfigError(f"Cannot read the results {path}: {why.strerror or why}.") from why
    try:
        if len(data) > MAX_BYTES:
            raise ValueError
        results = json.loads(data)
    except (ValueError, RecursionError):
        raise ConfigError(f"{path} holds no results of a benchmark: it is no JSON.") from None
    check(results, f"{path}")
    return results


def check(results: Any, where: str) -> None:
    """Raise ConfigError, one sentence that begins with `where`, unless these are results of this format that hold together."""
    if not isinstance(results, dict) or results.get("format") != FORMAT:
        raise ConfigError(f'{where} holds no results of a benchmark: "format" is not "{FORMAT}".')
    version = results.get("format_version")
    if version != VERSION:
        how = "update rotorwatch" if isinstance(version, int) and version > VERSION else "run the benchmark again"
        raise ConfigError(f"{where} has format version {version}, this rotorwatch reads {VERSION}: {how}.")
    _fields(results, TOP, where, "")
    _fields(results["plan"], PLAN, where, "plan.")
    _plan(results["plan"], where)
    _methods(results["methods"], where, "methods")
    for k, data_set in enumerate(results["data"]):
        _fields(data_set, DATA, where, f"data[{k + 1}].")
        _methods(data_set["methods"], where, f"data[{k + 1}].methods")


def _plan(plan: dict[str, Any], where: str) -> None:
    """Check the plan against its hash, and the name and version of a shipped plan against that plan."""
    if benchmark_plan.digest(plan["text"]) != plan["sha256"]:
        raise ConfigError(f"{where}: its plan was edited after the run (plan.text does not belong to plan.sha256).")
    known = benchmark_plan.shipped().get(plan["name"])
    if known is not None:
        ours = benchmark_plan.read(plan["name"])
        if ours.version == plan["version"] and ours.sha256 != plan["sha256"]:
            called = f"{plan['name']} version {plan['version']}"
            raise ConfigError(f"{where}: its plan calls itself {called} and is not the one of rotorwatch: give it another name.")


def _methods(entries: list, where: str, path: str) -> None:
    names = set()
    for k, method in enumerate(entries):
        here = f"{path}[{k + 1}]."
        _fields(method, METHOD, where, here)
        if method["name"] in names:
            raise ConfigError(f"{where}: the method {method['name']} is there twice.")
        names.add(method["name"])
        if (method["scores"] is None) and method["failed"] is None and path == "methods":
            raise ConfigError(f"{where}: {here}scores is missing, and failed does not say why.")
        if method["scores"] is not None:
            _scores(method["scores"], where, f"{here}scores.")


def _scores(scores: dict[str, Any], where: str, path: str) -> None:
    optional = {"us_per_step"} if path.startswith("data") else set()
    for key in (*COUNTS, *NUMBERS, *MEASURES):
        if key not in scores and key not in optional:
            raise ConfigError(f"{where}: {path}{key} is missing.")
    for key in COUNTS:
        if not _number(scores[key]) or scores[key] < 0:
            raise ConfigError(f"{where}: {path}{key} must be a number, not {scores[key]!r}.")
    for key in NUMBERS:
        if scores[key] is not None and not _number(scores[key]):
            raise ConfigError(f"{where}: {path}{key} must be a number or null, not {scores[key]!r}.")
    for key in MEASURES:
        value = scores.get(key)
        if value is None:
            continue
        parts: list[Any] = [value.get(part) for part in ("low", "value", "high")] if isinstance(value, dict) else [None]
        if not all(map(_number, parts)) or parts != sorted(parts):
            raise ConfigError(f"{where}: {path}{key} must hold value, low and high, in that order of size, or be null.")
    for key in FLIGHTS:
        if not isinstance(scores.get(key, []), list) or not all(type(n) is int for n in scores.get(key, [])):
            raise ConfigError(f"{where}: {path}{key} must be a list of the numbers of flights.")
    errors = scores.get("size_errors", {})
    if not isinstance(errors, dict) or not all(map(_number, errors.values())):
        raise ConfigError(f"{where}: {path}size_errors must be a table of numbers.")


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _fields(table: Any, fields: dict[str, Any], where: str, path: str) -> None:
    if not isinstance(table, dict):
        raise ConfigError(f"{where}: {path.rstrip('.')} must be a table, not {table!r:.40}.")
    for key, kind in fields.items():
        if key not in table:
            raise ConfigError(f"{where}: {path}{key} is missing.")
        if not isinstance(table[key], kind) or isinstance(table[key], bool):
            raise ConfigError(f"{where}: {path}{key} has the wrong type ({type(table[key]).__name__}).")
