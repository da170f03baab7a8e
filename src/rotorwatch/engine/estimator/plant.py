"""Wrench balance: commanded wrench = wrench that the motion needed + slow disturbances + shortfall of faulty rotors.

For each axis a of roll, pitch, yaw and thrust, in hover thrusts of one rotor (docs/methods/default.md derives it):

    y_a = G_a m_a + c_a r_a + l f_a + n k v + b1_a + b2_a + b3_a + sum_i (B_ai T_i + d_i) theta_i - sum_i d_i + noise

y = B T: commanded wrench; T: commanded thrusts; m: angular acceleration [rad/s^2], and for thrust the load factor times n; r: angular rate
[rad/s]; f: side force per mass [m/s^2], -right for roll and forward for pitch; v: speed along the thrust axis [m/s]; b1, b2: coloured
disturbances with time constants TAU; b3: a drift; d_i, for yaw: torque by the drag of rotor i in a side force (Martin and Salaun, ICRA
2010); theta_i: loss of rotor i. On coaxial frames the lower rotors of all arms give a share s more than in B: y_a - ... - s (dB/ds T)_a,
with B kept such that hover takes the same command. An error of the thrust curve is noise (model_error.py).

The state x is (b1, b2, b3, G, c) of each axis, where thrust, which has no damping, holds l in its last place; then AIR (k) and SHARE
(s). After it come the losses theta, from THETA on. The row of an axis is zero except in the axis' own states and from SIDEWAYS on.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, REAL, Real, Reals, Struct, array, exp, isnan, real, sqrt
from rotorwatch.base.physics import G0
from rotorwatch.engine.estimator.estimator_sizes import PLANT_STATES, ROTORS, STATES
from rotorwatch.engine.events.carried import STILL
from rotorwatch.engine.intake.craft import PITCH, ROLL, THRUST, YAW

PER_AXIS = 5
B1, B2, B3, GAIN, DAMPING = 0, 1, 2, 3, 4
SIDEWAYS, AIR, SHARE, THETA = 19, 20, 21, 22
YAW_GAIN, LOAD_GAIN = 13, 18

TAU = (0.25, 1.0)  # s
# Priors for any multirotor, in these units. Angular gains of roll, pitch and yaw, per rotor: squared radius of gyration over
# g times the arm (over g times the propellers' drag ratio for yaw), 3 to 60 cm arms. Air through the rotors and past the body damps motion
# at DAMPING_RATE in 1/s: damping is that rate times the gain, for any gain. Thrust against load factor is one to one by the choice of unit.
GAIN_MEAN = (0.005, 0.005, 0.13, 0.0)
GAIN_SD = (0.004, 0.004, 0.1, 0.005)
DAMPING_RATE, DAMPING_RATE_SD = 2.0, 1.5
# Hover thrusts per m/s^2 of side force and rotor: air that pushes the body sideways also tilts it, by blade flapping and by the point where
# the force acts. Real quadrotors: 0.05 to 0.2; rigid rotors in the plane of the centre of mass: 0.
SIDE, SIDE_SD = 0.05, 0.07
# Yaw, in hover thrusts, by a side force of 1 g through one rotor where rotors are one unit of B apart: arm over drag ratio. Arms grow with
# that gap and drag ratios with the propeller that fills it, so the product is similar for all frames: about 20 where the rotors take all of
# the side force, and 9 +- 3 in flights of real quadrotors (docs/methods/default.md).
DRAG = 6.0
BIAS_SD = (0.5, 0.5, 1.0, 0.4)
BUILT_SD = 0.03  # share by which rotors of a vehicle differ in thrust as built
# Standard deviation of a lower rotor's thrust relative to its share in B: it gives 75 to 95 % and more of the upper one's.
SHARE_SD = 0.12
# Per m/s of axial speed, rotors lose 0.4 of their hover thrust over the induced velocity, which is 4 m/s or more; body drag adds as much,
# and more on light vehicles: 0.03 to 0.1 in flights.
INFLOW, INFLOW_SD = 0.05, 0.05  # 1 / (m/s)
# Time constants [s] common to all parts: response of a controller; duration of a burst of errors beyond the noise model, as after a change;
# averaging of usual values.
ANSWER_S, BURST_S, USUAL_S = 0.5, 3.0, 6.0
ONE_ARM = 0.05  # units of B within which rotors are at the same position


class Plant(Struct):
    """A vehicle, its tick length, and priors before take-off. Constant; `set_plant` completes it."""

    rotors: int = 0
    dt: Real = 0.05  # length of a tick, s
    effect = array(REAL, 4, ROTORS)  # B: wrench of each rotor's thrust
    lower = array(REAL, ROTORS)  # 1 for the lower rotors of coaxial arms
    mean = array(REAL, PLANT_STATES)  # prior of the state
    variance = array(REAL, PLANT_STATES, PLANT_STATES)
    noise = array(REAL, 4, 4)  # prior variances of white noise, both coloured disturbances and the drift, of each axis
    noise_weight: Real = 0.0  # samples per lag that these are worth
    more = array(REAL, ROTORS)  # derivative of each rotor's thrust with respect to the lower rotors' share
    across = array(REAL, ROTORS)  # yaw by each rotor's drag per m/s^2 of side force to the right
    along = array(REAL, ROTORS)  # the same for a forward force
    decay = array(REAL, STATES)  # diagonal of the state's transition
    left = array(REAL, 2)  # share of b1 and b2 that is left after a tick


class Inputs(Struct):
    """Inputs of one tick: commanded thrusts in hover thrusts, motion, and the wrench with its validity."""

    thrust = array(REAL, ROTORS)
    turn = array(REAL, 3)  # angular acceleration, rad/s^2
    load: Real = 0.0  # load factor times the number of rotors
    rate = array(REAL, 3)  # rad/s
    forward: Real = 0.0  # side force, m/s^2
    right: Real = 0.0
    full: Real = 0.0  # full thrust of a rotor
    expo: Real = 0.0  # of the thrust curve
    expo_sd: Real = 0.0  # its standard deviation
    axial: Real = 0.0  # speed along the thrust axis, m/s, positive in a climb along it, 0 if unknown
    still: bool = False  # it is known to move neither up nor down
    mode: int = 0  # of intake/ticks.py, GROUND to ASSESS
    restart: bool = False  # widen the biases: a new hop, or after a contact
    hop: bool = False  # this restart is a new hop
    wrench = array(REAL, 4)
    valid = array(FLAG, 4)

    def climb(self, axial: Real) -> None:
        """Set the speed along the thrust axis, m/s; NaN: unknown."""
        self.axial = 0.0 if isnan(axial) else axial
        self.still = not isnan(axial) and abs(self.axial) <= STILL


class Rows(Struct):
    """Measurement matrix of a tick: y = h s + noise, one row per axis."""

    h = array(REAL, 4, STATES)
    drag = array(REAL, ROTORS)  # yaw by each rotor's drag


def set_plant(p: Plant) -> None:
    """Complete a plant whose rotors, dt, effect, lower, mean, variance, noise and noise_weight are set."""
    n = p.rotors
    gap = 0.0
    for i in range(n):
        for j in range(n):
            x = p.effect[0][i] / p.effect[3][i] - p.effect[0][j] / p.effect[3][j]
            y = p.effect[1][i] / p.effect[3][i] - p.effect[1][j] / p.effect[3][j]
            apart = sqrt(x * x + y * y)
            if max(abs(x), abs(y)) >= ONE_ARM and (gap <= 0.0 or apart < gap):
                gap = apart
    # The unit of thrust stays the hover command: extra thrust of the lower rotors reduces that of all.
    common = 0.0
    for i in range(n):
        common += p.effect[3][i] * p.lower[i] / real(n)
    for i in range(n):
        p.more[i] = p.lower[i] - common
        p.along[i] = DRAG / (gap * G0) * (p.effect[0][i] / p.effect[3][i]) if gap > 0.0 else 0.0
        p.across[i] = DRAG / (gap * G0) * (p.effect[1][i] / p.effect[3][i]) if gap > 0.0 else 0.0
    for k in range(2):
        p.left[k] = exp(-p.dt / TAU[k])
    for r in range(STATES):
        p.decay[r] = 1.0
    for a in range(4):
        p.decay[a * PER_AXIS + B1] = p.left[0]
        p.decay[a * PER_AXIS + B2] = p.left[1]


def _bent(share: Real, expo: Real) -> Real:
    """Derivative with respect to expo of the share of full thrust at the command that gives `share` under this expo."""
    straight = 1.0 - expo
    command = 2.0 * share / (sqrt(straight * straight + 4.0 * expo * share) + straight + 1e-9)
    return command * command - command


def bend(p: Plant, now: Inputs, thrust: Reals, usual: Real, out: Reals) -> None:
    """Extra thrust of each rotor at the same commands if the curve's expo were one standard deviation larger. The thrust at the command
    that gives `usual` is kept constant, since battery and air change it too."""
    full = max(now.full, 1e-3)
    usually = _bent(usual / full, now.expo)
    for i in range(p.rotors):
        own = _bent(min(max(thrust[i] / full, 0.0), 1.0), now.expo)
        out[i] = now.expo_sd * full * (own - thrust[i] / usual * usually)


def drag(p: Plant, thrust: Reals, forward: Real, right: Real, out: Reals) -> None:
    """Yaw torque by each rotor's in-plane drag; their sum is yaw that a healthy vehicle need not be commanded. forward, right: side force,
    m/s^2."""
    for i in range(p.rotors):
        out[i] = sqrt(max(thrust[i], 0.0)) * (p.along[i] * forward + p.across[i] * right)


def rows(p: Plant, now: Inputs, thrust: Reals, forward: Real, right: Real, s: Reals, out: Rows) -> None:
    """Measurement matrix of a tick for commands `thrust` and a side force [m/s^2]. s: state, source of the lower rotors' share."""
    n = p.rotors
    drag(p, thrust, forward, right, out.drag)
    for a in range(4):
        row = out.h[a]
        for r in range(THETA + n):
            row[r] = 0.0
        first = a * PER_AXIS
        row[first + B1] = 1.0
        row[first + B2] = 1.0
        row[first + B3] = 1.0
        row[first + GAIN] = now.load if a == THRUST else now.turn[a]
        if a < THRUST:
            row[first + DAMPING] = now.rate[a]
        for i in range(n):
            row[SHARE] -= p.effect[a][i] * p.more[i] * thrust[i]
            turned = out.drag[i] if a == YAW else 0.0
            row[THETA + i] = (p.effect[a][i] * thrust[i] + turned) * (1.0 + s[SHARE] * p.more[i])
    out.h[ROLL][SIDEWAYS] = -right
    out.h[PITCH][SIDEWAYS] = forward
    out.h[THRUST][AIR] = real(n) * now.axial


def entry(r: int, c: int) -> int:
    """Index of row r and column c in a symmetric matrix stored as its lower triangle, row by row."""
    return r * (r + 1) // 2 + c if r >= c else c * (c + 1) // 2 + r


def dot(row: Reals, s: Reals, axis: int, states: int) -> Real:
    """Product of an axis' row with the first `states` elements of the state."""
    total = 0.0
    for r in range(axis * PER_AXIS, min(axis * PER_AXIS + PER_AXIS, SIDEWAYS)):
        total += row[r] * s[r]
    for r in range(SIDEWAYS, states):
        total += row[r] * s[r]
    return total
