"""PX4 logs as Flight Review v2 stores them: a folder with TOPIC.parquet and TOPIC_INSTANCE.parquet, fields named as in the ULog, and
metadata.json with parameters, texts and the start. https://github.com/PX4/flight-review-rs (crates/converter)
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Message
from rotorwatch.logs import parameter_ranges, parquet_pages, px4_topics, series
from rotorwatch.logs.container import open_log
from rotorwatch.logs.parameter_ranges import is_parameter

FORMAT = "Flight Review tables"
METADATA = "metadata.json"
TABLES = re.compile(rf"(?P<topic>{'|'.join((*px4_topics.TOPICS, *px4_topics.RAW))})(?:_(?P<instance>\d+))?\.parquet")
_SEVERE = {"EMERGENCY", "ALERT", "CRITICAL", "ERROR"}


def sniff_folder(path: Path) -> bool:
    """True for a folder that holds at least one table of a topic that is read here."""
    return any(TABLES.fullmatch(p.name) for p in path.iterdir())


def read_folder(path: Path, progress=None) -> Flight:
    """Read the tables of one log. Raises LogError where they hold no samples, or pyarrow is missing."""
    files = {p: m for p in sorted(path.iterdir()) if p.is_file() and (m := TABLES.fullmatch(p.name))}
    speeds = any(m["topic"] == px4_topics.SPEEDS for m in files.values())
    notes: list[str] = []
    tables = {}
    for done, (file, match) in enumerate(files.items()):
        if speeds or match["topic"] in px4_topics.TOPICS:
            try:
                tables[match["topic"], int(match["instance"] or 0)] = _table(open_log(file)[0])
            except LogError as error:
                notes.append(f"{file.name}: {error}")
        if progress:
            progress((done + 1) / len(files))
    if not any(table["timestamp"].size for table in tables.values()):
        raise LogError(notes[0] if notes else "these tables hold no samples")
    return _flight(tables, _metadata(path / METADATA, notes), notes)


def _table(data) -> dict[str, np.ndarray]:
    """The columns of numbers, `timestamp` as whole us."""
    with parquet_pages.opened(data) as file:
        names = [column.name for column in file.schema_arrow if parquet_pages.is_number(column.type)]
        if "timestamp" not in names:
            raise LogError("a table needs a column timestamp")
        found = {name: file.read(columns=[name])[name].to_numpy() for name in names}
    return found | {"timestamp": found["timestamp"].astype(np.int64)}


def _metadata(path: Path, notes: list[str]) -> dict[str, Any]:
    """The content of metadata.json; empty without it."""
    if not path.is_file():
        notes.append(f"{METADATA} is missing beside the tables: parameters and texts are not known")
        return {}
    try:
        found = json.loads(bytes(open_log(path)[0]))
        if isinstance(found, dict):
            return found
    except (ValueError, RecursionError):
        pass
    notes.append(f"{METADATA} is damaged: parameters and texts are not known")
    return {}


def _flight(tables, about: dict[str, Any], notes: list[str]) -> Flight:
    """Second 0 is the log's own start, else the first attitude."""
    first = {key: int(t["timestamp"][0]) for key, t in tables.items() if t["timestamp"].size}
    start = about.get("start_timestamp_us")
    if not isinstance(start, int) or not any(abs(t - start) < 30e6 for t in first.values()):  # as in a ULog, it begins within seconds
        start = first.get(("vehicle_attitude", 0), min(first.values()))
    given = _mapping(about, "parameters")
    parameters, impossible = parameter_ranges.checked({str(k): float(v) for k, v in given.items() if is_parameter(str(k), v)})
    topics = px4_topics.Topics(tables, start)
    signals, facts = px4_topics.signals(topics, parameters)
    end = series.end_of(signals)
    messages = (m for m in (*px4_topics.messages(topics), *_texts(about, start)) if m.time <= end + 1)
    board = {key: text for key in ("sys_uuid", "ver_hw") if isinstance(text := about.get(key), str) and text.strip("0 ")}
    release = about.get("ver_sw_release_str") or str(about.get("ver_sw") or "")[:8]
    return Flight(
        format=FORMAT,
        autopilot="PX4",
        signals=signals,
        duration=end,
        firmware=f"PX4 {release}".strip(),
        vehicle_type=px4_topics.MAV_TYPES.get(int(parameters.get("MAV_TYPE", 0)), ("", 0))[0],
        parameters=parameters,
        messages=tuple(sorted(messages, key=lambda m: m.time)),
        warnings=(*notes, *impossible, *topics.notes),
        start_us=start,
        facts={**facts, **board},
    )


def _mapping(about: dict[str, Any], key: str) -> dict[str, Any]:
    found = about.get(key)
    return found if isinstance(found, dict) else {}


def _texts(about: dict[str, Any], start: int) -> list[Message]:
    """Texts of the autopilot."""
    out = []
    for key in ("logged_messages", "tagged_logged_messages"):
        rows = about.get(key)
        for row in rows if isinstance(rows, list) else ():
            if isinstance(row, dict) and isinstance(row.get("timestamp_us"), int):
                kind = "error" if row.get("level") in _SEVERE else "text"
                out.append(Message(max(0.0, (row["timestamp_us"] - start) * 1e-6), kind, str(row.get("message", "")).strip()))
    return out
