"""The standing of every aircraft and rotor over all flights of a store, in plain data.

Aircraft of one build share the scatter of healthy flights, the wind's effect on their trim, and the level of a healthy rotor. A flight is
not used when rotorwatch itself calls it faulty or ambiguous, doubts its log, or saw a rotor at its limit: it is shown, and named among
those left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rotorwatch.engine.events.decisions import DAMAGED, MENTIONED
from rotorwatch.fleet import attribution, condition, false_discovery, listing, prognosis, scatter
from rotorwatch.fleet.attribution import CENTRE, STEP, WORN, Found, Series
from rotorwatch.fleet.store import Store
from rotorwatch.stats import multivariate_t as student
from rotorwatch.witnesses.healthy.whole_flight import LIMITED, SLOPE_BETWEEN_SD, of_wind

FELL = "control was lost in it"
TAUGHT_BY = ("healthy", "inconclusive")
SISTERS = 2  # fewest other aircraft of the build for a comparison
BETWEEN = 2.0  # prior ratio of the scatter between aircraft to that between flights
LAGS = 3  # flights over which residuals may be correlated
# Of Student's t: information of a flight relative to its scale.
INFLATION = (scatter.NU + 5.0) / (scatter.NU + 3.0)


@dataclass(frozen=True)
class History:
    """An aircraft's flights in order. rows: as `Store.trims` yields them. left_out (K,): why a flight is not used, or "". ended (K,): hours
    in the air when it ended. services: (index of the next flight, rotor 0-based or -1, row)."""

    key: str
    rows: tuple[Mapping, ...]
    left_out: tuple[str, ...]
    ended: np.ndarray
    services: tuple[tuple[int, int, Mapping], ...]

    @property
    def use(self) -> np.ndarray:
        """(K,) bool."""
        return np.array([not why for why in self.left_out], bool)


def assess(store: Store, progress: Callable | None = None) -> tuple[dict[str, dict], dict[str, dict]]:
    """Standing of every aircraft, and the points of its plot, by key. Nothing is written."""
    rows: dict[str, list[dict]] = {}
    for row in store.trims():
        rows.setdefault(row["aircraft"], []).append(row)
    services: dict[str, list[dict]] = {}
    for one in store.services():
        services.setdefault(one["aircraft"], []).append(one)
    return standings(rows, services, progress)


def refresh(store: Store, progress: Callable | None = None) -> None:
    """Compute all standings and store them, in one transaction."""
    seen = store.state()
    standings_, points = assess(store, progress)
    store.set_standings(standings_, points, seen)


def standings(
    rows: Mapping[str, Sequence[Mapping]], services: Mapping[str, Sequence[Mapping]], progress: Callable | None = None
) -> tuple[dict[str, dict], dict[str, dict]]:
    """`assess` from flights (key of the aircraft -> rows) and services alone."""
    histories = [history(key, list(rows[key]), services.get(key, ())) for key in sorted(rows)]
    builds: dict[str, list[History]] = {}
    for one in histories:
        builds.setdefault(_build(one), []).append(one)
    explained: dict[str, tuple[History, Series, Found, int]] = {}
    done = 0
    for build in sorted(builds):
        for one, series, found, sisters in _of_one_build(builds[build]):
            explained[one.key] = (one, series, found, sisters)
            done += 1
            if progress:
                progress(done / len(histories), "comparing")
    keys = sorted(explained)
    evidence = np.concatenate([explained[key][2].evidence for key in keys] or [np.zeros(0)])
    names = iter(false_discovery.named(evidence).tolist())
    found = {one.key: _unknown(one) for one in histories if one.key not in explained}
    points = {one.key: heard for one in histories if (heard := _heard(one))}
    for key in keys:
        one, series, what, sisters = explained[key]
        found[key] = _standing(one, series, what, sisters, [next(names) for _ in what.evidence])
        points[key] = points.get(key, {}) | _points(one, what)
    return found, points


def history(key: str, rows: list, services: Iterable[Mapping]) -> History:
    """Flights in order, and where services lie among them."""
    rows = listing.in_order(rows)
    n = max((r["rotors"] for r in rows), default=0)
    left_out = tuple(_why_not(r, n) for r in rows)
    ended = np.cumsum([max(float(r["airborne_s"]), 1.0) / 3600.0 for r in rows])
    cuts = sorted(((_place(rows, s), int(s["rotor"]) - 1, s) for s in services), key=lambda c: (c[0], c[2]["number"]))
    return History(key, tuple(rows), left_out, ended, tuple(cuts))


def _place(rows: Sequence[Mapping], service: Mapping) -> int:
    """Index of the first flight after a service: after the flight that it names, else after the last one known to be before it, by time or,
    without one, by order of addition."""
    utc, after = service["utc"], service["after"]
    named = [] if utc else [k for k, r in enumerate(rows) if r["ordinal"] == after]
    later = next((k for k, r in enumerate(rows) if utc and r["utc"] and r["utc"] >= utc), len(rows))
    before = [k for k, r in enumerate(rows[:later]) if (utc and r["utc"]) or r["ordinal"] <= after]
    return max(named or before, default=-1) + 1


def _why_not(row: Mapping, rotors: int) -> str:
    trim = row["trim"]
    reasons = {
        FELL: trim.get("lost"),
        f"diagnosed {row['verdict']} on its own": row["verdict"] not in TAUGHT_BY,
        "too little steady hover": not trim.get("share"),
        "its log is inconsistent": trim.get("doubt"),
        "different number of rotors": len(trim.get("share", ())) != rotors,
        "a rotor was at its limit": max(trim.get("limited", (0.0,))) > LIMITED,
    }
    return next((why for why, holds in reasons.items() if holds), "")


def _build(one: History) -> str:
    """The build of most of its flights."""
    all_of_them = [r["build"] for r in one.rows]
    return max(sorted(set(all_of_them)), key=all_of_them.count)


# One build


def _of_one_build(histories: list[History]) -> list[tuple[History, Series, Found, int]]:
    """Every aircraft of a build with a usable flight, explained."""
    known = [one for one in histories if one.use.any()]
    if not known:
        return []
    trims = [[r["trim"] for r, u in zip(one.rows, one.use) if u] for one in known]
    slope, slope_variance = _wind(t for one in trims for t in one)
    tables = [_table(one, slope, slope_variance) for one in known]
    B = np.median([t["effectiveness"] for one in trims for t in one], axis=0)
    share = np.mean([np.array(t["share"]) / np.sum(t["share"]) for one in trims for t in one], axis=0)
    G = share * (B[:3] - (B[:3] @ share)[:, None])
    prior = scatter.assumed(B)
    rows = [scatter.differences(y[one.use]) for one, (y, _) in zip(known, tables)]
    noise = [c[one.use][1:-1] for one, (_, c) in zip(known, tables)]
    together = scatter.scale(np.concatenate(rows), np.concatenate(noise), prior)
    series = []
    for one, (y, c), r, v in zip(known, tables, rows, noise):
        between = scatter.scale(r, v, together)
        starts = one.ended - np.diff(one.ended, prepend=0.0)
        cuts = tuple((k, rotor) for k, rotor, _ in one.services if k < len(y))
        series.append(Series(y, (between + c) * INFLATION, starts, G, one.use, cuts))
    first = [attribution.explain(s) for s in series]
    longer = _correlation_inflation([f.rest[s.use] for f, s in zip(first, series)])
    series = [replace(s, noise=s.noise * longer) for s in series]
    out = []
    for k, (one, s) in enumerate(zip(known, series)):
        others = [f for j, f in enumerate(first) if j != k]
        if len(others) >= SISTERS:
            s = _with_sisters(s, others, prior)
        out.append((one, s, attribution.explain(s), len(others)))
    return out


def _wind(trims: Iterable[Mapping]) -> tuple[np.ndarray, np.ndarray]:
    """(2,) common slopes of roll and pitch on the crosswise force, and the variance of one flight's own, with SLOPE_BETWEEN_SD as a prior
    worth as many flights as an assumed scatter."""
    all_of_them = list(trims)
    variance = np.square([t["slope_sd"] for t in all_of_them])
    slopes = np.array([t["slope"] for t in all_of_them])
    between = np.full(2, SLOPE_BETWEEN_SD**2)
    middle = np.zeros(2)
    for _ in range(5):
        middle, _ = student.weighted_mean(slopes, variance + between)
        # Each flight's slope is weighted by its precision; clipped against outliers.
        worth = between / (variance + between)
        beyond = np.minimum(np.square(slopes - middle), 9.0 * (variance + between)) - variance
        seen = (worth**2 * beyond).sum(axis=0) / np.maximum((worth**2).sum(axis=0), 1e-9)
        count = worth.sum(axis=0)
        prior = scatter.PRIOR_FLIGHTS * SLOPE_BETWEEN_SD**2
        between = np.maximum((prior + count * seen) / (scatter.PRIOR_FLIGHTS + count), 1e-4)
    return middle, between


def _table(one: History, slope: np.ndarray, slope_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """y (K, 3), without wind, and its covariance (K, 3, 3); unused flights have the median of the used ones."""
    K = len(one.rows)
    y, c = np.zeros((K, 3)), np.tile(np.eye(3) * 1e-6, (K, 1, 1))
    for k, (row, use) in enumerate(zip(one.rows, one.use)):
        if use:
            t = row["trim"]
            y[k] = t["wrench"] - of_wind(t["force"], slope)
            c[k] = np.array(t["covariance"]) + np.diag(of_wind(np.square(t["force"]), slope_variance))
    y[~one.use] = np.median(y[one.use], axis=0)
    return y, c


def _correlation_inflation(rest: Sequence[np.ndarray]) -> float:
    """Variance inflation by the correlation of successive flights: 1 + 2 sum of the autocorrelation of the residuals, over all aircraft."""
    rows = [np.clip(r - np.median(r, axis=0), -3.0, 3.0) for r in rest if len(r) > 2 * LAGS + 2]
    if not rows:
        return 1.0
    power = np.concatenate([r.ravel() ** 2 for r in rows]).mean()
    total = sum(np.concatenate([(r[lag:] * r[:-lag]).ravel() for r in rows]).mean() for lag in range(1, LAGS + 1))
    return float(np.clip(1.0 + 2.0 * total / max(power, 1e-12), 1.0, 1.0 + 2.0 * LAGS))


def _with_sisters(series: Series, others: Sequence[Found], prior: np.ndarray) -> Series:
    """The healthy level of the build, by the other aircraft, with less weight where they differ much."""
    levels = np.array([f.level for f in others])
    within = np.array([f.level_covariance for f in others])
    middle, between = np.median(levels, axis=0), BETWEEN**2 * prior
    for _ in range(5):
        between = scatter.scale(levels - middle, within, BETWEEN**2 * prior)
        u = student.weights(levels - middle, between + within, scatter.NU)
        middle = (u[:, None] * levels).sum(axis=0) / u.sum()
    return replace(series, level=middle, level_covariance=INFLATION * between * (1.0 + 1.0 / len(others)))


# In plain data


def _unknown(one: History) -> dict:
    """An aircraft without a usable flight."""
    rotor = {"status": "unknown", "loss": 0.0, "interval": [0.0, 1.0], "evidence": 0.0} | {"named": False, "prognosis": None}
    rotors = [{"rotor": k} | rotor for k in range(1, max((r["rotors"] for r in one.rows), default=0) + 1)]
    why = Counter(one.left_out).most_common(1)[0][0]
    headline = f"Its rotors are not assessed over time: no flight can be used ({why})."
    return _standing_of(one, 0, headline, {"worst": 0.0, "rotors": rotors, "changes": []})


def _standing_of(one: History, sisters: int, headline: str, table: Mapping) -> dict:
    """The standing with rotors `table`: with the state of the aircraft, its last flight and its flights' verdicts."""
    since = max((k for k, _, _ in one.services), default=0)
    verdicts = [r["verdict"] for r in one.rows]
    fell = [bool(r["trim"].get("lost")) for r in one.rows]
    last = {name: one.rows[-1][name] for name in ("hash", "name", "utc", "verdict")}
    return {
        "state": condition.of(verdicts[since:], fell[since:], [r["status"] for r in table["rotors"]]),
        "headline": " ".join(filter(None, (condition.flights(verdicts[since:], fell[since:]), headline))),
        "last": last,
        "flights": len(one.rows),
        "used": int(one.use.sum()),
        "hours": round(float(one.ended[-1]), 4) if len(one.ended) else 0.0,
        "build": _build(one),
        "sisters": sisters,
        "left_out": [{"hash": r["hash"], "name": r["name"], "why": w} for r, w in zip(one.rows, one.left_out) if w],
        "services": [{"before_flight": k + 1, "rotor": r + 1, "what": s["what"], "utc": s["utc"] or None} for k, r, s in one.services],
    } | dict(table)


