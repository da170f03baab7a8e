"""The benchmark: fixed flights that any method can be tried on, and scores that mean the same for all of them.

    from rotorwatch_lab.campaign import benchmark
    results = benchmark.run("quick", ["ekf", "my_package.my_module:Mine"], "results.json")

Flights, assessing, statistics and the folder of finished parts are the campaign's. See docs/benchmark.md.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import __version__, airframes, detectors
from rotorwatch.base import discovery, files
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError
from rotorwatch_lab.campaign import batch, public_data, results_file, summary, work
from rotorwatch_lab.campaign.benchmark_plan import Benchmark, digest, read, shipped
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.campaign.score import COLUMNS
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.experiments.studies import compare, compare_flights
from rotorwatch_lab.published import origin, published
from rotorwatch_lab.simulation import logbook, truth
from rotorwatch_lab.simulation.scenario import brief
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

__all__ = ["Benchmark", "export", "known_methods", "parts_of", "read", "run", "selected_methods", "shipped", "try_out"]
REPEATS = 7  # of the table that a step is timed over


class Method(NamedTuple):
    """A method under test. label: the name it was selected by, used in rows of results; kind: "estimator" or "detector"."""

    label: str
    name: str
    kind: str
    about: str
    source: origin.Source

    @property
    def whose(self) -> str:
        """The method and its package, for sentences."""
        return f"The {self.kind} {self.name} of the package {self.source.package} {self.source.version}".rstrip()


def known_methods() -> list[Method]:
    """All methods that are installed, estimators first; a broken one of another package is left out, with a PluginWarning."""
    return [
        *(_method(name, "estimator", kind) for name, kind in discovery.estimators().items()),
        *(_method(rule.name, "detector", rule) for rule in detectors.modules()),
    ]


def selected_methods(names: Sequence[str]) -> list[Method]:
    """The methods of these names, or of package.module:Class; all that are installed when there are none, or for "all". Raises
    ConfigError."""
    if not names or list(names) == ["all"]:
        return known_methods()
    rules = {rule.name: rule for rule in detectors.modules()}
    selected: list[Method] = []
    for name in dict.fromkeys(names):
        if name in rules:
            selected.append(_method(name, "detector", rules[name]))
        elif ":" in name or name in discovery.names():
            selected.append(_method(name, "estimator", discovery.estimator(name)))
        else:
            known = [*discovery.names(), *rules]
            unknown = f"There is no method called {brief(name)}{meant(name, known)}"
            raise ConfigError(f"{unknown}; known are {', '.join(known)}, and package.module:Class.")
        twin = next((m for m in selected[:-1] if m.name == selected[-1].name), None)
        if twin:
            raise ConfigError(f"Two methods call themselves {twin.name} ({twin.label} and {name}): give one of them another name.")
    return selected


def _method(label: str, kind: str, implementation: Any) -> Method:
    return Method(label, implementation.name, kind, origin.about(implementation), origin.source(implementation))


def try_out(method: Method) -> str | None:
    """The reason why an estimator cannot run on a vehicle's plant, as a sentence, or None: it is constructed and one step is traced."""
    if method.kind == "detector" or method.name == "default":
        return None
    jax = load_jax()
    plant = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    n_u, n_y, n = plant.n_u, plant.n_y, plant.n_theta
    try:
        estimator = published.method(method.label, plant, 0.1)
        carry = jax.tree.map(np.asarray, estimator.init())
        new, out = jax.eval_shape(estimator.step, carry, np.ones(n_u), np.zeros(n_y), np.ones(n_y, bool))
        shapes = [(a.shape, a.dtype) for a in jax.tree.leaves(carry)]
        if jax.tree.structure(new) != jax.tree.structure(carry) or [(a.shape, a.dtype) for a in jax.tree.leaves(new)] != shapes:
            return f"{method.whose} returns from step another carry than init makes: shapes and types must stay the same."
        estimate = getattr(out, "estimate", out)
        wanted = {"theta": (n,), "theta_cov": (n, n), "innovation": (n_y,), "innovation_cov": (n_y, n_y), "status": ()}
        for part, shape in wanted.items():
            if not hasattr(estimate, part):
                return f"{method.whose} returns from step no {part}: return a rotorwatch.core.Estimate."
            if tuple(getattr(estimate, part).shape) != shape:
                returned = tuple(getattr(estimate, part).shape)
                return f"{method.whose} returns {part} of the shape {returned}; on a plant of {n} rotors it must be {shape}."
    except Exception as why:  # a stranger's method may raise anything
        return _sentence(method, why)
    return None


def _sentence(method: Method, why: Exception) -> str:
    reason = str(why).rstrip(".") if isinstance(why, ConfigError) else discovery.brief(why).rstrip(".")
    return f"{method.whose} fails: {reason}."


