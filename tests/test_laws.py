"""Laws that hold for every estimator there is, on every plant it runs on; see docs/architecture.md.

A made-up flight serves all of them: on the ground, learning, judging, a rotor that weakens, and gaps.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from rotorwatch import airframes, discovery
from rotorwatch.backend import jax as load_jax
from rotorwatch.core import Estimate
from rotorwatch.systems.wrench_balance import WrenchBalance
from rotorwatch.ticks import GROUND, JUDGE, LEARN

DT = 0.05
TICKS = 200
TAKE_OFF, READY, ONSET = 5, 80, 110
GAPS = (slice(50, 60), slice(95, 103), slice(130, 150))  # no measurement at all
BLIND_AXIS = slice(65, 75)  # only the thrust axis is missing
LOSS = 0.3
FORBIDDEN = {"while", "sort", "lu", "qr", "geqrf", "eigh", "eig", "svd", "pure_callback", "io_callback"}


def vehicle():
    return airframes.named("ardupilot-quad-x")


def make_system():
    return WrenchBalance(vehicle().effectiveness())


def flight(seed=0, motion=1.0, loss=LOSS, mode=None):
    """(u, y, valid) of a quad hovering in light wind; rotor 2 loses `loss` at ONSET. motion: how much it turns."""
    rng = np.random.default_rng(seed)
    B = vehicle().effectiveness()
    n = B.shape[1]
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
    table = SimpleNamespace(thrust=thrust, rate_dot=rate_dot, load=load, rate=rate)
    when = np.arange(TICKS)
    if mode is None:
        mode = np.where(when < TAKE_OFF, GROUND, np.where(when < READY, LEARN, JUDGE))
    u = np.column_stack([make_system().pack(table), np.broadcast_to(mode, TICKS), when == TAKE_OFF]).astype(float)
    valid = np.ones((TICKS, 4), bool)
    for gap in GAPS:
        valid[gap] = False
    valid[BLIND_AXIS, 3] = False
    return u, thrust @ B.T, valid


def estimate_of(out):
    return out if isinstance(out, Estimate) else out.estimate


@pytest.fixture(scope="module", params=discovery.estimators().items(), ids=lambda item: item[0])
def method(request):
    """One estimator on the plant, with its compiled run over a flight: (outputs, carries), a leading axis of ticks."""
    jax = load_jax()
    system = make_system()
    estimator = request.param[1](system, DT)

    def run(u, y, valid):
        def tick(carry, now):
            carry, out = estimator.step(carry, *now)
            return carry, (out, carry)

        return jax.lax.scan(tick, estimator.init(), (u, y, valid))[1]

    compiled = jax.jit(run)
    return SimpleNamespace(
        jax=jax,
        system=system,
        estimator=estimator,
        run=run,
        over=lambda *table: jax.tree.map(np.asarray, compiled(*table)),
        usual=jax.tree.map(np.asarray, compiled(*flight())),
    )


def leaves(method, tree):
    """(path, array) of everything in a tree, for messages that say what differs."""
    return [
        (method.jax.tree_util.keystr(path), leaf) for path, leaf in method.jax.tree_util.tree_leaves_with_path(tree)
    ]


def assert_same(method, one, other, **tolerance):
    for (path, a), (_, b) in zip(leaves(method, one), leaves(method, other), strict=True):
        if tolerance:
            np.testing.assert_allclose(a, b, err_msg=path, **tolerance)
        else:
            np.testing.assert_array_equal(a, b, err_msg=path)


def test_shapes_and_kinds_are_the_documented_ones(method):
    estimate, system = estimate_of(method.usual[0]), method.system
    n_x, n_theta, n_y = system.n_x, system.n_theta, system.n_y
    sizes = [(n_x,), (n_x, n_x), (n_theta,), (n_theta, n_theta), (n_y,), (n_y, n_y), ()]
    assert [leaf.shape for leaf in estimate] == [(TICKS, *size) for size in sizes]
    assert [leaf.dtype for leaf in estimate] == [np.float64] * 6 + [np.int32]


def test_everything_stays_finite(method):
    for path, leaf in leaves(method, method.usual):
        assert not np.isnan(leaf).any(), path
    for name, leaf in zip(Estimate._fields, estimate_of(method.usual[0]), strict=True):
        assert np.isfinite(leaf).all(), name


def test_losses_are_shares(method):
    theta = estimate_of(method.usual[0]).theta
    assert theta.min() >= 0 and theta.max() <= 1


def test_status_says_what_a_tick_was(method):
    _, _, valid = flight()
    expected = np.where(np.arange(TICKS) < TAKE_OFF, 1, np.where(valid.any(axis=1), 0, 2))
    np.testing.assert_array_equal(estimate_of(method.usual[0]).status, expected)


def primitives(jaxpr):
    """Names of all operations of a traced function, those inside loops, branches and calls included."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from primitives(inner)


