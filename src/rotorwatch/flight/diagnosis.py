"""The answer: verdict, rotors, events and the evidence for them. Plain data; see docs/json.md for every field."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import optional
from rotorwatch.errors import ConfigError
from rotorwatch.flight import kinds
from rotorwatch.flight.method_series import MOST_ROWS, MethodSeries

SCHEMA = 3
TINY = 1e-12  # probabilities are rounded to less
EXIT_CODES = {"healthy": 0, "fault": 1, "crashed": 1, "ambiguous": 3, "inconclusive": 3}
# Fields of the JSON answer (docs/json.md) in their order; of an event, before those of its kind; of a rotor.
ANSWER = (
    "flight", "fit_to_fly", "verdict", "headline", "reason", "story", "picture", "advice", "main_event", "causes", "rotors", "events",
    "common_mode", "whole_flight", "compared", "baseline", "estimator", "comparison", "assumptions", "warnings", "timing",
)  # fmt: skip
EVENT = (
    "kind", "rotors", "alternatives", "onset_s", "detected_s", "end_s", "loss", "interval", "probability", "reason",
)  # fmt: skip
ROTOR = ("rotor", "place", "loss", "interval", "status", "since_takeoff", "from_takeoff", "note", "grade", "trend", "imbalance")


@dataclass(frozen=True)
class Trend:
    """The trend of a rotor's loss. per_minute: share of its thrust, positive for a growing loss; interval: 95 %, for all rotors at once.

    start_s, end_s: the time that it covers, since the last event. word: growing, shrinking, no trend where the interval contains 0, or
    unclear for a drift that no single rotor explains. beyond: (low, high) of the growth by the end that no loss includes."""

    per_minute: float
    interval: tuple[float, float]
    start_s: float
    end_s: float
    word: str
    beyond: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class RotorState:
    """A rotor at the end of the assessed flight. rotor: 1-based. loss: 0 healthy .. 1 dead.

    interval: 95 %, over all explanations; the largest undetected loss where nothing was found. status: healthy, degraded (lost some, or
    slow), failed (lost most), suspect (one of several explanations, or evidence that no event explains) or unobservable. place: in words.
    since_takeoff: 95 % interval of the change since take-off, where assessed. from_takeoff: not assessed, healthy, bounded (by healthy
    vehicles of any build), suspect or damaged. note: its history, in a few words. grade: of the interval of the loss, or of its change
    since take-off where no more was assessed: healthy, worn, weak, critical, failed, two of them, or not assessed. trend: None where
    unknown. imbalance: value, interval, unit and more of its vibration once per turn (docs/balance.md), None where the log cannot hear
    it."""

    rotor: int
    loss: float
    interval: tuple[float, float]
    status: str
    place: str = ""
    since_takeoff: tuple[float, float] | None = None
    from_takeoff: str = "not assessed"
    note: str = ""
    grade: str = "not assessed"
    trend: Trend | None = None
    imbalance: Mapping[str, Any] | None = None


class Source(NamedTuple):
    """The origin of a claim, defined where the claim is made.

    name. rank: order in which open claims are weighed. explained: (claim, known) -> whether an event or claim that is known explains the
    claim, so that it is not reported again; None: nothing does.
    """

    name: str
    rank: int = 0
    explained: Callable[[Event, Event], bool] | None = None


NO_SOURCE = Source("")


@dataclass(frozen=True)
class Event:
    """An event in flight. Times in s from the first record of the log.

    onset_s: when it began. detected_s: when that was certain enough to announce. end_s: when it ended; None while it lasts. kind: its name
    in the table of kinds (`kinds`). rotors: 1-based. loss: of each of them, 0 to 1. interval: (low, high) of each loss, 95 %. alternatives:
    other rotor sets that explain the data as well. probability: of these rotors, given the data. reason: one sentence. extra: fields of
    some kinds only. history: (time, loss...) rows of the causal estimate, for plots. source: not in the JSON."""

    kind: str
    rotors: tuple[int, ...]
    onset_s: float
    detected_s: float
    end_s: float | None
    loss: tuple[float, ...]
    interval: tuple[tuple[float, float], ...]
    probability: float
    alternatives: tuple[tuple[int, ...], ...] = ()
    reason: str = ""
    extra: Mapping[str, Any] = field(default_factory=dict)
    source: Source = field(default=NO_SOURCE, compare=False, repr=False)

    @property
    def means(self) -> kinds.Kind:
        """The row of its kind."""
        return kinds.kind_of(self.kind)

    @property
    def explanations(self) -> tuple[tuple[int, ...], ...]:
        """All rotor sets that explain it, its own first; empty for an event of no rotor."""
        named = tuple(self.rotors)
        return (named, *(tuple(a) for a in self.alternatives if tuple(a) != named)) if named else ()

    @property
    def log_odds(self) -> float:
        """Log odds of its rotors against everything else, in nats."""
        p = min(max(self.probability, TINY), 1.0 - TINY)
        return float(np.log(p / (1.0 - p)))

    def stated(self) -> Event:
        """The event with the probability that an answer may state."""
        lossy = self.kind in (kinds.LOSS, kinds.SLOW_RESPONSE)
        return replace(self, probability=kinds.SUREST) if lossy and self.probability > kinds.SUREST else self

    def most(self, rotor: int) -> float:
        """Upper bound of a rotor's loss over all explanations: its own interval where it is among the event's rotors; in another set at
        most the total deficit of torque and thrust of the event's rotors; 1 where unknown."""
        if not self.interval:
            return 1.0
        named = self.interval[self.rotors.index(rotor)][1] if rotor in self.rotors else 0.0
        other = min(1.0, sum(high for _, high in self.interval))
        return max(named, other) if any(rotor in a for a in self.alternatives) else named

    @property
    def suspects(self) -> frozenset[int]:
        """All rotors of any explanation."""
        return frozenset(self.rotors).union(*self.alternatives)

    def to_dict(self) -> dict:
        """The documented JSON structure of an event (docs/json.md)."""
        return _round({name: getattr(self, name) for name in EVENT} | dict(self.extra))

    @classmethod
    def from_dict(cls, found: Mapping[str, Any]) -> Event:
        """The event from `to_dict`'s output, numbers as rounded."""
        fields = {name: value for name, value in found.items() if name in EVENT}
        return cls(**_tuples(fields), extra={name: value for name, value in found.items() if name not in fields})


