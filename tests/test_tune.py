"""Tuning by likelihood: the right noise is found, unseen flights become more likely, and files hold what was found."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rotorwatch import airframes
from rotorwatch.base import discovery
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab import tune
from rotorwatch_lab.published import published
from rotorwatch_lab.published.log_plant import LogPlant
from rotorwatch_lab.published.published import Tuning
from rotorwatch_lab.systems.rate_dynamics import RateDynamics

jax = load_jax()
DT, T = 0.05, 360
TRUE_TORQUE, TRUE_GYRO, TRUE_ACCEL = 0.004, 0.08, 0.2
TORQUE, GYRO, ACCEL = 0.016, 0.02, 0.5  # what the plant is given


def quad(torque_sd=TORQUE, gyro_sd=GYRO, accel_sd=ACCEL):
    B = airframes.named("ardupilot-quad-x").effectiveness()
    return RateDynamics(
        np.diag([0.012, 0.013, 0.025]), np.diag([1, 1, 0.08]) @ B[:3], B[3], 4 / 9.80665, gyro_sd, accel_sd,
        torque_sd * np.array([1.0, 1.0, 0.1]),
    )  # fmt: skip


WRONG = quad()


def flight(seed, loss=0.0, onset=T // 2):
    """A healthy flight with the true noise, on the plant with the wrong one; rotor 2 loses `loss`."""
    rng = np.random.default_rng(seed)
    truth = quad(TRUE_TORQUE, TRUE_GYRO, TRUE_ACCEL)
    mix = np.linalg.pinv(np.vstack([truth.B_tau, truth.B_T]))[:, :3] @ np.diag(np.diag(truth.J)) * 5.0
    root = np.linalg.cholesky(np.asarray(truth.Q(DT)))
    f, h, sd = jax.jit(truth.f), jax.jit(truth.h), np.sqrt(np.asarray(truth.R(None)))
    x, rows = np.zeros(3), []
    for k in range(T):
        theta = np.array([0.0, loss * (k >= onset), 0.0, 0.0])
        u = 1.0 - mix @ x + 0.05 * np.sin(0.3 * k + np.arange(4))
        x = np.asarray(f(x, u, theta, DT)) + root @ rng.standard_normal(3)
        rows.append((u, np.asarray(h(x, u, theta)) + sd * rng.standard_normal(4)))
    u, y = (np.array(column) for column in zip(*rows, strict=True))
    valid = np.ones((T, 4), bool)
    valid[100:110] = False
    return tune.Table(WRONG, u, np.where(valid, y, np.nan), valid, DT)


@pytest.fixture(scope="module")
def found():
    return tune.fit("ekf", [flight(0), flight(1)])


@pytest.mark.thorough
def test_the_noise_that_was_there_is_found(found):
    """Factors on variances, up to what 700 rows can tell; the plant was given 16 times too much and too little."""
    gyro, accel = found.tuning.r[:3], found.tuning.r[3]
    assert np.all((gyro > 6.0) & (gyro < 40.0))  # true: 16
    assert 0.08 < accel < 0.4  # true: 0.16
    assert np.all(found.tuning.q < 0.3)  # true: 0.0625, but the walk of the losses takes its share
    assert found.after > found.before + 0.3


def test_flights_not_used_for_fitting_become_more_likely(found):
    unseen = flight(5)
    tuned, hand = (tune.log_likelihood("ekf", unseen, t) for t in (found.tuning, None))
    right = tune.log_likelihood("ekf", tune.Table(quad(TRUE_TORQUE, TRUE_GYRO, TRUE_ACCEL), *vars_of(unseen)), None)
    assert tuned > hand + 0.3 and tuned > right - 0.1


def vars_of(table):
    return table.u, table.y, table.valid, table.dt


def test_a_loss_is_estimated_better(found):
    """Tuning is for the losses: on an unseen flight with one they come out closer."""
    faulty = flight(6, loss=0.3)
    error = []
    for tuning in (None, found.tuning):
        from rotorwatch_lab.compiling.run import run

        estimator = published.method("ekf", WRONG, DT, tuning)
        _, theta = run(estimator, faulty.u, faulty.y, faulty.valid, select=lambda out: out.theta)
        wanted = np.zeros((T, 4))
        wanted[T // 2 :, 1] = 0.3
        error.append(np.sqrt(np.mean((theta - wanted)[60:] ** 2)))
    assert error[1] < 0.9 * error[0], error


def test_losses_put_in_keep_the_walk_from_vanishing(found):
    assert 1e-4 < found.tuning.keywords["theta_walk"] < 1.0


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(("name", "pace"), [("adaptive_ekf", "memory_s"), ("ekf", "theta_walk")])
def test_the_gradient_is_that_of_the_likelihood(name, pace):
    objective = jax.jit(tune._objective(name, [flight(0)], {}, pace))
    slope = np.asarray(jax.jit(jax.grad(tune._objective(name, [flight(0)], {}, pace)))(np.zeros(8)))
    assert abs(slope[7]) > 1e-4
    for k in (0, 4, 6, 7):
        step = 1e-4 * (np.arange(8) == k)
        numeric = float(objective(step) - objective(-step)) / 2e-4
        assert abs(slope[k] - numeric) < 1e-5 * max(1.0, abs(numeric)), k


def test_likelihood_is_that_of_the_valid_components():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((4, 4))
    S, e, valid = A @ A.T + np.eye(4), rng.standard_normal(4), np.array([True, False, True, True])
    e_v, S_v = e[valid], S[np.ix_(valid, valid)]
    wanted = -0.5 * (e_v @ np.linalg.solve(S_v, e_v) + np.linalg.slogdet(2 * np.pi * S_v)[1])
    got = tune._log_normal(np.where(valid, e, np.nan), S, valid)
    assert abs(float(got) - wanted) < 1e-12


def test_a_loss_put_in_leaves_the_thrust_as_it_was():
    u = 1.0 + 0.1 * np.random.default_rng(0).standard_normal((200, 4))
    lost = tune._with_loss(u, 2, DT)
    assert np.array_equal(np.delete(lost, 2, 1), np.delete(u, 2, 1)) and np.array_equal(lost[:100], u[:100])
    np.testing.assert_allclose(lost[-1, 2] * (1 - tune.LOSS), u[-1, 2], rtol=1e-6)


def test_what_cannot_be_tuned_is_refused():
    short = tune.Table(WRONG, *(a[:100] for a in vars_of(flight(0))[:3]), DT)
    with pytest.raises(ConfigError, match="at least"):
        tune.fit("ekf", [short])
    with pytest.raises(ConfigError, match="one rate"):
        tune.fit("ekf", [flight(0), tune.Table(WRONG, *vars_of(flight(1))[:3], 0.1)])
    with pytest.raises(ConfigError, match="learns its noise"):
        tune.tune([], "default")
    with pytest.raises(ConfigError, match="no estimator called"):
        tune.tune([], "crystal ball")


def hop(rows):
    """A hop of so many rows, with one number each to tell them by."""
    time = np.arange(rows)
    return LogPlant({}, time[:, None] * 1.0, time[:, None] * 1.0, np.ones((rows, 1), bool), time, 0.1, time)


def test_something_is_kept_back_to_check_on():
    a, b, short = hop(900), hop(300), hop(500)
    assert tune._held_out([("a", [a]), ("nothing", []), ("b", [b])]) == ([a], [b], "b")
    taught, held, name = tune._held_out([("a", [a])])
    assert [len(h.u) for h in (*taught, *held)] == [675, 225] and name == "the last quarter of a"
    assert held[0].rows[0] == 675
    assert tune._held_out([("short", [short])]) == ([short], [], "")


def test_factors_at_their_bounds_are_named(found):
    assert found.notes == ()
    ends = np.array([1.0, tune.RANGE, 1.0, 1.0, 1.0 / tune.RANGE, 2.0, 1.0, tune.RANGE])
    (said,) = tune._at_bounds(ends, WRONG, "theta_walk")
    assert "process noise of pitch rate (largest), measurement noise of pitch rate (smallest), theta_walk (largest)." in said


@pytest.fixture
def tuned(monkeypatch):
    """tune.tune over made flights with a fit that finds nothing new, and a likelihood as wanted: tuned(after, flights) -> Fit."""
    from test_calibrate import flown, on_the_ground

    def go(after, *flights):
        asked = []

        def fitted(name, tables, keywords=None, rounds=0, progress=None):
            asked.append(len(tables))
            return tune.Fit(name, "rate_dynamics", 0.1, Tuning(np.ones(3), np.ones(4), {}), -1.0, 2.0)

        monkeypatch.setattr(tune, "fit", fitted)
        monkeypatch.setattr(tune, "log_likelihood", lambda name, table, tuning=None: -1.0 if tuning is None else after)
        made = {"one": flown(), "two": flown("two.bin"), "ground": on_the_ground(), "hexa": flown("hexa.bin", frame=2, rotors=6)}
        return tune.tune([made[f] for f in flights], "ekf"), asked

    return go


def test_a_tuning_that_makes_things_worse_says_so(tuned, tmp_path):
    worse, asked = tuned(-2.0, "one", "two")
    assert asked == [1] and worse.held_out == "two.bin" and worse.flights == ("one.bin", "two.bin")
    (said,) = worse.notes
    assert "is worse: on two.bin" in said and "from -1.000 to -2.000; do not use it" in said
    tune.write(worse, tmp_path / "t.toml")
    assert "The tuning is worse" in (tmp_path / "t.toml").read_text() and "held_out_after = -2" in (tmp_path / "t.toml").read_text()
    better, _ = tuned(-0.5, "one", "two")
    assert better.notes == () and (better.held_out_before, better.held_out_after) == (-1.0, -0.5)


def test_a_tuning_that_was_not_checked_says_so(tuned):
    (said,) = tuned(-0.5, "one")[0].notes
    assert "was not checked" in said


def test_logs_to_tune_to_are_assessed_first(tuned):
    found, _ = tuned(-0.5, "one", "ground", "hexa", "two")
    assert found.flights == ("one.bin", "two.bin")
    assert any("ground.bin was set aside: it has no flight" in n for n in found.notes)
    assert any("hexa.bin was set aside: its frame" in n for n in found.notes)


def test_how_fast_losses_change_is_known_by_the_methods_own_names():
    named = {name: tune.pace_of(name, published.method(name, WRONG, DT)) for name in discovery.names() if name != "default"}
    assert set(named.values()) <= {None, *tune.PACES}
    wanted = {"ekf": "theta_walk", "atsukf": "theta_walk", "akf": "memory_s", "axkf": "memory_s", "mhe": None}
    assert wanted.items() <= named.items()


# Files.


def fit(q, r, walk):
    return tune.Fit("ekf", "rate_dynamics", 0.05, Tuning(np.array(q), np.array(r), {"theta_walk": walk}), -1.0, 2.0, ('a "b".bin',))


factor = st.floats(1e-4, 1e4)


@given(q=st.lists(factor, min_size=3, max_size=3), r=st.lists(factor, min_size=4, max_size=4), walk=factor)
def test_files_hold_what_was_found(tmp_path_factory, q, r, walk):
    path = tmp_path_factory.mktemp("tuning") / "t.toml"
    tune.write(fit(q, r, walk), path)
    back = tune.read(path, "ekf")
    np.testing.assert_allclose([*back.q, *back.r, back.keywords["theta_walk"]], [*q, *r, walk], rtol=1e-5)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("estimator = ", "not a tuning file"),
        ('estimator = "ukf"', "for ukf, not for ekf"),
        ("q = [1, 2, 3]", "for no estimator"),
        ('estimator = "ekf"\nq = [1, 2]', "q must be 3 numbers"),
        ('estimator = "ekf"\nr = [1, 2, 0, 1]', "r must be 4 numbers above zero"),
        ('estimator = "ekf"\nr = ["a", 1, 1, 1]', "r must be 4 numbers"),
        ('estimator = "ekf"\n[keywords]\ntheta_walk = "x"', "keywords must be numbers"),
    ],
)
def test_wrong_files_get_one_sentence(tmp_path, text, says):
    path = tmp_path / "t.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says):
        tune.read(path, "ekf")
