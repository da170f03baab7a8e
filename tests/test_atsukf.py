"""Two-stage unscented filters, plain and adaptive, and the augmented one: laws, and that planted errors break them.

The linear plant of the study has gaps in its table and losses that are felt in the measurement. Steps are taken one by one, by a
compiled step.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.estimators.atsukf import ATSUKF
from rotorwatch_lab.estimators.tsukf import TSUKF
from rotorwatch_lab.estimators.ukf import UKF
from rotorwatch_lab.experiments.studies import reproduce_atsukf as study
from rotorwatch_lab.maths import two_stage, unscented
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

jax = load_jax()
jnp = jax.numpy
EXACT = 1e-9
METHODS = (UKF, TSUKF, ATSUKF)
TUNING = {"theta_walk": 0.01, "theta_var": 0.3}
DT = 0.1  # s
ROWS = 36
each_method = pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)


def walk(estimator, u, y, valid, dt=None):
    """Estimates of a table's rows, stacked, and the carries after each."""
    step = jax.jit(lambda carry, *row: estimator.step(carry, *row, dt=dt))
    carry, outs, carries = estimator.init(), [], []
    for row in zip(u, y, np.broadcast_to(valid, y.shape), strict=True):
        carry, out = step(carry, *row)
        outs.append(out)
        carries.append(carry)
    return type(outs[0])(*(np.stack([np.asarray(leaf) for leaf in column]) for column in zip(*outs, strict=True))), carries


@pytest.fixture(scope="module")
def plant():
    return study.Linear()


@pytest.fixture(scope="module")
def table(plant):
    u, y, valid = study.linear_table(plant, rows=ROWS)
    valid[8:11] = False
    return u, y, valid


def from_kalman(method, plant, table, **options):
    """Largest difference of x, theta, both covariances and S from the augmented Kalman filter."""
    out, _ = walk(method(plant, DT, **TUNING, **options), *table)
    z, P, S = study.kalman(plant, 0.001 * np.eye(2), 0.3 * np.eye(2), *table)
    n = plant.n_x
    found = (out.x, out.theta, out.x_cov, out.theta_cov, out.innovation_cov)
    wanted = (z[:, :n], z[:, n:], P[:, :n, :n], P[:, n:, n:], S)
    return max(np.abs(a - b).max() for a, b in zip(found, wanted, strict=True))


@each_method
def test_on_a_linear_plant_it_is_the_augmented_kalman_filter(method, plant, table):
    options = {"threshold": 1e9} if method is ATSUKF else {}
    assert from_kalman(method, plant, table, **options) < EXACT


PLANTED = {
    "H without feedthrough": lambda p: p._replace(H=p.seen.slope @ jnp.linalg.inv(p.L) @ p.beta),
    "coupling a thousandth off": lambda p: p._replace(beta=1.001 * p.beta),
    "innovation a thousandth off": lambda p: p._replace(e=1.001 * p.e),
    "P_yy without R": lambda p: p._replace(P_yy=p.seen.cov + 1e-9 * jnp.eye(3)),
    "state covariance a thousandth off": lambda p: p._replace(L=1.001 * p.L),
}


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("error", PLANTED)
def test_a_planted_error_breaks_that_law(error, plant, table, monkeypatch):
    predict = two_stage.predict
    monkeypatch.setattr(two_stage, "predict", lambda *args: PLANTED[error](predict(*args)))
    assert from_kalman(TSUKF, plant, table) > 1e-5


def test_a_forgotten_coupling_breaks_that_law(plant, table, monkeypatch):
    """Without what the losses' error has done to the states so far: r = df/dtheta, H = dh/dtheta only."""
    monkeypatch.setattr(two_stage, "_through", lambda t, L, beta: jnp.zeros((t.slope.shape[0], beta.shape[1])))
    assert from_kalman(TSUKF, plant, table) > 1e-3


def test_the_wrong_covariance_in_the_losses_gain_breaks_that_law(plant, table, monkeypatch):
    """P_yy where S belongs: of the two gains of a step, the second with the covariance of the first."""
    gain, used = unscented.gain, []

    def wrong(P_xy, S, valid):
        used.append(S)
        return gain(P_xy, used[-2] if len(used) % 2 == 0 else S, valid)

    monkeypatch.setattr(unscented, "gain", wrong)
    assert not from_kalman(TSUKF, plant, table) < 1e-3  # it may even diverge to NaN


