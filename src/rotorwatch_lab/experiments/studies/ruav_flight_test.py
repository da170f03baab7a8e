"""The paper's flight test, flown again: hover on an H-infinity attitude loop that is redesigned for a filter's bounds of the actuators'
coefficients; at step 21,500 two of them fail, at step 23,000 the pilot takes over.

Truth, noise and filters are those of `ruav_flight` and `ruav_filters`, the loops those of `ruav_control`. Attitude and place are measured
with the accuracy that the paper prints, .1 degree and .1 m, and neither loops nor filters get anything better; nothing here reads an
accelerometer, whose accuracy it prints as well. The flight begins at step 20,500, in hover: what happened before is more of the same. Every
REDESIGN steps the filter's bounds are looked at. The controller is made anew when one of them has left the interval it was made for, or
when that could be narrower by LOOSE; where no controller exists for the bounds, the last one stays. The fault's equation is lost in print:
that of figure 5 is flown, and its halves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.compiling.run import stepper
from rotorwatch_lab.experiments.studies import reproduction, ruav_control, ruav_filters, ruav_flight
from rotorwatch_lab.experiments.studies.reproduction import Claim, Verdict, graded, panels, silent
from rotorwatch_lab.experiments.studies.ruav_control import Designs
from rotorwatch_lab.experiments.studies.ruav_flight import DT
from rotorwatch_lab.maths import h_infinity

BEGIN, FAULT_STEP, PILOT = 20_500, 21_500, 23_000
REDESIGN = 10  # steps between looks at the bounds
LOOSE = 0.2  # a controller is designed again when a bound has left its interval, or leaves this much of it unused
QUIET, STABLE = 0.1, 0.3  # rad/s: the paper's two limits
SETTLE_S = 4.0  # a fault is a step: rates are assessed from then on
DITHER = np.array([0.003, 0.007, 0.02, 0.008])
LOST = 20.0  # rad/s or m/s: what flies no more


@dataclass(frozen=True)
class Setting:
    """Choices that the paper leaves open. fault (8,): added to losses and displacements; dither: factor on DITHER; restart: of a Kalman
    filter; eta: its rate of adaptation [1/s]; floor: of GD-ESMF's Q; sensors: factor on the errors of attitude and place; seed: of the
    noise; begin: first step flown."""

    fault: tuple[float, ...] = tuple(ruav_flight.FAULT)
    dither: float = 1.0
    restart: bool = False
    eta: float = 0.5
    floor: float = 1e-3
    sensors: float = 1.0
    seed: int = 0
    begin: int = BEGIN
    end: int = PILOT


class Flown(NamedTuple):
    """A flight: x (T, 6), attitude (T, 3) roll, pitch, heading, place (T, 3), command (T, 4), theta (T, 8), middle and half (T, 8) of the
    filter's bounds of gamma and delta; designs: how often a controller was made anew; excluded: how often there was none; synthesis, key:
    the last controller and its interval."""

    x: np.ndarray
    attitude: np.ndarray
    place: np.ndarray
    command: np.ndarray
    theta: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    designs: int
    excluded: int
    synthesis: Any
    key: tuple
    restarts: int
    begin: int


def fly(name: str, setting: Setting, designs: Designs, form: str = "own", literal: tuple[str, ...] = ()) -> Flown:
    """The flight on the bounds of the filter `name` of `ruav_filters`, a set in that form. Deterministic."""
    over, state = _program(name, form, literal)
    system = designs.system
    rows = _rows(setting)
    fault = np.array(setting.fault), np.array(setting.restart), setting.eta, setting.floor
    key = designs.key(1.0 - ruav_filters.START_REACH[1:4], np.ones(3))
    synthesis = designs.of(key)
    if synthesis is None:
        raise RuntimeError("the healthy helicopter has no controller")
    trim = system.trim
    parts, designed, excluded = [], 0, 0
    for k in range(0, len(rows[0]), REDESIGN):
        state, part = over(_Knobs(synthesis.K, trim, *fault), state, *(row[k : k + REDESIGN] for row in rows))
        parts.append(part)
        middle, half = np.asarray(part[5][-1]), np.asarray(part[6][-1])
        if not (np.isfinite(middle).all() and np.isfinite(half).all()):
            continue
        low, high = (np.clip(middle[1:4] + sign * half[1:4], 0.0, 1.0) for sign in (-1, 1))
        wanted = designs.key(low, high)
        if designs.is_due(wanted, key, LOOSE):
            design = designs.of(wanted)
            excluded += design is None
            if design is not None:
                state = _bumpless(state, synthesis.K, design.K)
                designed, synthesis, key = designed + 1, design, wanted
        trim = ruav_control.trim_command(system.trim, middle[:4], half[:4], middle[4:])
    tables = (np.concatenate([np.asarray(part[i]) for part in parts]) for i in range(7))
    return Flown._make([*tables, designed, excluded, synthesis, key, int(state[-1][1]), setting.begin])


def _bumpless(state, old, new):
    """The state with integrals for which the new controller commands what the old one did, as far as possible."""
    truth, y, xi, *rest = state
    left, wish = new[:, 5:], old[:, 5:] @ np.asarray(xi)
    xi = np.linalg.solve(left.T @ left + 1e-2 * np.eye(3), left.T @ wish + 1e-2 * np.asarray(xi))
    return (truth, y, xi, *rest)


def assessed(flown: Flown) -> dict:
    """Numbers that the claims use: largest rates before the fault, in the first seconds after it and from then on [rad/s], whether it is
    stable, and the share of steps at which the bounds hold the true coefficients."""
    at, late = FAULT_STEP - flown.begin, FAULT_STEP - flown.begin + round(SETTLE_S / DT)
    rates, well = np.abs(flown.x[:, 3:]), np.isfinite(flown.x).all() and np.abs(flown.x).max() < LOST
    before, after = rates[round(SETTLE_S / DT) : at], rates[late:]
    truth = np.concatenate([1.0 - flown.theta[:, :4], flown.theta[:, 4:]], axis=1)
    inside = np.abs(flown.middle - truth) <= flown.half
    return {
        "rates_before": before.max(axis=0),
        "rates_transient": rates[at:late].max(axis=0),
        "rates_after": after.max(axis=0) if well else np.full(3, np.inf),
        "stable_after": bool(well and after.max() < STABLE),
        "inside_before": float(inside[round(SETTLE_S / DT) : at].mean()),
        "inside_after": float(inside[late:].mean()),
        "all_inside_after": float(inside[late:].all(axis=1).mean()),
        "half_width_after": float(flown.half[late:].mean()),
        "furthest_m": float(np.abs(flown.place[at:]).max()) if well else float("inf"),
        "designs": flown.designs,
        "excluded": flown.excluded,
        "restarts": flown.restarts,
    }


def _rows(setting: Setting):
    """Rows of `_Loop`: (T, 11) and (T, 12). Drawn from step BEGIN's seed on."""
    steps = setting.end - setting.begin
    push, error, wave = ruav_flight.weather(setting.seed, steps)
    blur = setting.sensors * ruav_flight.sensed(setting.seed, steps)
    now = np.arange(steps) == FAULT_STEP - setting.begin
    return np.column_stack([push, setting.dither * DITHER * wave, now]), np.column_stack([error, blur])


