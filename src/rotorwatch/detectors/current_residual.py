"""PX4's newer motor failure check, by what an ESC draws less or more than expected, re-built from its pull requests 26262, 27711 and 27917.

The current that a command u is expected to draw is I = a u^2 + b u + c, one model for all motors. What a motor draws beyond it, low-passed
over 0.2 s, must stay within a band on both sides: a motor that lost its propeller draws less, one that is stuck or rubs draws more. The
check runs at 10 Hz; a motor that has left the band for the hold time has failed until it is disarmed.

Model and band are the log's parameters where the check was on (FD_ACT_EN):

    MOTFAIL_QUAD, MOTFAIL_C2T, MOTFAIL_IDLE     a, b, c [A]; the first of 27917's first versions, which later ones lack
    MOTFAIL_LOW_OFF, MOTFAIL_HIGH_OFF           the band of 26262 [A], without a filter; MOTFAIL_OFF: of 26990, both sides
    MOTFAIL_UNDER, MOTFAIL_OVER, MOTFAIL_REL    the band of 27917 [A], and a share of the expected current that is added
    MOTFAIL_TIME, MOTFAIL_UND_TIME, .._OVR_TIME the hold time [s]

Elsewhere PX4's own values are those of another vehicle, and report "failures on perfectly healthy flights" (docs of its replay tool): the
model is then fitted to the first seconds of this flight, and the band is that of PX4's replay tool, in proportion (5 A and a fifth of the
expected current, for 0.4 s, of a vehicle of 75 A).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion import allocation
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

name = "px4-current-residual"
autopilot = "PX4"
STEP_S, TAU_S, GAP_S = 0.1, 0.2, 0.3  # of the check; of its filter; after which that starts anew
C2T, OFF, HOLD_S = 35.0, 10.0, 1.0  # defaults of MOTFAIL_C2T [A], of the band [A] and of MOTFAIL_TIME [s]
# Band of the replay tool: shares of the current at full command and of the expected one; hold time.
FLAT, SHARE, FITTED_HOLD_S = 5.0 / 75.0, 0.2, 0.4
IDLE = 2.88 / 71.97  # of the replay tool: c of a
LEARN_S, FEWEST, TURNS = 10.0, 40, 10  # of flight, and samples in it, that a fit needs; of its reweighting
LOWEST = 0.05  # share of the commands of that flight below the lowest that count as flown
USUAL, PRIOR_SD = 1.5, 0.5  # standard deviations from which a sample counts less; of the coefficients, of the largest


class _Rule(NamedTuple):
    """model: a, b, c [A]; for less and for more current: flat part of the band [A] (inf: not checked) and the hold time [s]; share: of the
    expected current, added to both; tau_s: of the filter. fitted: to this flight; least: command below which low current is ignored,
    because such commands were not flown."""

    model: np.ndarray
    under: tuple[float, float]
    over: tuple[float, float]
    share: float
    tau_s: float = TAU_S
    fitted: bool = False
    least: float = 0.0

    def expected(self, command: np.ndarray) -> np.ndarray:
        return np.maximum(np.polyval(self.model, command), 0.0)


def detect(flight: Flight, vehicle: Vehicle, airborne: allocation.Spans) -> tuple[dict[str, Any], ...]:
    """At most one finding for each rotor; none where ESC currents are not logged."""
    if not flight.has("esc", "motors") or not airborne:
        return ()
    esc, low, high = flight["esc"], vehicle.curve.u_min, vehicle.curve.u_max
    rotors = [k for k in range(1, flight["motors"].values.shape[1] + 1) if f"current{k}" in esc.columns]
    airborne_rows = np.flatnonzero(allocation.within(esc.time, airborne))
    airborne_rows = airborne_rows[np.diff(np.floor(esc.time[airborne_rows] / STEP_S), prepend=-1.0) > 0]  # the check's own rate
    if not rotors or not airborne_rows.size:
        return ()
    columns, time = [esc.columns.index(f"current{k}") for k in rotors], esc.time[airborne_rows]
    share = np.clip((flight["motors"].values - low) / (high - low), 0.0, 1.0)
    command = allocation.hold(flight["motors"].time, share, time)[:, [k - 1 for k in rotors]]
    current, valid = esc.values[airborne_rows][:, columns], esc.valid[airborne_rows][:, columns]
    valid &= np.isfinite(command) & np.isfinite(current)
    valid &= np.maximum.accumulate(np.where(valid, current, 0.0), axis=0) > 0.0
    early = valid & (time < time[0] + LEARN_S)[:, None]
    rule = _rule(flight.parameters, command[early], current[early])
    if rule is None:
        return ()
    expected = rule.expected(command)
    beyond = _filtered(time, np.where(valid, current - expected, 0.0), valid, rule.tau_s)
    findings: dict[int, dict[str, Any]] = {}
    for (flat, hold_s), sign, word in ((rule.under, -1.0, "less"), (rule.over, 1.0, "more")):
        left = valid & (sign * beyond > flat + rule.share * expected) & ((sign > 0.0) | (command >= rule.least))
        for k, rotor in enumerate(rotors):
            at = _first(time, left[:, k], hold_s)
            if at is None or (rotor in findings and findings[rotor]["time_s"] <= time[at]):
                continue
            needs = f"than its command of {command[at, k]:.0%} needs ({expected[at, k]:.1f} A)"
            reason = f"ESC {rotor} drew {abs(beyond[at, k]):.1f} A {word} {needs}, for {hold_s:.1f} s"
            reason += "; model fitted to the first seconds of this flight" if rule.fitted else ""
            findings[rotor] = {"detector": name, "rotor": rotor, "time_s": float(time[at]), "reason": reason}
    return tuple(sorted(findings.values(), key=lambda one: one["time_s"]))


def _rule(parameters: Mapping[str, float], command: np.ndarray, current: np.ndarray) -> _Rule | None:
    """That of the autopilot where its check was on; otherwise one that fits these commands and currents (K,), None of too few."""
    if parameters.get("FD_ACT_EN") and any(key.startswith("MOTFAIL_") for key in parameters):
        parameter = parameters.get
        over = parameter("MOTFAIL_OVER", parameter("MOTFAIL_OFF", parameter("MOTFAIL_HIGH_OFF", OFF))) or np.inf
        under = parameter("MOTFAIL_UNDER", parameter("MOTFAIL_OFF", parameter("MOTFAIL_LOW_OFF", OFF))) or over
        hold = parameter("MOTFAIL_TIME", HOLD_S)
        model = np.array([parameter("MOTFAIL_QUAD", 0.0), parameter("MOTFAIL_C2T", C2T), parameter("MOTFAIL_IDLE", 0.0)], float)
        sides = (under, parameter("MOTFAIL_UND_TIME", hold)), (over, parameter("MOTFAIL_OVR_TIME", hold))
        plain = {"MOTFAIL_LOW_OFF", "MOTFAIL_HIGH_OFF"} & parameters.keys()
        return _Rule(model, *sides, parameter("MOTFAIL_REL", 0.0), 0.0 if plain else TAU_S)
    if command.size < FEWEST or not median(command) > 0.0 or not median(current) > 0.0:
        return None
    model = _fit(command, current)
    side = FLAT * float(np.polyval(model, 1.0)), FITTED_HOLD_S
    return _Rule(model, side, side, SHARE, fitted=True, least=float(np.quantile(command, LOWEST)))


def _fit(command: np.ndarray, current: np.ndarray) -> np.ndarray:
    """(3,) a, b, c [A] by reweighted least squares. What the commands flown do not show stays at a (u^2 + IDLE)."""
    X = np.vander(command, 3)
    largest = float(median(current) / median(command**2 + IDLE))
    start = largest * np.array([1.0, 0.0, IDLE])
    model, prior = start, np.eye(3) / (PRIOR_SD * largest)
    for _ in range(TURNS):
        error = current - X @ model
        sd = max(1.48 * float(median(np.abs(error))), 1e-3 * largest)
        weight = 1.0 / (sd * np.sqrt(np.maximum(np.abs(error) / (USUAL * sd), 1.0)))
        A, y = np.vstack([X * weight[:, None], prior]), np.concatenate([current * weight, prior @ start])
        model = np.linalg.lstsq(A, y, rcond=None)[0]
    return model


def _filtered(time: np.ndarray, beyond: np.ndarray, valid: np.ndarray, tau_s: float) -> np.ndarray:
    """(K, n) low-passed; from nothing after a gap, and as it was where a sample is not valid."""
    step = np.diff(time, prepend=time[:1])
    gap = max(GAP_S, 2.0 * float(median(step)))  # of logs that hold fewer reports than the check had
    out, state = np.zeros_like(beyond), np.zeros(beyond.shape[1])
    for k, dt in enumerate(step):
        share = dt / (tau_s + dt) if tau_s + dt > 0.0 else 1.0
        state = np.where(valid[k], state + share * (beyond[k] - state), state) if dt <= gap else 0.0 * state
        out[k] = state
    return out


def _first(time: np.ndarray, left: np.ndarray, hold_s: float) -> int | None:
    """The first index at which `left` (K,) has held for `hold_s`."""
    begins = left & ~np.append(False, left[:-1])
    since = np.maximum.accumulate(np.where(begins, time, -np.inf))
    held = left & (time - since >= hold_s - 1e-9)
    return int(np.argmax(held)) if held.any() else None
