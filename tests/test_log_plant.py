"""A real flight as a plant: the same physics as the default method's balance, causal, a plant for each hop."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.plain import logs, made, room

from rotorwatch import airframes
from rotorwatch.base import discovery
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.engine.bindings import event_rows
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.estimator.bank import FIRST_LOSS, Window
from rotorwatch.engine.estimator.hypotheses import Asked, Freed, Jump, pair, steps
from rotorwatch.engine.estimator.plant import Plant
from rotorwatch.engine.motion.tick_table import ASSESS, LEARN, Ticks
from rotorwatch.errors import ConfigError
from rotorwatch_lab.compiling.run import run
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.experiments.studies import compare_flights
from rotorwatch_lab.published import decide, log_plant, published

jax = load_jax()
G, C = np.array([0.012, 0.014, 0.3, 1.0]), np.array([0.02, 0.03, 0.1, 0.0])
BIAS = np.array([0.05, -0.03, 0.02, 0.1])
NOISE = np.tile(np.array([[0.02**2], [0.01**2], [0.01**2], [0.001**2]]), (1, 4))


def geometry(frame="ardupilot-quad-x"):
    return airframes.named(frame).effectiveness()


def dynamics(gains=G):
    x0 = np.zeros((4, 5))
    x0[:, 3], x0[:, 4] = gains, C
    return {"x0": x0.reshape(-1), "noise": NOISE}


def ticks(B, theta=None, T=300, dt=0.05, seed=0, restarts=(0,), learn_s=4.0):
    """Ticks that fulfil the balance exactly: B thrust (1 - theta) = G m + c r + bias."""
    rng = np.random.default_rng(seed)
    n = B.shape[1]
    rate_dot, rate = 0.5 * rng.standard_normal((T, 3)), 0.1 * rng.standard_normal((T, 3))
    load = 1.0 + 0.02 * rng.standard_normal(T)
    theta = np.zeros(n) if theta is None else theta
    wrench = G * np.column_stack([rate_dot, n * load]) + C * np.column_stack([rate, np.zeros(T)]) + BIAS
    thrust = wrench @ np.linalg.pinv(B * (1.0 - theta)).T
    time = dt * np.arange(1, T + 1)
    mode, restart = np.full(T, ASSESS), np.zeros(T, bool)
    for k in restarts:
        mode[k : k + round(learn_s / dt)], restart[k] = LEARN, True
    return Ticks(
        time, time - 0.5 * dt, thrust, thrust @ B.T, rate, rate_dot, load, np.ones((T, 4), bool), mode, restart,
        np.ones(T), dt, np.zeros(T, bool),
    )  # fmt: skip


@pytest.mark.parametrize("frame", ["ardupilot-quad-x", "ardupilot-hexa-x", "ardupilot-octa-plus"])
def test_the_plant_is_the_balance(frame):
    """Where the balance holds, the plant turns as measured and feels the load that was measured, losses and all."""
    B = geometry(frame)
    theta = np.linspace(0.0, 0.3, B.shape[1])
    table = ticks(B, theta)
    plant = log_plant.plant(log_plant.parameters(B, G, C, BIAS, NOISE, 0.05))
    for k in range(5):
        x = table.rate[k]
        turning = np.cross(x, plant.J @ x) / np.diag(plant.J)
        rate_dot = np.asarray(plant.derivative(x, table.thrust[k], theta)) + turning
        np.testing.assert_allclose(rate_dot, table.rate_dot[k], rtol=1e-9, atol=1e-9)
        f_z = np.asarray(plant.h(x, table.thrust[k], theta))[3]
        assert abs(f_z + 9.80665 * table.load[k]) < 1e-9
    J = np.diag(plant.J)
    assert abs(J[2] - J[0] - J[1]) < 1e-12  # a flat body: yaw is in the same unit as roll and pitch


def test_gains_come_from_the_teacher_and_trims_from_the_hop():
    B = geometry()
    (hop,) = log_plant.hops(ticks(B), B, dynamics())
    assert np.allclose(np.diag(hop.parameters["J"])[:2], G[:2], rtol=1e-12)
    assert np.allclose(hop.parameters["tau_0"][:2], -BIAS[:2], atol=1e-9) and abs(hop.parameters["F_0"] + BIAS[3]) < 1e-9
    assert hop.u.shape == (220, 4) and hop.y.shape == (220, 4) and (hop.rows == np.arange(80, 300)).all()
    assert hop.system.n_theta == 4


def test_gains_that_no_multirotor_has_are_not_believed():
    wild = np.array([-0.1, 5.0, 0.3, 1.0])
    (hop,) = log_plant.hops(ticks(geometry()), geometry(), dynamics(wild))
    J = np.diag(hop.parameters["J"])
    assert 0.003 < J[0] < 0.07 and 0.003 < J[1] < 0.07
    assert (hop.parameters["damping"] <= log_plant.FASTEST_DAMPING * J * (1 + 1e-9)).all()


def test_later_ticks_change_nothing():
    B = geometry()
    table = ticks(B)
    cut = {k: v[:200] for k, v in vars(table).items() if isinstance(v, np.ndarray)}
    (whole,), (early,) = (log_plant.hops(t, B, dynamics()) for t in (table, replace(table, **cut)))
    for key, value in early.parameters.items():
        np.testing.assert_array_equal(value, whole.parameters[key], err_msg=key)
    for a, b in ((early.u, whole.u), (early.y, whole.y), (early.valid, whole.valid)):
        np.testing.assert_array_equal(a, b[: len(a)])


def test_each_hop_is_a_plant_of_its_own_and_gaps_stay_gaps():
    B = geometry()
    table = ticks(B, T=400, restarts=(0, 200))
    table.valid[120] = False
    hops = log_plant.hops(table, B, dynamics())
    assert [len(h.u) for h in hops] == [120, 120] and hops[1].rows[0] == 280
    assert not hops[0].valid[40:42].any() and hops[0].valid[42:].all()  # a mean of two ticks misses when either does
    short = ticks(B, T=60)
    assert log_plant.hops(short, B, dynamics()) == ()


def climbing(hover_s, T=600):
    """A flight that climbs at 2.5 m/s through its learning time and until `hover_s`, with k = 0.04 of thrust lost per m/s."""
    B, table = geometry(), ticks(geometry(), T=T)
    axial = np.where(table.time < hover_s, 2.5, 0.0)
    thrust = table.thrust + (0.04 * axial)[:, None]
    return B, replace(table, thrust=thrust, wrench=thrust @ B.T, axial=axial)


@pytest.mark.parametrize(("hover_s", "begins_s", "taught"), [(2.0, 5.0, 60), (7.0, 10.0, 60), (12.5, 14.0, 30), (99.0, 14.0, 80)])
def test_the_trim_is_that_of_hover(hover_s, begins_s, taught):
    """Learning lasts until 4 s; 3 s of hover teach the trim, at most 10 s later what there is of it; without it, the known air."""
    B, table = climbing(hover_s)
    known = {**dynamics(), "air": [0.04, 0.01]}
    (hop,) = log_plant.hops(table, B, known)
    assert hop.rows[0] == pytest.approx(begins_s / table.dt, abs=1) and len(hop.trimmed) == pytest.approx(taught, abs=1)
    assert abs(hop.parameters["F_0"] + BIAS[3]) < 1e-9
    thrusts = np.abs(hop.u.mean(axis=0) - (0.04 * table.axial[hop.rows]).mean() - table.load[hop.rows].mean())
    assert thrusts.max() < 0.1  # the commands are those of the log
    felt = np.array([np.asarray(hop.system.h(x, u, np.zeros(4)))[3] for x, u in zip(hop.y[:50, :3], hop.u[:50])])
    np.testing.assert_allclose(felt, hop.y[:50, 3], atol=1e-6)  # in the climb, too, no loss is seen
    cut = {k: v[: hop.rows[0] + 20] for k, v in vars(table).items() if isinstance(v, np.ndarray)}
    (early,) = log_plant.hops(replace(table, **cut), B, known)
    assert early.parameters["F_0"] == hop.parameters["F_0"] and early.rows[0] == hop.rows[0]


def test_without_known_air_a_trim_of_hover_is_still_that_of_hover():
    B, table = climbing(7.0)
    (hop,) = log_plant.hops(table, B, dynamics())
    assert abs(hop.parameters["F_0"] + BIAS[3]) < 1e-9
    B, table = climbing(99.0)
    (never,) = log_plant.hops(table, B, dynamics())
    assert never.parameters["F_0"] == pytest.approx(-BIAS[3] - 4 * 0.1, abs=1e-6)


def test_ticks_of_no_estimator_are_refused():
    B = geometry()
    with pytest.raises(ConfigError, match="no ticks of"):
        log_plant.hops(ticks(B, dt=0.3), B)


# The threshold.


@pytest.fixture(scope="module")
def decided():
    """decide over stacked losses: (theta (T, n), frame) -> stacked Decision, with dt 0.05."""
    programs = {}

    def over(theta, frame="ardupilot-hexa-x", **settings):
        key = (frame, tuple(settings.items()), len(theta))
        if key not in programs:
            threshold = decide.Threshold(geometry(frame), **settings)

            def step(carry, theta):
                return threshold.step(carry, SimpleNamespace(theta=theta, status=0), 0.05)

            programs[key] = jax.jit(lambda theta: jax.lax.scan(step, threshold.init(), theta)[1])
        return jax.tree.map(np.asarray, programs[key](theta))

    return over


def drifting(n, T=400, sd=0.01, seed=0):
    """Losses as a healthy flight's estimate shows them: noise and a slow drift of all together."""
    rng = np.random.default_rng(seed)
    return sd * rng.standard_normal((T, n)) + np.linspace(0, 0.05, T)[:, None]


