"""A published method's own estimate on a log: losses, states and innovations over time with the method's own interval or set; several
methods beside each other. Nothing is decided here; `diagnose --estimator` decides on the same series."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import logs
from rotorwatch.base import discovery, files, optional
from rotorwatch.errors import ConfigError, LogError
from rotorwatch.flight import Flight
from rotorwatch.flight.method_series import MethodSeries
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.logs import plausible
from rotorwatch.toolkit import Given, aerobatic, baselines, prepare
from rotorwatch_lab.published import conformal, helicopter_log, log_plant, paper_log, published
from rotorwatch_lab.published.published import Tuning

SCHEMA = 1
TABLES, PICTURES, PAGES = (".csv", ".parquet", ".json"), (".png", ".svg", ".pdf"), (".html",)
ENDINGS = (*TABLES, *PICTURES, *PAGES)
PLANTS = ("rates", "paper", "both")


Truth = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""theta's name (loss_3, ..) -> (times s, values): what it truly was from each time on; 0 before the first, and where it has no entry."""


def steps(segments: Iterable[tuple[str, float, float, float]]) -> Truth:
    """The truth of segments (name, value, start s, end s), in the order of time."""
    out: dict[str, list[tuple[float, float]]] = {}
    for name, value, start, end in sorted(segments, key=lambda row: row[2]):
        rows = out.setdefault(name, [])
        if rows and rows[-1][0] >= start:  # one that ends where the next begins
            rows.pop()
        rows += [(start, value), (end, 0.0)]
    return {name: (np.array(rows)[:, 0], np.array(rows)[:, 1]) for name, rows in out.items()}


