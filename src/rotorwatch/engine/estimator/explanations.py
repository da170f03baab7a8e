"""Explanations of one change, compared on all motion before and after it.

Each explanation is a filter of its own (kalman.py) over the same ticks. They are alike until the onset. From then on an explanation may
hold a loss of some rotors, a rotor stuck at one thrust, capped, or slower than before, a step or a drift of the trim, and a free wrench:
disturbances `force` times as strong as in the rest of the flight, as the ground, a tether, a wake or a gust cause. Its
evidence is the likelihood of all four axes after the onset,

    log p = sum_k sum_a [ -log S_a / 2 - nu_a^2 / (2 S_a) ]

with the innovations nu and their variances S of its filter. A loss must thus predict what follows as well as the healthy model predicted
what came before: where it does not, a free wrench, alone or beside the loss, has more evidence.
"""

from __future__ import annotations

from rotorwatch.base.compiling.structs import MASK, REAL, Flags, Real, Reals, Struct, array, copy, exp, local, log, sqrt
from rotorwatch.base.physics import G0
from rotorwatch.engine.estimator.batch import take
from rotorwatch.engine.estimator.estimator import Estimator
from rotorwatch.engine.estimator.estimator_sizes import ROTORS
from rotorwatch.engine.estimator.hypotheses import NONE
from rotorwatch.engine.estimator.kalman import Branch, Measured
from rotorwatch.engine.estimator.noise import DRIFT, FAST, SLOW, Noise
from rotorwatch.engine.estimator.plant import B1, B2, B3, PER_AXIS, THETA, Inputs, Plant, Rows, drag, entry, set_plant
from rotorwatch.engine.intake.craft import PITCH, ROLL, THRUST, YAW
from rotorwatch.engine.intake.ticks import ASSESS

WIDTH = 0.5  # standard deviation of a loss before the data
LEANS = 0.5  # standard deviation of the thrust that a push takes, of that where the vehicle leans into it: free to move, it need not
SETTLES_S = 0.3  # after a begin or an end whose tick is not known exactly, and which no explanation is to predict


class Explanation(Struct):
    """What an explanation holds from the onset on, and its result."""

    rotors: int = 0  # set of those that lose thrust
    end: int = 0  # tick at which they have it again
    grows: Real = 0.0  # walk of the loss, 1 per sqrt(s)
    late: Real = 0.0  # s by which their thrust lags behind the command, instead of a loss; 0: they lose thrust
    cap: Real = 0.0  # most thrust that they give, hover thrusts, instead of a loss; 0: as much as commanded
    turned: Real = 0.0  # standard deviation of the yaw by their turned mounts, as a share of their thrust's in B, instead of a loss
    gives: Real = 0.0  # standard deviation of the thrust that they give whatever they are commanded, hover thrusts; 0: they follow
    step = array(REAL, 4)  # standard deviation of a step of the trim, hover thrusts
    force: Real = 1.0  # factor of the disturbances
    drift: Real = 0.0  # of the trim in roll and pitch by a centre of mass that moves, hover thrusts per sqrt(s)
    lever: Real = 0.0  # arm over drag ratio: side force yaws the vehicle about the moved centre of mass
    push: Real = 0.0  # standard deviation of both parts of a torque that turns with the world, by a force from outside, hover thrusts
    swells: Real = 0.0  # walk of that torque, hover thrusts per sqrt(s)
    lift: Real = 0.0  # thrust that the push takes where the vehicle leans into it, hover thrusts
    side = array(REAL, 2)  # forward and right side force at the onset, m/s^2
    carriers = array(MASK, 3)  # rotors whose states hold that torque, by the north and the east of the force at the onset, and that thrust
    ahead: Real = 1.0  # cosine and sine of the turn since the onset
    aside: Real = 0.0
    load: Real = 0.0  # share of the trim of roll and pitch that grows with the thrust of all rotors, as that of a centre of mass does
    moved = array(REAL, 2)  # trim of roll and pitch at the onset
    fit: Real = 0.0  # log p
    loss = array(REAL, ROTORS)  # at its end
    variance = array(REAL, ROTORS)
    thrust = array(REAL, ROTORS)  # of the rotors that lag, at this tick


