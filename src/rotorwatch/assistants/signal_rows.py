"""Samples of a plot's time series: the minimum and the maximum of every interval, so that peaks stay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import figures
from rotorwatch.report.thinning import Screen

WHOLE = ("loss", "command", "residual", "evidence", "attitude", "rates")
MOMENT = ("moment_attitude", "moment_rates", "moment_command", "moment_speed")
UNITS = {
    "loss": "share, 0 healthy to 1 dead, as a live observer would have had it",
    "command": "share of full thrust",
    "residual": "hover thrusts of one rotor; torques times the arm",
    "evidence": "log10 odds against healthy",
    "attitude": "degrees",
    "rates": "degrees/s",
    "speed": "revolutions a minute",
}
AXES = figures.ANGLES
Table = tuple[np.ndarray, list[str], np.ndarray]  # time (T,), names (k), values (T, k)


def sampled(diagnosis: Diagnosis, what: str, rotor: int | None, start_s: float | None, end_s: float | None, most: int) -> dict[str, Any]:
    """Rows of [time, values] from start_s to end_s, at most `most` of them (one of WHOLE over the flight, one of MOMENT around a loss of
    control). rotor: of losses only this one, with its 95 % interval. Raises ConfigError for a missing series."""
    time, names, values = _moment(diagnosis, what) if what in MOMENT else _whole(diagnosis, what, rotor)
    first = float(time[0]) if start_s is None else start_s
    last = float(time[-1]) if end_s is None else end_s
    inside = (time >= first) & (time <= last)
    if not inside.any():
        raise ConfigError(f"This series has no samples in that time; it goes from {time[0]:.2f} to {time[-1]:.2f} s.")
    time, values = time[inside], values[inside]
    rows = [(t, *row) for t, row in zip(time, values)]
    if time.size > most:
        screen = Screen(time, [], overview=most)
        columns = [screen.time, *(screen.line(column) for column in values.T)]
        rows = list(zip(*columns))[:most]
    digits = 0 if what == "moment_speed" else 1 if what.endswith(("attitude", "rates")) else 3
    return {
        "what": what,
        "unit": UNITS[what.removeprefix("moment_")],
        "columns": ["time_s", *names],
        "rows": [[round(float(t), 2), *(_number(v, digits) for v in row)] for t, *row in rows],
        "samples": int(time.size),
        "start_s": round(float(time[0]), 2),
        "end_s": round(float(time[-1]), 2),
    }


def _number(value: float, digits: int) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None


def _whole(diagnosis: Diagnosis, what: str, rotor: int | None) -> Table:
    trace = diagnosis.trace
    if trace is None or trace.time.size < 2:
        raise ConfigError("No part of this log could be assessed, so it has no series.")
    n = trace.loss.shape[1]
    if rotor is not None and not 1 <= rotor <= n:
        raise ConfigError(f"rotor: this vehicle has rotors 1 to {n}.")
    numbers = range(1, n + 1) if rotor is None else [rotor]
    rotors, columns = [f"rotor {k}" for k in numbers], [k - 1 for k in numbers]
    if what == "loss" and rotor is not None:
        parts = (trace.loss, trace.lower, trace.upper)
        return trace.time, ["loss", "lower", "upper"], np.stack([v[:, rotor - 1] for v in parts], axis=1)
    if what in ("loss", "command"):
        return trace.time, rotors, (trace.loss if what == "loss" else trace.command)[:, columns]
    if what == "residual":
        names = [*figures.CHANNELS, *(f"{name} sd" for name in figures.CHANNELS)]
        return trace.time, names, np.concatenate([trace.residual, trace.residual_sd], axis=1)
    if what == "evidence":
        names = figures.hypotheses(diagnosis)
        if not names:
            raise ConfigError("This method provides no evidence over time.")
        return trace.time, names, np.stack([trace.evidence[name] for name in names], axis=1)
    flown, wanted = (trace.attitude, trace.wanted) if what == "attitude" else (trace.rates, trace.rates_wanted)
    have = {"": flown, "wanted ": wanted}
    parts = {f"{prefix}{axis}": v[:, k] for prefix, v in have.items() if v is not None for k, axis in enumerate(AXES)}
    if not parts:
        raise ConfigError(f"The log has no {what}.")
    return trace.time, list(parts), np.stack(list(parts.values()), axis=1)


def _moment(diagnosis: Diagnosis, what: str) -> Table:
    facts: Mapping[str, Any] = diagnosis.picture or {}
    key = {"command": "commands", "speed": "speeds"}.get(what.removeprefix("moment_"), what.removeprefix("moment_"))
    part = facts.get(key)
    if not part:
        raise ConfigError("No such series: control was not lost and no motor desynced, or the log does not hold it.")
    lists = part.get("share", part.get("rpm"))
    if lists is not None:
        named = {f"rotor {k}": values for k, values in enumerate(lists, 1)}
    else:
        named = {k.rpartition("_")[0].replace("_", " "): v for k, v in part.items() if k != "time_s" and v is not None}
    return (np.asarray(part["time_s"], float), list(named), np.stack([np.asarray(v, float) for v in named.values()], axis=1))