@dataclass(frozen=True)
class Estimates:
    """What methods say of one log. log: its name. series: of each method, in the order asked for. failed: method -> why it could not run.
    truth: what is known, for pictures and coverage; None where nothing is. found: of a helicopter, method -> actuator -> estimates at the
    end (`helicopter_log.summary`)."""

    log: str
    series: tuple[MethodSeries, ...]
    failed: Mapping[str, str] = field(default_factory=dict)
    truth: Truth | None = None
    found: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __getitem__(self, method: str) -> MethodSeries:
        """The series of that method, of its first plant. Raises KeyError."""
        return {s.method: s for s in reversed(self.series)}[method]

    def true(self, series: MethodSeries) -> np.ndarray | None:
        """(T, n) true theta at the steps of a series; None where no truth is known."""
        if self.truth is None:
            return None
        out = np.zeros(series.theta.shape)
        for name, (times, values) in self.truth.items():
            if name in series.theta_names:
                at = np.searchsorted(times, series.time, side="right") - 1
                out[:, series.theta_names.index(name)] = np.where(at >= 0, values[np.maximum(at, 0)], 0.0)
        return out

    def coverage(self, series: MethodSeries) -> np.ndarray | None:
        """(n,) share of the steps with a measurement in which the method's own interval or bound holds the truth; None without truth."""
        true = self.true(series)
        if true is None:
            return None
        seen = series.status == 0
        return np.mean((series.lower <= true) & (true <= series.upper), axis=0, where=seen[:, None]) if seen.any() else None

    def notes(self) -> dict[str, str]:
        """What the figures rest on, a sentence each -> the methods it is said of."""
        out: dict[str, list[str]] = {}
        for s in self.series:
            for note in s.notes:
                out.setdefault(note, []).append(s.method)
        return {note: ", ".join(dict.fromkeys(who)) for note, who in out.items()}

    def columns(self) -> dict[str, np.ndarray]:
        """Name -> values, the table of all methods, one after the other: `method`, `plant`, those of `MethodSeries.columns`, and
        `true_loss_1` .. where the truth is known; NaN where a plant has no such column."""
        tables, names = [], ["method", "plant"]
        for s in self.series:
            table: dict[str, np.ndarray] = {
                "method": np.full(len(s.time), s.method), "plant": np.full(len(s.time), s.plant), **s.columns()
            }  # fmt: skip
            true = self.true(s)
            if true is not None:
                table |= {f"true_{name}": true[:, k] for k, name in enumerate(s.theta_names)}
            tables.append(table)
            names += [name for name in table if name not in names]
        return {n: np.concatenate([t.get(n, np.full(len(t["time_s"]), np.nan)) for t in tables]) for n in names}

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON (docs/estimate.md); never NaN or Infinity."""
        methods = []
        for s in self.series:
            one, coverage, true = s.to_dict(), self.coverage(s), self.true(s)
            if s.factor is not None:
                one["factor"] = s.factor
            if coverage is not None:
                one["coverage"] = dict(zip(s.theta_names, map(float, coverage)))
            if true is not None:
                one["series"] |= {f"true_{name}": true[:, k].tolist() for k, name in enumerate(s.theta_names)}
            methods.append(one | ({"actuators": dict(self.found[s.method])} if s.method in self.found else {}))
        return {"schema": SCHEMA, "log": self.log, "methods": methods, "failed": dict(self.failed)}

    def to_pandas(self):
        """The table of `columns` as a pandas DataFrame. Raises ConfigError where pandas is not installed."""
        return optional.library("pandas", "to_pandas").DataFrame(self.columns())

    def to_html(self, path: str | PathLike) -> None:
        """A page with the methods over each other, that opens offline. Raises ConfigError where Bokeh is not installed."""
        from rotorwatch_lab import methods_page as methods

        with files.replacing(path) as unfinished:
            unfinished.write_text(methods.page(self), encoding="utf-8")

    def plot(self, path: str | PathLike | None = None) -> Any:
        """The same as `figure`."""
        return self.figure(path)

    def figure(self, path: str | PathLike | None = None) -> Any:
        """The losses of every method with its interval or bound, one over the other, as a matplotlib figure; written to `path` (.png, .svg,
        .pdf) when given. Raises ConfigError where matplotlib is not installed."""
        from rotorwatch_lab import methods_page as methods

        return methods.figure(self, path)

    def write(self, path: str | PathLike) -> None:
        """Write a table (.csv, .parquet, .json), a picture (.png, .svg, .pdf) or a page (.html): all of it or nothing. Raises
        ConfigError."""
        path = writable(path)
        kind = path.suffix.lower()
        if kind in PAGES:
            self.to_html(path)
        elif kind in PICTURES:
            self.figure(path)
        elif kind == ".parquet":
            pa, _ = (optional.library("pyarrow", "A .parquet file"), optional.library("pyarrow.parquet", "A .parquet file"))
            with files.replacing(path) as unfinished:
                pa.parquet.write_table(pa.table(self.columns()), unfinished)
        elif kind == ".json":
            text = json.dumps(self.to_dict(), indent=1, allow_nan=False)
            with files.replacing(path) as unfinished:
                unfinished.write_text(text + "\n", encoding="utf-8")
        else:
            columns = self.columns()
            with files.replacing(path) as unfinished, open(unfinished, "w", newline="", encoding="utf-8") as file:
                out = csv.writer(file)
                out.writerow(columns)
                for row in zip(*(values.tolist() for values in columns.values())):
                    out.writerow("" if value != value else value for value in row)

    def __repr__(self) -> str:
        return f"<Estimates of {self.log or 'a flight'}: {', '.join(s.title for s in self.series) or 'none'}>"


def writable(path: str | PathLike) -> Path:
    """The path, when results can be written there. Raises ConfigError for another ending, a folder, or a library that is missing."""
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in ENDINGS:
        raise ConfigError(f"--out {path}: give a name that ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}.")
    needs = {".parquet": "pyarrow.parquet", ".html": "bokeh"} | dict.fromkeys(PICTURES, "matplotlib.figure")
    if kind in needs:
        optional.library(needs[kind], f"A {kind} file")
    return files.writable(path, "--out")


def _stem(log: str) -> str:
    return Path(log).name.removesuffix(".xz").removesuffix(".gz")


def read_truth(path: str | PathLike, log: str) -> Truth:
    """What a CSV file says of the log of that name: as `rotorwatch simulate` writes it beside the log (time_s, and columns such as loss_3),
    or a table with a line for each log: path, faulty_rotors (1+2), thrust_loss, start_s, and end_s or faults (rotors:loss:start:end;..)
    where known. Raises ConfigError for another file, a log that it does not name and a loss that it does not know."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            table = csv.DictReader(file)
            rows, names = list(table), list(table.fieldnames or ())
        if "time_s" in names:
            time = np.array([float(row["time_s"]) for row in rows])
            columns = {n: np.array([float(row[n]) for row in rows]) for n in names if n.startswith(("loss_", "bias_"))}
            return {name: (time, values) for name, values in columns.items()}
        if not {"path", "faulty_rotors", "thrust_loss", "start_s"} <= set(names):
            raise ConfigError(f"{path} needs the columns time_s and loss_1 .., or path, faulty_rotors, thrust_loss and start_s.")
        row = next((row for row in rows if _stem(row["path"] or "") == _stem(log)), None)
        if row is None:
            raise ConfigError(f"{path} has no line for {log}; its column path holds names of logs.")
        if row["thrust_loss"] == "?":
            raise ConfigError(f"{path} does not know the loss in {log}.")
        faults = row.get("faults") or ":".join((row["faulty_rotors"], row["thrust_loss"], row["start_s"], row.get("end_s") or "inf"))
        found = [part.split(":") for part in faults.split(";") if row["faulty_rotors"]]
        return steps((f"loss_{int(r)}", float(loss), float(a), float(b)) for who, loss, a, b in found for r in who.split("+"))
    except OSError as why:
        raise ConfigError(f"Cannot read the truth {path}: {why.strerror or why}.") from None
    except (ValueError, TypeError, csv.Error):
        raise ConfigError(f"The truth {path} holds something that is no number, or no table of commas and lines.") from None


