"""A bank of onset times: the effect that a jump at each of them would have had on the filter's innovations since.

For every onset time the bank propagates M, the part of a unit jump that the filter has not absorbed, and the information
matrix C and vector z of the jump's size (Willsky & Jones, IEEE TAC 21(1), 1976). For a measurement h s with innovation
nu of variance S and any gain K:

    phi = h M,   C += phi' phi / S,   z += phi' nu / S,   M <- A (M - K phi)

Directions of a jump: a step of the bias of each axis; then two model errors, which are integrated out; then a loss of each rotor. The two
errors are those of the yaw gain, the least known gain of the vehicle, because the yaw that follows a loss is long and slow; and of roll and
pitch damping, unknown until the vehicle has moved: when it first flies off, damping in both axes at once looks like a rotor's loss.

Slots are reused in turn: dense for recent onsets, sparse for older ones, and one group for losses that show gradually, as the controller
reveals them.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import (
    EACH,
    LANES,
    REAL,
    Each,
    Flags,
    Real,
    Reals,
    Struct,
    array,
    each,
    exp,
    local,
    one,
    packed,
    real,
    replaced,
)
from rotorwatch.engine.estimator.estimator_sizes import CROSSES, DIRECTIONS, ROTORS, SLOTS, STATES
from rotorwatch.engine.estimator.kalman import Branch
from rotorwatch.engine.estimator.plant import (
    ANSWER_S,
    B1,
    B2,
    B3,
    DAMPING,
    PER_AXIS,
    PITCH,
    ROLL,
    SIDEWAYS,
    THETA,
    THRUST,
    YAW,
    YAW_GAIN,
    Plant,
    Rows,
    dot,
    entry,
)

GROUP, GROUPS = 16, 3  # slots of a group
SHORT, LONG = (1, 2, 4), (1, 5, 3)  # ticks between the slots of each group: for short ticks, and for ticks of SLOW_S or longer
SLOW_S = 0.08
YAW_ERROR, DAMPING_ERROR, FIRST_LOSS = 4, 5, 6  # directions; 0 to 3 are the steps of the axes


class Observed(Struct):
    """Factors of one tick's measurement, common to all onsets. An axis without a valid measurement has weight 0, as its gain is 0."""

    weight = array(REAL, 4)  # 1 / S times `calm`
    absorbed = array(REAL, 4, 4)  # h_a K_b: share of a jump's effect on axis b that the update of b, before a, takes away from axis a

    def by(self, p: Plant, rows: Rows, leader: Branch, calm: Reals, counts: Flags) -> None:
        """Compute them from the leading filter. calm (4,): weight of evidence, lower in gusts (model_error.py); counts (4,): the axis is
        valid."""
        for a in range(4):
            self.weight[a] = calm[a] / leader.S[a] if counts[a] else 0.0
            for b in range(a):
                self.absorbed[a][b] = dot(rows.h[a], leader.gain[b], a, THETA + p.rotors)


