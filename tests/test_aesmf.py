"""Set-membership filters: outer bounds are outer, sets hold the truth under the worst noise, and wrong ones are caught."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.estimators.aekf import AEKF
from rotorwatch_lab.estimators.aesmf import AESMF, gradient
from rotorwatch_lab.estimators.aukf import AUKF
from rotorwatch_lab.estimators.esmf import ESMF
from rotorwatch_lab.experiments.studies import ruav_flight, small_systems
from rotorwatch_lab.maths import ellipsoid, interval, mit_rule, small, taylor
from rotorwatch_lab.maths.set_membership import Cutting
from rotorwatch_lab.systems.helicopter import Helicopter

jax = load_jax()
jnp = jax.numpy
HELICOPTER = Helicopter(airframes.paper("ruav-40kg"))
HOVER = np.concatenate([HELICOPTER.trim, ruav_flight.ATTITUDE])
seeds = st.integers(0, 2**31)


def spd(rng, n):
    A = rng.standard_normal((n, n))
    return A @ A.T + 0.1 * np.eye(n)


def surface(rng, P, count):
    d = rng.standard_normal((count, P.shape[0]))
    return d / np.linalg.norm(d, axis=1, keepdims=True) @ np.linalg.cholesky(P).T


def form(P, d):
    return np.einsum("ki,ij,kj->k", d, np.linalg.inv(P), d)


# Sets.


@settings(max_examples=trials(25), deadline=None)
@given(seeds)
def test_a_sum_of_sets_holds_every_sum(seed):
    rng = np.random.default_rng(seed)
    P, Q = spd(rng, 4), 0.1 * spd(rng, 4)
    whole, b = ellipsoid.minkowski(P, Q)
    assert form(np.asarray(whole), surface(rng, P, 500) + surface(rng, Q, 500)).max() <= 1 + 1e-9
    for other in (0.5 * b, min(0.99, 2 * b)):
        assert np.trace(P / (1 - other) + Q / other) >= np.trace(whole) - 1e-9
    # The source writes the shares mirrored; it is the same matrix.
    c = np.sqrt(np.trace(P)) / (np.sqrt(np.trace(P)) + np.sqrt(np.trace(Q)))
    # Entries whose two parts cancel keep the rounding of the parts.
    np.testing.assert_allclose(whole, Q / (1 - c) + P / c, rtol=1e-12, atol=1e-14)


def test_an_ellipsoid_around_a_box_holds_its_corners_and_the_printed_one_does_not():
    half = np.array([0.3, 1.0, 0.2])
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * half
    for rule, holds in (("trace", True), ("volume", True), ("paper", False)):
        worst = (corners**2 / np.asarray(ellipsoid.around_box(half, rule))).sum(1).max()
        assert (worst <= 1 + 1e-12) == holds, rule


@settings(max_examples=trials(25), deadline=None)
@given(seeds, st.sampled_from(["source", "volume", "trace"]))
def test_a_cut_keeps_every_point_that_explains_the_measurement(seed, rule):
    rng = np.random.default_rng(seed)
    P, h = spd(rng, 4), rng.standard_normal(4)
    d = surface(rng, P, 3000) * rng.uniform(0, 1, (3000, 1)) ** 0.25
    g = h @ P @ h
    e, r = rng.uniform(-1, 1) * np.sqrt(g), (rng.uniform(0.05, 0.8) ** 2) * g
    cut = ellipsoid.strip_cut(np.zeros(4), jnp.asarray(P), h, e, r, rule)
    kept = d[np.abs(e - d @ h) <= np.sqrt(r)]
    if len(kept):
        assert form(np.asarray(cut.P), kept - np.asarray(cut.a)).max() <= 1 + 1e-9
    if rule == "volume":
        assert np.linalg.det(cut.P) <= np.linalg.det(P) * (1 + 1e-9)
    if rule == "trace":
        assert np.trace(cut.P) <= np.trace(P) * (1 + 1e-9)
    # The bound of the error at a quarter throws possible points away: the law can fail.
    wrong = ellipsoid.strip_cut(np.zeros(4), jnp.asarray(P), h, 0.0, r / 16, rule)
    possible = d[np.abs(d @ h) <= np.sqrt(r)]
    assert form(np.asarray(wrong.P), possible).max() > 1


def test_weights_are_the_best_ones():
    rng = np.random.default_rng(3)
    for _ in range(5):
        P, h, w = spd(rng, 5), rng.standard_normal(5), rng.uniform(0.1, 3, 5)
        g = h @ P @ h
        e, r = 0.1 * np.sqrt(g), 0.04 * g  # the strip lies inside: nothing is narrowed
        size, trace = np.inf, np.inf
        for weight in np.concatenate([[0.0], np.logspace(-3, 3, 4001)]):
            D = r + weight * g
            scale = 1 + weight - weight * e**2 / D
            size = min(size, 5 * np.log(scale) + np.log(r / D) + np.linalg.slogdet(P)[1])
            trace = min(trace, scale * ((w * np.diag(P)).sum() - weight / D * (w * (P @ h) ** 2).sum()))
        volume = ellipsoid.strip_cut(np.zeros(5), jnp.asarray(P), h, e, r, "volume").P
        least = ellipsoid.strip_cut(np.zeros(5), jnp.asarray(P), h, e, r, "trace", w).P
        assert np.linalg.slogdet(volume)[1] == pytest.approx(size, abs=1e-5)
        assert (w * np.diag(least)).sum() == pytest.approx(trace, rel=1e-5)


def test_factors_are_the_same_filter():
    rng = np.random.default_rng(0)
    P, h, Phi, Q = spd(rng, 5), rng.standard_normal(5), rng.standard_normal((5, 5)), 0.1 * spd(rng, 5)
    UD = ellipsoid.factored(jnp.asarray(P))
    np.testing.assert_allclose(ellipsoid.unfactored(UD), P, rtol=1e-12)
    e, r = 0.3, 0.2 * h @ P @ h
    one, other = (ellipsoid.strip_cut(np.zeros(5), jnp.asarray(P), h, e, r), ellipsoid.ud_strip_cut(np.zeros(5), UD, h, e, r))
    np.testing.assert_allclose(other.a, one.a, rtol=1e-10)
    np.testing.assert_allclose(ellipsoid.unfactored(other.P), one.P, rtol=1e-9, atol=1e-12)
    U, D = ellipsoid.factors(UD)
    summed = ellipsoid.ud_sum(jnp.concatenate([Phi @ U, np.linalg.cholesky(Q)], axis=1), jnp.concatenate([2 * D, 3 * np.ones(5)]))
    np.testing.assert_allclose(ellipsoid.unfactored(summed), 2 * Phi @ P @ Phi.T + 3 * Q, rtol=1e-9)


def test_all_at_once_equals_one_at_a_time_for_one_measurement():
    rng = np.random.default_rng(1)
    P, h = spd(rng, 4), rng.standard_normal((1, 4))
    r = 0.1 * (h @ P @ h.T)
    one = ellipsoid.strip_cut(np.zeros(4), jnp.asarray(P), h[0], 0.2, r[0, 0])
    both, _, rho = ellipsoid.batch_cut(np.zeros(4), jnp.asarray(P), h, np.array([0.2]), r)
    np.testing.assert_allclose(both.P, one.P, rtol=1e-9)
    np.testing.assert_allclose(both.health, one.health, rtol=1e-12)
    assert rho == pytest.approx(np.sqrt(0.1) / (1 + np.sqrt(0.1)))


def test_small_algebra_is_algebra():
    rng = np.random.default_rng(2)
    A, B, many = spd(rng, 6), rng.standard_normal((6, 3)), rng.standard_normal((2, 4, 6))
    np.testing.assert_allclose(small.product(many, A), many @ A, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(small.product(many, many.transpose(0, 2, 1)), many @ many.transpose(0, 2, 1), rtol=1e-12)
    np.testing.assert_allclose(small.solve(A, B), np.linalg.solve(A, B), rtol=1e-9, atol=1e-12)
    uneven = np.logspace(0, 12, 6)  # sets of states in unlike units: as exact as with even ones
    solved = small.solve(A * uneven * uneven[:, None], B * uneven[:, None]) * uneven[:, None]
    np.testing.assert_allclose(solved, np.linalg.solve(A, B), rtol=1e-9, atol=1e-12)
    assert np.isnan(small.solve(A - 2 * np.linalg.eigvalsh(A)[0] * np.eye(6), B)).all()


def test_largest_eigenvalue():
    P = spd(np.random.default_rng(5), 6)
    assert ellipsoid.largest_eigenvalue(P) == pytest.approx(np.linalg.eigvalsh(P)[-1], rel=1e-2)


# What a function does over a set.


def helicopter_step(z):
    return HELICOPTER.f(z[:6], HOVER, z[6:], 0.02)


def tricky(z):
    a, b, c = z[0], z[1], z[2]
    mixed = jnp.stack([jnp.sin(a) * b / (2.0 + c**2), jnp.exp(a * b) - jnp.abs(c), jnp.where(a > b, a, b) * jnp.cos(3 * c)])
    return jnp.concatenate([mixed, jnp.sqrt(4.0 + jnp.clip(z, -0.1, 0.3)), jnp.tanh(z @ np.ones((3, 2)))])


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(("seed", "size"), [(2, 0.6), (0, 0.02), (1, 0.2)])
def test_taylor_models_hold_what_a_function_does_over_an_ellipsoid(seed, size):
    rng = np.random.default_rng(seed)
    a, P = 0.2 * rng.standard_normal(3), size**2 * spd(rng, 3)
    d = surface(rng, P, 2000) * rng.uniform(0, 1, (2000, 1)) ** 0.3
    c, g, e = (np.asarray(part) for part in taylor.expand(tricky, a, np.linalg.cholesky(P).T))
    xi = np.linalg.solve(np.linalg.cholesky(P), d.T).T
    values = np.asarray(jax.vmap(tricky)(a + d))
    assert (np.abs(values - c - xi @ g.T) <= e + 1e-9).all()
    c2, _, e2 = taylor.expand(tricky, a, np.eye(3), P)
    np.testing.assert_allclose(np.asarray(c2), c, atol=1e-9)
    np.testing.assert_allclose(np.asarray(e2), e, atol=1e-9)
    box = interval.evaluate(tricky, interval.Interval(a - np.sqrt(np.diag(P)), a + np.sqrt(np.diag(P))))
    assert (values >= np.asarray(box.lo) - 1e-9).all() and (values <= np.asarray(box.hi) + 1e-9).all()


def test_the_helicopters_remainder_is_held_and_tighter_than_by_the_box():
    rng = np.random.default_rng(0)
    scale = np.repeat([0.02, 0.01, 0.2, 0.1], [3, 3, 4, 4])
    A = 0.2 * rng.standard_normal((14, 14)) + np.eye(14)
    L = np.linalg.cholesky((scale[:, None] * A) @ (scale[:, None] * A).T)
    d = surface(rng, L @ L.T, 5000)
    c, g, e = (np.asarray(part) for part in taylor.expand(helicopter_step, np.zeros(14), L.T))
    rest = np.asarray(jax.vmap(helicopter_step)(d)) - c - np.linalg.solve(L, d.T).T @ g.T
    assert (np.abs(rest) <= e + 1e-12).all()
    reach = np.sqrt((L**2).sum(1))
    box = interval.second_order_remainder(helicopter_step, np.zeros(14), -reach, reach)
    straight = np.asarray(jax.vmap(helicopter_step)(d) - helicopter_step(np.zeros(14)))
    straight = straight - d @ np.asarray(jax.jacfwd(helicopter_step)(np.zeros(14))).T
    assert (straight >= np.asarray(box.lo) - 1e-12).all() and (straight <= np.asarray(box.hi) + 1e-12).all()
    assert (3 * e < np.asarray(box.hi - box.lo) / 2).all()


def direction_let_loose(function, centre, lo, hi):
    """The plain way to bound 1/2 d' Hess d: through every operation with d an interval, which counts it at each anew."""

    def curvature(z, d):
        return 0.5 * jax.jvp(lambda point: jax.jvp(function, (point,), (d,))[1], (z,), (d,))[1]

    return interval.evaluate(curvature, interval.Interval(lo, hi), interval.Interval(lo - centre, hi - centre))


