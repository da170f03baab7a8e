"""Plans: the flights of a campaign as a TOML file. A scenario whose fields may be drawn at random, and the possible faults.

    name = "small multirotors"
    seed = 1
    healthy = 0.3                                  # share of flights without a fault
    estimators = ["default", "ekf"]
    detectors = ["ardupilot-thrust-loss"]

    [[decisions]]                                  # thresholds behind published estimators; without any: the usual one
    name = "strict"
    sigmas = 7.0

    [scenario]                                     # any field of a scenario (docs/simulation.md), or how to draw it
    duration_s = 60.0
    [scenario.airframe]
    frame = { choice = ["quad-x", "hexa-x"] }
    [scenario.wind]
    speed_m_s = { uniform = [0.0, 8.0] }

    [[faults]]                                     # one of these in every flight that is not healthy, by share
    kind = "loss"
    onset_s = { uniform = [22.0, 35.0] }
    strength = { log_uniform = [0.03, 0.6] }

Instead of `healthy` and [[faults]] a plan may have kinds of flights, of which each flight is one, by share. A kind changes any fields of
the scenario, and may have a fault:

    assess = "log"                                  # write each flight's log and `diagnose` it (open_world.py); else "ticks" (batch.py)

    [[kinds]]
    name = "a climb with little thrust"
    share = 2.0
    [kinds.scenario.airframe]
    thrust_to_weight = { uniform = [1.25, 1.5] }

    [[kinds]]
    name = "stuck"
    [kinds.fault]
    kind = "stuck"
    onset_s = { uniform = [22.0, 35.0] }

Flight k is the same flight whatever else is flown: its numbers come from (seed, k) alone.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import detectors
from rotorwatch.base import discovery, files
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError
from rotorwatch_lab.simulation import prepare, scenario
from rotorwatch_lab.simulation.scenario import Scenario, brief, is_number, number, only_fields, whole

MAX_BYTES = 1_000_000
DRAWS = ("choice", "uniform", "log_uniform")
FIXED = ("duration_s", "rate_hz", "name", "seed")
MOST_CELLS = 64
TOP = {
    "name": "", "seed": 0, "healthy": 0.3, "estimators": ("default",), "detectors": (), "decisions": (),
    "false_alarm_period_h": 10.0, "assess": "ticks", "scenario": {}, "faults": (), "kinds": (),
}  # fmt: skip
ASSESSES = ("ticks", "log")
FAULT = {"share": 1.0, "together": 1}
KIND = ("name", "share", "scenario", "fault")
SET_BY_CELL = (("autopilot",), ("airframe", "frame"), ("logging", "profile"))
DECISION = {"sigmas": (0.5, 100.0), "least": (0.0, 1.0), "persist_s": (0.0, 60.0)}
"""What a [[decisions]] table may set (published/decide.py), from and to."""


class Cell(NamedTuple):
    """Properties shared by the flights of a compiled batch: frame, autopilot, logging profile."""

    frame: str
    autopilot: str
    profile: str


class Decision(NamedTuple):
    """A threshold behind published estimators. name: "" for the usual one; tuning: keywords of `decide.Threshold`."""

    name: str = ""
    tuning: tuple[tuple[str, float], ...] = ()

    def label(self, estimator: str) -> str:
        """Name of the pair in the results."""
        return f"{estimator}/{self.name}" if self.name else estimator


class Kind(NamedTuple):
    """A kind of flights. scenario: the plan's, with this kind's own fields; fault: its template, or None."""

    name: str
    share: float
    scenario: Mapping[str, Any]
    fault: Mapping[str, Any] | None


@dataclass(frozen=True)
class Plan:
    """A checked plan. text: the file's, by which a folder of results knows its plan. cells: flight k belongs to cell k % len(cells).

    assess: one of ASSESSES. kinds: of flights; empty where `healthy` and `faults` say what happens.

    scenario and faults: tables whose values are numbers and texts, or draws. false_alarm_period_h: the mean time between false
    alarms that the bound on delays is worked out for.
    """

    name: str
    seed: int
    healthy: float
    estimators: tuple[str, ...]
    detectors: tuple[str, ...]
    decisions: tuple[Decision, ...]
    false_alarm_period_h: float
    scenario: Mapping[str, Any]
    faults: tuple[Mapping[str, Any], ...]
    cells: tuple[Cell, ...]
    rotors: tuple[int, ...]
    text: str
    assess: str = "ticks"
    kinds: tuple[Kind, ...] = ()

    @property
    def methods(self) -> tuple[str, ...]:
        """Estimators (published ones with each decision), then detectors."""
        pairs = ([name] if name == "default" else [d.label(name) for d in self.decisions] for name in self.estimators)
        return (*itertools.chain.from_iterable(pairs), *self.detectors)

    def cell(self, flight: int) -> Cell:
        """The cell of a flight."""
        return self.cells[flight % len(self.cells)]

    def kind(self, k: int) -> Kind | None:
        """The kind of flight k, drawn by share from (seed, k); None in a plan without kinds."""
        if not self.kinds:
            return None
        rng = np.random.default_rng([self.seed, k, 1])
        return self.kinds[_by_share([kind.share for kind in self.kinds], rng)]

    def flight(self, k: int) -> Scenario:
        """The scenario of flight k, drawn from (seed, k)."""
        rng = np.random.default_rng([self.seed, k])
        kind = self.kind(k)
        table = drawn(kind.scenario if kind else self.scenario, rng)
        here, n = self.cell(k), self.rotors[k % len(self.cells)]
        table["autopilot"] = here.autopilot
        table["airframe"]["frame"], table["logging"]["profile"] = here.frame, here.profile
        faults, template = [], kind.fault if kind else self._fault(rng)
        if template:
            rotors = rng.permutation(n)[: template["together"]] + 1
            for rotor in rotors:
                fault = drawn({key: v for key, v in template.items() if key not in FAULT}, rng)
                faults.append({"rotor": int(rotor), **fault})
        return scenario.from_table({**table, "name": f"{self.name} {k}", "seed": int(rng.integers(2**31 - 1)), "faults": faults})

    def _fault(self, rng: np.random.Generator) -> Mapping[str, Any] | None:
        """A fault drawn from `faults` by share, or None for a flight without."""
        if not self.faults or rng.random() < self.healthy:
            return None
        return self.faults[_by_share([f["share"] for f in self.faults], rng)]


def read(path: str | os.PathLike) -> Plan:
    """The plan in a TOML file. Raises ConfigError with one sentence that names the field."""
    table, text = files.toml(path, "plan", MAX_BYTES)
    stem = os.path.splitext(os.path.basename(os.fspath(path)))[0]
    try:
        return from_table({"name": stem, **table}, text)
    except ConfigError as error:
        raise ConfigError(f"Plan {path}: {error}") from error


def from_table(table: Mapping[str, Any], text: str = "") -> Plan:
    """The plan of a parsed TOML table. Raises ConfigError naming the field that is missing or wrong."""
    only_fields(table, TOP, of=" of a plan")
    fields = {**TOP, **table}
    if not isinstance(fields["name"], str):
        raise ConfigError(f"name must be a text, not {brief(fields['name'])}.")
    seed = whole("seed", fields["seed"], 0, 2**31 - 1)
    healthy = number("healthy", fields["healthy"], 0.0, 1.0)
    period = number("false_alarm_period_h", fields["false_alarm_period_h"], 0.01, 1e6)
    estimators = _estimators(fields["estimators"])
    rules = _names("detectors", fields["detectors"], tuple(m.name for m in detectors.modules()))
    if not estimators and not rules:
        raise ConfigError("estimators and detectors are both empty; name at least one of either.")
    decisions = _decisions(fields["decisions"])
    template = fields["scenario"]
    if not isinstance(template, Mapping):
        raise ConfigError("scenario must be a table, [scenario].")
    if "faults" in template:
        raise ConfigError("scenario.faults: faults of a plan are [[faults]] tables at its top.")
    for key in ("name", "seed"):
        if key in template:
            raise ConfigError(f"scenario.{key} is each flight's own; a plan has {key} at its top.")
    template = {key: dict(v) if isinstance(v, Mapping) and not _is_draw(v) else v for key, v in template.items()}
    for part in ("airframe", "logging"):
        if not isinstance(template.setdefault(part, {}), dict):
            raise ConfigError(f"scenario.{part} must be a table, [scenario.{part}].")
    _check_draws("scenario", template)
    for key in FIXED:
        if isinstance(template.get(key), Mapping):
            raise ConfigError(f"scenario.{key} must be one value: flights of a batch share it.")
    cells = _cells(template)
    rows = fields["faults"]
    if not isinstance(rows, (list, tuple)) or not all(isinstance(row, Mapping) for row in rows):
        raise ConfigError("faults must be [[faults]] tables.")
    faults = tuple(_fault(f"faults[{k + 1}]", row) for k, row in enumerate(rows))
    if fields["kinds"] and ("healthy" in table or faults):
        raise ConfigError("kinds stand instead of healthy and [[faults]]; leave those out.")
    if not faults and healthy < 1.0 and "healthy" in table:
        raise ConfigError("healthy is below 1, but there are no [[faults]] for the other flights.")
    if fields["assess"] not in ASSESSES:
        raise ConfigError(f"assess must be one of {', '.join(ASSESSES)}, not {brief(fields['assess'])}{meant(fields['assess'], ASSESSES)}.")
    rotors = _try_out(template, cells, faults)
    kinds = _kinds(fields["kinds"], template, cells)
    if fields["assess"] == "log" and (not kinds or estimators != ("default",) or rules):
        raise ConfigError('assess = "log" needs [[kinds]], and neither other estimators than "default" nor detectors.')
    name, text = fields["name"], text or repr(table)
    return Plan(
        *(name, seed, healthy, estimators, rules, decisions, period, template, faults, cells, rotors, text),
        assess=fields["assess"],
        kinds=kinds,
    )


def _by_share(shares: Sequence[float], rng: np.random.Generator) -> int:
    """Index drawn at random, each with its share of the total."""
    weights = np.array(shares)
    return int(rng.choice(len(weights), p=weights / weights.sum()))


def _kinds(rows: Any, template: dict[str, Any], cells: tuple[Cell, ...]) -> tuple[Kind, ...]:
    """The kinds of flights, each checked at the ends of its own draws."""
    if not isinstance(rows, (list, tuple)) or not all(isinstance(row, Mapping) for row in rows):
        raise ConfigError("kinds must be [[kinds]] tables.")
    kinds: list[Kind] = []
    for k, row in enumerate(rows):
        where = f"kinds[{k + 1}]"
        only_fields(row, KIND, f"{where}.")
        name, changes, fault = row.get("name"), row.get("scenario", {}), row.get("fault")
        if not isinstance(name, str) or not name or name in (kind.name for kind in kinds):
            raise ConfigError(f"{where}.name must be a text that no other kind has, not {brief(name)}.")
        if not all(isinstance(part, Mapping) for part in (changes, {} if fault is None else fault)):
            raise ConfigError(f"{where}.scenario and {where}.fault must be tables.")
        share = number(f"{where}.share", row.get("share", 1.0), 1e-6, 1e6)
        for path in (*SET_BY_CELL, *((key,) for key in (*FIXED, "faults"))):
            part = changes if len(path) == 1 else changes.get(path[0], {})
            if isinstance(part, Mapping) and path[-1] in part:
                raise ConfigError(f"{where}.scenario.{'.'.join(path)} is the same for all kinds; leave it out here.")
        _check_draws(f"{where}.scenario", changes)
        if fault is not None:
            if "share" in fault:
                raise ConfigError(f"{where}.fault.share: the kind has it.")
            fault = _fault(f"{where}.fault", fault)
        kind = Kind(name, share, _merged(template, changes), fault)
        for end in _ends(changes):
            try:
                for cell in cells:
                    _flyable(_built("scenario.", _merged(next(_ends(template)), end), cell, []))
            except ConfigError as error:
                raise ConfigError(f"{where}.{error}") from error
        for end in _ends({key: v for key, v in (fault or {}).items() if key not in FAULT}) if fault else ():
            first = next(_ends(kind.scenario))
            _built("", first, cells[0], [{**end, "rotor": 1}], f"{where}.fault")
        kinds.append(kind)
    return tuple(kinds)


def _merged(table: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The table with the fields of `own` in their places; a draw is one value."""
    both = dict(table)
    for key, value in changes.items():
        deeper = all(isinstance(v, Mapping) and not _is_draw(v) for v in (value, both.get(key)))
        both[key] = _merged(both[key], value) if deeper else value
    return both


