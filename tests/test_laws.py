"""Laws that hold for every estimator there is, on the plants it runs on; see docs/architecture.md.

Published methods run on rotational dynamics (a quad in hover thrusts, a hexa in SI) that are flown in closed loop by a made-up
pilot; the default method runs on the plant of its own. A law is a function that looks at a `Case` and asserts; further down
each law is shown to catch a planted error.
"""

import functools
import inspect
import os
from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.base import discovery
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.core import Estimate
from rotorwatch.engine.bindings import plant_rows as plant
from rotorwatch.engine.bindings import program
from rotorwatch.engine.bindings.default import Default
from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.estimator.plant import PER_AXIS, TAU, THETA
from rotorwatch.engine.motion.tick_table import ASSESS, GROUND, LEARN
from rotorwatch_lab.estimators.adaptive_ekf import AdaptiveEKF
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.experiments import limits
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

DT, TICKS = 0.02, 220
THETA_VAR = 0.1  # of the losses on the linear plant: much of what an innovation is made of
TAKE_OFF, READY, ONSET = 5, 80, 110
GAPS = (slice(50, 60), slice(95, 103), slice(130, 150))  # no measurement at all
BLIND_AXIS = slice(65, 75)  # only the thrust axis is missing
LONG = 6  # the tick whose length is looked at
LOSS = 0.3
FORBIDDEN = {"while", "sort", "lu", "qr", "geqrf", "eigh", "eig", "svd", "pure_callback", "io_callback"}

jax = load_jax()


def rates_quad():
    """A quad in hover thrusts of one rotor, as logs are assessed."""
    B = airframes.named("ardupilot-quad-x").effectiveness()
    return RateDynamics(np.diag([0.012, 0.013, 0.025]), np.diag([1, 1, 0.08]) @ B[:3], B[3], 4 / 9.80665, 0.01, 0.3, 0.01 * np.ones(3))


def rates_hexa():
    """The hexarotor of a paper, SI, with trim, so that theta is not seen through the torque alone."""
    return RateDynamics.of(airframes.paper("niermeyer-hexa"))


def wrench_quad():
    """The plant of the default method."""
    B = airframes.named("ardupilot-quad-x").effectiveness()
    names = [f"{axis}.{what}" for axis in plant.AXES for what in ("b1", "b2", "b3", "gain", "damping")]
    names[-1] = "side force"
    return SimpleNamespace(B=B, n_x=THETA, n_theta=4, n_y=4, n_u=19, x_names=(*names, "air", "lower rotors' share"))


def gaps():
    valid = np.ones((TICKS, 4), bool)
    for gap in GAPS:
        valid[gap] = False
    valid[BLIND_AXIS, 3] = False
    return valid


@functools.cache
def plant_of(make):
    """(plant, its f, its h), compiled once for all flights."""
    system = make()
    return system, jax.jit(system.f), jax.jit(system.h)


@functools.cache
def flown(make, seed=0, loss=0.0, spread=0.0):
    """(u, y, valid, x) of a flight on rotational dynamics with the noise the plant says: hover, rates damped by the pilot, every
    rotor excited; rotor 2 loses `loss` at ONSET. spread: size of the losses that all rotors have from the start."""
    rng = np.random.default_rng(seed)
    system, f, h = plant_of(make)
    n = system.n_u
    B = np.vstack([system.B_tau, system.B_T])
    hover = np.linalg.pinv(B) @ np.array([0, 0, 0, system.m * 9.80665])
    share = np.linalg.pinv(B)[:, :3] @ np.diag(np.diag(system.J)) * 8.0
    root = np.linalg.cholesky(np.asarray(system.Q(DT)))
    first = spread * np.abs(np.random.default_rng(100 + seed).standard_normal(n))  # none below 0: some methods know that
    x, rows = np.asarray(system.x0) + 0.1 * rng.standard_normal(3), []
    for k in range(TICKS):
        theta = first + np.where(np.arange(n) == 1, loss * (k >= ONSET), 0.0)
        wiggle = 0.05 * hover * np.sin(0.9 * k * DT * 2 * np.pi + np.arange(n))
        u = np.clip(hover + wiggle - share @ x, 0.05 * hover, 3.0 * hover)
        x = np.asarray(f(x, u, theta, DT)) + root @ rng.standard_normal(3)
        y = np.asarray(h(x, u, theta)) + np.sqrt(np.asarray(system.R(u))) * rng.standard_normal(4)
        rows.append((u, y, x))
    u, y, x = (np.array(column) for column in zip(*rows, strict=True))
    return u, y, gaps(), x