@pytest.mark.parametrize(("plant", "ratio", "sampled"), [("helicopter", (1.15, 2.3), 3.2), ("pendulum", (1.75, 1.85), 1.5)])
def test_interval_hessians_hold_the_remainder_and_are_tighter_than_a_direction_let_loose(plant, ratio, sampled):
    """ratio: least and largest gain over the components; sampled: at most this times as wide as what 20,000 points span."""
    rng = np.random.default_rng(3)
    if plant == "helicopter":
        function, centre, reach = helicopter_step, np.zeros(14), np.repeat([0.02, 0.01, 0.2, 0.1], [3, 3, 4, 4])
    else:
        system, centre, reach = small_systems.Pendulum(), np.array([0.3, 0.0, 0.0]), np.array([0.1, 0.1, 0.3])
        function = lambda z: system.f(z[:2], np.ones(1), z[2:], 0.05)[1:]  # noqa: E731  the rate: the angle's row is linear
    # A box that is not symmetric about the point, and random points and corners of it.
    lo, hi = centre - reach, centre + 0.8 * reach
    d = rng.uniform(lo, hi, (20_000, len(centre)))
    d[::2] = np.where(d[::2] > centre, hi, lo)
    value, J = function(centre), np.asarray(jax.jacfwd(function)(centre))
    rest = np.asarray(jax.jit(jax.vmap(function))(d) - value) - (d - centre) @ J.T
    found = interval.second_order_remainder(function, centre, lo, hi)
    assert (rest >= np.asarray(found.lo) - 1e-12).all() and (rest <= np.asarray(found.hi) + 1e-12).all()
    width, plain = np.asarray(found.hi - found.lo), direction_let_loose(function, centre, lo, hi)
    gain = np.asarray(plain.hi - plain.lo) / width
    assert ratio[0] < gain.min() and gain.max() < ratio[1], gain
    assert (width < sampled * np.ptp(rest, axis=0)).all(), width / np.ptp(rest, axis=0)


