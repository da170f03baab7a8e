"""Blackbox logs of Betaflight, INAV, EmuFlight, Cleanflight and their relatives (`.bbl`, `.bfl`, `.txt`) -> Flight.

header.py      lines before the frames: settings, and the layout of frames
encodings.py   the encoding of numbers, as a definition that is also machine code
frames.py      frames from bytes, likewise
frame_sizes.py sizes of the arrays in both
decoder.py     a session as tables
modes.py       flight modes by name
assembly.py    tables as signals: units, axes, ranges; which signal comes from which field
decoded.py     tables that blackbox_decode made of such logs

A file holds a session for each time the vehicle was armed. LOG.BFL#2 is its second one; LOG.BFL alone is the longest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotorwatch.errors import LogError
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.logs import series
from rotorwatch.logs.blackbox import assembly, decoder, frames, header, modes

FORMAT = "Blackbox"
ENDINGS = (".bbl", ".bfl")

VELOCITY, PLACE = tuple(f"GPS_velned[{k}]" for k in range(3)), ("GPS_coord[0]", "GPS_coord[1]")
LEAST_SATELLITES = 4
NAMED = 5  # sessions that a warning names
# Phases of the failsafe (failsafe.h) and why it disarmed (core.h, INAV: fc_core.h), by firmware; others number them as Betaflight does.
FAILSAFE = {
    "": ("", "signal lost", "landing", "landed", "signal looked for", "signal back", "GPS rescue", "mission goes on without signal"),
    "INAV": (
        "", "signal lost", "waiting for the signal", "return home", "landing", "landed", "signal looked for", "signal back",
    ),
}  # fmt: skip
REASONS = {
    "": (
        "arming disabled", "failsafe", "throttle timeout", "sticks", "switch", "crash protection", "runaway take-off", "GPS rescue",
        "serial command", "landing", "crash flip",
    ),
    "INAV": ("no reason", "timeout", "sticks", "switch", "switch", "kill switch", "failsafe", "navigation", "landing"),
}  # fmt: skip


def sniff(head: bytes, name: str) -> bool:
    """True where a session's header begins near the start; by name for .bbl and .bfl."""
    return header.START in head or header.FIELDS_START in head or name.lower().endswith(ENDINGS)


def parts(data) -> list[int]:
    """Numbers, from 1, of the sessions that hold frames, the longest first."""
    starts = [*header.starts(data), len(data)]
    sizes = {}
    for k, start in enumerate(starts[:-1]):
        end = starts[k + 1]
        try:
            size = end - header.read(data, start, end).start
        except LogError:
            continue
        if size > 0:
            sizes[k + 1] = size
    return sorted(sizes, key=lambda k: -sizes[k])


def read(data, name: str, progress=None, part: int | None = None) -> Flight:
    """Read a session, by default the longest. Times count from its first main frame.

    Raises LogError where the file holds no such session, or none with frames that can be read."""
    starts = [*header.starts(data), len(data)]
    if len(starts) == 1:
        raise LogError(f"{name}: no session of this Blackbox log has a valid beginning; copy it from the vehicle again")
    if part is not None and not 1 <= part < len(starts):
        raise LogError(f"{name}: this Blackbox log holds {len(starts) - 1} sessions, not one of number {part}")
    there = parts(data)
    wanted = [part] if part is not None else there or [1]  # where none is readable, the first gives the error
    notes: list[str] = []
    for number in wanted:
        try:
            session = decoder.decode(data, starts[number - 1], starts[number], progress, assembly.used)
        except LogError as why:
            if number == wanted[-1]:
                raise LogError(f"{name}: {why}") from None
            notes.append(f"Session {number} was skipped: {why}.")
            continue
        others = [k for k in there if k != number]
        if part is None and others:
            named = ", ".join(f"#{k}" for k in others[:NAMED])
            others_more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
            notes.append(f"This is session {number} of {len(starts) - 1}, the longest; also in this file: {named}{others_more}.")
        return _flight(session, name, number, notes)
    raise AssertionError


def _flight(session: decoder.Session, name: str, number: int, notes: list[str]) -> Flight:
    notes += _damage(session)
    first = session.time[0]
    time = (session.time - first) * 1e-6
    columns = assembly.Columns(session.main.columns, time, session.header, notes)
    counts = {"main": len(session.main), "slow": len(session.slow), "gps": len(session.gps), "event": len(session.events)}
    facts = {"session": number, "log_messages": {key: value for key, value in counts.items() if value}}
    flown = assembly.assembled(
        columns, FORMAT, name, facts=facts, signals=_gps(session, first, notes), messages=_messages(session, first),
        start_us=int(first),
    )  # fmt: skip
    return replace(flown, warnings=tuple(notes))