def _cells(template: Mapping[str, Any]) -> tuple[Cell, ...]:
    """Every combination of the frames, autopilots and profiles that the plan names."""
    parts = []
    for name, value in (
        ("airframe.frame", template["airframe"].get("frame")),
        ("autopilot", template.get("autopilot", "ardupilot")),
        ("logging.profile", template["logging"].get("profile", "default")),
    ):
        if value is None:
            raise ConfigError(f"scenario.{name} is missing; name one, or {{ choice = [...] }}.")
        values = value["choice"] if _is_draw(value) and "choice" in value else [value]
        if not all(isinstance(v, str) for v in values):
            raise ConfigError(f"scenario.{name} must be a name or a choice of names, not {brief(value)}.")
        parts.append(values)
    for frame in parts[0]:
        if scenario.is_helicopter(frame):
            raise ConfigError(f"scenario.airframe.frame: {frame} is a helicopter; campaigns fly multirotors.")
    cells = tuple(Cell(*one) for one in itertools.product(*parts))
    if len(cells) > MOST_CELLS:
        raise ConfigError(f"scenario: {len(cells)} combinations of frame, autopilot and profile; at most {MOST_CELLS}.")
    return cells


def _decisions(rows: Any) -> tuple[Decision, ...]:
    if not isinstance(rows, (list, tuple)) or not all(isinstance(row, Mapping) for row in rows):
        raise ConfigError("decisions must be [[decisions]] tables.")
    decisions = []
    for k, row in enumerate(rows):
        where = f"decisions[{k + 1}]"
        only_fields(row, ("name", *DECISION), f"{where}.")
        name = row.get("name")
        if not isinstance(name, str) or not name or name in (d.name for d in decisions):
            raise ConfigError(f"{where}.name must be a text that no other decision has, not {brief(name)}.")
        numbers = ((key, number(f"{where}.{key}", row[key], *ends)) for key, ends in DECISION.items() if key in row)
        decisions.append(Decision(name, tuple(numbers)))
    return tuple(decisions) or (Decision(),)