@functools.cache
def balanced(seed=0, motion=1.0, loss=LOSS, mode=None):
    """(u, y, valid) of a quad hovering in light wind, for the default method; rotor 2 loses `loss` at ONSET. motion: how much it turns."""
    rng = np.random.default_rng(seed)
    system = wrench_quad()
    B, n = system.B, system.n_theta
    wind = np.zeros((TICKS, 4))
    for k in range(1, TICKS):
        wind[k] = 0.95 * wind[k - 1] + 0.01 * rng.standard_normal(4)
    rate_dot, rate = (motion * 0.2 * rng.standard_normal((TICKS, 3)) for _ in range(2))
    load = 1.0 + motion * 0.02 * rng.standard_normal(TICKS)
    needed = np.column_stack([0.012 * rate_dot[:, :2], 0.25 * rate_dot[:, 2], n * load]) + wind
    share = np.ones((TICKS, n))
    share[ONSET:, 1] -= loss
    # The controller commands what makes up for the loss: B diag(share) thrust = needed.
    thrust = np.stack([np.linalg.solve(B * s, w) for s, w in zip(share, needed, strict=True)])
    thrust += 0.004 * rng.standard_normal((TICKS, n))
    table = SimpleNamespace(
        thrust=thrust, rate_dot=rate_dot, load=load, rate=rate, side=None, hover=np.full(TICKS, 0.4), curve=(0.65, 0.0), axial=None
    )
    when = np.arange(TICKS)
    if mode is None:
        mode = np.where(when < TAKE_OFF, GROUND, np.where(when < READY, LEARN, ASSESS))
    u = np.column_stack([plant.packed(table, n), np.broadcast_to(mode, TICKS), when == TAKE_OFF]).astype(float)
    return u, thrust @ B.T, gaps()


def estimate_of(out):
    return out if isinstance(out, Estimate) else out.estimate


class Case:
    """One estimator on one plant, with its compiled run over a flight."""

    reverse = False  # for a planted error

    def __init__(self, kind, make, dt=DT):
        self.kind, self.make, self.dt = kind, make, dt
        self.own_plant = make is wrench_quad
        self.system = make()
        self.estimator = kind(self.system, dt)
        self._compiled = None

    def flight(self, seed=0, loss=LOSS):
        return balanced(seed, loss=loss) if self.own_plant else flown(self.make, seed, loss)[:3]

    def run(self, u, y, valid, dt=None):
        """Stacked estimates; dt (T,) where steps differ."""

        def tick(carry, row):
            carry, out = self.estimator.step(carry, *row)
            return carry, estimate_of(out)

        rows = (u, y, valid) if dt is None else (u, y, valid, dt)
        return jax.lax.scan(tick, self.estimator.init(), rows, reverse=self.reverse)[1]

    def over(self, u, y, valid, dt=None):
        """Every step is given its length: one compiled program, whatever a law asks."""
        if self._compiled is None:
            self._compiled = jax.jit(lambda *table: self.run(*table))
        return jax.tree.map(np.asarray, self._compiled(u, y, valid, np.full(len(u), self.dt) if dt is None else dt))

    @functools.cached_property
    def usual(self):
        return self.over(*self.flight())


class DefaultCase(Case):
    """The default estimator, which is a definition: it is stepped, not traced."""

    def __init__(self):
        self.kind, self.make, self.dt, self.own_plant, self.system = Default, wrench_quad, 0.05, True, wrench_quad()
        self.estimator = Default(self.system.B, self.dt)

    def over(self, u, y, valid):
        carry, rows = self.estimator.init(), []
        for row in zip(u, y, valid, strict=True):
            carry, out = self.estimator.step(carry, *row)
            rows.append(out)
        return Estimate(*(np.stack(column) for column in zip(*rows, strict=True)))


def published():
    return {name: kind for name, kind in discovery.estimators().items() if name != "default"}


# A method whose laws are always tried on a hexacopter as well.
HEXA_TOO = ("tsukf",)
CASES = [(name, make) for name in published() for make in (rates_quad, rates_hexa)]


@functools.cache
def case_of(name, make):
    return DefaultCase() if name == "default" else Case(discovery.estimator(name), make)


def assert_same(one, other, **tolerance):
    for name, a, b in zip(Estimate._fields, one, other, strict=True):
        if tolerance:
            np.testing.assert_allclose(a, b, err_msg=name, **tolerance)
        else:
            np.testing.assert_array_equal(a, b, err_msg=name)


# The laws.


def shapes_and_kinds_are_the_documented_ones(case):
    n_x, n_theta, n_y = case.system.n_x, case.system.n_theta, case.system.n_y
    sizes = [(n_x,), (n_x, n_x), (n_theta,), (n_theta, n_theta), (n_y,), (n_y, n_y), ()]
    assert [leaf.shape for leaf in case.usual] == [(TICKS, *size) for size in sizes]
    assert [leaf.dtype for leaf in case.usual] == [np.float64] * 6 + [np.int32]


def everything_stays_finite(case):
    for name, leaf in zip(Estimate._fields, case.usual, strict=True):
        assert np.isfinite(leaf).all(), name


def losses_are_shares(case):
    if case.own_plant or getattr(case.kind, "bounded", False):
        assert case.usual.theta.min() >= 0 and case.usual.theta.max() <= 1


def status_says_what_a_tick_was(case):
    """1 at the start only, while a method fills its window; then 0, and 2 where nothing is measured."""
    measured = case.flight()[2].any(axis=1)
    ready = TAKE_OFF if case.own_plant else int(np.argmax(case.usual.status != 1))
    assert ready < 50 and set(case.usual.status[:ready]) <= {1}
    np.testing.assert_array_equal(case.usual.status[ready:], np.where(measured, 0, 2)[ready:])


