"""A bank of onset times: what a jump at each of them would have done to the filter's innovations since.

For every onset time the part M of a unit jump that the filter has not absorbed is carried along, and with it the information
matrix C and vector z of the jump's size (Willsky & Jones, IEEE TAC 21(1), 1976). For a measurement h s with innovation
nu of variance S and any gain K:

    phi = h M,   C += phi' phi / S,   z += phi' nu / S,   M <- A (M - K phi)

Directions of a jump: a step of the bias of each axis; then two errors of the model, which are integrated out; then a loss of each rotor.
What it takes to yaw this vehicle is the least known of its gains, and the yaw that follows a loss is long and slow. How fast roll and
pitch die out is known only once it has moved: when it first flies off, both at once look like a rotor's loss.

Slots are reused in turn: dense for recent onsets, sparse for older ones, and a group for losses that show gradually, as a controller
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
SHORT, LONG = (1, 2, 4), (1, 5, 3)  # ticks between the slots of a group: for short ticks, and from SLOW_S on
SLOW_S = 0.08
YAW_ERROR, DAMPING_ERROR, FIRST_LOSS = 4, 5, 6  # directions; before them the steps of four axes


class Observed(Struct):
    """What one tick's measurement does to all onsets alike; an axis that does not count has no weight, as it has no gain."""

    weight = array(REAL, 4)  # 1 / S, times what evidence is worth in this weather
    absorbed = array(REAL, 4, 4)  # h_a K_b: axis a sees so much less of what axis b, before it, has seen of a jump

    def by(self, p: Plant, rows: Rows, leader: Branch, calm: Reals, counts: Flags) -> None:
        """By the filter whose innovations they are; calm: what evidence is worth in this weather."""
        for a in range(4):
            self.weight[a] = calm[a] / leader.S[a] if counts[a] else 0.0
            for b in range(a):
                self.absorbed[a][b] = dot(rows.h[a], leader.gain[b], a, THETA + p.rotors)


class Slots(Struct):
    """LANES onsets of a group, side by side."""

    age: Each = -1.0  # ticks since then, -1 unused
    gradual: bool = False  # of the group of losses that build up
    stride: Real = 1.0  # onsets that each stands for
    before = array(EACH, ROTORS)  # thrust of each rotor above the mean, lately, just before
    M = array(EACH, STATES, DIRECTIONS)
    C = array(EACH, CROSSES)  # symmetric: row by row, each up to its diagonal
    z = array(EACH, DIRECTIONS)

    def used(self) -> bool:
        """Whether any is."""
        for lane in range(LANES):
            if one(self.age, lane) >= 0.0:
                return True
        return False

    def open(self, p: Plant, lane: int, before: Reals) -> None:
        """A jump now."""
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
        """One tick on: a sudden jump comes at once, a gradual one by its share of each tick; fades: what of it is left after a tick."""
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
        """One tick's measurement, of all axes at once: what an axis shows of a jump is less by what those before it have absorbed."""
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
    """All onsets, slot k in lane k % LANES of its pack."""

    packs = array(Slots, packed(SLOTS))
    count: int = 0  # ticks so far
    reach: Real = 0.0  # ticks

    def begin(self, p: Plant) -> None:
        """All slots unused."""
        for k in range(SLOTS // LANES):
            group = k * LANES // GROUP
            self.packs[k].gradual = group == GROUPS - 1
            self.packs[k].stride = real(_stride(p, group))
            self.reach = max(self.reach, real(GROUP * _stride(p, group)))

    def advance(self, p: Plant, judge: bool, restart: bool, before: Reals, first: int, last: int) -> None:
        """The packs from `first` to `last` one tick on: where the flight is judged a slot of each group becomes a jump now; elsewhere all
        are unused."""
        fades = exp(-p.dt / ANSWER_S)
        for k in range(first, last):
            pack = self.packs[k]
            stride = _stride(p, k * LANES // GROUP)
            fresh = self.count // stride % GROUP if self.count % stride == 0 else -1
            for lane in range(LANES):
                if not judge or restart:
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
        """All slots unused: what they were compared with has changed."""
        for k in range(SLOTS // LANES):
            self.packs[k].age = each(-1.0)


class Window(Struct):
    """What the ticks since each onset say of a jump then, whatever the errors of the model: information C and vector z of its size."""

    C = array(EACH, DIRECTIONS, DIRECTIONS)
    z = array(EACH, DIRECTIONS)

    def reduce(self, p: Plant, slots: Slots, yaw_error: Real, damping_error: Real) -> None:
        """Of slots, with both errors of the model integrated out, of given variances: C - c c' / (C_ll + 1 / variance), and z alike.
        Damping has a least, which is 0: less of it than is known is not allowed for."""
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