def test_a_step_is_made_of_what_can_run_anywhere(method):
    """No loops of unknown length, nothing that a microcontroller could not do: docs/architecture.md, rules 3 and 4."""
    u, y, valid = flight()
    traced = method.jax.make_jaxpr(method.estimator.step)(method.estimator.init(), u[0], y[0], valid[0])
    assert set(primitives(traced.jaxpr)) & FORBIDDEN == set()
    assert {str(v.aval.dtype) for v in traced.jaxpr.outvars} <= {"float64", "int32", "bool"}
    found = set(primitives(method.jax.make_jaxpr(method.jax.numpy.linalg.inv)(np.eye(2)).jaxpr))
    assert found & FORBIDDEN  # else the list has lost touch with the library's names


def test_causal(method):
    """What comes later changes nothing of what was said before."""
    cut = ONSET + 12
    table, other = flight(), flight(seed=1, loss=0.8)
    mixed = [np.concatenate([a[:cut], b[cut:]]) for a, b in zip(table, other, strict=True)]
    mixed[2][cut:] = ~mixed[2][cut:]
    changed = method.over(*mixed)
    head = method.jax.tree.map(lambda leaf: leaf[:cut], (method.usual, changed))
    assert_same(method, *head)
    assert not np.array_equal(estimate_of(changed[0]).x[cut:], estimate_of(method.usual[0]).x[cut:])


@pytest.mark.parametrize("garbage", [1e30, -1e30, np.nan])
def test_what_is_not_valid_does_not_count(method, garbage):
    u, y, valid = flight()
    assert_same(method, method.usual, method.over(u, np.where(valid, y, garbage), valid))


def test_covariances_are_symmetric_and_not_negative(method):
    estimate = estimate_of(method.usual[0])
    for name in ("x_cov", "theta_cov", "innovation_cov"):
        P = getattr(estimate, name)
        np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2), err_msg=name)
        # Scaled to a unit diagonal: states have units of their own.
        sd = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 1e-30))
        least = np.linalg.eigvalsh(P / sd[:, :, None] / sd[:, None, :]).min(axis=1)
        assert (least > -1e-9).all(), f"{name} at tick {least.argmin()}: {least.min()}"


def test_nothing_is_learned_where_nothing_is_measured(method):
    """In a gap the variance of a state that stays as it is never shrinks, nor does that of a loss."""
    estimate, system = estimate_of(method.usual[0]), method.system
    u = flight()[0]
    for gap in GAPS:
        x, theta = estimate.x[gap.start], estimate.theta[gap.start]
        F = method.jax.jacfwd(lambda x, u=u[gap.start], theta=theta: system.f(x, u, theta, DT))(x)
        constant = np.all(np.asarray(F) == np.eye(system.n_x), axis=1)
        assert constant.any()
        for P, which in ((estimate.x_cov, constant), (estimate.theta_cov, slice(None))):
            variance = np.diagonal(P, axis1=1, axis2=2)[gap.start - 1 : gap.stop, which]
            assert (np.diff(variance, axis=0) >= -1e-12 * variance[:-1]).all(), gap
        assert (estimate.innovation[gap] == 0).all()