def run(
    plan: str | os.PathLike | Benchmark = "quick",
    methods: Sequence[str] = (),
    out: str | os.PathLike = "benchmark.json",
    jobs: int | None = None,
    data: Sequence[tuple[str, str | os.PathLike]] = (),
    progress: work.Progress | None = None,
    notify: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Run methods on a benchmark's flights and on public data; returns the contents of `out` (format: results_file.py).

    plan: a name of `shipped`, a file, or a Benchmark. methods: names, or package.module:Class; none: all installed ones, and those that
    cannot run are listed with the reason, while a named one that cannot is an error. jobs: processes. data: (name, path) of public data
    sets (public_data.py). progress(done, flights, flights a second). notify: receives messages on methods that fail during the run.
    Finished parts are kept in `parts_of(out)`: the same call resumes an interrupted run. Raises ConfigError.
    """
    benchmark = plan if isinstance(plan, Benchmark) else read(plan)
    files.writable(out, "--out")
    sets = [public_data.read(name, path) for name, path in data]
    wanted = selected_methods(methods)
    failed = {m.label: why for m in wanted if (why := try_out(m))}
    if methods and list(methods) != ["all"] and failed:
        raise ConfigError(next(iter(failed.values())))
    running = [m for m in wanted if m.label not in failed]
    folder = parts_of(out)
    entered = _entered(benchmark, running)
    _same_run(folder, entered)
    assess = Assessor(os.fspath(folder), tuple(running))
    table = work.run(entered, benchmark.flights, folder, jobs, progress, assess)
    for label, why in assess.failed().items():
        failed[label] = why
        if notify:
            notify(why)
    columns = summary.arrays(table)
    scenes = compare_flights.simulated(1, (), frames=compare_flights.AIRFRAMES[:1])  # steps of a quad are timed
    entries = []
    for method in wanted:
        scored = None
        if method.label not in failed:
            scored = scores(summary.of_method(columns, method.label), benchmark) | {"us_per_step": cost(method, scenes)}
        entries.append(_entry(method, scored, failed.get(method.label)))
    results = {
        "format": results_file.FORMAT, "format_version": results_file.VERSION, "rotorwatch": __version__,
        "plan": {
            "name": benchmark.plan.name, "version": benchmark.version, "sha256": benchmark.sha256, "flights": benchmark.flights,
            "false_alarms_h": benchmark.false_alarms_h, "within_s": benchmark.within_s, "text": benchmark.text,
        },
        "machine": machine(), "methods": entries,
        "data": [_on_data(data_set, [m for m in running if m.label not in failed], benchmark, notify) for data_set in sets],
    }  # fmt: skip
    results_file.write(results, out)
    return results


def export(
    plan: str | os.PathLike | Benchmark, folder: str | os.PathLike, progress: Callable[[float, str], Any] | None = None
) -> list[Path]:
    """Write a benchmark's flights for methods of other programs, and return the files: each log with its losses over time (.truth.csv, as
    `rotorwatch compare --truth` reads them), plan.toml, and SHA256SUMS of them all. folder: a new or empty one. progress(share, text).
    Raises ConfigError."""
    benchmark, place = plan if isinstance(plan, Benchmark) else read(plan), Path(folder)
    if place.exists() and (not place.is_dir() or any(place.iterdir())):
        raise ConfigError(f"{folder} holds something already; give a new folder.")
    place.mkdir(parents=True, exist_ok=True)
    suffixes = {autopilot: suffix for suffix, autopilot in reversed(logbook.SUFFIXES.items())}
    (place / "plan.toml").write_text(benchmark.text, encoding="utf-8")
    written, width = [place / "plan.toml"], batch.width()
    for numbers in tools.batches(benchmark.flights, len(benchmark.plan.cells), width):
        for number, scenario, flown, record in batch.simulated(benchmark.plan, numbers, width):
            stem = place / f"{number:05d}"
            log = stem.with_suffix(suffixes[scenario.autopilot])
            logbook.write(scenario, flown, record, log)
            table = stem.with_suffix(".truth.csv")
            stride = max(1, round(1.0 / truth.HZ / float(record.time[1] - record.time[0])))
            names = ["time_s", *(f"loss_{k + 1}" for k in range(record.theta.shape[1]))]
            truth.write_csv(table, names, np.column_stack([record.time, record.theta])[::stride])
            written += [log, table]
            if progress:
                progress((len(written) - 1) / (2 * benchmark.flights), log.name)
    written.sort()
    sums = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in written]
    (place / "SHA256SUMS").write_text("".join(sums), encoding="utf-8")
    return [*written, place / "SHA256SUMS"]


def parts_of(out: str | os.PathLike) -> Path:
    """The folder beside the results in which finished parts are kept."""
    return Path(out).with_suffix(".parts")


def _entered(benchmark: Benchmark, methods: Sequence[Method]) -> Plan:
    """The campaign's plan with these methods. Its text, by which the folder knows it, names them with their versions."""
    versions = "".join(f"\n# {m.label} {m.source.package} {m.source.version}" for m in methods)
    names = {kind: tuple(m.label for m in methods if m.kind == kind) for kind in ("estimator", "detector")}
    return replace(benchmark.plan, estimators=names["estimator"], detectors=names["detector"], text=benchmark.text + versions + "\n")