def estimate(
    flight: Flight | str | PathLike,
    method: Any = (),
    *,
    vehicle: Vehicle | str | PathLike | None = None,
    baseline: Given | Iterable[Given] = (),
    plant: str = "rates",
    tuning: Tuning | None = None,
    airframe: str | None = None,
    lag_s: float = helicopter_log.LAG_S,
    truth: Truth | str | PathLike | None = None,
    calibrated: bool = False,
    progress: Callable | None = None,
) -> Estimates:
    """What published methods themselves say of a log: losses, states and innovations over time, with their own intervals or sets.

    flight: a Flight or a log file. method: one estimator or several (names, `module:Class`, classes, instances: `discovery.estimator`).
    vehicle, baseline: as for `diagnose`. plant: "rates", rotational dynamics identified from the flight, on which any method runs;
    "paper", the plant that each method's paper has (docs/estimate.md), with numbers from the vehicle's `extra`; or "both".
    tuning: of a single method (`rotorwatch.tune`).
    airframe: of a helicopter's log: the name of one that a paper describes (ruav-40kg), or an airframe file; lag_s: of its actuators.
    truth: what is known of the flight, for pictures and coverage: see `Truth`, or a file as of `read_truth`.
    calibrated: widen the intervals of losses on the plant "rates" by measured factors, so that they hold (docs/estimate.md).
    progress: called as progress(share, text). A method that cannot run on this flight stands in `failed`; if none can, its sentence is
    raised. Raises LogError, VehicleError or ConfigError.
    """
    tell = progress or (lambda share, text="": None)
    names = list(method) if isinstance(method, (list, tuple)) else [method]
    if not names:
        raise ConfigError(f"Name a method; known are {', '.join(name for name in discovery.estimators() if name != 'default')}.")
    for name in names:
        discovery.estimator(name)
    titles = [discovery.title(name) for name in names]
    if calibrated and (airframe is not None or plant != "rates" or tuning is not None):
        raise ConfigError("Calibrated intervals are for methods as they are, on multirotors and the plant rates: leave the others out.")
    if twice := next((t for k, t in enumerate(titles) if t in titles[:k]), None):
        raise ConfigError(f"The method {twice} is named twice; name each once.")
    if tuning is not None and len(names) > 1:
        raise ConfigError("A tuning belongs to one method; name that one alone.")
    if plant not in PLANTS:
        raise ConfigError(f"plant must be {' or '.join(PLANTS)}, not {plant!r}.")
    if airframe is not None and (vehicle is not None or baseline or tuning is not None or plant != "rates"):
        raise ConfigError(
            "An airframe is of a helicopter; vehicle, baseline, tuning and plant are of multirotors: leave one or the other out."
        )
    if airframe is not None:
        helicopter_log.helicopter(airframe)
    if not isinstance(flight, Flight):
        flight = logs.read(flight, lambda share: tell(0.2 * share, "reading"))
    flight = plausible.checked(flight)
    if isinstance(truth, (str, PathLike)):
        truth = read_truth(truth, flight.name)
    actuators: dict[str, Any] = {}
    plants = (
        _helicopter(flight, airframe, lag_s, actuators) if airframe is not None else _multirotor(flight, vehicle, baseline, plant, tuning)
    )
    found, failed = [], {}
    for k, (name, title) in enumerate(zip(names, titles)):
        at = lambda share, k=k, title=title: tell(0.2 + 0.8 * (k + share) / len(names), title)  # noqa: E731
        at(0.0)
        for run in plants:
            try:
                series = run(name, at)
                found.append(conformal.calibrated(series) if calibrated else series)
            except ConfigError as why:
                if len(names) == len(plants) == 1:
                    raise
                failed[title] = str(why)
    if not found:
        raise ConfigError(next(iter(failed.values())))
    tell(1.0, "done")
    return Estimates(flight.name, tuple(found), failed, truth, actuators)


