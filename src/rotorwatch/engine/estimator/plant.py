"""Commanded wrench = what the motion needed + slow disturbances + what faulty rotors did not deliver.

For each axis a of roll, pitch, yaw and thrust, in hover thrusts of one rotor (docs/methods/default.md derives it):

    y_a = G_a m_a + c_a r_a + l f_a + n k v + b1_a + b2_a + b3_a + sum_i (B_ai T_i + d_i) theta_i - sum_i d_i + noise

y = B T: commanded wrench; T: commanded thrusts; m: angular acceleration [rad/s^2], and for thrust the load factor times n; r: angular rate
[rad/s]; f: side force per mass [m/s^2], -right for roll and forward for pitch; v: speed along the thrust axis [m/s]; b1, b2: coloured
disturbances with time constants TAU; b3: a drift; d_i, for yaw: what the drag of rotor i turns in a side force (Martin and Salaun, ICRA
2010); theta_i: loss of rotor i. On coaxial frames the lower rotors of all arms give a share s more than B says: y_a - ... - s (dB/ds T)_a,
with B kept such that hover takes the same command. How far the thrust curve is bent is a state as well.

The state x is (b1, b2, b3, G, c) of each axis, where thrust, which has no damping, holds l in its last place; then CURVE, AIR (k), SHARE
(s). After it come the losses theta, from THETA on. A row of an axis is zero but in the axis' own states and from SIDEWAYS on.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, REAL, Real, Reals, Struct, array, exp, local, real, sqrt
from rotorwatch.base.physics import G0
from rotorwatch.engine.estimator.estimator_sizes import PLANT_STATES, ROTORS, STATES
from rotorwatch.engine.intake.craft import PITCH, ROLL, THRUST, YAW

PER_AXIS = 5
B1, B2, B3, GAIN, DAMPING = 0, 1, 2, 3, 4
SIDEWAYS, CURVE, AIR, SHARE, THETA = 19, 20, 21, 22, 23
YAW_GAIN, LOAD_GAIN = 13, 18

TAU = (0.25, 1.0)  # s
# What any multirotor is like, in these units. Angular gains of roll, pitch and yaw, per rotor: squared radius of gyration over
# g times the arm (over g times the propellers' drag ratio for yaw), 3 to 60 cm arms. Motion dies out, at DAMPING_RATE in
# 1/s, from air through the rotors and past the body: damping is that rate times the gain, whatever the gain turns out to be.
# Thrust against load factor is one to one by the choice of unit.
GAIN_MEAN = (0.005, 0.005, 0.13, 0.0)
GAIN_SD = (0.004, 0.004, 0.1, 0.005)
DAMPING_RATE, DAMPING_RATE_SD = 2.0, 1.5
# Hover thrusts per m/s^2 of side force and rotor: air that pushes the body sideways also tilts it, by the flapping of its blades and by
# where it pushes. Real quadrotors: 0.05 to 0.2; rigid rotors in the plane of the centre of mass: 0.
SIDE, SIDE_SD = 0.05, 0.07
# Yaw, in hover thrusts, that a side force of 1 g through one rotor makes where rotors stand one unit of B apart: arm over drag ratio.
# Arms grow with that gap and drag ratios with the propeller that fills it, so the product is alike for all frames: about 20 where rotors
# take all of the side force, and 9 +- 3 in flights of real quadrotors (docs/methods/default.md).
DRAG = 6.0
BIAS_SD = (0.5, 0.5, 1.0, 0.4)
BUILT_SD = 0.03  # by which a rotor's thrust differs from the others' as vehicles are built: a share of it
# Of a lower rotor's thrust, relative to what its share in B says: 75 to 95 % and more of the upper one's.
SHARE_SD = 0.12
# Rotors lose 0.4 of their hover thrust over the induced velocity, which is 4 m/s and more; drag of the body adds as much and more where it
# is light: 0.03 to 0.1 in flights.
INFLOW, INFLOW_SD = 0.05, 0.05  # 1 / (m/s)
# Times [s] that all parts share: by when a controller has answered what happened; how long a burst lasts, of errors that the noise model
# does not expect, as a change brings them; over which what is usual is averaged.
ANSWER_S, BURST_S, USUAL_S = 0.5, 3.0, 6.0
ONE_ARM = 0.05  # units of B within which rotors stand in the same place


class Plant(Struct):
    """One vehicle with its ticks, and what is known before take-off. Constant; `set_plant` completes it."""

    rotors: int = 0
    dt: Real = 0.05  # length of a tick, s
    effect = array(REAL, 4, ROTORS)  # B: wrench of each rotor's thrust
    lower = array(REAL, ROTORS)  # 1 for the lower rotors of coaxial arms
    mean = array(REAL, PLANT_STATES)  # of the state
    variance = array(REAL, PLANT_STATES, PLANT_STATES)
    noise = array(REAL, 4, 4)  # variances of white noise, both coloured ones and the drift, of each axis
    noise_weight: Real = 0.0  # samples a lag that these count for
    more = array(REAL, ROTORS)  # by how much each rotor's thrust grows with the lower rotors' share
    across = array(REAL, ROTORS)  # yaw that each rotor's drag makes of a force forward, and to the right
    along = array(REAL, ROTORS)
    decay = array(REAL, STATES)  # diagonal of the state's transition
    left = array(REAL, 2)  # share of b1 and b2 that is left after a tick


class Inputs(Struct):
    """What one tick brings: commanded thrusts in hover thrusts, motion, and which of the wrench can be believed."""

    thrust = array(REAL, ROTORS)
    turn = array(REAL, 3)  # angular acceleration, rad/s^2
    load: Real = 0.0  # load factor times the number of rotors
    rate = array(REAL, 3)  # rad/s
    forward: Real = 0.0  # side force, m/s^2
    right: Real = 0.0
    full: Real = 0.0  # full thrust of a rotor
    expo: Real = 0.0  # of the thrust curve
    expo_sd: Real = 0.0  # its standard deviation
    axial: Real = 0.0  # speed along the thrust axis, m/s, above 0 where the vehicle climbs along it; 0 where it is not known
    mode: int = 0
    restart: bool = False  # biases are open again: a new hop, or after a contact
    hop: bool = False
    wrench = array(REAL, 4)
    valid = array(FLAG, 4)


class Rows(Struct):
    """One tick's measurement y = h s + noise, an axis a row."""

    h = array(REAL, 4, STATES)
    drag = array(REAL, ROTORS)  # yaw that each rotor's drag makes


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
    # The unit of thrust stays the hover command: what the lower rotors give more, all give less.
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
    """By how much a steeper curve changes the share of full thrust that the command of this share gives."""
    straight = 1.0 - expo
    command = 2.0 * share / (sqrt(straight * straight + 4.0 * expo * share) + straight + 1e-9)
    return command * command - command