def _fault(where: str, row: Mapping[str, Any]) -> Mapping[str, Any]:
    if "rotor" in row:
        raise ConfigError(f"{where}.rotor is drawn anew for each flight; leave it out.")
    if _is_draw(row):
        raise ConfigError(f"{where}.{next(iter(row))} is not a field of a fault; draw its fields, one by one.")
    _check_draws(where, row)
    share = number(f"{where}.share", row.get("share", 1.0), 1e-6, 1e6)
    return {**row, "share": share, "together": whole(f"{where}.together", row.get("together", 1), 1, 2)}


def _try_out(template, cells, faults) -> tuple[int, ...]:
    """Build scenarios at the ends of every draw, and one vehicle per cell whose log can be written: (rotors of each). Raises what they
    raise, by field."""
    for end in _ends(template):
        _flyable(_built("scenario.", end, cells[0], []))
    counts = []
    base = next(_ends(template))
    for cell in cells:
        built = _built("scenario.", base, cell, [])
        _flyable(built)
        counts.append(len(prepare.vehicle(built).rotors))
    for k, fault in enumerate(faults):
        for end in _ends({key: v for key, v in fault.items() if key not in FAULT}):
            _built("", base, cells[0], [{**end, "rotor": 1}], f"faults[{k + 1}]")
    return tuple(counts)