class Slots(Struct):
    """LANES onsets of a group, one per SIMD lane."""

    age: Each = -1.0  # ticks since the onset, -1 unused
    gradual: bool = False  # in the group of losses that build up
    stride: Real = 1.0  # onset ticks that each slot represents
    before = array(EACH, ROTORS)  # each rotor's smoothed thrust above the mean, just before the onset
    M = array(EACH, STATES, DIRECTIONS)
    C = array(EACH, CROSSES)  # symmetric: row by row, each up to its diagonal
    z = array(EACH, DIRECTIONS)

    def used(self) -> bool:
        """Whether any lane is in use."""
        for lane in range(LANES):
            if one(self.age, lane) >= 0.0:
                return True
        return False

    def open(self, p: Plant, lane: int, before: Reals) -> None:
        """Start an onset at this tick in a lane. before: thrust of each rotor above the mean."""
        directions = FIRST_LOSS + p.rotors
        self.age = replaced(self.age, lane, 0.0)
        for r in range(THETA + p.rotors):
            for d in range(directions):
                self.M[r][d] = replaced(self.M[r][d], lane, 0.0)
        for d in range(directions):
            self.z[d] = replaced(self.z[d], lane, 0.0)
        for e in range(entry(directions, 0)):
            self.C[e] = replaced(self.C[e], lane, 0.0)
        for i in range(p.rotors):
            self.before[i] = replaced(self.before[i], lane, before[i])

    def advance(self, p: Plant, fades: Real) -> None:
        """Propagate by one tick. A sudden jump comes at once, a gradual one in exponentially decreasing parts; fades: share still to come
        after one tick."""
        directions = FIRST_LOSS + p.rotors
        for a in range(4):
            for b in range(a * PER_AXIS + B1, a * PER_AXIS + B2 + 1):
                row = self.M[b]
                for d in range(directions):
                    row[d] *= p.decay[b]
        share = each(0.0)
        comes = False
        for lane in range(LANES):
            age = one(self.age, lane)
            if age >= 0.0 and (self.gradual or age <= 0.0):
                share = replaced(share, lane, (1.0 - fades) * exp(-p.dt / ANSWER_S * age) if self.gradual else 1.0)
                comes = True
        if not comes:
            return
        for a in range(4):
            self.M[a * PER_AXIS + B3][a] += share
        self.M[YAW_GAIN][YAW_ERROR] += share
        self.M[ROLL * PER_AXIS + DAMPING][DAMPING_ERROR] += share
        self.M[PITCH * PER_AXIS + DAMPING][DAMPING_ERROR] += share
        for i in range(p.rotors):
            self.M[THETA + i][FIRST_LOSS + i] += share

    def observe(self, p: Plant, rows: Rows, leader: Branch, by: Observed) -> None:
        """Update M, C and z with one tick's measurement. Axes are updated in sequence, so an axis shows less of a jump by the part that the
        axes before it have absorbed."""
        directions = FIRST_LOSS + p.rotors
        phi = local(EACH, 4, DIRECTIONS)
        for a in range(4):
            shown = phi[a]
            h = rows.h[a]
            for part in range(2):
                first = a * PER_AXIS if part == 0 else SIDEWAYS
                last = min(first + PER_AXIS, SIDEWAYS) if part == 0 else THETA + p.rotors
                for r in range(first, last):
                    row = self.M[r]
                    effect = h[r]
                    for d in range(directions):
                        shown[d] += effect * row[d]
            for b in range(a):
                absorbed = by.absorbed[a][b]
                earlier = phi[b]
                for d in range(directions):
                    shown[d] -= absorbed * earlier[d]
        roll = phi[ROLL]
        pitch = phi[PITCH]
        yaw = phi[YAW]
        thrust = phi[THRUST]
        nu = leader.innovation
        for d in range(directions):
            first = entry(d, 0)
            of_roll = by.weight[ROLL] * roll[d]
            of_pitch = by.weight[PITCH] * pitch[d]
            of_yaw = by.weight[YAW] * yaw[d]
            of_thrust = by.weight[THRUST] * thrust[d]
            for e in range(d + 1):
                self.C[first + e] += of_roll * roll[e] + of_pitch * pitch[e] + of_yaw * yaw[e] + of_thrust * thrust[e]
            self.z[d] += of_roll * nu[ROLL] + of_pitch * nu[PITCH] + of_yaw * nu[YAW] + of_thrust * nu[THRUST]
        for r in range(THETA + p.rotors):
            row = self.M[r]
            of_roll = leader.gain[ROLL][r]
            of_pitch = leader.gain[PITCH][r]
            of_yaw = leader.gain[YAW][r]
            of_thrust = leader.gain[THRUST][r]
            for d in range(directions):
                row[d] -= of_roll * roll[d] + of_pitch * pitch[d] + of_yaw * yaw[d] + of_thrust * thrust[d]