def a_step_is_made_of_what_can_run_anywhere(case):
    """No loops of unknown length, nothing that a microcontroller could not do: docs/architecture.md, rules 3 and 4."""
    u, y, valid = case.flight()
    traced = jax.make_jaxpr(case.estimator.step)(case.estimator.init(), u[0], y[0], valid[0])
    assert set(primitives(traced.jaxpr)) & FORBIDDEN == set()
    assert {str(v.aval.dtype) for v in traced.jaxpr.outvars} <= {"float64", "int32", "bool"}
    found = set(primitives(jax.make_jaxpr(jax.numpy.linalg.inv)(np.eye(2)).jaxpr))
    assert found & FORBIDDEN  # else the list has lost touch with the library's names


def primitives(jaxpr):
    """Names of all operations of a traced function, those inside loops, branches and calls included."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from primitives(inner)


def causal(case):
    """What comes later changes nothing of what was said before."""
    cut = ONSET + 12
    mixed = [np.concatenate([a[:cut], b[cut:]]) for a, b in zip(case.flight(), case.flight(1, 0.6), strict=True)]
    mixed[2][cut:] = ~mixed[2][cut:]
    changed = case.over(*mixed)
    assert_same([leaf[:cut] for leaf in case.usual], [leaf[:cut] for leaf in changed])
    assert not np.array_equal(changed.x[cut:], case.usual.x[cut:])


def what_is_not_valid_does_not_count(case):
    u, y, valid = case.flight()
    for garbage in (1e30, -1e30, np.nan):
        assert_same(case.usual, case.over(u, np.where(valid, y, garbage), valid))


def covariances_are_symmetric_and_not_negative(case):
    for name in ("x_cov", "theta_cov", "innovation_cov"):
        P = getattr(case.usual, name)
        np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2), err_msg=name)
        # Scaled to a unit diagonal: states have units of their own.
        sd = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-30))
        least = np.linalg.eigvalsh(P / sd[:, :, None] / sd[:, None, :]).min(axis=1)
        assert (least > -1e-9).all(), f"{name} at tick {least.argmin()}: {least.min()}"


def nothing_is_learned_where_nothing_is_measured(case):
    """In a gap no loss becomes surer, nor any state that stays as it is; innovations are 0."""
    constant = np.array([name.endswith(("b3", "gain", "damping")) for name in case.system.x_names])
    theta = np.diagonal(case.usual.theta_cov, axis1=1, axis2=2)
    x = np.diagonal(case.usual.x_cov, axis1=1, axis2=2)
    for gap in GAPS:
        for variance in (theta, x[:, constant] if constant.any() else x.sum(axis=1, keepdims=True)):
            inside = variance[gap.start - 1 : gap.stop]
            assert (np.diff(inside, axis=0) >= -1e-9 * inside[:-1]).all(), gap
        assert (case.usual.innovation[gap] == 0).all()


def many_flights_at_once_are_the_same_as_one_by_one(case):
    """And a step that is given no length has the constructor's."""
    flights = case.flight(), case.flight(2, 0.0)
    together = jax.jit(jax.vmap(case.run))(*(np.stack(column) for column in zip(*flights, strict=True)))
    for k, table in enumerate(flights):
        assert_same(case.over(*table), [np.asarray(leaf[k]) for leaf in together], rtol=1e-6, atol=1e-9)


def compiled_is_the_same_as_not(case):
    """And a step that is given no length has the constructor's."""
    u, y, valid = case.flight()
    carry = case.estimator.init()
    for k in range(2):
        carry, out = case.estimator.step(carry, u[k], y[k], valid[k])
        assert_same([leaf[k] for leaf in case.usual], estimate_of(out), rtol=1e-9, atol=1e-12)


def errors_are_as_large_as_the_covariance_says(case):
    """Healthy flights with the plant's own noise: states and losses lie within three standard deviations; where the method is
    the Kalman filter, the normalised error squared (NEES) is the number of states as well."""
    if case.own_plant:
        return  # its noise model is learned in flight: tests/test_default_estimator.py
    inside_x, inside_theta, nees = [], [], []
    for seed in (0, 1, 2):
        u, y, valid, x = flown(case.make, seed, 0.0)
        estimate = case.over(u, y, valid)
        late = slice(10, None)
        error, P = (estimate.x - x)[late], estimate.x_cov[late]
        inside_x.append((np.abs(error) <= 3.0 * np.sqrt(np.diagonal(P, axis1=1, axis2=2))).mean())
        sd = np.sqrt(np.diagonal(estimate.theta_cov, axis1=1, axis2=2))[late]
        inside_theta.append((np.abs(estimate.theta[late]) <= 3.0 * sd).mean())
        nees.append(np.einsum("ti,tij,tj->t", error, np.linalg.inv(P), error).mean())
    assert min(inside_x) > 0.97, f"states: {inside_x}"
    assert min(inside_theta) > 0.9, f"losses: {inside_theta}"
    if not case.kind.not_kalman:
        assert 0.75 * case.system.n_x < np.mean(nees) < 1.3 * case.system.n_x, nees


