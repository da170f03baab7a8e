"""From a log's ticks to a plant and its table, the input of every published method on a real flight.

The default diagnoser's balance  B T (1 - theta) = G m + c r + b  (engine/estimator/plant.py; G motion gains, c damping, b biases)
is the rotational dynamics of systems/rate_dynamics.py in hover thrusts of one rotor:

    J = diag(G),   D = diag(c),   tau_0 = -b,   m = n G_T / g,   F_0 = -b_T

so the data that the default method learns gains and noise from - healthy flights, else the first seconds of this one - give
the plant. Roll and pitch torques are in arm lengths, yaw in drag ratios; a flat body, J_z = J_x + J_y, makes them one unit.

The trim b is of hover: learned in a climb it would be the air's, near 9 % of the thrust at 2.5 m/s. A hop's rows begin once it has hovered
for HOVER_S after the learning time, or waited WAIT_S for it. What the air column takes at the axial speed v, n k v, is added to the load.

A tick's rate is a mean over the tick; from one to the next it changes by what the commands of both did, so a row's u is the
mean of two ticks' commands, and f_z of two ticks' loads.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from rotorwatch.base.physics import G0
from rotorwatch.toolkit import AIR, ASSESS, DAMPING, GAIN, GROUND, LEARN, PER_AXIS, TAU, Ticks, program, usual_gains
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

GAIN_RANGE = 3.0  # a gain further than this factor from what any multirotor has was learned from noise
FASTEST_DAMPING = 5.0  # 1/s
LEAST_SD = 0.002  # hover thrusts: no torque is known better
LEAST_ACCEL_SD = 0.1  # m/s^2
STILL_M_S = 0.5  # axial speed of hover
HOVER_S, WAIT_S = 3.0, 10.0
LEAST_S = 1.0  # of learning


@dataclass(frozen=True)
class LogPlant:
    """A hop of a flight as the table of a plant. parameters: arrays that `system` makes the RateDynamics of.

    u (T, n) thrusts in hover thrusts of one rotor; y (T, 4) = (p, q, r [rad/s], f_z [m/s^2]); valid (T, 4); dt [s].
    rows (T,): which ticks they are; trimmed: those that taught the trim.
    """

    parameters: dict
    u: np.ndarray
    y: np.ndarray
    valid: np.ndarray
    rows: np.ndarray
    dt: float
    trimmed: np.ndarray

    @property
    def system(self) -> RateDynamics:
        """The plant, with values."""
        return plant(self.parameters)

    def part(self, start: int, stop: int | None = None) -> LogPlant:
        """Rows start..stop only."""
        cut = slice(start, stop)
        return replace(self, u=self.u[cut], y=self.y[cut], valid=self.valid[cut], rows=self.rows[cut])


def plant(parameters) -> RateDynamics:
    """RateDynamics of `parameters`: names of its constructor's arguments -> arrays, which may be traced."""
    return RateDynamics(**parameters)


def hops(table: Ticks, B: np.ndarray, dynamics: dict | None = None) -> tuple[LogPlant, ...]:
    """Plant and table of each hop of a flight, from the end of its learning time on; empty without such a hop.

    B (4, n): geometry. dynamics: learned from healthy flights (`default.learning.learn`); None: the hop's own first part,
    which is taken as healthy, teaches gains and noise. Trims are always the hop's own. Causal: a row uses nothing later than
    its tick. Raises ConfigError when the commands are too slow for the default estimator, which is the teacher.
    """
    starts = [*np.flatnonzero(table.restart), len(table.time)]
    candidates = (_hop(table, B, dynamics, a, b) for a, b in itertools.pairwise(starts))
    return tuple(hop for hop in candidates if hop is not None)


def _hop(table: Ticks, B: np.ndarray, dynamics: dict | None, start: int, stop: int) -> LogPlant | None:
    here = np.arange(start, stop)
    assessing = here[table.mode[here] == ASSESS]
    learning = here[table.mode[here] == LEARN]
    learning = learning[: np.searchsorted(learning, assessing[0])] if assessing.size else learning
    if not assessing.size or learning.size * table.dt < LEAST_S:
        return None
    axial = np.zeros(len(table.time)) if table.axial is None else np.nan_to_num(table.axial)
    trimmed, end = _hover(table, axial, learning, assessing)
    assessing = assessing[assessing > end]
    if not assessing.size:
        return None
    x, noise, k = _learned(_cut(table, start, end + 1), B, dynamics)
    G, c = _plausible(x.reshape(4, PER_AXIS), B.shape[1])
    load = table.load + k * axial / G[3]
    b = _trim(table, load, trimmed, G, c)
    previous = np.maximum(assessing - 1, start)
    u = 0.5 * (table.thrust[assessing] + table.thrust[previous])
    y = np.column_stack([table.rate[assessing], -0.5 * G0 * (load[assessing] + load[previous])])
    valid = table.valid[assessing] & table.valid[previous] & (table.mode[previous] > GROUND)[:, None]
    return LogPlant(parameters(B, G, c, b, noise, table.dt), u, y, valid, assessing, table.dt, trimmed)