class _Knobs(NamedTuple):
    """What a flight's steps take besides their rows: controller K, trim command (4,), and a `Setting`'s fault, restart, eta, floor."""

    K: Any
    trim: Any
    fault: Any
    restart: Any
    eta: Any
    floor: Any


class _Loop(NamedTuple):
    """The closed loop in steps: u (11,) is push, dither and whether the fault comes now, y (12,) the errors of what is measured. lift:
    climb per collective command."""

    system: Any
    estimator: Any
    lift: float
    knobs: _Knobs

    def init(self):
        zero = np.zeros
        return ruav_flight.Truth.hover(), zero(6), zero(3), zero(3), ruav_filters.start(self.estimator)

    def step(self, state, u, y, valid):
        jnp, knobs, errors = load_jax().numpy, self.knobs, y
        push, dither, now, error, blur = u[:6], u[6:10], u[10] > 0.5, errors[:6], errors[6:]
        truth, y, xi, integral, filtered = state
        attitude, place = truth.attitude + blur[:3], truth.place + blur[3:]
        roll, pitch, turn, climb, integral = ruav_control.position_loop(place, attitude[2], y[:3], y[5], integral)
        off = jnp.stack([attitude[0] - roll, attitude[1] - pitch])
        slow = y[5] - turn
        whole = jnp.concatenate([y[3:5], slow[None], off, xi])
        xi = xi + DT * jnp.concatenate([off, (slow - xi[2] / ruav_control.LEAK_S)[None]])
        U = jnp.clip(knobs.trim + jnp.concatenate([(climb / self.lift)[None], knobs.K @ whole]) + dither, 0.0, 1.0)
        u, truth = truth.moved(self.system, U, push, now, knobs.fault)
        y = truth.x + error
        filter_ = _with(self.estimator, knobs.eta, knobs.floor)
        filtered, z, P = ruav_filters.step(filter_, filtered, jnp.concatenate([u[:4], attitude[:2]]), y, knobs.restart)
        half = jnp.sqrt(jnp.maximum(jnp.diagonal(P), 0.0))[6:]
        middle = jnp.concatenate([1.0 - z[6:10], z[10:]])
        return (truth, y, xi, integral, filtered), (truth.x, truth.attitude, truth.place, U, truth.theta, middle, half)