# Guaranteed containment.


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("mode", small_systems.RIGOROUS[:5], ids=str)
def test_the_truth_never_escapes(mode):
    """Nor while theta drifts; at 8 per second a step moves it by more than the small sets are wide."""
    for drift in (0.0, small_systems.DRIFT, 8.0):
        assert small_systems.escapes(small_systems.Pendulum(), 40, drift=(drift, drift), **mode) == 0, drift


def test_nor_from_an_oscillator():
    for drift in (0.0, small_systems.DRIFT):
        assert small_systems.escapes(small_systems.VanDerPol(), 40, drift=(drift, drift)) == 0


@pytest.mark.parametrize("name", small_systems.MUTATIONS)
def test_wrong_filters_lose_it(name):
    assert small_systems.escapes(small_systems.Pendulum(), 40, **small_systems.MUTATIONS[name]) > 0


# Adaptation.


def test_the_rules_slope_is_the_derivative_of_its_criterion():
    rng = np.random.default_rng(0)
    n, m = 5, 3
    H, Phi, P, Q, R = rng.standard_normal((m, n)), rng.standard_normal((n, n)), spd(rng, n), np.ones(n), np.eye(m)
    e, mu, b, b_Q = 0.3 * rng.standard_normal(m), 7.0, 0.3, 0.2

    def shape(q):
        noise = jnp.diag(q) + Phi @ jnp.diag(q) @ Phi.T  # of this step and the one before
        return P + (noise - jnp.eye(n) - Phi @ Phi.T) / (b * (1 - b_Q))

    rho = ellipsoid.batch_share(H @ P @ H.T, R)

    def J(q):
        W = H @ shape(q) @ H.T / (1 - rho) + R / rho
        return jnp.linalg.slogdet(W)[1] - mu * jnp.log(1 - e @ jnp.linalg.solve(W, e))

    slope, _ = gradient(Cutting(Phi, H, e, P, R, 1 / (b * (1 - b_Q))), mu)
    np.testing.assert_allclose(slope, jax.grad(J)(Q), rtol=1e-9)