def _standing(one: History, series: Series, found: Found, sisters: int, named: list[bool]) -> dict:
    rotors = [_rotor(one, series, found, i, named[i]) for i in range(len(found.now))]
    changes = [_change(one, found, k) for k in range(len(found.atoms))]
    table = {"worst": _round(found.evidence.max()), "rotors": rotors, "changes": changes}
    return _standing_of(one, sisters, _headline(table), table)


def _rotor(one: History, series: Series, found: Found, i: int, named: bool) -> dict:
    n = len(found.now)
    mine = [k for k, a in enumerate(found.atoms) if a.rotor == i]
    since = series.cuts(i)[-2]
    live = [k for k in mine if found.atoms[k].start >= since]
    e, sd = float(found.now[i]), float(found.now_sd[i])
    unsure = [k for k in mine if found.candidates[k].get(i, 0.0) < DAMAGED]
    sure = len(mine) > len(unsure)
    status = "healthy" if not mine else "restored" if sure and named else "suspect"
    if status == "restored" and live and e >= 1.96 * sd:
        lost = any(found.atoms[k].kind == STEP and float(found.coefficients[k][0]) > 0.0 for k in live)
        worn = any(found.atoms[k].kind == WORN for k in live)
        status = "damaged" if lost else "worn" if worn else "restored"
    low, high = (e - 1.96 * sd, e + 1.96 * sd) if live else (0.0, float(found.hidden[i]))
    # After a service since the last flight the rotor's state is unknown.
    if any(k >= len(one.rows) and r in (i, -1) for k, r, _ in one.services):
        status, e, low, high = "serviced", 0.0, 0.0, 0.0
    return {
        "rotor": i + 1,
        "status": status,
        "named": bool(named and sure),
        "loss": _round(attribution.loss(max(e, 0.0), n)),
        "interval": [_round(attribution.loss(max(v, 0.0), n)) for v in (low, high)],
        "evidence": _round(float(found.evidence[i])),
        "candidates": sorted({c + 1 for k in unsure for c, p in found.candidates[k].items() if p > MENTIONED and c >= 0}),
        "or_centre_of_mass": any(found.candidates[k].get(-1, 0.0) > MENTIONED for k in unsure),
        "prognosis": _prognosis(one, series, found, i),
    }