def innovations_are_as_large_as_their_covariance_says(case):
    """The normalised innovation squared (NIS) of flights whose losses are drawn from the prior is the number of measurements in
    the mean. Fixed gains and bounds may expect more than comes, never less."""
    if case.own_plant or case.kind.name in ONE_AT_A_TIME:
        return  # its noise model is learned in flight
    nis = []
    for seed in (10, 11, 12):
        u, y, valid, _ = flown(case.make, seed, spread=0.1)
        estimate = case.over(u, y, valid)
        whole = valid.all(axis=1) & (estimate.status == 0) & (np.arange(TICKS) > 1)
        e, S = estimate.innovation[whole], estimate.innovation_cov[whole]
        nis.append(np.einsum("ti,tij,tj->t", e, np.linalg.inv(S), e).mean() / case.system.n_y)
    assert 0.02 < np.mean(nis) < 1.15, nis
    if case.kind.name not in NO_POSTERIOR:
        assert np.mean(nis) > 0.8, nis


def remembering(kind):
    """A method that forgets, with a memory as long as these flights."""

    class Remembering(kind):
        def __init__(self, system, dt):
            super().__init__(system, dt, memory_s=4.0)

    return Remembering


def a_loss_is_found(case):
    """Half of it soon, at the end its size, in the right rotor and in no other; of a set, that it holds a loss and no longer none."""
    if case.kind.name in FORGETFUL and case.make is rates_hexa:
        case = Case(remembering(case.kind), case.make)  # four measurements do not tell six losses apart within 0.2 s
    size, onset = case.usual.theta, slice(ONSET, None)
    if case.kind.name in SETS:
        if case.make is rates_hexa:
            return  # six losses by four measurements stay wider than the loss for as long as such a flight lasts
        reach = np.sqrt(np.diagonal(case.usual.theta_cov, axis1=1, axis2=2))
        truth = np.where(np.arange(size.shape[1]) == 1, LOSS, 0.0)
        assert (np.abs(size[-1] - truth) <= reach[-1]).all()
        low = size - reach
        assert low[:ONSET].max() < 0 and (low[ONSET:, 1] > 0).any() and (np.delete(low, 1, axis=1) < 0).all()
        return
    half = np.flatnonzero(size[onset, 1] > LOSS / 2)
    assert np.abs(size[READY:ONSET]).max() < RESTLESS.get(case.kind.name, 0.1)
    assert half.size and half[0] * case.dt < 1.1, half[:1]
    last = size[-10:].mean(axis=0)
    assert last.argmax() == 1 and abs(last[1] - LOSS) < 0.15, last


SETS = ("esmf", "aesmf")
FORGETFUL = ("akf", "adaptive_ekf", "axkf")
# Its window is short: .11 before any loss, six of them by four measurements.
RESTLESS = {"atsukf": 0.15}
# Bounds; covariances of observers with fixed gains.
NO_POSTERIOR = (*SETS, "lyapunov", "mh_lyapunov", "intermediate", "thau", "sliding_mode")
ONE_AT_A_TIME = ("imm",)  # flights whose rotors are all a little weak are not what they expect
MEASURED = ("irls", "parity")  # the state is taken as measured, what is not is not filtered


LAWS = [
    shapes_and_kinds_are_the_documented_ones,
    everything_stays_finite,
    losses_are_shares,
    status_says_what_a_tick_was,
    a_step_is_made_of_what_can_run_anywhere,
    causal,
    what_is_not_valid_does_not_count,
    covariances_are_symmetric_and_not_negative,
    nothing_is_learned_where_nothing_is_measured,
    errors_are_as_large_as_the_covariance_says,
    innovations_are_as_large_as_their_covariance_says,
    a_loss_is_found,
]
# Compiled once more each. Left to ROTORWATCH_FULL_LAW=1: esmf.
SLOW_LAWS = [many_flights_at_once_are_the_same_as_one_by_one, compiled_is_the_same_as_not]
FULL = os.environ.get("ROTORWATCH_FULL_LAW") == "1"
SLOW_CASES = [c for c in CASES if c[1] is not rates_hexa and (FULL or c[0] != "esmf")]


# aesmf has all of the step of esmf.
LATER = [name == "esmf" or (make is rates_hexa and name not in HEXA_TOO) for name, make in CASES]
EACH = [pytest.param(*case, marks=[pytest.mark.thorough] * later) for case, later in zip(CASES, LATER, strict=True)]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
@pytest.mark.parametrize(("name", "make"), EACH, ids=lambda v: v if isinstance(v, str) else v.__name__)
def test_law(name, make, law):
    law(case_of(name, make))


@pytest.mark.parametrize("law", [law for law in LAWS if law is not a_step_is_made_of_what_can_run_anywhere], ids=lambda law: law.__name__)
def test_law_of_the_default(law):
    """What can run anywhere is what the translator takes (test_definitions.py); other pieces give the same bits (test_engine.py)."""
    law(case_of("default", wrench_quad))