@pytest.mark.parametrize("additive", [False, True])
def test_the_rule_goes_down_its_slope_at_its_rate(additive):
    """A step of eta dt times the slope per ln q, or (additive) that over q: towards less of its criterion."""
    rng = np.random.default_rng(1)
    made = AESMF(HELICOPTER, 0.02, eta=1e3, ceiling=9.0, additive=additive)
    n, m, dt = HELICOPTER.n_x + HELICOPTER.n_theta, HELICOPTER.n_y, 0.04
    q = rng.uniform(1.0, 2.0, n)
    cutting = Cutting(np.eye(n), rng.standard_normal((m, n)), np.full(m, 1e-3), spd(rng, n), np.eye(m), 1.0)
    step = 1e3 * dt * np.asarray(gradient(cutting, made.mu)[0]) * np.diagonal(np.asarray(made.noise(dt, q)))
    found = np.asarray(made.adapt(q, cutting, None, dt))
    assert np.abs(step).max() > 1e-6
    np.testing.assert_allclose(found, q - step / q if additive else q * np.exp(-step), rtol=1e-12)


def test_mit_rule_waits_for_a_window_of_measured_steps():
    """Not of measurements: with six channels it does not begin six times earlier. Steps without any do not count, nor do they
    push what was measured out of the window."""
    how = mit_rule.Adaptation(eta=0.5, window=10)
    adapt = jax.jit(lambda state, valid: mit_rule.adapt(state, np.eye(6), np.eye(6), np.full(6, 3.0), valid, 0.02, how))
    for every in (1, 3):
        state, begun = mit_rule.init(6, 6, how), []
        for k in range(12 * every):
            valid = np.full(6, k % every == every - 1)
            valid[1:3] = False  # some channels are always missing
            state = adapt(state, valid)
            begun.append(bool(np.abs(state.log_q).max() > 0))
        assert begun.index(True) + 1 == 10 * every


