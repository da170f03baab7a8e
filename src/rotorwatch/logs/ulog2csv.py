"""PX4 logs as the tables that ulog2csv writes: <log>_<topic>_<instance>.csv, first column `timestamp` in us."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight
from rotorwatch.logs import log_memory, px4_topics, series
from rotorwatch.logs.container import open_log

FORMAT = "ulog2csv tables"

TABLES = re.compile(rf"(?:(?P<log>.*)_)?(?P<topic>{'|'.join(px4_topics.TOPICS)})_(?P<instance>\d+)\.csv(?:\.(?:xz|gz|bz2))?")


def sniff(head: bytes, name: str) -> bool:
    """True for a text table whose first column is `timestamp`."""
    return not name and log_memory.header(head)[:1] == ["timestamp"]


def read(data, name: str, progress=None) -> Flight:
    """Read a single table of a set; its file name says which topic it is."""
    match = TABLES.fullmatch(name)
    if match is None:
        raise LogError(f"{name}: a ulog2csv table is named <log>_<topic>_<instance>.csv, with a topic that is read here")
    notes: list[str] = []
    table = _integer_stamps(log_memory.numbers(data, notes, name))
    return _flight({(match["topic"], int(match["instance"])): table}, notes)


def sniff_folder(path: Path) -> bool:
    """True for a folder that holds at least one table of a topic that is read here."""
    return any(TABLES.fullmatch(p.name) for p in path.iterdir())


def read_folder(path: Path, progress=None) -> Flight:
    """Read the tables of one log from a folder.

    Raises LogError when the folder holds tables of several logs."""
    files = {p: m for p in sorted(path.iterdir()) if p.is_file() and (m := TABLES.fullmatch(p.name))}
    logs = sorted({m["log"] or "" for m in files.values()})
    if len(logs) > 1:
        raise LogError(f"{path}: tables of {len(logs)} logs ({logs[0]}, {logs[1]} ..); give each log a folder of its own")
    notes: list[str] = []
    tables = {}
    for done, (file, match) in enumerate(files.items()):
        data, name, warnings = open_log(file)
        notes += [f"{name}: {w}" for w in warnings]
        try:
            tables[match["topic"], int(match["instance"])] = _integer_stamps(log_memory.numbers(data, notes, name))
        except LogError as error:
            notes.append(str(error))
        if progress:
            progress((done + 1) / len(files))
    return _flight(tables, notes)


def _integer_stamps(table):
    """`timestamp` as whole us; lines without one dropped."""
    stamp = table.get("timestamp")
    if stamp is None:
        raise LogError("a ulog2csv table needs a column timestamp")
    fine = (stamp >= 0) & (stamp < 9e15)
    return {k: v[fine] for k, v in table.items()} | {"timestamp": stamp[fine].astype(np.int64)}


def _flight(tables, notes) -> Flight:
    """Second 0 is the first attitude: the tables do not say when the log started; the estimator runs from then on."""
    stamps = {k: t["timestamp"] for k, t in tables.items() if t["timestamp"].size}
    first = {k: int(stamp[series.steady(stamp * 1e-6)[0]]) for k, stamp in stamps.items()}
    if not first:
        raise LogError("these tables hold no samples")
    start = first.get(("vehicle_attitude", 0), min(first.values()))
    topics = px4_topics.Topics(tables, start)
    signals, facts = px4_topics.signals(topics, {})
    messages = sorted(px4_topics.messages(topics), key=lambda m: m.time)
    return Flight(
        format=FORMAT,
        autopilot="PX4",
        signals=signals,
        duration=series.end_of(signals),
        firmware="PX4",
        messages=tuple(messages),
        warnings=(*notes, *topics.notes, "parameters are not in ulog2csv tables"),
        start_us=start,
        facts=facts,
    )
