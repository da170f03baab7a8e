"""Statistics of a campaign's table: rates and shares with 95 % intervals, ROC and delay curves, loss errors, bounds.

Missed detections are counted apart and never enter a delay or an error.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign.score import COLUMNS, NOTHING, RISE_S, WINDOWS_S
from rotorwatch_lab.experiments.tools import RESAMPLES, boot, interval, rate, share, table

LOSS_EDGES = (0.03, 0.06, 0.12, 0.25, 0.5, 1.01)
WIND_EDGES = (0.0, 3.0, 6.0, np.inf)
INDUCED_EDGES = (0.0, 2.0, 3.5, 5.0, np.inf)  # real vehicles have 3.5 m/s and more
DELAYS_S = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0)
THRESHOLDS = (*np.arange(-12.0, 0.0, 0.5), 0.0, *np.arange(0.5, 12.1, 0.5))
DRAWN = ("frame", "profile", "wind", "induced velocity")  # groups with curves of their own
LIKELY = 0.6744897501960817  # half of normal errors are smaller than so many standard deviations


def summarise(rows: Any, name: str = "") -> dict[str, Any]:
    """{"name", "flights", "healthy_h", "methods": {method: {...}}} of rows, a pyarrow table with the columns of score.COLUMNS.

    Per method: `overall` and, by frame, profile, wind, trajectory and fault, `groups`, each a dict of `measures`; `roc`, `delay_curve` and
    `loss_error`, lists of points; `curves`: the same three for each frame, profile and wind, as plain numbers. Raises ConfigError for
    an empty table.
    """
    if rows.num_rows == 0:
        raise ConfigError("There is no flight in this campaign's table.")
    columns = arrays(rows)
    methods = {}
    for method in sorted(set(columns["method"])):
        part = of_method(columns, method)
        labels = _labels(part)
        methods[method] = {
            "overall": measures(part),
            "groups": {kind: _groups(part, labels[kind], measures) for kind in labels},
            "roc": _roc(part), "delay_curve": _delay_curve(part), "loss_error": _loss_error(part),
            "curves": {kind: _groups(part, labels[kind], _curves) for kind in DRAWN},
        }  # fmt: skip
    first = columns["method"] == columns["method"][0]
    hours = float(columns["healthy_s"][first].sum() / 3600.0)
    return {"name": name, "flights": int(first.sum()), "healthy_h": hours, "methods": methods}


def arrays(rows: Any) -> dict[str, np.ndarray]:
    """The columns of a pyarrow table as NumPy arrays (`column`)."""
    return {key: column(rows[key].to_pylist(), COLUMNS[key][0]) for key in rows.column_names}


def of_method(columns: dict[str, np.ndarray], method: str) -> dict[str, np.ndarray]:
    """The rows of one method."""
    return {key: values[columns["method"] == method] for key, values in columns.items()}


def at_rate(d: dict[str, np.ndarray], false_alarms_h: float, within_s: float = 10.0) -> dict[str, Any]:
    """Performance of a method whose threshold is set on healthy time: {"threshold", "false_alarms_h", "detected", "delay_s", "found"}.

    The threshold [nats above the one in use] is the lowest at which at most `false_alarms_h` an hour are left, the first of each
    flight; a method without a statistic keeps its own (threshold None). detected: share of clear faults within `within_s` (one of
    score.RISE_S), delay_s: median of those, read from score.RISE_S; found: the numbers of those flights. Intervals: bootstrap of flights,
    the threshold set anew in each; for the share Wilson's where that is wider. None where they are not defined: without healthy time, or
    without a clear fault.
    """
    clear, hours = d["clear"].astype(bool), float(d["healthy_s"].sum() / 3600.0)
    if not np.isfinite(d["peak"]).any():
        with np.errstate(invalid="ignore"):
            found = clear & (d["delay_s"] <= within_s)
        own = rate(int(d["false_alarms"].sum()), hours)
        delays = boot(d["delay_s"][found].astype(float), np.median)
        return {
            "threshold": None, "false_alarms_h": own, "detected": share(found[clear]), "delay_s": delays, "found": numbers(d, found),
        }  # fmt: skip
    if hours <= 0.0 or not clear.any():
        return {"threshold": None, "false_alarms_h": None, "detected": None, "delay_s": None, "found": []}
    grid = [s for s in RISE_S if s <= within_s]
    rise = np.stack([d[f"peak_{s:g}s"] for s in grid], axis=1)

    def found_in(rows: np.ndarray) -> tuple[float, np.ndarray]:
        """The threshold of some flights, and the delays of the clear faults in them, inf for those not found."""
        least = _threshold(d["peak"][rows], false_alarms_h * float(d["healthy_s"][rows].sum() / 3600.0))
        over = rise[rows][clear[rows]] > least
        return least, np.where(over.any(axis=1), np.array(grid)[over.argmax(axis=1)], np.inf)

    everyone = np.arange(len(clear))
    least, delays = found_in(everyone)
    rng, shares, medians = np.random.default_rng(len(clear)), [], []
    for _ in range(RESAMPLES):
        again = found_in(rng.integers(len(clear), size=len(clear)))[1]
        finite = again[np.isfinite(again)]
        shares += [float(np.mean(np.isfinite(again)))] if again.size else []
        medians += [float(np.median(finite))] if finite.size else []
    found = np.isfinite(delays)
    detected, hits = share(found), delays[found]
    assert detected is not None
    low, high = np.quantile(shares, (0.025, 0.975))
    detected |= {"low": min(detected["low"], float(low)), "high": max(detected["high"], float(high))}
    delay = None
    if hits.size:
        low, high = np.quantile(medians, (0.025, 0.975))
        middle = float(np.median(hits))
        delay = {"value": middle, "low": min(float(low), middle), "high": max(float(high), middle), "n": int(hits.size)}
    alarms = rate(int((d["peak"] > least).sum()), hours)
    return {
        "threshold": least, "false_alarms_h": alarms, "detected": detected, "delay_s": delay,
        "found": numbers(d, np.flatnonzero(clear)[found]),
    }  # fmt: skip


def numbers(d: dict[str, np.ndarray], which: np.ndarray) -> list[int]:
    """The numbers of some flights (indices or a mask), in ascending order."""
    return sorted(int(n) for n in d["flight"][which])


def mcnemar(first: Sequence[int], other: Sequence[int]) -> dict[str, Any]:
    """McNemar's test of two methods on the same flights: {"only_first", "only_this", "p"}.

    first, other: the numbers of the flights in which each succeeds. Flights in which both or neither do say nothing. p: two-sided and
    exact, of the binomial distribution with 1/2 (McNemar, Psychometrika 12 (1947) 153).
    """
    a, b = len(set(first) - set(other)), len(set(other) - set(first))
    tail = sum(math.comb(a + b, k) for k in range(min(a, b) + 1)) / 2 ** (a + b)
    return {"only_first": a, "only_this": b, "p": min(1.0, 2.0 * tail)}


def _threshold(peaks: np.ndarray, allowed: float) -> float:
    """The lowest threshold that at most so many of the peaks exceed."""
    most = int(allowed)
    return float(np.sort(peaks)[::-1][most]) if most < len(peaks) else NOTHING


def measures(d: dict[str, np.ndarray]) -> dict[str, Any]:
    """Measures of some flights: numbers, or {"value", "low", "high", "n"} for what has an interval; None where it is not defined."""
    faulty, clear = d["fault"] != "", d["clear"].astype(bool)
    hours = float(d["healthy_s"].sum() / 3600.0)
    detected = clear & (d["detected"] == True)  # noqa: E712 - None where there is no fault
    delays = d["delay_s"][detected].astype(float)
    error, sd = _errors(d)
    both = detected & np.isfinite(d["bound_delay_s"])
    inside = _announced(d)
    covered = (d["lower"] <= d["loss"]) & (d["loss"] <= d["upper"])
    return {
        "flights": len(faulty), "faults": int(faulty.sum()), "clear_faults": int(clear.sum()), "healthy_h": hours,
        "false_alarms": int(d["false_alarms"].sum()), "false_alarms_h": rate(int(d["false_alarms"].sum()), hours),
        "sure_false_alarms_h": rate(int(d["sure_false_alarms"].sum()), hours),
        "detected": share(d["detected"][clear]), "right": share(d["right"][clear]), "named": share(d["named"][clear]),
        "answered": _answered(d), "accused_h": _accused(d),
        "misled": int(_misled(d).sum()), "wrong": int(d["wrong"].sum()),
        "delay_s": boot(delays, np.median), "bound_delay_s": boot(d["bound_delay_s"][both], np.median),
        "delay_ratio": boot(d["delay_s"][both] / d["bound_delay_s"][both], np.median),
        "loss_rmse": boot(error, _rms), "bound_rmse": boot(sd, _rms),
        "rmse_ratio": _ratio(error, sd), "typical_ratio": boot(np.abs(error) / sd / LIKELY, np.median),
        "coverage": share(covered[inside]),
    }  # fmt: skip


def _reported(d: dict[str, np.ndarray]) -> np.ndarray:
    """Flights of a method with an answer to the whole flight."""
    return np.array([answer is not None for answer in d["answer"]], bool)


def _answered(d: dict[str, np.ndarray]) -> dict[str, float] | None:
    """Share of the clear faults whose rotor the answer to the whole flight names, alone or among others."""
    has = d["clear"].astype(bool) & _reported(d)
    return share(np.array([b in a.split("+") for a, b in zip(d["accused"][has], d["broken"][has])], bool))


def _misled(d: dict[str, np.ndarray]) -> np.ndarray:
    """Flights with a fault whose answer names other rotors only."""
    has = (d["fault"] != "") & _reported(d)
    pairs = zip(d["accused"], d["broken"], has, strict=True)
    return np.array([bool(h and a) and not set(a.split("+")) & set(b.split("+")) for a, b, h in pairs], bool)


def _accused(d: dict[str, np.ndarray]) -> dict[str, float] | None:
    """Answers that name rotors of vehicles without a fault, per healthy hour of such flights."""
    sound = (d["fault"] == "") & _reported(d)
    return rate(int((d["accused"][sound] != "").sum()), float(d["healthy_s"][sound].sum() / 3600.0))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _ratio(error: np.ndarray, sd: np.ndarray) -> dict[str, float] | None:
    """RMS error over RMS bound, flights resampled together."""
    both = np.arange(error.size, dtype=float)
    return boot(both, lambda k: _rms(error[k.astype(int)]) / _rms(sd[k.astype(int)]))


def size_errors(d: dict[str, np.ndarray]) -> dict[str, float]:
    """Flight -> estimated less true loss, of the announced clear faults; the numbers of flights as texts, as JSON keeps them."""
    ok = _announced(d)
    return {str(int(n)): round(float(e), 4) for n, e in zip(d["flight"][ok], (d["estimate"] - d["loss"])[ok], strict=True)}


def closer(first: Mapping[str, float], other: Mapping[str, float]) -> dict[str, Any]:
    """Paired comparison of two methods' loss errors in the flights in which both announced a loss: {"flights", "first", "this", "p"}.

    first, other: `size_errors` of the two. first, this: their RMS errors over these flights, None where there are none. p: two-sided sign
    test, exact, on which of the two is closer.
    """
    common = sorted(set(first) & set(other))
    if not common:
        return {"flights": 0, "first": None, "this": None, "p": 1.0}
    a, b = (np.array([errors[n] for n in common]) for errors in (first, other))
    ours, theirs = (np.flatnonzero(won).tolist() for won in (abs(a) < abs(b), abs(b) < abs(a)))
    return {"flights": len(common), "first": _rms(a), "this": _rms(b), "p": mcnemar(ours, theirs)["p"]}


def _announced(d: dict[str, np.ndarray]) -> np.ndarray:
    """Clear faults whose rotor was announced in time to have an estimate."""
    return d["clear"].astype(bool) & (d["estimate"] > 0.0) & np.isfinite(d["bound_sd"])


def _errors(d: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    ok = _announced(d)
    return d["estimate"][ok] - d["loss"][ok], d["bound_sd"][ok]


def _labels(d: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    profile = np.array([f"{a} {p}" for a, p in zip(d["autopilot"], d["profile"])], object)
    return {
        "frame": d["frame"],
        "profile": profile,
        "wind": by_speed(d["wind_m_s"], WIND_EDGES),
        "induced velocity": by_speed(d["induced_m_s"], INDUCED_EDGES),
        "trajectory": d["trajectory"],
        "fault": np.array([f or "none" for f in d["fault"]], object),
    }


def by_speed(speeds: np.ndarray, edges: Sequence[float]) -> np.ndarray:
    """Label of the interval between edges that holds each speed [m/s]; "unknown" where it is NaN."""
    names = [f"{a:g} to {b:g} m/s" if np.isfinite(b) else f"over {a:g} m/s" for a, b in itertools.pairwise(edges)]
    return np.where(np.isnan(speeds), "unknown", np.array(names, object)[np.digitize(speeds, edges[1:-1])])


def _groups(d: dict[str, np.ndarray], labels: np.ndarray, count: Callable) -> dict[str, dict]:
    """Result of `count` for the flights of each label."""
    return {str(g): count({k: v[labels == g] for k, v in d.items()}) for g in sorted(set(labels))}


def _curves(d: dict[str, np.ndarray]) -> dict[str, list[dict]]:
    """ROC, delays and errors of some flights, as numbers without intervals, for figures with many lines."""
    hours, clear = float(d["healthy_s"].sum() / 3600.0), d["clear"].astype(bool)
    roc: list[dict] = []
    if np.isfinite(d["peak"]).any() and hours > 0.0 and clear.any():
        roc = [
            {"threshold": float(t), "false_alarms_h": float((d["peak"] > t).sum() / hours)}
            | {f"detected_{s:g}s": float((d[f"peak_{s:g}s"][clear] > t).mean()) for s in (2.0, 10.0)}
            for t in THRESHOLDS[::2]
        ]
    delays: list[dict] = []
    if clear.any():
        with np.errstate(invalid="ignore"):
            delays = [{"delay_s": t, "detected": float((d["delay_s"][clear] <= t).mean())} for t in DELAYS_S]
    errors = []
    for low, high in itertools.pairwise(LOSS_EDGES):
        here = (d["loss"] >= low) & (d["loss"] < high)
        error, sd = _errors({k: v[here] for k, v in d.items()})
        if error.size:
            errors.append({"low": low, "high": min(high, 1.0), "rmse": _rms(error), "bound_rmse": _rms(sd)})
    return {"roc": roc, "delay_curve": delays, "loss_error": errors}


def _roc(d: dict[str, np.ndarray]) -> list[dict]:
    """Points: threshold (nats above the one in use), false alarms per healthy hour, detected within each window.

    A flight's first false alarm ends its healthy time as far as this curve knows: at most one counts per flight.
    """
    peak, clear = d["peak"], d["clear"].astype(bool)
    if not np.isfinite(peak).any():
        return []
    hours = float(d["healthy_s"].sum() / 3600.0)
    return [
        {"threshold": float(t), "false_alarms_h": rate(int((peak > t).sum()), hours)}
        | {f"detected_{s:g}s": share(d[f"peak_{s:g}s"][clear] > t) for s in WINDOWS_S}
        for t in THRESHOLDS
    ]


def _delay_curve(d: dict[str, np.ndarray]) -> list[dict]:
    """Points: share of clear faults detected within so many seconds, and by the best possible detector on average."""
    clear = d["clear"].astype(bool)
    with np.errstate(invalid="ignore"):
        return [
            {"delay_s": t, "detected": share(d["delay_s"][clear] <= t), "bound": share(d["bound_delay_s"][clear] <= t)} for t in DELAYS_S
        ]


def _loss_error(d: dict[str, np.ndarray]) -> list[dict]:
    """By size of the loss: detections, bias and error of the announced ones, and the bound."""
    points = []
    for low, high in itertools.pairwise(LOSS_EDGES):
        here = d["clear"].astype(bool) & (d["loss"] >= low) & (d["loss"] < high)
        part = {k: v[here] for k, v in d.items()}
        error, sd = _errors(part)
        points.append(
            {
                "low": low, "high": min(high, 1.0), "faults": int(here.sum()), "detected": share(part["detected"]),
                "answered": _answered(part), "right": share(part["right"]), "delay_s": measures(part)["delay_s"],
                "bias": boot(error, np.mean), "rmse": boot(error, _rms), "bound_rmse": boot(sd, _rms), "rmse_ratio": _ratio(error, sd),
                "typical_ratio": boot(np.abs(error) / sd / LIKELY, np.median),
            }
        )  # fmt: skip
    return points


def column(values: list, kind: str) -> np.ndarray:
    """A column of score.COLUMNS as NumPy: numbers as floats with NaN for what is missing, else objects."""
    if kind in ("double", "int64"):
        return np.array([np.nan if v is None else v for v in values], float)
    objects = np.empty(len(values), object)
    objects[:] = values
    return objects


MEASURES = {
    "false_alarms_h": "false alarms/h", "sure_false_alarms_h": "of these sure", "accused_h": "healthy accused/h", "detected": "detected",
    "answered": "named by the answer", "right": "right rotor",
    "delay_s": "delay, s", "delay_ratio": "x bound", "loss_rmse": "loss RMSE", "rmse_ratio": "x bound", "typical_ratio": "typical x",
    "coverage": "coverage",
}  # fmt: skip
ERRORS = {
    "detected": "detected", "answered": "named by the answer", "right": "right rotor", "bias": "bias", "rmse": "RMSE",
    "bound_rmse": "bound", "rmse_ratio": "x bound", "typical_ratio": "typical x",
}  # fmt: skip


def lines_of(results: dict[str, Any]) -> list[tuple[str, dict]]:
    """(label, measures) of a method: over all flights, then of each group."""
    groups = ((kind, name, m) for kind, named in results["groups"].items() for name, m in named.items())
    return [("all", results["overall"]), *((f"{kind}: {name}", m) for kind, name, m in groups)]


def markdown(summary: dict[str, Any]) -> str:
    """The summary as Markdown tables."""
    parts = [f"{summary['flights']} flights, {summary['healthy_h']:.1f} healthy hours assessed."]
    for method, results in summary["methods"].items():
        rows = ([label, m["flights"], *(cell(key, m[key]) for key in MEASURES)] for label, m in lines_of(results))
        parts.append(f"\n### {method}\n\n{table(['', 'flights', *MEASURES.values()], rows)}")
        if any(point["rmse"] for point in results["loss_error"]):
            rows = ([f"{p['low']:g} to {p['high']:g}", p["faults"], *(cell(k, p[k]) for k in ERRORS)] for p in results["loss_error"])
            parts.append("\n" + table([f"{method}: loss", "faults", *ERRORS.values()], rows))
    return "\n".join(parts) + "\n"


def cell(key: str, value: Any) -> str:
    """A measure with its interval, as text."""
    if key in ("detected", "answered", "right", "named", "coverage"):
        return interval(value)
    return interval(value, 3 if key in ("loss_rmse", "bias", "rmse", "bound_rmse") else 2)