def _prognosis(one: History, series: Series, found: Found, i: int) -> dict:
    outlook = prognosis.foresee(attribution.lines(series, found, i), float(one.ended[-1]))
    table = {k: _round(v) for k, v in outlook.to_dict().items()}
    mean = float(one.ended[-1]) / len(one.rows)
    table["flights_left"] = None if outlook.hours is None else int(np.ceil(outlook.hours / mean))
    return table


def _change(one: History, found: Found, k: int) -> dict:
    atom, value = found.atoms[k], found.coefficients[k]
    first, last = found.when[k]
    row = one.rows[atom.start]
    kind = {CENTRE: "centre of mass", WORN: "wear", STEP: "loss" if float(value[0]) > 0.0 else "gain"}[atom.kind]
    shares = sorted(found.candidates[k].items(), key=lambda c: -c[1])
    return {
        "kind": kind,
        "rotor": atom.rotor + 1 if atom.rotor >= 0 else None,
        "flight": atom.start + 1,
        "between": [first + 1, last + 1],
        "hash": row["hash"],
        "name": row["name"],
        "utc": row["utc"],
        "from_the_first": atom.start == 0,
        "size": _round(_size(atom, value, found)),
        "candidates": [{"rotor": r + 1 if r >= 0 else None, "probability": _round(p)} for r, p in shares],
    }