def test_many_flights_at_once_are_the_same_as_one_by_one(method):
    flights = [flight(), flight(seed=1, motion=0.3), flight(seed=2, loss=0.0)]
    batch = [np.stack(column) for column in zip(*flights, strict=True)]
    together, _ = method.jax.jit(method.jax.vmap(method.run))(*batch)
    for k, table in enumerate(flights):
        alone, _ = method.over(*table)
        one = method.jax.tree.map(lambda leaf, k=k: leaf[k], together)
        assert_same(method, estimate_of(alone), estimate_of(one), rtol=1e-6, atol=1e-9)


def test_compiled_is_the_same_as_not(method):
    steps = slice(TAKE_OFF - 1, TAKE_OFF + 2)
    u, y, valid = flight()
    carry = method.jax.tree.map(lambda leaf: leaf[steps.start - 1], method.usual[1])
    for k in range(steps.start, steps.stop):
        carry, out = method.estimator.step(carry, u[k], y[k], valid[k])
        expected = method.jax.tree.map(lambda leaf, k=k: leaf[k], method.usual[0])
        assert_same(method, estimate_of(expected), estimate_of(out), rtol=1e-9, atol=1e-12)


def kalman(system, x, P, u, y, valid, Q, R):
    """Textbook Kalman filter, dense and in NumPy: x- = A x, P- = A P A' + Q; K = P- C' S^-1 with S = C P- C' + R.

    Q (T, n_x, n_x) and R (T, n_y) may change from step to step. Returns x (T, n_x) and P (T, n_x, n_x) after each.
    """
    A = np.diag(system.decay(DT))
    history = []
    for k in range(len(y)):
        x, P = A @ x, A @ P @ A.T + Q[k]
        C, r = np.asarray(system.C(u[k]))[valid[k]], R[k][valid[k]]
        S = C @ P @ C.T + np.diag(r)
        K = np.linalg.solve(S, C @ P).T
        x = x + K @ (y[k][valid[k]] - C @ x)
        I_KC = np.eye(x.size) - K @ C
        P = I_KC @ P @ I_KC.T + K @ np.diag(r) @ K.T  # Joseph's form
        history.append((x, P))
    return (np.stack(column) for column in zip(*history, strict=True))


def test_default_is_the_kalman_filter_while_nothing_is_suspected(method, monkeypatch):
    """Hovering without motion the plant is linear and Gaussian: the filter has to be Kalman's with the learned noise.

    In motion the default estimator is more careful than Kalman: it counts the error of its own gains as noise. So it is
    with outliers and with commands that jump; that caution is switched off here.
    """
    if method.estimator.name != "default":
        pytest.skip("about the default estimator's own noise model")
    from rotorwatch import caution, noise
    from rotorwatch.estimators import jump_bank

    monkeypatch.setattr(jump_bank, "OUTLIER", 1e9)
    monkeypatch.setattr(caution, "LAG_ERROR_S", 0.0)
    when = np.arange(TICKS)
    u, y, valid = flight(seed=4, motion=0.0, loss=0.0, mode=np.where(when < TAKE_OFF, GROUND, LEARN))
    out, carries = method.jax.tree.map(np.asarray, method.jax.jit(lambda *table: method.run(*table))(u, y, valid))
    estimate = estimate_of(out)
    learned = carries.noise.variances[:-1]  # what a tick works with was known before it
    flying = slice(TAKE_OFF, TICKS)
    R = learned[TAKE_OFF - 1 :, 0]
    Q = np.stack([np.diag(np.asarray(noise.process_variance(v, DT))) for v in learned[TAKE_OFF - 1 :]])
    x, P = kalman(method.system, method.system.x0, method.system.P0, u[flying], y[flying], valid[flying], Q, R)
    assert learned[-1, 0].max() < 0.1 * learned[0, 0].min()  # the noise was learned: Q and R did change on the way
    np.testing.assert_allclose(estimate.x[flying], x, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(estimate.x_cov[flying], P, rtol=1e-6, atol=1e-10)