def explain(
    p: Plant,
    e: Estimator,
    variances: Reals,
    count: int,
    u: Reals,
    y: Reals,
    valid: Flags,
    onset: int,
    many: int,
    them: list[Explanation],
    others: list[Branch],
) -> None:
    """Compare `many` explanations over `count` ticks of one hop. variances: of the noise, 4 components of 4 axes; u, y, valid: as in
    `batch.run`; onset: a tick; others: filters of all but the first, which is the filter of all until the onset. The first explanation's
    state decides how far inputs are trusted."""
    n = p.rotors
    now = Inputs()
    set_plant(p)
    e.begin(p)
    for c in range(4):
        for a in range(4):
            e.noise.v[c][a] = variances[4 * c + a]
    e.branches.all[0].weight = 0.0
    for k in range(many):
        them[k].fit = 0.0
    wrench = local(REAL, 4)
    begin = onset + max(int(SETTLES_S / p.dt), 1)
    for t in range(count):
        first = t * (n + 15)
        if t == onset:
            for k in range(1, many):
                copy(others[k - 1], e.branches.all[0])
            for k in range(many):
                for i in range(n):
                    them[k].thrust[i] = now.thrust[i]
                them[k].side[0] = e.seen.forward
                them[k].side[1] = e.seen.right
        differing = many if t >= onset else 1
        take(p, u, first, now)
        now.mode = ASSESS
        now.restart = t == 0
        for a in range(4):
            now.wrench[a] = y[4 * t + a]
            now.valid[a] = valid[4 * t + a]
        again = t > 0 and u[first + n + 14] > 0.5
        _predict(p, e.branches.all[0], them[0], e.noise, again, t, onset, begin)
        for k in range(1, differing):
            _predict(p, others[k - 1], them[k], e.noise, again, t, onset, begin)
        e.look(p, now, True)
        for a in range(4):
            wrench[a] = e.measured.y[a]
            e.measured.counts[a] = e.measured.counts[a] and (t < onset or t >= begin)
        _update(p, e, e.branches.all[0], them[0], now, t >= onset, t >= begin)
        for k in range(1, differing):
            for a in range(4):
                e.measured.y[a] = wrench[a]
            _update(p, e, others[k - 1], them[k], now, True, t >= begin)
    if them[0].end >= count:
        _read(p, e.branches.all[0], them[0])
    for k in range(1, many):
        if them[k].end >= count:
            _read(p, others[k - 1], them[k])


def _predict(p: Plant, one: Branch, how: Explanation, noise: Noise, again: bool, t: int, onset: int, begin: int) -> None:
    """Predict an explanation's filter by one tick. again: after a contact; begin: from this tick on the change counts."""
    if again:
        one.open(p)
    _change(p, one, how, t, begin)
    one.predict(p, noise, 1.0, True)
    if t >= onset and t < how.end and how.grows > 0.0:
        for i in range(p.rotors):
            if (how.rotors & (1 << i)) != 0:
                one.P[entry(THETA + i, THETA + i)] += how.grows * how.grows * p.dt
    if t >= begin and t < how.end and how.push > 0.0:
        for k in range(2):
            one.P[entry(THETA + how.carriers[k], THETA + how.carriers[k])] += how.swells * how.swells * p.dt
    if t >= onset:
        _stir(p, one, noise, how.force * how.force - 1.0, how.drift)