def _hover(table: Ticks, axial: np.ndarray, learning: np.ndarray, assessing: np.ndarray) -> tuple[np.ndarray, int]:
    """The ticks to learn the trim from, and the last one before rows begin. axial (T,) m/s; learning, assessing: ticks of these modes."""
    candidates, wanted = np.concatenate([learning, assessing]), min(round(HOVER_S / table.dt), learning.size)
    latest = int(learning[-1]) + round(WAIT_S / table.dt)
    still = candidates[(np.abs(axial[candidates]) < STILL_M_S) & (candidates <= latest)]
    end = max(int(learning[-1]), int(still[wanted - 1])) if still.size >= wanted else latest
    still = still[still <= end]
    return still if still.size * table.dt >= LEAST_S else learning, end


def parameters(B: np.ndarray, G, c, b, noise: np.ndarray, dt: float) -> dict:
    """RateDynamics' arguments. B (4, n); gains G, damping c, biases b (4,); noise (4, 4): variances of the wrench's white part,
    two coloured parts and random walk [hover thrusts^2, the last per s], a column per axis; dt [s] of the ticks they hold for."""
    n = B.shape[1]
    to_common = np.array([1.0, 1.0, (G[0] + G[1]) / G[2]])  # yaw: drag ratios to arm lengths, as a flat body has it
    # What is slower than a tick counts as white noise of the same power at 0 Hz; drift as what drifts within a second.
    white, slow = noise[0], 2.0 * np.array(TAU) @ noise[1:3] + noise[3]
    # Half of the white part is taken as the gyro's (a difference of two samples), half as torque: tune.py estimates the
    # shares.
    gyro_sd = 0.5 * np.sqrt(white[:3]) * dt / G[:3]
    torque_sd = np.sqrt(0.5 * white[:3] * dt + slow[:3])
    accel_sd = np.sqrt(noise[:, 3].sum()) * G0 / (n * G[3])
    return {
        "J": np.diag(to_common * G[:3]),
        "B_tau": to_common[:, None] * B[:3],
        "B_T": B[3].copy(),
        "m": np.array(n * G[3] / G0),
        "gyro_sd": np.maximum(gyro_sd, LEAST_SD * dt / G[:3]),
        "accel_sd": np.array(max(accel_sd, LEAST_ACCEL_SD)),
        "torque_sd": to_common * np.maximum(torque_sd, LEAST_SD * np.sqrt(dt)),
        "damping": to_common * c[:3],
        "tau_0": -to_common * b[:3],
        "F_0": np.array(-b[3]),
    }


def _learned(part: Ticks, B: np.ndarray, dynamics: dict | None) -> tuple[np.ndarray, np.ndarray, float]:
    """State (20,), noise variances (4, 4) and loss of thrust by the air k [1 / (m/s)] of the default method: from healthy flights, else
    after the ticks of `part`."""
    if dynamics:
        return np.array(dynamics["x0"], float), np.array(dynamics["noise"], float), float(dynamics.get("air", [0.0])[0])
    carry, _ = program.estimate(part, B)
    s = np.asarray(carry.s)
    return s[: 4 * PER_AXIS], np.asarray(carry.variances), float(s[AIR])


def _plausible(x: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gains and damping (4,) that an n-rotor vehicle can have: in calm air little can be learned, and some of it wrong."""
    usual = usual_gains(n)
    G = np.clip(x[:, GAIN], usual / GAIN_RANGE, usual * GAIN_RANGE)
    return G, np.clip(x[:, DAMPING], 0.0, FASTEST_DAMPING * G * [1.0, 1.0, 1.0, 0.0])


def _trim(table: Ticks, load: np.ndarray, rows: np.ndarray, G: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(4,) median of the commanded wrench less what the motion, with this load (T,), shows; 0 on an axis that is not measured."""
    n = table.thrust.shape[1]
    motion = np.column_stack([table.rate_dot[rows], n * load[rows]])
    turning = np.column_stack([table.rate[rows], np.zeros(rows.size)])
    rest = table.wrench[rows] - G * motion - c * turning
    return np.array([np.median(r[ok]) if ok.any() else 0.0 for r, ok in zip(rest.T, table.valid[rows].T)])


def _cut(table: Ticks, start: int, stop: int) -> Ticks:
    """The ticks start..stop."""
    arrays = {k: v[start:stop] for k, v in vars(table).items() if isinstance(v, np.ndarray)}
    return replace(table, **arrays)