def _size(atom: Any, value: np.ndarray, found: Found) -> Any:
    """A step as a loss (a gain below 0); wear as loss per hour; a shift of the centre as it is."""
    if atom.kind != STEP:
        return value.tolist() if atom.kind == CENTRE else float(value[0])
    return float(np.copysign(attribution.loss(abs(value[0]), len(found.now)), value[0]))


def _headline(table: Mapping) -> str:
    sentences = []
    for r in table["rotors"]:
        if r["status"] in ("worn", "damaged"):
            of_rotor = [c for c in table["changes"] if c["rotor"] == r["rotor"] and c["kind"] in ("wear", "loss")]
            since = f" since flight {of_rotor[-1]['flight']}" if of_rotor and not of_rotor[-1]["from_the_first"] else ""
            low, high = (100 * x for x in r["interval"])
            text = f"Rotor {r['rotor']} is {r['status']}{since}: {100 * r['loss']:.0f} % of its thrust lost ({low:.0f} to {high:.0f} %)"
            sentences.append(text + _outlook(r["prognosis"]) + ".")
        elif r["status"] == "suspect":
            others = [str(c) for c in r["candidates"] if c != r["rotor"]]
            alternatives = [*(f"rotor {c}" for c in others), *(["a shifted centre of mass"] if r["or_centre_of_mass"] else [])]
            else_ = ", or it is " + " or ".join(alternatives) if alternatives else ", but not beyond doubt"
            sentences.append(f"Rotor {r['rotor']} may have lost thrust{else_}.")
    return " ".join(sentences) or "No rotor has lost thrust over its flights."