@lru_cache(maxsize=8)
def _program(name: str, form: str, literal: tuple[str, ...]):
    """(compiled (knobs, state, u (T, 11), y (T, 12)) -> (state, seen), state at the start)."""
    estimator, system = ruav_filters.filters(ruav_flight.plant(stops=False), literal, form)[name], ruav_flight.plant()
    lift = float(ruav_flight.hover(system)[1][2, 0])

    def build(knobs):
        return _Loop(system, estimator, lift, knobs)

    return stepper(build), build(None).init()


def _with(estimator, eta, floor):
    """The filter with this rate of an AEKF's adaptation, or this floor of GD-ESMF."""
    from copy import copy

    changed = copy(estimator)
    if hasattr(changed, "adaptation"):
        changed.adaptation = changed.adaptation and changed.adaptation._replace(eta=eta)
    elif hasattr(changed, "floor"):
        changed.floor = floor
    return changed


ROLL_ONLY, TAIL_ONLY = (tuple(ruav_flight.FAULT * np.tile(mask, 2)) for mask in ((0, 0, 0, 1), (0, 1, 0, 0)))
# What pushes and an attitude that is measured wrongly add to a velocity, in filters' semi-axes, squared: less is no bound.
SURE_FLOOR = ((1.0 + np.sqrt(2.0) * G0 * DT * ruav_flight.ACCURACY[0] / ruav_flight.PROCESS[0]) / ruav_filters.TOO_WIDE) ** 2
VARIED: dict[str, dict[str, dict[str, Any]]] = {
    "aesmf": {
        "roll_only": {"fault": ROLL_ONLY},
        "tail_only": {"fault": TAIL_ONLY},
        "dither_double": {"dither": 2.0},
        "floor": {"floor": SURE_FLOOR},
        "exact_sensors": {"sensors": 0.0},
    },
    "aekf": {
        "restart": {"restart": True},
        "roll_only": {"fault": ROLL_ONLY},
        "tail_only": {"fault": TAIL_ONLY},
        "eta_5": {"eta": 5.0},
        "dither_quarter": {"dither": 0.25},
        "dither_double": {"dither": 2.0},
        "longer_hover": {"begin": FAULT_STEP - 2000},
        "exact_sensors": {"sensors": 0.0},
        "seed_1": {"seed": 1},
        "seed_2": {"seed": 2},
    },
    "ekf": {"fixed_q": {"restart": True}},
    "aukf": {"no_restart": {}, "restart": {"restart": True}},
}
LOOKED_AT = ("rates_before", "rates_after", "stable_after", "inside_after", "half_width_after", "excluded")
FLIGHTS = 2 + len(ruav_filters.FORMS) - 1 + sum(map(len, VARIED.values()))