def test_mit_rule_matches_the_innovations():
    rng = np.random.default_rng(0)
    how = mit_rule.Adaptation(eta=0.5, window=50)
    adapt = jax.jit(lambda state, e, S: mit_rule.adapt(state, np.eye(2), S, e, np.ones(2, bool), 0.02, how))
    state = mit_rule.init(2, 2, how)
    for _ in range(1500):  # innovations of variance 4 and 0.25 where the filter expects q + 0
        S = jnp.diag(jnp.exp(state.log_q))
        state = adapt(state, np.array([2.0, 0.5]) * rng.standard_normal(2), S)
    np.testing.assert_allclose(np.exp(state.log_q), [4.0, 0.25], rtol=0.6)
    blind = mit_rule.adapt(state, np.eye(2), S, np.full(2, np.nan), np.zeros(2, bool), 0.02, how)
    np.testing.assert_array_equal(blind.log_q, state.log_q)


# The helicopter.


def test_trim_is_an_equilibrium_and_its_solution_is_the_papers():
    from scipy.optimize import least_squares

    found = least_squares(lambda u: np.asarray(HELICOPTER.derivative(np.zeros(6), u, np.zeros(8))), HOVER).x
    np.testing.assert_allclose(found[:4], [0.4937, 0.1608, 0.5100, 0.4603], atol=2e-4)


def test_a_jammed_actuator_does_not_follow():
    jammed = np.array([0, 1.0, 0, 0, 0, 0.15, 0, 0])
    for command in (0.0, 0.9):
        out = HELICOPTER.outputs(np.array([0.5, command, 0.5, 0.5, 0, 0]), jammed)
        np.testing.assert_allclose(out, [0.5, 0.15, 0.5, 0.5])


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("kind", [AESMF, AUKF, AEKF])
def test_gaps_do_no_harm(kind):
    plant = small_systems.Pendulum()  # a set-membership filter of the helicopter takes half a minute to compile
    estimator = kind(plant, 0.02)
    u, y = np.ones((60, 1)), np.zeros((60, 1))
    y[20:40] = np.nan
    _, out = run(estimator, u, y)
    assert all(np.isfinite(leaf).all() for leaf in out)
    assert (np.diff(np.trace(out.theta_cov, axis1=1, axis2=2)[20:40]) >= -1e-12).all()
    assert set(out.status[20:40]) == {2} and (out.innovation[20:40] == 0).all()


BAD = {
    "form": ("square", "form must be one of"),
    "cut": ("deep", "cut must be one of"),
    "remainder": ("some", "remainder must be one of"),
    "bound": (0.0, "bound must be above zero"),
    "process": (np.ones(2), "process must have the shape"),
    "theta_reach": (-1.0, "theta_reach must be above zero"),
    "theta_range": ((1.0, 0.0), "theta_range must be"),
    "theta_drift": (-1.0, "theta_drift must lie"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_configuration_is_one_sentence(name):
    value, sentence = BAD[name]
    with pytest.raises(ConfigError, match=sentence):
        ESMF(HELICOPTER, 0.02, **{name: value})


def test_more_bad_configuration():
    with pytest.raises(ConfigError, match="not defined for form 'batch'"):
        ESMF(HELICOPTER, 0.02, form="batch", cut="volume")
    with pytest.raises(ConfigError, match="floor"):
        AESMF(HELICOPTER, 0.02, floor=0.0)
    with pytest.raises(ConfigError, match="eta must be above zero"):
        AUKF(HELICOPTER, 0.02, eta=0.0)
    with pytest.raises(ConfigError, match="lacks mass"):
        Helicopter({"main": {}, "tail": {}})