Runs = tuple[Callable[[Any, Callable], MethodSeries], ...]
"""For each plant (method, progress) -> its series."""


def _multirotor(flight: Flight, vehicle, baseline, plant: str, tuning: Tuning | None) -> Runs:
    """Methods on the rotors of a flight."""
    vehicle = baselines.vehicle_of(vehicle)
    aerobatic.decline(flight, "the published methods model hover.", vehicle)
    ready, log = prepare(flight, vehicle, baseline), flight.name or "The log"
    table, B = ready.table, ready.vehicle.effectiveness()
    if table is None:
        raise LogError(
            f"{log} was never in the air with motor outputs, so that there is nothing to estimate; `rotorwatch info` shows what it holds."
        )
    hops = log_plant.hops(table, B, ready.dynamics)
    if not hops:
        raise LogError(
            f"{log} is too short to estimate on: the first {ready.ready_s:.0f} s in the air teach the plant, and nothing is left."
        )

    def rates(name: Any, progress: Callable) -> MethodSeries:
        if discovery.title(name) == "default":
            return published.default(table, B, ready.dynamics, progress)
        return published.itself(name, table, B, hops, tuning, progress)

    def paper(name: Any, progress: Callable) -> MethodSeries:
        return paper_log.estimate(name, ready.flight, ready.vehicle, table, hops, progress)

    return {"rates": (rates,), "paper": (paper,), "both": (rates, paper)}[plant]


def _helicopter(flight: Flight, airframe: str, lag_s: float, actuators: dict[str, Any]) -> Runs:
    """Methods on the actuators of a helicopter's flight; `actuators` is filled."""

    def one(name: Any, progress: Callable) -> MethodSeries:
        found = helicopter_log.estimate(flight, airframe, name, lag_s, progress)
        actuators[found.itself.method] = helicopter_log.summary(found)
        return found.itself

    return (one,)
