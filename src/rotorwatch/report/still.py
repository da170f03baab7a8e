"""Still pictures of a diagnosis (matplotlib), with the content of the report's plots: the moment of a loss of control or a desync, or the
losses over the whole flight."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.base import files, optional
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import colours, figures, thinning, upset

KINDS = ("auto", "moment", "flight")
SIZE = (9.0, 6.0)  # inches
DASHES = {"solid": "-", "dashed": "--", "dotted": ":", "dotdash": "-.", "dashdot": (0, (3, 1, 1, 1))}


def shows(diagnosis: Diagnosis, what: str = "auto") -> str:
    """The picture that `figure` draws: "moment" or "flight". Raises ConfigError where there is none."""
    moment = bool(diagnosis.picture and diagnosis.picture.get("commands"))
    flight = diagnosis.trace is not None and diagnosis.trace.time.size > 1
    if what not in KINDS:
        raise ConfigError(f"what: there is no {what!r}{meant(what, KINDS)}; give one of {', '.join(KINDS)}.")
    if what == "moment" and not moment:
        raise ConfigError("No moment to show: control was not lost and no motor desynced.")
    if (what == "flight" and not flight) or not (moment or flight):
        raise ConfigError("Nothing to draw: no part of this log could be assessed.")
    return "moment" if moment and what != "flight" else "flight"


def figure(diagnosis: Diagnosis, what: str = "auto", path: str | os.PathLike | None = None) -> Any:
    """The matplotlib figure; written to `path` (SVG, PNG, PDF) when given. what: moment, flight, or auto: the moment where there is one.
    Raises ConfigError where there is nothing to draw, or no matplotlib."""
    kind = shows(diagnosis, what)
    picture = optional.library("matplotlib.figure", "A picture").Figure(figsize=SIZE, layout="constrained")
    (_moment if kind == "moment" else _flight)(diagnosis, picture)
    if path is not None:
        with files.replacing(path) as unfinished:
            picture.savefig(unfinished, metadata={"Date": None} if Path(path).suffix != ".png" else None)
    return picture


def _moment(diagnosis: Diagnosis, picture: Any) -> None:
    """Attitude or rates wanted and flown, the commands and the speeds of every rotor, with the moments as lines."""
    facts: Any = diagnosis.picture
    followed, axes_of, unit = (
        (facts.get("attitude"), upset.ANGLES, "deg") if facts.get("attitude") else (facts.get("rates"), upset.RATES, "dps")
    )
    rows = [(followed, axis) for axis in axes_of] if followed else []
    speeds = facts.get("speeds")
    axes = picture.subplots(len(rows) + (2 if speeds else 1), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (series, axis) in zip(axes, rows):
        time = series["time_s"]
        for prefix, look in (("", {"color": "#2b83ba"}), ("wanted_", {"color": "0.4", "ls": "--"})):
            values = series.get(f"{prefix}{axis}_{unit}")
            if values is not None:
                ax.plot(time, _numbers(values), lw=1.5, label="wanted" if prefix else "flown", **look)
        ax.set_ylabel(f"{axis} [{'°' if unit == 'deg' else '°/s'}]")
    if rows:
        axes[0].legend(frameon=False, fontsize="small", loc="upper left")
    share = 100.0 * _numbers(facts["commands"]["share"])
    _rotors(diagnosis, axes[len(rows)], facts["commands"]["time_s"], share, facts["accused"], "command [%]")
    if speeds:
        _rotors(diagnosis, axes[-1], speeds["time_s"], _numbers(speeds["rpm"]) / 1e3, facts["accused"], "speed [1000/min]")
    for ax in axes:
        for mark in facts["marks"]:
            ax.axvline(mark["time_s"], color=upset.TINTS.get(mark["what"], colours.INK), lw=1)
    for k, mark in enumerate(facts["marks"]):
        tint = upset.TINTS.get(mark["what"], colours.INK)
        where = {"xy": (mark["time_s"], 1.0), "xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
        axes[0].annotate(f"{mark['what']} {mark['time_s']:.2f} s", xytext=(2, 4 + 11 * (k % 4)), color=tint, fontsize="small", **where)
    axes[0].set_xlim(facts["start_s"], facts["end_s"])
    axes[-1].set_xlabel("time [s]")


def _flight(diagnosis: Diagnosis, picture: Any) -> None:
    """The loss of every rotor with its 95 % band, and the commands, over the whole flight."""
    trace = diagnosis.trace
    assert trace is not None
    top, bottom = picture.subplots(2, 1, sharex=True)
    looks = colours.looks(diagnosis, trace.loss.shape[1])
    flying = thinning.within(trace.time, trace.airborne or [(-np.inf, np.inf)])
    named = {*colours.faulty(diagnosis), *colours.suspects(diagnosis)}
    for k in sorted(looks, key=lambda k: k in named):
        tint, dash = looks[k]
        loss, low, high = (100.0 * np.where(flying, v[:, k - 1], np.nan) for v in (trace.loss, trace.lower, trace.upper))
        top.fill_between(trace.time, low, high, color=tint, alpha=0.3 if k in named else 0.07, lw=0)
        look: dict[str, Any] = {"color": tint, "ls": DASHES[dash], "lw": 2.2 if k in named else 1.0}
        top.plot(trace.time, loss, label=f"rotor {k}", **look)
        bottom.plot(trace.time, 100.0 * trace.command[:, k - 1], **(look | {"lw": 1.0}))
    for event in diagnosis.events:
        top.axvline(event.onset_s, color=colours.of_event(event), lw=1)
    top.set(ylabel="loss [%], 95 % band", ylim=(-3.0, figures.highest_loss(diagnosis)))
    top.legend(frameon=False, fontsize="small", ncols=min(len(looks), 4), loc="upper left")
    bottom.set(ylabel="command [%]", xlabel="time [s]")


def _rotors(diagnosis: Diagnosis, ax: Any, time: Any, values: np.ndarray, accused: Any, label: str) -> None:
    """A line of `values` (n, samples) for every rotor, the accused ones thick."""
    looks = colours.looks(diagnosis, len(values))
    for k in range(1, len(values) + 1):
        tint, dash = looks[k]
        width = 2.6 if k in accused else 1.2
        ax.plot(time, values[k - 1], color=tint, ls=DASHES[dash], lw=width, label=f"rotor {k}", drawstyle="steps-post")
    ax.set_ylabel(label)
    ax.legend(frameon=False, fontsize="x-small", ncols=4, loc="upper left")


def _numbers(values: Any) -> np.ndarray:
    """Array with NaN for None."""
    return np.asarray(values, float)