class Bank(Struct):
    """All onsets; slot k is lane k % LANES of pack k // LANES."""

    packs = array(Slots, packed(SLOTS))
    count: int = 0  # ticks so far
    reach: Real = 0.0  # oldest onset, ticks

    def begin(self, p: Plant) -> None:
        """Configure the groups; all slots are unused."""
        for k in range(SLOTS // LANES):
            group = k * LANES // GROUP
            self.packs[k].gradual = group == GROUPS - 1
            self.packs[k].stride = real(_stride(p, group))
            self.reach = max(self.reach, real(GROUP * _stride(p, group)))

    def advance(self, p: Plant, assess: bool, restart: bool, before: Reals, first: int, last: int) -> None:
        """Propagate packs `first` to `last` - 1 by one tick. When `assess` is set, a slot of each group starts a new onset at its stride;
        else, or at a restart, all become unused. before: thrust of each rotor above the mean."""
        fades = exp(-p.dt / ANSWER_S)
        for k in range(first, last):
            pack = self.packs[k]
            stride = _stride(p, k * LANES // GROUP)
            fresh = self.count // stride % GROUP if self.count % stride == 0 else -1
            for lane in range(LANES):
                if not assess or restart:
                    pack.age = replaced(pack.age, lane, -1.0)
                elif fresh == (k * LANES + lane) % GROUP:
                    pack.open(p, lane, before)
                elif one(pack.age, lane) >= 0.0:
                    pack.age = replaced(pack.age, lane, one(pack.age, lane) + 1.0)
            if pack.used():
                pack.advance(p, fades)
        if last == SLOTS // LANES:
            self.count += 1

    def age(self, slot: int) -> Real:
        """Ticks since the onset of a slot, -1 unused."""
        return one(self.packs[slot // LANES].age, slot % LANES)

    def forget(self) -> None:
        """Mark all slots unused, because the filter that they refer to has changed."""
        for k in range(SLOTS // LANES):
            self.packs[k].age = each(-1.0)


class Window(Struct):
    """Information matrix C and vector z of a jump's size at each onset, with the model errors integrated out."""

    C = array(EACH, DIRECTIONS, DIRECTIONS)
    z = array(EACH, DIRECTIONS)

    def reduce(self, p: Plant, slots: Slots, yaw_error: Real, damping_error: Real) -> None:
        """Integrate both model errors, of the given prior variances, out of the slots' C and z: C - c c' / (C_ll + 1 / variance), and z
        likewise. The damping error may only be positive (less damping than the state has is not considered): where its score is negative
        its prior variance is set to nearly 0."""
        directions = FIRST_LOSS + p.rotors
        damping = local(EACH, DIRECTIONS)
        for d in range(directions):
            damping[d] = slots.C[entry(d, DAMPING_ERROR)]
        prior = damping_error if slots.z[DAMPING_ERROR] > 0.0 else 1e-12
        inverse = 1.0 / (damping[DAMPING_ERROR] + 1.0 / prior)
        for d in range(directions):
            first = entry(d, 0)
            out = self.C[d]
            share = damping[d] * inverse
            for e in range(d + 1):
                out[e] = slots.C[first + e] - share * damping[e]
            self.z[d] = slots.z[d] - share * slots.z[DAMPING_ERROR]
        yaw = local(EACH, DIRECTIONS)
        for d in range(directions):
            yaw[d] = self.C[max(d, YAW_ERROR)][min(d, YAW_ERROR)]
        score = self.z[YAW_ERROR]
        inverse = 1.0 / (yaw[YAW_ERROR] + 1.0 / yaw_error)
        for d in range(directions):
            mine = self.C[d]
            share = yaw[d] * inverse
            for e in range(d + 1):
                mine[e] -= share * yaw[e]
                self.C[e][d] = mine[e]
            self.z[d] -= share * score


def _stride(p: Plant, group: int) -> int:
    return int(LONG[group]) if p.dt >= SLOW_S else int(SHORT[group])