def _update(p: Plant, e: Estimator, one: Branch, how: Explanation, now: Inputs, changed: bool, settled: bool) -> None:
    """Update an explanation's filter with the tick that `e` measures, from the onset on (`changed`) by what it holds, and its evidence."""
    m = e.measured
    if changed:
        _lag(p, how, now, m)
        if how.load > 0.0:
            _weigh(p, one, how, now, m)
        if how.lever > 0.0:
            _lever(one, how, now, m)
    if how.push > 0.0 and settled:
        _turn(how, now.rate[2] * p.dt)
        m.y[YAW] -= _by_push(p, how, e)
        _push(p, how, e.rows, m, one, e.seen.gain_share)
    elif how.turned > 0.0 and settled:
        _yaws(p, how, e.rows, m, one, e.seen.gain_share)
    else:
        one.update(p, e.rows, m, e.seen.gain_share)
    for a in range(4):
        if changed and m.counts[a]:
            how.fit -= 0.5 * (log(one.S[a]) + one.innovation[a] * one.innovation[a] / one.S[a])


def _change(p: Plant, one: Branch, how: Explanation, t: int, onset: int) -> None:
    """Apply what begins or ends at tick t."""
    begins = t == onset
    if begins:
        how.moved[0] = one.s[ROLL * PER_AXIS + B3]
        how.moved[1] = one.s[PITCH * PER_AXIS + B3]
    ends = t == how.end and t > onset
    if ends:
        _read(p, one, how)
    for i in range(p.rotors):
        if (how.rotors & (1 << i)) == 0 or how.late > 0.0 or how.cap > 0.0:
            continue
        if begins:
            wide = how.turned if how.turned > 0.0 else WIDTH
            one.P[entry(THETA + i, THETA + i)] += wide * wide
            one.active[i] = True
            if how.gives > 0.0:
                one.forget(p, THETA + i)
                one.s[THETA + i] = 1.0
                one.P[entry(THETA + i, THETA + i)] = NONE * NONE
                for a in range(4):
                    for b in range(a + 1):
                        both = p.effect[a][i] * p.effect[b][i] * how.gives * how.gives
                        one.P[entry(a * PER_AXIS + B3, b * PER_AXIS + B3)] += both
        if ends:
            one.forget(p, THETA + i)
            one.active[i] = False
    if how.push > 0.0 and (begins or ends):
        how.ahead = 1.0
        how.aside = 0.0
        for k in range(_carried(how)):
            held = THETA + how.carriers[k]
            one.forget(p, held)
            if begins:
                wide = how.push if k < 2 else LEANS * how.lift
                one.s[held] = 0.0 if k < 2 else how.lift
                one.P[entry(held, held)] = wide * wide
    if begins or (ends and how.push <= 0.0):
        for a in range(4):
            one.P[entry(a * PER_AXIS + B3, a * PER_AXIS + B3)] += how.step[a] * how.step[a]


def _lag(p: Plant, how: Explanation, now: Inputs, m: Measured) -> None:
    """Take from the commanded wrench what rotors that lag do not give yet, and what is beyond a cap."""
    for i in range(p.rotors):
        if (how.rotors & (1 << i)) != 0 and how.cap > 0.0:
            for a in range(4):
                if m.counts[a]:
                    m.y[a] -= p.effect[a][i] * max(now.thrust[i] - how.cap, 0.0)
        if (how.rotors & (1 << i)) == 0 or how.late <= 0.0:
            continue
        follows = 1.0 - exp(-p.dt / how.late) if now.valid[0] else 1.0
        how.thrust[i] += follows * (now.thrust[i] - how.thrust[i])
        for a in range(4):
            if m.counts[a]:
                m.y[a] -= p.effect[a][i] * (now.thrust[i] - how.thrust[i])


def _yaws(p: Plant, how: Explanation, h: Rows, m: Measured, one: Branch, gain_share: Reals) -> None:
    """Update an explanation whose rotors only yaw the vehicle."""
    kept = local(REAL, 4, ROTORS)
    for a in range(4):
        for i in range(p.rotors):
            kept[a][i] = h.h[a][THETA + i]
            if a != YAW and (how.rotors & (1 << i)) != 0:
                h.h[a][THETA + i] = 0.0
    one.update(p, h, m, gain_share)
    for a in range(4):
        for i in range(p.rotors):
            h.h[a][THETA + i] = kept[a][i]