def spread(theta, frame):
    """What a filter makes of it that cannot tell more than the wrench: the smallest losses with the same effect."""
    B = geometry(frame)
    return theta @ B.T @ np.linalg.pinv(B).T


@pytest.mark.parametrize("rotor", range(6))
def test_a_spread_loss_is_read_as_one_rotor(decided, rotor):
    theta = drifting(6)
    theta[200:, rotor] += 0.3
    out = decided(spread(theta, "ardupilot-hexa-x"))
    hyp = list_hypotheses(6)
    first = int(np.argmax(out.alarm))
    assert not out.alarm[:200].any() and 200 < first < 215
    assert hyp.rotors[out.best[first]] == (rotor,) and abs(first - out.onset[first] - 200) <= 2


def test_noise_drift_and_battery_are_no_faults(decided):
    for seed in range(3):
        theta = drifting(6, seed=seed)
        theta[200:] += 0.15  # all rotors alike
        assert not decided(theta).alarm.any()


def test_opposite_pairs_stay_ambiguous(decided):
    """Equal losses of opposite rotors of a hexa make no torque: no pair may be announced as more probable than the others."""
    theta = drifting(6)
    theta[200:, [0, 1]] += 0.4
    out = decided(spread(theta, "ardupilot-hexa-x"))
    hyp = list_hypotheses(6)
    odds = [out.log_odds[-1, hyp.rotors.index(pair)] for pair in ((0, 1), (2, 3), (4, 5))]
    assert np.ptp(odds) < 1.0