def _flyable(built: Scenario) -> None:
    """Raise ConfigError where no vehicle can fly the scenario, or no log can be written of it."""
    try:
        prepare.plan(built)
        if built.autopilot == "ardupilot":
            prepare.frame_numbers(built.airframe["frame"])
    except ConfigError as error:
        raise ConfigError(f"scenario.{error}") from error


def _built(prefix: str, table: Mapping[str, Any], cell: Cell, faults: list, called: str = "") -> Scenario:
    table = {k: dict(v) if isinstance(v, Mapping) else v for k, v in table.items()}
    table["autopilot"] = cell.autopilot
    table.setdefault("airframe", {})["frame"] = cell.frame
    table.setdefault("logging", {})["profile"] = cell.profile
    try:
        return scenario.from_table({**table, "faults": faults})
    except ConfigError as error:
        text = str(error).replace("faults[1]", called) if called else str(error)
        raise ConfigError(prefix + text) from error


def _ends(table: Mapping[str, Any]) -> Iterator[dict]:
    """The table with every draw at its first value; then with one draw after the other at each of its other values."""

    def first(value):
        if _is_draw(value):
            return next(iter(value.values()))[0]
        return {k: first(v) for k, v in value.items()} if isinstance(value, Mapping) else value

    base = first(table)
    yield base
    for path, draw in _draws(table):
        for other in next(iter(draw.values()))[1:]:
            changed = {k: dict(v) if isinstance(v, Mapping) else v for k, v in base.items()}
            where = changed
            for step in path[:-1]:
                where = where[step]
            where[path[-1]] = other
            yield changed