# JAX batches and compiles what a step is made of, whichever method; the others with --thorough.
USUAL = {many_flights_at_once_are_the_same_as_one_by_one: ("imm",), compiled_is_the_same_as_not: ("ukf",)}
SLOW = [
    pytest.param(name, make, law, marks=[] if name in USUAL[law] else pytest.mark.thorough, id=f"{name}-{law.__name__}")
    for name, make in SLOW_CASES
    for law in SLOW_LAWS
]


@pytest.mark.parametrize(("name", "make", "law"), SLOW)
def test_slow_law(name, make, law):
    law(case_of(name, make))


# Steps of different length, and the Kalman filter.


class Linear:
    """x+ = A x + dt B (u o (1 - theta)),  y = C x + D (u o (1 - theta)): linear and Gaussian for given u."""

    name, n_x, n_u, n_theta, n_y = "linear", 3, 2, 2, 3
    x_names, x0, P0 = ("a", "b", "c"), np.array([0.3, -0.2, 0.1]), np.diag([0.5, 0.3, 0.4])
    drift = np.array([[-0.4, 1.0, 0.0], [-1.0, -0.3, 0.2], [0.1, 0.0, -0.6]])
    B = np.array([[1.0, -0.5], [0.3, 0.8], [0.0, 1.2]])
    C = np.array([[1.0, 0.0, 0.2], [0.0, 1.0, 0.0], [0.3, 0.0, 0.0]])
    D = np.array([[0.0, 0.0], [0.0, 0.0], [0.7, -0.9]])

    def A(self, dt):
        return np.eye(3) + dt * self.drift

    def f(self, x, u, theta, dt):
        return self.A(dt) @ x + dt * self.B @ (u * (1.0 - theta))

    def h(self, x, u, theta):
        return self.C @ x + self.D @ (u * (1.0 - theta))

    def Q(self, dt):
        return dt * np.diag([1e-2, 2e-2, 5e-3])

    def R(self, u):
        return np.array([1e-2, 2e-2, 1.5e-2])


def linear_table(T=60, seed=0):
    """Random inputs and measurements with gaps, and steps of different lengths."""
    rng = np.random.default_rng(seed)
    valid = rng.random((T, 3)) < 0.8
    valid[[0, 1, 20, 21]] = False  # the first two show the method's prior
    return rng.normal(1, 0.5, (T, 2)), rng.normal(0, 1, (T, 3)), valid, rng.uniform(0.5, 1.5, T) * DT


def kalman(system, x, P, walk, table):
    """Textbook Kalman filter of [x; theta], dense and in NumPy, Joseph's form; yields Estimates without status."""
    n = system.n_x
    for u, y, valid, dt in zip(*table, strict=True):
        F = np.block([[system.A(dt), -dt * system.B * u], [np.zeros((2, n)), np.eye(2)]])
        H = np.hstack([system.C, -system.D * u])
        x = F @ x + np.concatenate([dt * system.B @ u, np.zeros(2)])
        P = F @ P @ F.T
        P[:n, :n] += system.Q(dt)
        P[n:, n:] += dt * walk
        e = np.where(valid, y - H @ x - system.D @ u, 0.0)
        S = H @ P @ H.T + np.diag(system.R(u))
        K = np.linalg.solve(S[np.ix_(valid, valid)], H[valid] @ P).T
        x = x + K @ e[valid]
        I_KH = np.eye(n + 2) - K @ H[valid]
        P = I_KH @ P @ I_KH.T + K @ np.diag(system.R(u)[valid]) @ K.T
        yield x[:n], P[:n, :n], x[n:], P[n:, n:], e, S


def linear_flights(count=200, seed=7):
    """y (count, T, 3) of flights over the inputs and steps of `linear_table`; states and losses are drawn from the prior."""
    u, _, _, steps = linear_table()
    plant, rng = Linear(), np.random.default_rng(seed)
    x = plant.x0 + rng.standard_normal((count, 3)) * np.sqrt(np.diag(plant.P0))
    theta, rows = np.sqrt(THETA_VAR) * rng.standard_normal((count, 2)), []
    for now, dt in zip(u, steps, strict=True):
        push = now * (1.0 - theta)
        x = x @ plant.A(dt).T + dt * push @ plant.B.T + rng.standard_normal((count, 3)) * np.sqrt(np.diag(plant.Q(dt)))
        rows.append(x @ plant.C.T + push @ plant.D.T + rng.standard_normal((count, 3)) * np.sqrt(plant.R(now)))
    return np.stack(rows, axis=1)


@functools.cache
def over_linear(kind):
    """The method on the linear plant with steps of different length: stacked estimates of `linear_table`, and of `linear_flights`."""
    case = Case(kind, Linear)
    if "theta_var" in (known := inspect.signature(kind).parameters):
        # Losses are constant: what forgets sooner says more than the error that it has.
        case.estimator = kind(case.system, DT, theta_var=THETA_VAR, **({"memory_s": 4.0} if "memory_s" in known else {}))
    u, y, valid, dt = linear_table()
    many = jax.jit(jax.vmap(case.run, (None, 0, None, None)))(u, np.concatenate([y[None], linear_flights()]), valid, dt)
    return tuple(Estimate(*(np.asarray(leaf[part]) for leaf in many)) for part in (0, slice(1, None)))