def test_small_losses_and_short_ones_do_not_count(decided):
    small, short = drifting(6), drifting(6)
    small[200:, 2] += 0.06
    short[200:204, 2] += 0.4
    assert not decided(small).alarm.any() and not decided(short).alarm.any()
    small[200:, 2] += 0.14
    assert decided(small).alarm.any() and not decided(small, sigmas=60.0).alarm.any()


evidence = jax.jit(decide.Threshold(geometry()).evidence)


@settings(deadline=None)
@given(away=st.lists(st.floats(-2, 2), min_size=4, max_size=4), scatter=st.floats(1e-4, 0.1))
def test_evidence_is_finite_and_losses_are_shares(away, scatter):
    log_odds, loss = evidence(np.array(away), np.full(4, scatter))
    assert np.isfinite(log_odds).all()
    hyp = list_hypotheses(4)
    single = np.array([kind in ("single", "pair") for kind in hyp.kinds])[: loss.shape[0]]
    assert (np.asarray(loss)[single] >= 0).all() and (np.asarray(loss)[single] <= 1).all()


@pytest.mark.parametrize(("wrong", "says"), [({"least": 2.0}, "least"), ({"sigmas": -1.0}, "sigmas")])
def test_bad_thresholds_are_refused(wrong, says):
    with pytest.raises(ConfigError, match=says):
        decide.Threshold(geometry(), **wrong)