def _same_run(folder: Path, entered: Plan) -> None:
    plan_file = folder / "plan.toml"
    if plan_file.is_file() and plan_file.read_bytes() != entered.text.encode():
        raise ConfigError(f"{folder} holds parts of a run with another plan or other methods: delete that folder or give another --out.")


@dataclass(frozen=True)
class Assessor:
    """Makes rows of flights (`work.Assessor`). A method that raises is left out from then on, and its message is kept in the folder."""

    folder: str
    methods: tuple[Method, ...]

    def __call__(self, plan: Plan, flights: Sequence[int], size: int) -> list[dict]:
        failed_before = self.failed()
        left = replace(
            plan,
            estimators=tuple(e for e in plan.estimators if e not in failed_before),
            detectors=tuple(d for d in plan.detectors if d not in failed_before),
        )
        flown = batch.fly(plan, flights, size)
        return batch.rows(left, flown, size, self.note) if flown else []

    def note(self, label: str, why: Exception) -> None:
        """Keep what a method raised."""
        k = [m.label for m in self.methods].index(label)
        sentence = _sentence(self.methods[k], why)
        with files.replacing(Path(self.folder) / f"failed-{k}.json") as unfinished:
            unfinished.write_text(json.dumps([label, sentence]))

    def failed(self) -> dict[str, str]:
        """Label -> sentence of the methods that raised."""
        return dict(json.loads(path.read_text()) for path in sorted(Path(self.folder).glob("failed-*.json")))


def scores(d: dict[str, np.ndarray], benchmark: Benchmark) -> dict[str, Any]:
    """Scores of a method from its rows: each {"value", "low", "high", "n"} with its 95 % interval, or None."""
    usual, at_rate = summary.measures(d), summary.at_rate(d, benchmark.false_alarms_h, benchmark.within_s)
    return {
        "flights": usual["flights"], "clear_faults": usual["clear_faults"], "healthy_h": usual["healthy_h"],
        "threshold": at_rate["threshold"], "false_alarms_h": at_rate["false_alarms_h"], "detected": at_rate["detected"],
        "delay_s": at_rate["delay_s"], "own_false_alarms_h": usual["false_alarms_h"], "own_detected": usual["detected"],
        "own_delay_s": usual["delay_s"], "right": usual["right"], "loss_rmse": usual["loss_rmse"], "coverage": usual["coverage"],
        "found_flights": at_rate["found"], "right_flights": summary.numbers(d, d["clear"].astype(bool) & (d["right"] == True)),  # noqa: E712
        "size_errors": summary.size_errors(d),
    }  # fmt: skip


def cost(method: Method, scenes: Sequence[compare_flights.Scene]) -> dict[str, float] | None:
    """Microseconds of one step of a quad in a compiled loop, the median of REPEATS; None for detectors, which have no step."""
    if method.kind == "detector":
        return None
    return summary.boot(compare.timings(method.label, scenes, REPEATS), np.median)


def _entry(method: Method, scored: dict[str, Any] | None, failed: str | None) -> dict[str, Any]:
    about = {"name": method.name, "kind": method.kind, "about": method.about, **method.source._asdict()}
    return {**about, "failed": failed, "scores": scored}


def _on_data(data_set: public_data.DataSet, methods: Sequence[Method], benchmark: Benchmark, notify: Callable | None) -> dict[str, Any]:
    """Results on one data set."""
    entered, reasons = _entered(benchmark, methods), {}

    def note(label: str, why: Exception) -> None:
        reasons[label] = _sentence(next(m for m in methods if m.label == label), why)
        if notify:
            notify(reasons[label])

    rows, left_out = public_data.assess(data_set, entered, note)
    columns = {key: summary.column([row[key] for row in rows], kind) for key, (kind, _) in COLUMNS.items()}
    entries = []
    for method in methods:
        own_rows = summary.of_method(columns, method.label)
        fine = method.label not in reasons and len(own_rows["method"])
        entries.append(_entry(method, scores(own_rows, benchmark) if fine else None, reasons.get(method.label)))
    return {
        "name": data_set.name, "index_sha256": digest(data_set.text), "logs": len(data_set.logs), "left_out": left_out,
        "methods": entries,
    }  # fmt: skip


def machine() -> str:
    """Description of this machine in one line, for the measured computing times."""
    system = f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors"
    return f"{system}, Python {platform.python_version()}, JAX {load_jax().__version__}, {batch.where()}"