def _turn(how: Explanation, angle: Real) -> None:
    """Turn the heading by a small angle."""
    ahead = how.ahead - how.aside * angle
    aside = how.aside + how.ahead * angle
    size = sqrt(ahead * ahead + aside * aside)
    how.ahead = ahead / size
    how.aside = aside / size


def _carried(how: Explanation) -> int:
    """Number of carriers of a push: without its thrust where too few rotors are free."""
    return 3 if (how.rotors & (1 << how.carriers[2])) == 0 else 2


def _by_push(p: Plant, how: Explanation, e: Estimator) -> Real:
    """Yaw by the drag of all rotors in the side force that has come with a push, which acts elsewhere."""
    dragged = local(REAL, ROTORS)
    drag(p, e.seen.thrust, e.seen.forward - how.side[0], e.seen.right - how.side[1], dragged)
    total = 0.0
    for i in range(p.rotors):
        total += dragged[i]
    return total


def _push(p: Plant, how: Explanation, h: Rows, m: Measured, one: Branch, gain_share: Reals) -> None:
    """Update an explanation with a force from outside that keeps its direction and its point: its torque, which is that of a force to the
    right in roll and of one forward in pitch (plant.py), turns against the vehicle's heading. It takes thrust where the vehicle leans."""
    kept = local(REAL, 4, 3)
    carried = _carried(how)
    for k in range(carried):
        for a in range(4):
            kept[a][k] = h.h[a][THETA + how.carriers[k]]
            h.h[a][THETA + how.carriers[k]] = 0.0
    for k in range(2):
        h.h[ROLL][THETA + how.carriers[k]] = how.aside if k == 0 else -how.ahead
        h.h[PITCH][THETA + how.carriers[k]] = how.ahead if k == 0 else how.aside
    if carried > 2:
        h.h[THRUST][THETA + how.carriers[2]] = 1.0
    one.update(p, h, m, gain_share)
    for k in range(carried):
        for a in range(4):
            h.h[a][THETA + how.carriers[k]] = kept[a][k]


def _weigh(p: Plant, one: Branch, how: Explanation, now: Inputs, m: Measured) -> None:
    """Take off what the trim of roll and pitch gains with the thrust T of all rotors, T0 in hover: load b (T / T0 - 1)."""
    more = -1.0
    for i in range(p.rotors):
        more += now.thrust[i] / p.rotors
    for a in range(2):
        if m.counts[a]:
            m.y[a] -= how.load * one.s[a * PER_AXIS + B3] * more


def _lever(one: Branch, how: Explanation, now: Inputs, m: Measured) -> None:
    """Take off the yaw by the side force f [m/s^2] that acts off the moved centre of mass: lever (b_pitch f_right + b_roll f_forward) / g,
    with the changes b of the commanded roll and pitch since the onset."""
    of_roll = one.s[ROLL * PER_AXIS + B3] - how.moved[0]
    of_pitch = one.s[PITCH * PER_AXIS + B3] - how.moved[1]
    m.y[YAW] -= how.lever * (of_pitch * now.right + of_roll * now.forward) / G0


def _read(p: Plant, one: Branch, how: Explanation) -> None:
    for i in range(p.rotors):
        how.loss[i] = one.s[THETA + i]
        how.variance[i] = one.P[entry(THETA + i, THETA + i)]


def _stir(p: Plant, one: Branch, noise: Noise, more: Real, drift: Real) -> None:
    """Add the disturbances of a free wrench, and the drift of a centre of mass."""
    for a in range(4):
        b = a * PER_AXIS
        one.P[entry(b + B1, b + B1)] += more * noise.v[FAST][a] * (1.0 - p.left[0] * p.left[0])
        one.P[entry(b + B2, b + B2)] += more * noise.v[SLOW][a] * (1.0 - p.left[1] * p.left[1])
        one.P[entry(b + B3, b + B3)] += more * noise.v[DRIFT][a] * p.dt
        if a < YAW:
            one.P[entry(b + B3, b + B3)] += drift * drift * p.dt