# A published method over a flight.


@pytest.fixture(scope="module")
def quad():
    """A simulated quad that loses 35 % of rotor 3 at 18 s: (ticks, B)."""
    vehicle = airframes.named("ardupilot-quad-x")
    short = pytest.MonkeyPatch()
    short.setattr(compare_flights, "SECONDS", 27.0)
    rng = np.random.default_rng(3)
    (flight,) = compare_flights.simulate(vehicle, [0.35], np.array([2]), np.array([17.0]), rng)
    short.undo()
    scene = compare_flights._scene("", flight, vehicle, ())
    assert scene is not None
    return scene.ticks, scene.B


def known():
    x0 = np.zeros((4, 5))
    x0[:, 3] = [*compare_flights.INERTIA[:2], compare_flights.INERTIA[2] / compare_flights.DRAG_RATIO, 1.0]
    return {"x0": x0.reshape(-1), "noise": NOISE}


def losses_of(name, quad, tuning=None):
    out, _ = published.assess(name, *quad, known(), tuning)
    return out, event_rows.read(out, quad[0], quad[1])


def test_a_published_method_finds_the_rotor(quad):
    out, found = losses_of("ekf", quad)
    (event,) = found
    assert event.rotors == (3,) and not event.alternatives and 18.0 <= event.detected_s < 21.0
    assert abs(event.loss[0] - 0.35) < 0.06 and event.interval[0][0] < 0.35 < event.interval[0][1]
    assert abs(event.onset_s - 18.0) < 1.0
    for name, values in zip(out._fields, out, strict=True):
        assert np.isfinite(np.asarray(values, float)).all(), name
    assert (out.theta[quad[0].mode != ASSESS] == 0).all()


def test_what_is_missing_is_written_down_whole(quad):
    """Losses shown and biases together are what the method says is missing: trends are read from it, announced or not."""
    ticks, B = quad
    out, (event,) = losses_of("ekf", quad)
    missing = out.biases + (ticks.thrust * out.theta) @ B.T
    assessed = ticks.mode == ASSESS
    for part, loss in ((assessed & (ticks.time < 17.0), 0.0), (assessed & (ticks.time > event.detected_s + 3.0), 0.35)):
        wanted = loss * ticks.thrust[part, 2].mean() * B[:, 2]
        np.testing.assert_allclose(missing[part].mean(axis=0)[:2], wanted[:2], atol=0.06)


def test_design_work_that_needs_values_is_compiled_for_the_flight(quad, monkeypatch):
    class Designed(EKF):
        name = "designed"

        def __init__(self, system, dt):
            np.linalg.eigvalsh(np.asarray(system.J))  # refuses traced arrays
            super().__init__(system, dt)

    monkeypatch.setattr(discovery, "estimator", lambda name: Designed)
    out, _ = losses_of("designed", quad)
    monkeypatch.undo()
    np.testing.assert_allclose(out.theta, losses_of("ekf", quad)[0].theta, rtol=1e-6, atol=1e-9)