def _draws(table: Mapping[str, Any], path: tuple = ()) -> Iterator[tuple[tuple, Mapping]]:
    for key, value in table.items():
        if _is_draw(value):
            yield (*path, key), value
        elif isinstance(value, Mapping):
            yield from _draws(value, (*path, key))


def _is_draw(value: Any) -> bool:
    return isinstance(value, Mapping) and len(value) == 1 and next(iter(value)) in DRAWS


def _check_draws(where: str, table: Mapping[str, Any]) -> None:
    for path, draw in _draws(table):
        name, (kind, values) = ".".join((where, *path)), next(iter(draw.items()))
        if not isinstance(values, list) or not values:
            raise ConfigError(f"{name}.{kind} must be a list of values, not {brief(values)}.")
        if kind == "choice":
            continue
        if len(values) != 2 or not all(map(is_number, values)) or values[0] > values[1]:
            raise ConfigError(f"{name}.{kind} must be two numbers, the smaller first, not {brief(values)}.")
        if kind == "log_uniform" and values[0] <= 0:
            raise ConfigError(f"{name}.log_uniform must be above zero, not {values[0]:g}.")


def drawn(table: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """The table with a value for every draw, in the order of the file."""
    drawn_table: dict[str, Any] = {}
    for key, value in table.items():
        if _is_draw(value):
            kind, values = next(iter(value.items()))
            if kind == "choice":
                drawn_table[key] = values[int(rng.integers(len(values)))]
            elif kind == "uniform":
                drawn_table[key] = float(rng.uniform(*values))
            else:
                drawn_table[key] = float(np.exp(rng.uniform(*np.log(values))))
        else:
            drawn_table[key] = drawn(value, rng) if isinstance(value, Mapping) else value
    return drawn_table


def _estimators(values: Any) -> tuple[str, ...]:
    """Names of estimators, checked; a class may be named as package.module:Class."""
    classes = [v for v in values if isinstance(v, str) and ":" in v] if isinstance(values, (list, tuple)) else []
    for text in classes:
        discovery.estimator(text)
    return _names("estimators", values, (*discovery.estimators(), *classes))


def _names(name: str, values: Any, known: tuple[str, ...]) -> tuple[str, ...]:
    if not isinstance(values, (list, tuple)):
        raise ConfigError(f"{name} must be a list of names, not {brief(values)}.")
    for value in values:
        if value not in known:
            raise ConfigError(f"{name}: there is no {brief(value)}{meant(value, known)}; known are {', '.join(known)}.")
    return tuple(dict.fromkeys(values))