def _damage(session: decoder.Session) -> list[str]:
    """Sentences on skipped data."""
    sentences = []
    lost = session.corrupt + session.orphans
    if lost or session.garbage:
        what = f"{session.corrupt} damaged frame{'s' if session.corrupt != 1 else ''}"
        sentences.append(f"{what}, {session.orphans} more that need them, and {session.garbage} bytes between frames were skipped.")
    if session.header.lost:
        kinds = " and ".join(session.header.lost)
        sentences.append(f"The header's list of fields of {kinds} frames is damaged: those frames were skipped.")
    if session.cut:
        sentences.append(f"The log continues after {len(session.main)} frames, which is more than is read.")
    elif not session.ended:
        sentences.append("The log has no end marker of the firmware: power was lost, or the file is incomplete.")
    return sentences


def _gps(session: decoder.Session, first: int, notes: list[str]) -> dict[str, Signal]:
    """Place and speed from GPS frames, and velocity, which newer firmware gives in all three directions."""
    table = session.gps
    if not len(table):
        return {}
    stamp = table.columns.get("time", session.main.columns["time"][np.clip(table.before - 1, 0, None)])
    time = (session.clock(stamp, table.before) - first) * 1e-6
    signals: dict[str, Signal | None] = {}
    if all(n in table.columns for n in VELOCITY):
        values = np.stack([table.columns[n].astype(float) for n in VELOCITY], axis=1) / 100.0
        signals["velocity"] = series.signal("velocity", time, values, "GPS_velned", notes)
    if all(n in table.columns for n in PLACE):
        degrees = np.stack([table.columns[n] * 1e-7 for n in PLACE], axis=1)
        unknown = np.full(len(table), np.nan)
        altitude, speed = (np.asarray(table.columns.get(f"GPS_{n}", unknown), float) for n in ("altitude", "speed"))
        fixed = np.asarray(table.columns.get("GPS_numSat", np.full(len(table), LEAST_SATELLITES))) >= LEAST_SATELLITES
        altitude = altitude * assembly.altitude_unit(session.header)
        signals["gps"] = series.gps(time, degrees, altitude, speed / 100.0, fixed, "GPS_coord")
    return {name: signal for name, signal in signals.items() if signal is not None}


def _messages(session: decoder.Session, first: int) -> tuple[Message, ...]:
    """Events, and changes of the failsafe's phase, in order of time."""
    messages: list[Message] = []
    firmware = assembly.autopilot(session.header)
    reasons, phases = (table.get(firmware, table[""]) for table in (REASONS, FAILSAFE))
    named = modes.messages(session, first)
    before, kinds, stamps = session.events[:, 0], session.events[:, 1], session.events[:, 2]
    times = (session.clock(stamps, before) - first) * 1e-6 if len(session.events) else np.zeros(0)
    for time, kind, (a, b) in zip(times.tolist(), kinds.tolist(), session.events[:, 3:].tolist()):
        if kind == frames.DISARM:
            reason = reasons[a] if 0 <= a < len(reasons) else f"reason {a}"
            messages += [
                Message(0.0, "armed", "armed", 1.0),
                Message(time, "armed", "disarmed", 0.0),
                Message(time, "event", f"disarmed: {reason}", a),
            ]
        elif kind == frames.MODES:
            text = f"modes 0x{a & 0xFFFFFFFF:x}, before 0x{b & 0xFFFFFFFF:x}"
            messages.append(Message(time, "event" if named else "mode", text, a & 0xFFFFFFFF))
        elif kind == frames.ADJUSTMENT:
            messages.append(Message(time, "event", f"adjustment {a & 127} in flight", b))
        elif kind == frames.IMU_FAILURE:
            messages.append(Message(time, "error", f"IMU failure {a}", a))
        elif kind == frames.RESUME:
            messages.append(Message(time, "dropout", "logging goes on after a pause"))
        elif kind == frames.LOG_END:
            messages.append(Message(time, "event", "end of log"))
    phase = session.slow.columns.get("failsafePhase")
    if phase is not None and len(session.slow):
        at = np.clip(session.slow.before, 0, len(session.time) - 1)
        when = (session.time[at] - first) * 1e-6
        for time, value in series.changes(when, phase):
            if value or time > when[0]:
                known = int(value) if 0 < value < len(phases) else 0
                text = phases[known] if known else f"phase {int(value)}" if value else "over"
                messages.append(Message(time, "error" if value else "event", f"failsafe: {text}", value))
    return tuple(sorted((*messages, *named), key=lambda m: m.time))