def flight_test(literal: tuple[str, ...] = (), progress=silent) -> tuple[dict, dict]:
    """The numbers of the flight test, and the two flights of the pictures. literal: readings that choose the sets' form, and others of the
    filters; progress(share, text) before each flight."""
    designs, chosen, count = Designs(ruav_flight.plant()), ruav_filters.form_of(literal), iter(range(FLIGHTS))

    def one(name: str, label: str, form: str = chosen, **setting) -> Flown:
        progress(next(count) / FLIGHTS, f"flight test on {ruav_filters.LABELS[name]}, {label}")
        return fly(name, Setting(**setting), designs, form, literal)

    flown = {name: one(name, "the paper's") for name in ("aesmf", "aekf")}
    seen = {name: assessed(flight) for name, flight in flown.items()}
    forms = {
        form: seen["aesmf"] if form == chosen else assessed(one("aesmf", ruav_filters.FORM_LABELS[form], form))
        for form in ruav_filters.FORMS
    }
    varied = {
        name: {label: _short(assessed(one(name, label.replace("_", " "), **setting))) for label, setting in these.items()}
        for name, these in VARIED.items()
    }
    key = designs.key(1.0 - ruav_filters.START_REACH[1:4], np.ones(3))
    short = {"aesmf": "esmf", "aekf": "aekf"}
    after = [f"{what}_after" for what in ("rates", "stable")]
    numbers: dict[str, Any] = {
        "rates_before": np.maximum(seen["aesmf"]["rates_before"], seen["aekf"]["rates_before"]),
        **{f"{what}_{label}": seen[name][what] for what in after for name, label in short.items()},
        "flights": seen,
        "varied": varied,
        "forms": {form: _short(flight) for form, flight in forms.items()},
        "controllers": {
            "healthy": _norms(designs, key, designs.of(key)),
            **{name: _norms(designs, flight.key, flight.synthesis) for name, flight in flown.items()},
            "made": sum(made is not None for made in designs.made.values()),
            "excluded": sum(made is None for made in designs.made.values()),
        },
    }
    return numbers, {"flight_test": flown}


def _short(seen: dict) -> dict:
    return {key: seen[key] for key in LOOKED_AT}


def _norms(designs: Designs, key: tuple, made) -> dict:
    """The bound of a controller's level, and its worst vertex' norm by synthesis, sweep, bisection and the bounded real lemma."""
    plant, bounds = designs.plant, designs.grid * np.array(key)
    gains = np.array(list(product(*(sorted({a, b}) for a, b in zip(bounds[:3], bounds[3:], strict=True)))))
    closed = plant.A + (plant.B * gains[made.worst]) @ made.K
    system = closed, plant.E, plant.C + plant.D @ made.K
    every = plant.A + (plant.B * gains[:, None, :]) @ made.K
    return {
        "interval": bounds,
        "level": made.level,
        "norm": made.norm,
        "sweep": h_infinity.sweep(*system),
        "bisection": h_infinity.bisection(*system),
        "bounded_real": h_infinity.bounded_real(*system),
        "decay_per_s": h_infinity.quadratic_decay(every, made.X),
    }


def claims(numbers: dict, chosen: str = "own") -> tuple[tuple[Claim, ...], dict]:
    """The paper's claims about the flight test, with verdicts from the numbers, and the verdicts on some of them by filter. chosen: the
    sets' form that the variations flew."""
    before, seen, made, varied = (numbers[key] for key in ("rates_before", "flights", "controllers", "varied"))
    stable = {name: [label for label, one in varied[name].items() if one["stable_after"]] for name in seen}
    lost = {name: [label for label in varied[name] if label not in stable[name]] for name in seen}
    norms = [made[key] for key in ("healthy", *seen)]
    apart = max(abs(one[way] / one["norm"] - 1) for one in norms for way in ("sweep", "bisection", "bounded_real"))
    decay = min(one["decay_per_s"] for one in norms)
    sets: dict[str, Verdict] = {
        label: graded(
            numbers["forms"][form]["stable_after"] and not (form == chosen and lost["aesmf"]), numbers["forms"][form]["stable_after"]
        )
        for form, label in ruav_filters.FORM_LABELS.items()
    }
    crashes = not numbers["stable_after_aekf"]
    unstable = {f"{name}, {label}": not one["stable_after"] for (name, label), one in _kalman(numbers).items()}
    kalman: dict[str, Verdict] = {label: graded(lost_it) for label, lost_it in unstable.items()}
    flights = {label: numbers["forms"][form] for form, label in ruav_filters.FORM_LABELS.items()}
    flights |= {f"{name}, {label}": one for (name, label), one in _kalman(numbers).items()}
    quiet: dict[str, Verdict] = {label: graded(np.max(one["rates_before"]) < QUIET) for label, one in flights.items()}
    verdicts = {
        "quiet": reproduction.across(quiet),
        "sets_fly": reproduction.across(sets),
        "kalman_crashes": graded(crashes and not stable["aekf"] and all(unstable.values()), crashes),
        "one_controller": graded(apart < 1e-4 and decay > 0),
    }
    main = reproduction.claims(
        "aesmf", verdicts, seen=seen, made=made, apart=apart, decay=decay, looks=(PILOT - BEGIN) // REDESIGN,
        before=_rates(before), before_aekf=_rates(seen["aekf"]["rates_before"]),
        after_esmf=_rates(numbers["rates_after_esmf"]), after_aekf=_rates(numbers["rates_after_aekf"]),
        fixed=_rates(varied["ekf"]["fixed_q"]["rates_after"]),
        other_forms=ruav_filters.by_form({
            form: f"{_rates(one['rates_after'])}, half-width {one['half_width_after']:.2g}, no controller at {one['excluded']} looks"
            for form, one in numbers["forms"].items() if form != chosen
        }),
        kalmans="; ".join(f"{name}, {label}: {_rates(one['rates_after'])}" for (name, label), one in _kalman(numbers).items()),
        calm=", ".join(stable["aesmf"]) or "no variation", rough=", ".join(lost["aesmf"]) or "none",
        wild=", ".join(lost["aekf"]) or "no variation", steady=", ".join(stable["aekf"]) or "no variation",
    )  # fmt: skip
    return main, {"quiet": quiet, "sets_fly": sets, "kalman_crashes": kalman}