@pytest.mark.parametrize("error", ["one gain for all", "R twice"])
def test_a_planted_error_in_the_augmented_filter_breaks_that_law(error, plant, table, monkeypatch):
    gain = unscented.gain
    if error == "R twice":
        monkeypatch.setattr(study.Linear, "R", lambda self, u: 2 * self.variance)
    else:  # invalid rows not left out of S
        monkeypatch.setattr(unscented, "gain", lambda P, S, valid: jnp.where(valid, gain(P, S, valid | True), 0.0))
    assert from_kalman(UKF, plant, table) > 1e-3


def window(carry, n_y):
    """Sums of the window: squares (n_y,), counts (n_y,), lag-1 products."""
    total = np.asarray(carry.window.total)
    return total[:n_y], total[n_y : 2 * n_y], total[-1]


def test_adaptation_is_the_papers_formula(plant):
    """Against a window summed afresh in NumPy, all measurements valid."""
    M, threshold = 10, 1.1
    u, y, _ = study.linear_table(plant, rows=ROWS)
    y[20:] += 3.0  # larger than predicted
    estimator = ATSUKF(plant, DT, **TUNING, window_s=M * DT, threshold=threshold)
    _, carries = walk(estimator, u, y, True)
    e = np.stack([np.asarray(c.e) for c in carries])
    widened = 0
    for k in range(1, ROWS):
        Q, before = DT * estimator.theta_walk, carries[k - 1].state
        p = two_stage.predict(plant, estimator.weights, before, Q, u[k], y[k], np.ones(3, bool), DT)
        nominal = float(jnp.trace(p.P_yy) + jnp.trace(p.H @ before.P_theta @ p.H.T))
        walk_trace = float(jnp.trace(p.H @ Q @ p.H.T))
        expected = 1.0
        if k >= M - 1 and e[k] @ e[k] > threshold * (nominal + walk_trace):
            seen = (e[k - M + 1 : k + 1] ** 2).sum() / (M - 1)
            expected = max(1.0, (seen - nominal) / walk_trace)
        np.testing.assert_allclose(carries[k].delta, expected, rtol=1e-9)
        widened += expected > 1
    assert 3 < widened < ROWS - M


def test_the_window_holds_the_last_rows(plant, table):
    """Rows without any measurement do not count; a huge innovation leaves no rounding behind once it has left."""
    M, spike = 6, 14
    u, y, valid = table
    y, valid = y.copy(), valid.copy()
    y[spike], valid[spike] = 1e9, True
    _, carries = walk(ATSUKF(plant, DT, **TUNING, window_s=M * DT, threshold=1e30), u, np.where(valid, y, np.nan), valid)
    e = np.stack([np.asarray(c.e) for c in carries])
    before = np.vstack([np.zeros(3), e[:-1]])
    measured = np.flatnonzero(valid.any(axis=1))
    assert len(measured) < ROWS and not valid.all(axis=1).all()
    for k in (*range(spike), *range(spike + 2 * M, ROWS)):
        last = measured[measured <= k][-M:]
        squares, counts, products = window(carries[k], 3)
        scale = (e[last] ** 2).sum()
        np.testing.assert_allclose(squares, (e[last] ** 2).sum(axis=0), rtol=1e-12, atol=1e-12 * scale)
        np.testing.assert_array_equal(counts, valid[last].sum(axis=0))
        np.testing.assert_allclose(products, (e[last] * before[last]).sum(), atol=1e-12 * scale)
        assert bool(carries[k].window.full) == ((measured <= k).sum() >= M)


def test_without_adaptation_it_is_the_plain_filter(plant, table):
    plain, _ = walk(TSUKF(plant, DT, **TUNING), *table)
    for options, same in (({"threshold": 1e9}, True), ({}, False)):
        adaptive, _ = walk(ATSUKF(plant, DT, **TUNING, window_s=10 * DT, **options), *table)
        assert (np.abs(adaptive.theta - plain.theta).max() < 1e-12) == same, options