def bend(p: Plant, now: Inputs, thrust: Reals, usual: Real, out: Reals) -> None:
    """Thrust that each rotor gives more where the curve's expo is a standard deviation larger, at the same commands, while that of the
    command that gives `usual` stays as it is: battery and air change that, too."""
    full = max(now.full, 1e-3)
    usually = _bent(usual / full, now.expo)
    for i in range(p.rotors):
        own = _bent(min(max(thrust[i] / full, 0.0), 1.0), now.expo)
        out[i] = now.expo_sd * full * (own - thrust[i] / usual * usually)


def bent_wrench(p: Plant, bends: Reals, out: Reals) -> None:
    """What `bend` of the rotors does to each axis."""
    for a in range(4):
        out[a] = 0.0
        for i in range(p.rotors):
            out[a] += p.effect[a][i] * bends[i]


def drag(p: Plant, thrust: Reals, forward: Real, right: Real, out: Reals) -> None:
    """Yaw that each rotor's drag in the plane of the rotors makes; of all together, what a healthy vehicle need not be commanded."""
    for i in range(p.rotors):
        out[i] = sqrt(max(thrust[i], 0.0)) * (p.along[i] * forward + p.across[i] * right)


def rows(p: Plant, now: Inputs, thrust: Reals, forward: Real, right: Real, s: Reals, usual: Real, out: Rows) -> None:
    """The measurement of a tick, for commands `thrust` and a side force; s: state, which the thrust curve and the lower rotors' share are
    taken from; usual: mean thrust lately, about which the curve is bent."""
    n = p.rotors
    bends = local(REAL, ROTORS)
    bend(p, now, thrust, usual, bends)
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
            row[CURVE] -= p.effect[a][i] * bends[i]
            row[SHARE] -= p.effect[a][i] * p.more[i] * thrust[i]
            given = max(thrust[i] + s[CURVE] * bends[i], 0.0)
            turned = out.drag[i] if a == YAW else 0.0
            row[THETA + i] = (p.effect[a][i] * given + turned) * (1.0 + s[SHARE] * p.more[i])
    out.h[ROLL][SIDEWAYS] = -right
    out.h[PITCH][SIDEWAYS] = forward
    out.h[THRUST][AIR] = real(n) * now.axial


def entry(r: int, c: int) -> int:
    """Where row r and column c of a symmetric matrix stand that is kept row by row, each up to its diagonal."""
    return r * (r + 1) // 2 + c if r >= c else c * (c + 1) // 2 + r


def dot(row: Reals, s: Reals, axis: int, states: int) -> Real:
    """A row of an axis times a state."""
    total = 0.0
    for r in range(axis * PER_AXIS, min(axis * PER_AXIS + PER_AXIS, SIDEWAYS)):
        total += row[r] * s[r]
    for r in range(SIDEWAYS, states):
        total += row[r] * s[r]
    return total