def _kalman(numbers: dict) -> dict:
    """(filter, whether with a restart) -> its flight."""
    varied = numbers["varied"]
    return {
        ("AEKF", "no restart"): numbers["flights"]["aekf"],
        ("AEKF", "restart"): varied["aekf"]["restart"],
        ("AUKF", "no restart"): varied["aukf"]["no_restart"],
        ("AUKF", "restart"): varied["aukf"]["restart"],
    }


def _rates(values) -> str:
    return ", ".join(f"{v:.3f}" if v < 100 else "lost" for v in values)


def edges(axis, x, middle, half, colour: str, label: str) -> None:
    """Both edges of bounds."""
    for sign in (-1, 1):
        axis.plot(x, middle + sign * half, colour, lw=0.8, label=label if sign > 0 else None)


def figures(flown: dict) -> dict:
    """Figures 7 to 9 of the paper: tracking in hover, attitude rates, bounds of the coefficients."""
    names = {"aekf": ("AEKF", "C3"), "aesmf": ("GD-ESMF", "C2")}
    steps = {name: one.begin + np.arange(len(one.x)) for name, one in flown.items()}
    one, until = flown["aekf"], FAULT_STEP - flown["aekf"].begin
    hover, axes = panels(2, 1, (9, 5), sharex=True)
    shown = {"m/s": (one.x, ("u", "v", "w")), "m": (one.place, ("north", "east", "down"))}
    for axis, (unit, (values, labels)) in zip(axes.flat, shown.items(), strict=True):
        for i, label in enumerate(labels):
            axis.plot(steps["aekf"][:until], values[:until, i], lw=0.9, label=label)
        axis.set(ylabel=unit)
        axis.legend(fontsize="small")
    axes[1, 0].set_xlabel("step")
    rates, axes = panels(2, 1, (9, 5), sharex=True)
    for axis, (name, (label, _)) in zip(axes.flat, names.items(), strict=True):
        for i, rate in enumerate("pqr"):
            axis.plot(steps[name], flown[name].x[:, 3 + i], lw=0.8, label=rate)
        for limit in (-STABLE, STABLE):
            axis.axhline(limit, color="k", lw=0.6, ls=":")
        reach = 1.1 * min(max(np.nanmax(np.abs(flown[name].x[:, 3:])), STABLE), LOST)
        axis.set(title=f"designed for the bounds of {label}", ylabel="rad/s", ylim=(-reach, reach))
    axes[0, 0].legend(fontsize="small")
    axes[1, 0].set_xlabel("step")
    bounds, axes = panels(2, 2, (9, 6), sharex=True)
    titles = {1: "tail: gamma", 3: "roll: gamma", 5: "tail: delta", 7: "roll: delta"}
    for axis, (i, title) in zip(axes.flat, titles.items(), strict=True):
        for name, (label, colour) in names.items():
            one = flown[name]
            edges(axis, steps[name][::5], one.middle[::5, i], one.half[::5, i], colour, label)
        truth = flown["aesmf"].theta[:, i]
        axis.plot(steps["aesmf"], 1 - truth if i < 4 else truth, "k--", lw=1.1, label="truth")
        axis.set(title=title, ylim=(-0.6, 1.6) if i < 4 else (-0.6, 0.8))
    axes[0, 0].legend(fontsize="small")
    return {"aesmf-hover": hover, "aesmf-rates": rates, "aesmf-flight-bounds": bounds}