def on_linear_plants_it_is_the_kalman_filter(kind):
    """States, losses, covariances and innovations, through gaps and changing steps.

    The prior and the walk of the losses are the method's own: the first two steps, without measurements, show them.
    """
    table = linear_table()
    got, _ = over_linear(kind)
    dt = table[3]
    walk = (got.theta_cov[1] - got.theta_cov[0]) / dt[1]
    P = np.zeros((5, 5))
    P[:3, :3], P[3:, 3:] = Linear.P0, got.theta_cov[0] - dt[0] * walk
    wanted = kalman(Linear(), np.concatenate([Linear.x0, np.zeros(2)]), P, walk, table)
    wanted = [np.array(column) for column in zip(*wanted, strict=True)]
    for name, a, b in zip(Estimate._fields[:5], got[:5], wanted[:5], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10, err_msg=name)
    measured = table[2].any(axis=1)
    np.testing.assert_allclose(got.innovation_cov[measured], wanted[5][measured], rtol=1e-8, atol=1e-10)


def on_linear_plants_the_innovations_are_what_they_are_said_to_be(kind):
    """Each measurement's innovation squared over its variance is 1 in the mean of flights from the prior, from the first step on."""
    _, flights = over_linear(kind)
    valid = linear_table()[2]
    share = flights.innovation**2 / np.diagonal(flights.innovation_cov, axis1=2, axis2=3)
    for part in (slice(0, 15), slice(15, None)):
        mean = [share[:, part][:, valid[part, i], i].mean() for i in range(3)]
        np.testing.assert_allclose(mean, 1.0, atol=0.12, err_msg=str(part))


def the_length_of_a_step_counts(case):
    """A long step without measurements ends elsewhere, and no surer, than a short one."""
    u, y, valid = case.flight()
    valid = np.ones_like(valid)
    valid[LONG] = False
    lengths = (np.where(np.arange(TICKS) == LONG, k * case.dt, case.dt) for k in (0.5, 5.0))
    short, long = (Estimate(*(leaf[LONG] for leaf in case.over(u, y, valid, dt))) for dt in lengths)
    assert np.abs(long.x - short.x).max() > 1e-3
    assert np.trace(long.x_cov) > np.trace(short.x_cov)
    assert np.trace(long.theta_cov) >= np.trace(short.theta_cov)


STEP, BEGINS, ENDS, FLIGHT_S = 0.05, 4.0, 6.0, 8.0  # s: of logs, the longer step; rotor 2 is weak between the other two
# Sets have bounds instead of a memory, and more cuts make them smaller. The MIT rule changes its factors by so much a step at most, and
# without noise it always does.
NO_MEMORY = (*SETS, "aekf", "aukf")
STEPS_OF = dict.fromkeys(("irls", "atsukf"), 0.04)  # what is forgotten, or leaves a window, leaves it by the step


@functools.cache
def noiseless(dt):
    """(plant, u, y) of a flight in steps of dt without noise, commands held over STEP; the noise that the plant tells is as strong in a
    second, whatever dt is."""
    usual, n = rates_quad(), 4
    sd = [np.sqrt(STEP / dt) * s for s in (0.01, 0.3)]
    system = RateDynamics(usual.J, usual.B_tau, usual.B_T, usual.m, *sd, 0.01 * np.ones(3))
    f, h = jax.jit(system.f), jax.jit(system.h)
    hover = np.full(n, 1.0)
    damp = np.linalg.pinv(np.vstack([system.B_tau, system.B_T]))[:, :3] @ np.diag(np.diag(system.J)) * 8.0
    x, rows = np.zeros(3), []
    for k in range(round(FLIGHT_S / dt)):
        now, first = k * dt, k % round(STEP / dt) == 0
        if first:
            u = hover + 0.05 * np.sin(0.9 * now * 2 * np.pi + np.arange(n)) - damp @ x
        theta = np.where(np.arange(n) == 1, LOSS * (BEGINS <= now + 1e-9 < ENDS), 0.0)
        x = np.asarray(f(x, u, theta, dt))
        rows.append((u, np.asarray(h(x, u, theta))))
    return system, *map(np.array, zip(*rows, strict=True))


def memory_is_a_time(kind):
    """The same flight in steps of half the length: losses come and go as fast in seconds."""
    found = []
    for dt in (STEP, STEP / 2):
        system, u, y = noiseless(dt)
        case = Case(kind, lambda system=system: system, dt)
        found.append(case.over(u, y, np.ones(y.shape, bool)).theta[round(STEP / dt) - 1 :: round(STEP / dt)])
    late = slice(round(0.5 * BEGINS / STEP), None)
    rms = np.sqrt(((found[0] - found[1])[late] ** 2).sum(axis=1).mean())
    assert rms < STEPS_OF.get(kind.name, 0.02), rms


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in ("adaptive_ekf", "irls") else pytest.mark.thorough)
        for name in published()
        if name not in NO_MEMORY
    ],
)
def test_the_memory_of_a_method_is_a_time(name):
    memory_is_a_time(discovery.estimator(name))