@pytest.mark.parametrize("correlated", [True, False])
def test_the_gate_tells_a_lag_from_noise(plant, correlated):
    """Innovations of the same size: pointing one way they widen the walk, changing sign each step they do not."""
    u, y, _ = study.linear_table(plant, rows=ROWS)
    y[20:] += 4.0 * (1.0 if correlated else (-1.0) ** np.arange(ROWS - 20)[:, None])
    _, gated = walk(ATSUKF(plant, DT, theta_walk=1e-6, theta_var=1e-6, window_s=10 * DT, whiteness=0.2), u, y, True)
    _, open_ = walk(ATSUKF(plant, DT, theta_walk=1e-6, theta_var=1e-6, window_s=10 * DT), u, y, True)
    assert max(float(c.delta) for c in open_[22:]) > 100
    assert (max(float(c.delta) for c in gated[22:]) > 100) == correlated


def test_motors_off_say_nothing_of_losses():
    """H = 0: no division by it, no loss found, and the losses' variance grows as it walks."""
    plant = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    y = 5.0 * np.random.default_rng(1).standard_normal((20, 4))  # innovations far larger than predicted
    out, _ = walk(ATSUKF(plant, DT, **TUNING, window_s=10 * DT), np.zeros((20, 6)), y, True)
    assert all(np.isfinite(leaf).all() for leaf in out)
    np.testing.assert_array_equal(out.theta, 0.0)
    np.testing.assert_allclose(out.theta_cov[-1], (0.3 + 20 * 0.001) * np.eye(6), atol=1e-9)


@pytest.mark.thorough(keep=2)
@each_method
def test_clipping_keeps_losses_in_the_unit_interval(method, plant, table):
    clipped, _ = walk(method(plant, DT, **TUNING, clip=True), *table)
    assert clipped.theta.min() == 0.0 and 0.1 < clipped.theta.max() <= 1.0  # one of the true losses is negative


def test_biases_are_not_clipped():
    limit = unscented.to_unit(2)
    np.testing.assert_array_equal(limit(np.array([-0.5, 1.5, -3.0])), [0.0, 1.0, -3.0])


@pytest.mark.thorough(keep=1)
@each_method
def test_a_longer_step_is_taken_as_one(method):
    """A step length said at each step is the same as having been made for it."""
    plant = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    rng = np.random.default_rng(0)
    table = (0.3 + 0.05 * rng.random((10, 6)), rng.standard_normal((10, 4)), True)
    made, _ = walk(method(plant, 0.02, **TUNING), *table)
    said, _ = walk(method(plant, 0.01, **TUNING), *table, dt=0.02)
    for a, b in zip(made, said, strict=True):
        np.testing.assert_array_equal(a, b)


@each_method
@pytest.mark.parametrize(
    "options, says",
    [
        ({"theta_walk": -1.0}, "theta_walk is not positive semidefinite"),
        ({"theta_var": [1.0, 2.0, 3.0]}, r"theta_var must have the shape \(2,\)"),
        ({"theta_var": np.eye(3)}, r"theta_var must have the shape \(2, 2\)"),
        ({"theta_walk": np.nan}, "theta_walk holds NaN"),
        ({"dt": 0.0}, "dt must be above zero"),
        ({"alpha": 0.0}, "alpha must be above zero"),
    ],
)
def test_bad_tuning_gets_one_sentence(method, options, says, plant):
    with pytest.raises(ConfigError, match=says):
        method(plant, **({"dt": DT} | options))


@pytest.mark.parametrize(
    "options, says",
    [
        ({"window_s": 0.0}, "window_s must be above zero"),
        ({"threshold": 0.0}, "threshold must be above zero"),
        ({"whiteness": 2.0}, "whiteness must lie between -1 and 1"),
    ],
)
def test_bad_adaptation_gets_one_sentence(options, says, plant):
    with pytest.raises(ConfigError, match=says):
        ATSUKF(plant, DT, **options)


@each_method
def test_a_plant_without_noise_is_refused(method):
    usual = RateDynamics.of(airframes.paper("niermeyer-hexa"))
    parts = ("n_x", "n_u", "n_theta", "n_y", "x0", "P0", "f", "h")
    silent = SimpleNamespace(name="silent", **{part: getattr(usual, part) for part in parts})
    with pytest.raises(ConfigError, match=f"{method.name} is not defined for the plant silent: it needs Q, R"):
        method(silent, DT)