@dataclass(frozen=True)
class Fitness:
    """Whether to fly again. word: fly (no loss that matters, and nothing to look at), look first, do not fly (a fault, or control was lost)
    or cannot say (too little was seen). checks: at most three inspections, in the order of their worth. surer: what to log or fly so that
    the next answer is surer."""

    word: str
    checks: tuple[str, ...] = ()
    surer: tuple[str, ...] = ()


@dataclass(frozen=True)
class StoryLine:
    """A sentence of the story of a loss of control, and its time [s]."""

    time_s: float
    text: str


@dataclass(frozen=True, repr=False)
class Trace:
    """Time series for the plots of a flight, on the diagnoser's own ticks (T of them, n rotors).

    time (T,): s. loss, lower, upper (T, n): estimate and its 95 % interval. residual, residual_sd (T, 4): in hover-thrust units, roll,
    pitch, yaw, thrust. command (T, n): share of full thrust, NaN where none is logged. threshold: of the evidence, log10 odds. evidence:
    hypothesis name -> (T,) log10 odds against healthy; blind: ((start, end, why), ...) of unassessed time; airborne: ((start, end), ...).
    attitude, wanted (T, 3): roll, pitch, yaw in degrees, actual and commanded, or None; messages: ((time, kind, text), ...), kinds as in
    `flight.Message`. rates, rates_wanted (T, 3): the same in degrees/s, of a vehicle flown by rates. position (T, 3): north, east, down in
    m from the lift-off; ground_speed (T,): m/s; battery (T, 2): V, A; vibration (T, 3): standard deviation of the accelerometer above the
    motion, m/s^2, body x, y, z; each NaN where unknown, None where not logged."""

    time: np.ndarray
    loss: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    residual: np.ndarray
    residual_sd: np.ndarray
    command: np.ndarray
    evidence: Mapping[str, np.ndarray]
    blind: tuple[tuple[float, float, str], ...]
    airborne: tuple[tuple[float, float], ...]
    threshold: float = 0.0
    attitude: np.ndarray | None = None
    wanted: np.ndarray | None = None
    messages: tuple[tuple[float, str, str], ...] = ()
    rates: np.ndarray | None = None
    rates_wanted: np.ndarray | None = None
    position: np.ndarray | None = None
    ground_speed: np.ndarray | None = None
    battery: np.ndarray | None = None
    vibration: np.ndarray | None = None

    def to_pandas(self):
        """A pandas DataFrame, a row for each tick, its index the time [s]: columns `loss_1`, `lower_1`, `upper_1`, `command_1` and so on
        for each rotor, `residual_roll` and so on with their `residual_sd_...`, the evidence by hypothesis, and `position_north` and so on,
        where logged. Raises ConfigError where pandas is not installed."""
        columns = {f"{name}_{k + 1}": getattr(self, name)[:, k]
                   for k in range(self.loss.shape[1]) for name in ("loss", "lower", "upper", "command")}  # fmt: skip
        for k, axis in enumerate(("roll", "pitch", "yaw", "thrust")):
            columns |= {f"residual_{axis}": self.residual[:, k], f"residual_sd_{axis}": self.residual_sd[:, k]}
        columns |= {f"evidence_{name}": values for name, values in self.evidence.items()}
        logged = {"position": ("north", "east", "down"), "battery": ("voltage", "current"), "vibration": ("x", "y", "z")}
        for name, parts in logged.items():
            if (values := getattr(self, name)) is not None:
                columns |= {f"{name}_{part}": values[:, k] for k, part in enumerate(parts)}
        if self.ground_speed is not None:
            columns["ground_speed"] = self.ground_speed
        pd = optional.library("pandas", "to_pandas")
        return pd.DataFrame(columns, index=pd.Index(self.time, name="time_s"))

    def plot(self, path=None):
        """A matplotlib figure of the loss of every rotor with its 95 % interval, and of the commands, in %, over time [s]. path: also write
        it there (.png, .svg, .pdf). Raises ConfigError where matplotlib is not installed."""
        from rotorwatch.flight.display import Panel, plot

        names = [f"rotor {k + 1}" for k in range(self.loss.shape[1])]
        losses = Panel("loss [%]", 100.0 * self.loss, names, 100.0 * self.lower, 100.0 * self.upper)
        return plot(self.time, [losses, Panel("command [%]", 100.0 * self.command, names)], path)

    def __repr__(self) -> str:
        span = f", {self.time[0]:.1f} to {self.time[-1]:.1f} s" if len(self.time) else ""
        return f"<Trace: {len(self.time)} ticks of {self.loss.shape[1]} rotors{span}>"


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """The answer of `rotorwatch diagnose`.

    verdict: healthy, fault, crashed (without a rotor as the cause), ambiguous or inconclusive. reason: why, one sentence. headline: the
    same for a pilot; main: index into events of the main one, or None; advice: recommended actions. These, rotors and events come from
    conclusion.conclude alone.
    flight: the log (docs/json.md). rotors: the state of each at the end. events: in time order. common_mode: common change of all rotors.
    baseline: the healthy flights compared with. assumptions, warnings: sentences. timing: s of each step of the work. estimator: the
    method's name. comparison: results of the autopilot's own checks. whole_flight: damage from take-off, where assessed. trace: time series
    for plots. doubts: why the log may not show the real flight, a sentence each (the first is then the reason). story: the sequence of a
    loss of control, four sentences in order of time, or empty. picture: attitude and commands around it (docs/json.md), or None. aircraft:
    its identity, such as a serial number; empty where the log has none; not in the JSON. own: of a published method, its own series over
    the flight (`own_estimate` of the JSON). compared: claims of losses and what else explains the motion (docs/json.md). balance: what a
    sensor hears of the rotors (witnesses/balance/imbalances.py), for the report, not in the JSON. fit_to_fly: whether to fly again. causes:
    what explains the answer, the most probable first: name, rotors, probability (None where unknown) and evidence (docs/json.md)."""

    flight: Mapping[str, Any]
    verdict: str
    reason: str
    rotors: tuple[RotorState, ...]
    events: tuple[Event, ...]
    common_mode: Mapping[str, Any]
    baseline: str
    assumptions: tuple[str, ...]
    warnings: tuple[str, ...]
    timing: Mapping[str, float]
    estimator: str = "default"
    comparison: tuple[Mapping[str, Any], ...] = ()
    whole_flight: Mapping[str, Any] | None = None
    trace: Trace | None = None
    headline: str = ""
    main: int | None = None
    advice: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    story: tuple[StoryLine, ...] = ()
    picture: Mapping[str, Any] | None = None
    aircraft: str = ""
    own: MethodSeries | None = None
    compared: tuple[Mapping[str, Any], ...] = ()
    balance: Any = None
    fit_to_fly: Fitness | None = None
    causes: tuple[Mapping[str, Any], ...] = ()

    @property
    def exit_code(self) -> int:
        """0 healthy, 1 fault found or crashed, 3 inconclusive or ambiguous only."""
        return EXIT_CODES[self.verdict]

    def important(self, most: int) -> list[int]:
        """Indices in time order of the events for a short answer, at most `most`: the main event, losses of control, then the first
        ones."""
        first = [k for k, e in enumerate(self.events) if k == self.main or e.means.weight is kinds.Weight.UPSET]
        return sorted([*first, *(k for k in range(len(self.events)) if k not in first)][:most])

    def to_dict(self) -> dict:
        """The documented JSON structure (docs/json.md), without the trace."""
        converted = {
            "flight": {},
            "main_event": self.main,
            "rotors": [{name: getattr(r, name) for name in ROTOR} for r in self.rotors],
            "events": [e.to_dict() for e in self.events],
        }
        answer = {name: _round(converted[name] if name in converted else getattr(self, name)) for name in ANSWER}
        own_estimate = {} if self.own is None else {"own_estimate": _round(self.own.to_dict(MOST_ROWS))}
        return {"schema": SCHEMA} | answer | {"flight": dict(self.flight)} | own_estimate

    @classmethod
    def from_dict(cls, found: Mapping[str, Any]) -> Diagnosis:
        """The Diagnosis from `to_dict`'s output, without the trace and a method's own series, numbers as rounded. Raises ConfigError for
        another schema."""
        if found.get("schema") != SCHEMA:
            raise ConfigError(f"This diagnosis has the schema {found.get('schema')}, not {SCHEMA}; diagnose the log again.")
        rotors = [{**r, "trend": None if r["trend"] is None else Trend(**_tuples(r["trend"]))} for r in found["rotors"]]
        optional_ = {"timing": {}, "picture": None, "story": (), "compared": (), "fit_to_fly": None, "causes": ()}
        answer = {name: found.get(name, optional_[name]) if name in optional_ else found[name] for name in ANSWER}
        answer |= {name: tuple(answer[name]) for name in ("assumptions", "warnings", "comparison", "compared", "advice", "causes")}
        answer["rotors"] = tuple(RotorState(**_tuples(r)) for r in rotors)
        answer["events"] = tuple(map(Event.from_dict, found["events"]))
        answer["fit_to_fly"] = answer["fit_to_fly"] and Fitness(**_tuples(answer["fit_to_fly"]))
        answer["story"] = tuple(StoryLine(**line) for line in answer["story"])
        return cls(main=answer.pop("main_event"), **answer)

    def to_json(self, indent: int | None = 1) -> str:
        """`to_dict` as JSON text; never NaN or Infinity."""
        return json.dumps(self.to_dict(), indent=indent, allow_nan=False)

    def to_html(self, path) -> None:
        """Write the self-contained HTML report to `path` (atomically). Raises ConfigError where Bokeh is not installed."""
        from rotorwatch.report.html import write

        write(self, path)

    def to_markdown(self, path=None, identify: bool = False) -> str:
        """The answer as Markdown for a forum or an issue, below 10,000 letters, without positions, serial numbers and folders. path: also
        write it there (atomically), and beside it its picture, NAME.png, where matplotlib is installed and there is something to draw.
        identify: with the aircraft's serial number, the time of day, and texts as in the log. Raises ConfigError when the target is not
        writable."""
        from rotorwatch.report import markdown

        if path is None:
            return markdown.text(self, identify)
        return markdown.write(self, path, identify).text

    def to_line(self) -> str:
        """The answer as one line of plain text for a forum, without private data."""
        from rotorwatch.report import markdown

        return markdown.line(self)

    def plot(self, what: str = "auto", path=None):
        """A matplotlib figure: "moment", attitude and commands around a loss of control or a desync; "flight", the loss of every rotor [%]
        with its 95 % interval, and the commands, over time [s]; "auto", the moment where there is one. path: also write it there (.png,
        .svg, .pdf). Raises ConfigError where there is nothing to draw, or no matplotlib."""
        from rotorwatch.report import still

        return still.figure(self, what, path)

    def to_mcap(self, path) -> None:
        """Write the diagnosis as an MCAP file, for Foxglove and PlotJuggler, to `path` (atomically). Raises ConfigError where the package
        mcap is not installed."""
        from rotorwatch.report.mcap_file import write

        write(self, path)

    def to_parquet(self, folder) -> None:
        """Write flights.parquet, ticks.parquet, losses.parquet and events.parquet (docs/parquet.md) into a folder, which is made. Raises
        ConfigError where pyarrow is not installed."""
        from rotorwatch.report.parquet_tables import write

        write(self, folder)

    def to_pandas(self):
        """The rotors as a pandas DataFrame, a row each: the fields of `RotorState`, intervals as two columns (`lower`, `upper`,
        `since_takeoff_lower`, `since_takeoff_upper`). Raises ConfigError where pandas is not installed."""
        rows = []
        for r in self.rotors:
            change = r.since_takeoff or (None, None)
            rows.append(
                {
                    "rotor": r.rotor, "place": r.place, "status": r.status, "loss": r.loss, "lower": r.interval[0], "upper": r.interval[1],
                    "since_takeoff_lower": change[0], "since_takeoff_upper": change[1], "from_takeoff": r.from_takeoff, "grade": r.grade,
                    "trend_per_minute": r.trend.per_minute if r.trend else None, "trend": r.trend.word if r.trend else None, "note": r.note,
                }
            )  # fmt: skip
        table = optional.library("pandas", "to_pandas").DataFrame(rows)
        return table.set_index("rotor") if rows else table

    def __repr__(self) -> str:
        return f"<Diagnosis of {self.flight.get('name') or 'a flight'}: {self.verdict}. {self.headline or self.reason}>"

    def _repr_html_(self) -> str:
        from rotorwatch.report import notebook

        return notebook.page(self)


def _tuples(fields_of: Mapping[str, Any]) -> dict[str, Any]:
    """Lists, also lists of them, as tuples."""

    def tuples(value: Any) -> Any:
        return tuple(map(tuples, value)) if isinstance(value, list) else value

    return {name: tuples(value) for name, value in fields_of.items()}


def _round(value: Any, digits: int = 4) -> Any:
    """Numbers to plain Python, rounded; containers walked; NaN and infinities become None."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (Trend, StoryLine, Fitness)):
        value = vars(value)
    if isinstance(value, Mapping):
        return {str(k): _round(v, digits) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_round(v, digits) for v in value]
    if isinstance(value, (int, np.integer)):
        return int(value)
    number = float(value)
    return round(number, digits) if np.isfinite(number) else None