def _outlook(p: Mapping) -> str:
    if p["word"] != "growing" or p["hours_left"] is None:
        return ""
    low, high = p["hours_left_interval"]
    until = f"{low:.1f} to {high:.1f} h" if high is not None else f"{low:.1f} h or later"
    return f"; {100 * p['limit']:.0f} % in about {p['hours_left']:.1f} h in the air ({until})"


def _heard(one: History) -> dict:
    """`imbalance`: of every flight that of each rotor with its interval, or None, in one `unit`, the last; empty where no flight was
    heard."""
    heard = [r["trim"].get("imbalance") for r in one.rows]
    unit = next((h["unit"] for h in reversed(heard) if h), None)
    return {"unit": unit, "imbalance": [h["rotors"] if h and h["unit"] == unit else None for h in heard]} if unit else {}


def _points(one: History, found: Found) -> dict:
    """For every flight: hash, utc, hours in the air when it ended, whether it was used, each rotor's loss by it alone and its deviation."""
    n, lost = len(found.now), _round(attribution.loss(found.own, len(found.now)).tolist())
    return {
        "hash": [r["hash"] for r in one.rows],
        "utc": [r["utc"] for r in one.rows],
        "hours": _round(one.ended.tolist()),
        "used": one.use.tolist(),
        "loss": [row if use else None for row, use in zip(lost, one.use)],
        "sd": _round(found.own_sd.tolist()),
        "explained": _round(attribution.loss(found.e, n).tolist()),
    }


def _round(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_round(v) for v in value]
    if value is None or isinstance(value, (str, bool, int)):
        return value
    return float(f"{float(value):.5g}")