def test_a_planted_memory_of_so_many_steps_is_caught():
    """A factor of 0.995 a step, whatever the step."""

    class Mistaken(AdaptiveEKF):
        def __init__(self, system, dt):
            super().__init__(system, dt, memory_s=200 * dt)

    with pytest.raises(AssertionError):
        memory_is_a_time(Mistaken)


@pytest.mark.parametrize("name", published())
def test_not_kalman_says_why_in_a_sentence(name):
    reason = discovery.estimator(name).not_kalman
    assert reason == "" or len(reason.split()) >= 5


@pytest.mark.parametrize("name", [name for name, kind in published().items() if not kind.not_kalman])
def test_on_linear_plants_it_is_the_kalman_filter(name):
    on_linear_plants_it_is_the_kalman_filter(discovery.estimator(name))


@pytest.mark.thorough(keep=3)
@pytest.mark.parametrize(
    "name", [n for n in published() if n not in (*NO_POSTERIOR, *ONE_AT_A_TIME, *MEASURED, "mhe")]
)  # mhe has no theta_var
def test_on_linear_plants_the_innovations_are_what_they_are_said_to_be(name):
    on_linear_plants_the_innovations_are_what_they_are_said_to_be(discovery.estimator(name))


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.thorough] * (name == "esmf")) for name in published()])
def test_the_length_of_a_step_counts(name):
    the_length_of_a_step_counts(case_of(name, rates_quad))


@pytest.mark.parametrize("name", published())
def test_every_tuning_keyword_has_a_default(name):
    parameters = list(inspect.signature(discovery.estimator(name).__init__).parameters.values())[3:]
    assert all(p.kind is p.KEYWORD_ONLY and p.default is not p.empty for p in parameters)


# Planted errors: an extended Kalman filter with one mistake each, and the law that must catch it.


def mistaken(change):
    """EKF whose step is `change(step, self, carry, u, y, valid, dt)`."""

    class Mistaken(EKF):
        def step(self, carry, u, y, valid, dt=None):
            return change(super().step, self, carry, u, y, valid, dt)

    return Mistaken


def altered(**fields):
    """EKF with fields of its Estimate replaced by functions of it."""

    def change(step, self, carry, u, y, valid, dt):
        carry, out = step(carry, u, y, valid, dt)
        return carry, out._replace(**{name: new(out) for name, new in fields.items()})

    return mistaken(change)


def _learns_in_gaps(step, self, carry, u, y, valid, dt):
    return step(carry, u, jax.numpy.where(valid, y, 0.0), jax.numpy.ones_like(valid), dt)


def _ignores_validity(step, self, carry, u, y, valid, dt):
    carry, out = step(carry, u, y, valid, dt)
    return carry, out._replace(innovation=out.innovation + 1e-40 * jax.numpy.where(valid, 0.0, y))


def _loops(step, self, carry, u, y, valid, dt):
    y = jax.lax.while_loop(lambda v: (v > 1e300).any(), lambda v: v / 2, jax.numpy.where(valid, y, 0.0))
    return step(carry, u, y, valid, dt)


def _deaf_to_dt(step, self, carry, u, y, valid, dt):
    return step(carry, u, y, valid)


def _knows_it_is_compiled(step, self, carry, u, y, valid, dt):
    carry, out = step(carry, u, y, valid, dt)
    return carry, out._replace(x=out.x + (1e-3 if isinstance(out.x, jax.core.Tracer) else 0.0))


@jax.custom_batching.custom_vmap
def _lonely(x):
    return x


_lonely.def_vmap(lambda size, batched, x: (1.001 * x, True))


def _trusts_too_much(step, self, carry, u, y, valid, dt):
    carry, out = step(carry, u, y, valid, dt)
    return carry._replace(P=0.99 * carry.P), out


class _Foreseeing(Case):
    reverse = True


def more(*case):
    """One more error of a law."""
    return pytest.param(*case, marks=pytest.mark.thorough)


PLANTED = [
    (shapes_and_kinds_are_the_documented_ones, altered(x=lambda e: e.x.astype("float32"))),
    (everything_stays_finite, altered(x=lambda e: e.x / jax.numpy.where(e.status == 2, 0.0, 1.0))),
    (status_says_what_a_tick_was, altered(status=lambda e: 0 * e.status)),
    (a_step_is_made_of_what_can_run_anywhere, mistaken(_loops)),
    (what_is_not_valid_does_not_count, mistaken(_ignores_validity)),
    (covariances_are_symmetric_and_not_negative, altered(x_cov=lambda e: e.x_cov + 1e-12 * np.eye(3, k=1))),
    more(covariances_are_symmetric_and_not_negative, altered(theta_cov=lambda e: e.theta_cov - 1e-3 * np.eye(4))),
    (nothing_is_learned_where_nothing_is_measured, mistaken(_learns_in_gaps)),
    (errors_are_as_large_as_the_covariance_says, altered(x_cov=lambda e: 0.2 * e.x_cov)),
    (innovations_are_as_large_as_their_covariance_says, altered(innovation_cov=lambda e: 1.5 * e.innovation_cov)),
    more(innovations_are_as_large_as_their_covariance_says, altered(innovation_cov=lambda e: 0.7 * e.innovation_cov)),
    (a_loss_is_found, altered(theta=lambda e: 0.0 * e.theta)),
    more(a_loss_is_found, altered(theta=lambda e: 0.45 * e.theta)),
    more(a_loss_is_found, altered(theta=lambda e: e.theta[::-1])),
    (many_flights_at_once_are_the_same_as_one_by_one, altered(x=lambda e: _lonely(e.x))),
    (compiled_is_the_same_as_not, mistaken(_knows_it_is_compiled)),
]