def test_tuning_reaches_the_method(quad):
    """Factors on Q and R act as another plant would; the walk is the method's own keyword."""
    (hop,) = log_plant.hops(*quad, known())
    tuning = published.Tuning(np.array([4.0, 1.0, 9.0]), np.array([1.0, 1.0, 1.0, 0.25]), {"theta_walk": 1e-2})
    louder = dict(hop.parameters)
    louder["torque_sd"] = louder["torque_sd"] * np.array([2.0, 1.0, 3.0])
    louder["accel_sd"] = louder["accel_sd"] * 0.5
    by_tuning = published.method("ekf", hop.system, hop.dt, tuning)
    by_plant = EKF(log_plant.plant(louder), hop.dt, theta_walk=1e-2)
    rows = slice(0, 100)
    one, other = (run(e, hop.u[rows], hop.y[rows], hop.valid[rows])[1] for e in (by_tuning, by_plant))
    np.testing.assert_allclose(one.theta, other.theta, rtol=1e-9, atol=1e-12)
    with pytest.raises(ConfigError, match="no tuning called"):
        published.method("ekf", hop.system, hop.dt, published.Tuning(keywords={"wisdom": 1.0}))
    with pytest.raises(ConfigError, match="no estimator called"):
        published.assess("crystal ball", *quad)


@pytest.mark.parametrize("frame", ["ardupilot-quad-x", "ardupilot-hexa-x"])
def test_a_published_methods_wrench_is_weighed_as_the_default_estimator_weighs_a_window(frame):
    """One sample with exact geometry, in still air: the same Bayes factors and losses of one rotor, of two, of disturbances."""
    B = geometry(frame)
    n, rng, rule = B.shape[1], np.random.default_rng(0), decide.Threshold(B)
    hyp = list_hypotheses(n)
    p, ask = made(Plant, rotors=n, effect=B), made(Asked, hi=np.ones(n), full=2.0)
    for _ in range(5):
        away, scatter = (B @ (0.4 * rng.random(n) * (rng.random(n) < 0.4)) + 0.05 * rng.standard_normal(4), np.full(4, 0.02**2))
        factors, sizes = map(np.asarray, rule.evidence(away, scatter))
        common = np.array([0.0, 0.0, 0.0, (n * decide.COMMON_SD) ** 2])
        w = 1.0 / (scatter + common + decide.TURNED**2 * (away @ away) / 4.0)
        Phi, place = np.concatenate([B, np.eye(4)], axis=1), [*range(FIRST_LOSS, FIRST_LOSS + n), *range(4)]
        C, z = np.zeros((FIRST_LOSS + n,) * 2), np.zeros(FIRST_LOSS + n)
        C[np.ix_(place, place)], z[place] = Phi.T @ (w[:, None] * Phi), Phi.T @ (w * away)
        window, free, jump = made(Window, C=C, z=z), Freed(), Jump()
        nats, weight = room(len(hyp.blocks)), room(len(hyp.blocks))
        free.free(p, window, ask)
        for h, (kind, who) in enumerate(zip(hyp.kinds, hyp.rotors)):
            if kind in ("single", "pair"):
                if kind == "single":
                    free.loss(ask, *who, jump)
                else:
                    pair(window, ask, *who, jump)
                assert factors[h] == pytest.approx(float(logs(jump.nats, jump.weight)), rel=1e-6, abs=1e-6), hyp.names[h]
                assert sizes[h] == pytest.approx([jump.size, jump.other_size], abs=1e-6), hyp.names[h]
        steps(window, [1.0] * 4, 1.0, 0, nats, weight)
        assert factors[-len(nats) :] == pytest.approx(logs(nats, weight), rel=1e-9)


def test_an_end_is_written_down_and_another_set_takes_over():
    """What `_follow` makes of evidence over time: announced, replaced by a better set, over when nothing is left."""
    hyp = list_hypotheses(4)
    T, dt = 300, 0.05
    odds = np.full((T, len(hyp.names)), -5.0)
    odds[100:150, hyp.rotors.index((1,))] = 30.0
    odds[150:200, hyp.rotors.index((2,))] = 60.0
    best = odds.argmax(axis=1)
    seen = SimpleNamespace(log_odds=odds, best=best, alarm=odds.max(axis=1) > 0, onset=np.full(T, 3.0))
    announced, active, _, _ = published._follow(seen, hyp, dt)
    assert np.flatnonzero(announced).tolist() == [100, 150, 199 + round(decide.OVER_S / dt)]
    assert active[120].tolist() == [False, True, False, False] and active[180].tolist() == [False, False, True, False]
    assert not active[260].any() and not active[:100].any()