@pytest.mark.parametrize(("law", "kind"), PLANTED, ids=lambda v: getattr(v, "__name__", "") if inspect.isfunction(v) else "")
def test_a_planted_error_is_caught(law, kind):
    with pytest.raises(AssertionError):
        law(Case(kind, rates_quad))


def test_planted_innovations_that_forget_the_losses_are_caught():
    kind = altered(innovation_cov=lambda e: e.innovation_cov - 0.1 * np.diag([0.0, 0.0, 0.03]))
    with pytest.raises(AssertionError):
        on_linear_plants_the_innovations_are_what_they_are_said_to_be(kind)


def test_planted_foresight_is_caught():
    with pytest.raises(AssertionError):
        causal(_Foreseeing(EKF, rates_quad))


def test_planted_losses_out_of_range_are_caught():
    kind = altered(theta=lambda e: e.theta - 1.0)
    kind.bounded = True
    with pytest.raises(AssertionError):
        losses_are_shares(Case(kind, rates_quad))


@pytest.mark.parametrize("law", [on_linear_plants_it_is_the_kalman_filter, the_length_of_a_step_counts])
@pytest.mark.parametrize("change", [_deaf_to_dt, _trusts_too_much])
def test_planted_errors_of_the_filter_are_caught(law, change):
    if law is the_length_of_a_step_counts and change is _trusts_too_much:
        pytest.skip("a wrong covariance, but steps count")
    kind = mistaken(change)
    with pytest.raises(AssertionError):
        law(Case(kind, rates_quad) if law is the_length_of_a_step_counts else kind)


# The default method on its own plant.


def balance_kalman(known, h, y, valid, Q, R):
    """Textbook Kalman filter, dense and in NumPy: x- = A x, P- = A P A' + Q; K = P- C' S^-1 with S = C P- C' + R.

    h (T, n_y, n_x), Q (T, n_x) and R (T, n_y) may change from step to step. Returns x (T, n_x) and P (T, n_x, n_x) after each.
    """
    x, P, A = known["mean"][0], known["variance"][0], np.diag(known["decay"][0, :THETA])
    history = []
    for k in range(len(y)):
        x, P = A @ x, A @ P @ A.T + np.diag(Q[k])
        C, r = h[k][valid[k]], R[k][valid[k]]
        S = C @ P @ C.T + np.diag(r)
        K = np.linalg.solve(S, C @ P).T
        x = x + K @ (y[k][valid[k]] - C @ x)
        I_KC = np.eye(x.size) - K @ C
        P = I_KC @ P @ I_KC.T + K @ np.diag(r) @ K.T  # Joseph's form
        history.append((x, P))
    return (np.stack(column) for column in zip(*history, strict=True))


def test_default_is_the_kalman_filter_while_nothing_is_suspected():
    """Hovering without motion the plant is linear and Gaussian: the filter has to be Kalman's with the learned noise.

    In motion the default estimator is more careful than Kalman: it counts the error of its own gains as noise. So it is
    with outliers and with commands that jump; that caution is switched off here.
    """
    u, y, valid = balanced(4, 0.0, 0.0, mode=tuple(np.where(np.arange(TICKS) < TAKE_OFF, GROUND, LEARN).tolist()))
    # How rotors differ is in the dense filter of test_default_estimator.py.
    with ENGINE.changed({"kalman.OUTLIER": 1e9, "model_error.LAG_ERROR_S": 0.0, "plant.BUILT_SD": 0.0}):
        steps, kept = program.steps(0.05, wrench_quad().B), []
        for k in range(TICKS):
            steps.run(u[k : k + 1], y[k : k + 1], valid[k : k + 1])
            kept.append(steps.learned)
        h, _ = limits.balance(u, steps.plant)
    states, covariances, learned = (np.stack(column) for column in zip(*kept, strict=True))
    flying, before = slice(TAKE_OFF, TICKS), learned[TAKE_OFF - 1 : -1]  # what a tick works with was known before it
    grows, Q = [*(1.0 - np.exp(-0.1 / np.array(TAU))), 0.05], np.zeros((TICKS - TAKE_OFF, THETA))
    for a in range(4):
        Q[:, a * PER_AXIS : a * PER_AXIS + 3] = before[:, 1:, a] * grows
    x, P = balance_kalman(steps.plant, h[flying, :, :THETA], y[flying], valid[flying], Q, before[:, 0])
    assert learned[-1, 0].max() < 0.1 * learned[0, 0].min()  # the noise was learned: Q and R did change on the way
    np.testing.assert_allclose(states[flying, :THETA], x, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(covariances[flying, :THETA, :THETA], P, rtol=1e-6, atol=1e-10)
