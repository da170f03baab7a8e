"""The excitation in the null space: what it moves, what it tells, and what is refused."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from conftest import trials
from rotorwatch import airframes
from rotorwatch.engine.bindings.plant_rows import usual_gains
from rotorwatch.engine.estimator.plant import TAU
from rotorwatch.errors import ConfigError
from rotorwatch_lab.control import excitation
from rotorwatch_lab.control.excitation import Limits, Noise, Signal
from rotorwatch_lab.planning.ask import ask

FRAMES = ("hexa-x", "hexa-plus", "octa-x", "octa-plus", "y6", "dodecahexa-x")
NOISE = Noise(np.array([0.025**2, 0.01**2, 0.02**2, 0.2**2]), np.array(TAU))
B_OF = {frame: airframes.named(f"ardupilot-{frame}").effectiveness() for frame in FRAMES}


@pytest.fixture(scope="module", autouse=True)
def float64():
    from rotorwatch.base.backend import jax

    jax()


def losses(n, *sets, loss=0.3):
    return [np.where(np.isin(np.arange(n) + 1, who), loss, 0.0) for who in sets]


def designed(frame="hexa-x", sets=((1, 2), (3, 4), (5, 6), ()), hover=0.45, **more):
    B = B_OF[frame]
    n = B.shape[1]
    loss = more.pop("loss", 0.3)
    return excitation.design(
        B, losses(n, *sets, loss=loss), np.full(n, hover), NOISE, usual_gains(n)[:3], 0.05, **more
    )  # fmt: skip


@pytest.fixture(scope="module")
def hexa():
    return designed()


@pytest.mark.parametrize("frame", FRAMES)
def test_the_null_space_moves_nothing_and_with_hover_shows_every_loss(frame):
    B, N = B_OF[frame], excitation.null_space(B_OF[frame])
    assert N.shape == (B.shape[1], B.shape[1] - 4)
    assert np.abs(B @ N).max() < 1e-12
    assert pytest.approx(np.eye(N.shape[1]), abs=1e-12) == N.T @ N
    # Hover shows B theta, the thrust of the answer N' diag(B_T) theta: together all losses, none of them for free.
    both = np.concatenate([B, N.T * B[3]])
    assert np.linalg.matrix_rank(both, tol=1e-3) == B.shape[1] > np.linalg.matrix_rank(B)


def test_a_quadrotor_has_none():
    assert excitation.null_space(airframes.named("ardupilot-quad-x").effectiveness()).shape == (4, 0)


@settings(max_examples=trials(40), deadline=None)
@given(st.floats(-1.0, 5.0))
def test_a_healthy_vehicle_does_not_answer(t):
    signal, B = SIGNAL, B_OF["hexa-x"]
    c = np.asarray(excitation.value_at(signal, t))
    assert np.abs(B @ c).max() < 1e-12
    if not 0.0 < t < 1.3:
        assert not c.any()


SIGNAL = Signal(*(0.1 * excitation.null_space(B_OF["hexa-x"])[:, k] for k in (0, 1)), 0.5, 0.0, 1.3)  # fmt: skip


def test_an_excitation_that_never_begins_is_nothing():
    for t in (0.0, 1e6):
        assert not np.asarray(excitation.value_at(excitation.none(8), t)).any()


@settings(max_examples=6, deadline=None)
@given(
    st.sampled_from(("hexa-x", "octa-x", "y6")), st.floats(0.1, 0.6), st.floats(0.3, 0.6), st.floats(0.2, 2.0),
    st.floats(0.02, 0.2), st.integers(0, 10**6),
)  # fmt: skip
def test_a_design_keeps_its_limits(frame, loss, hover, tilt, amplitude, seed):
    n = B_OF[frame].shape[1]
    one, other = (tuple(k) for k in np.random.default_rng(seed).choice(np.arange(1, n + 1), (2, 2), replace=False))
    limits = Limits(tilt=np.radians(tilt), amplitude=amplitude)
    try:
        made = designed(frame, (one, other), hover, loss=loss, limits=limits, length_s=2.0)
    except ConfigError as error:
        assert "null space cannot tell" in str(error)
        return
    c = np.stack([np.asarray(excitation.value_at(made.signal, t)) for t in np.arange(0.0, 2.0, 0.02)])
    assert np.abs(B_OF[frame] @ c.T).max() < 1e-9
    assert np.abs(c).max() <= min(amplitude, 0.5 * min(hover, limits.most - hover)) + 1e-9
    assert made.tilt.max() <= np.radians(tilt) * (1.0 + 1e-6)
    assert made.information.min() > 0.0


def test_its_information_is_that_of_the_commands_it_makes(hexa):
    # Independently of the design's own algebra: commands at a hundred times the ticks' rate, through lag and means, to wrenches.
    signal, dt, fine, lag = hexa.signal, 0.05, 0.0005, 0.03
    t = np.arange(0.0, float(signal.length), fine) + fine / 2.0
    first, second = (np.array([float(v) for v in w]) for w in excitation._waves(t, float(signal.period), float(signal.length)))
    passed = []
    for wave, f in ((first, 1.0), (second, excitation.FASTER)):
        passed.append(wave / np.sqrt(1.0 + (2.0 * np.pi * f / float(signal.period) * lag) ** 2))
    c = np.outer(passed[0], signal.first) + np.outer(passed[1], signal.second)
    c = c.reshape(-1, round(dt / fine), 6).mean(axis=1)
    thetas = losses(6, (1, 2), (3, 4), (5, 6), ())
    for (i, j), reported in zip(hexa.pairs, hexa.information, strict=True):
        difference = c @ (B_OF["hexa-x"][3] * (thetas[i] - thetas[j])) / 0.45
        assert excitation.information(NOISE, difference, dt)[-1] == pytest.approx(reported, rel=0.1)


def test_information_in_white_noise_is_the_signal_over_it():
    x = np.sin(np.arange(40) * 0.7)
    white = Noise(np.array([0.3**2, 0.0, 0.0, 0.0]), np.array(TAU))
    assert excitation.information(white, x, 0.05)[-1] == pytest.approx(((x - x.mean()) ** 2).sum() / 0.09, rel=1e-3)


def test_the_log_likelihood_ratio_has_the_mean_and_variance_that_information_says():
    """Noise from its own recursions, not from the covariance that is tested."""
    rng, dt, T, M = np.random.default_rng(3), 0.05, 40, 6000
    white, first, second, walk = NOISE.variances
    e = np.sqrt(white) * rng.standard_normal((M, T)) + rng.normal(0.0, 0.3, (M, 1))
    for variance, tau in ((first, TAU[0]), (second, TAU[1])):
        left, x = np.exp(-dt / tau), np.sqrt(variance) * rng.standard_normal(M)
        for k in range(T):
            e[:, k] += x
            x = left * x + np.sqrt(variance * (1.0 - left**2)) * rng.standard_normal(M)
    e += np.cumsum(np.sqrt(walk * dt) * rng.standard_normal((M, T)), axis=1)
    phi = 0.2 * np.sin(2.0 * np.pi * dt * np.arange(T) / 0.5)
    reported = excitation.information(NOISE, phi, dt)[-1]
    weight = np.linalg.solve(excitation.covariance(NOISE, T, dt), phi)
    ratio = (e + phi) @ weight - 0.5 * phi @ weight  # the hypothesis phi is true
    assert ratio.mean() == pytest.approx(reported / 2.0, abs=5.0 * np.sqrt(reported / M))
    assert ratio.var() == pytest.approx(reported, rel=6.0 * np.sqrt(2.0 / M))


@pytest.mark.parametrize("probability, power", [(0.99, 0.99), (0.9, 0.7)])
def test_needed_information_names_the_true_one_of_two_as_often_as_asked(probability, power):
    reported = excitation.needed(2, probability, power)
    ratio = np.random.default_rng(1).normal(reported / 2.0, np.sqrt(reported), 100_000)
    assert np.mean(1.0 / (1.0 + np.exp(-ratio)) > probability) == pytest.approx(power, abs=0.005)


@pytest.mark.parametrize("period", [0.4, 1.25])
def test_the_turn_is_that_of_the_attitude_loop_that_it_reckons_with(period):
    length = 6.0 * period
    for which, said in enumerate(excitation._turn(period)):

        def move(t, x, which=which):
            a = float(excitation._waves(t, period, length)[which]) if t <= length else 0.0
            return [x[1], a - 2.0 * excitation.DAMPED * excitation.HOLD * x[1] - excitation.HOLD**2 * x[0]]

        found = solve_ivp(move, (0.0, length + 2.0), [0.0, 0.0], max_step=0.01, rtol=1e-8, atol=1e-12)
        assert said == pytest.approx(np.abs(found.y[0]).max(), rel=0.02)


@pytest.mark.parametrize(
    "request_, words",
    [
        (dict(frame="hexa-x", sets=((1, 2),)), "at least two candidates"),
        (dict(frame="hexa-x", sets=((1, 2), (1, 2))), "same losses"),
        (dict(frame="hexa-x", hover=0.99), "no room"),
        (dict(frame="hexa-x", longest_s=0.3), "takes at least"),
        (dict(frame="hexa-x", loss=0.01, longest_s=1.0), "times as large would do"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(request_, words):
    with pytest.raises(ConfigError, match=words) as refused:
        designed(**request_)
    assert str(refused.value).count(". ") == 0


def test_losses_that_answer_alike_are_named():
    """A rotor that loses twice as much as each of a pair of opposite ones: the thrust of every answer is the same."""
    thetas = [losses(6, (1,), loss=0.6)[0], losses(6, (1, 2), loss=0.3)[0]]
    with pytest.raises(ConfigError, match="cannot tell 1\\+2 from 1"):
        excitation.design(B_OF["hexa-x"], thetas, np.full(6, 0.45), NOISE, usual_gains(6)[:3], 0.05)


def test_the_picture_and_numbers_of_a_question():
    asked = ask("ardupilot-hexa-x", [(1, 2), (3, 4), ()], loss=[0.2, 0.3, 0.1], hover=0.4, arm_m=0.25)
    assert asked.candidates == ((1, 2), (3, 4), ())
    assert asked.losses[2].max() == 0.0 and asked.losses[1].max() == 0.3
    assert (asked.separation**2).min() == pytest.approx(asked.design.information.min())
    assert asked.design.information.min() >= asked.design.needed
    time, added = asked.commands(50.0)
    assert added.shape == (len(time), 6) and np.abs(added).max() <= asked.amplitude.max() + 1e-12


@pytest.fixture
def run(run):
    """What is said: output, or the error."""

    def call(*argv):
        code, out, err = run(*argv)
        return code, out if code == 0 else err

    return call


def test_the_command_prints_a_table_json_commands_and_a_picture(run, tmp_path):
    pytest.importorskip("matplotlib")
    given_ = ("ask", "--vehicle", "ardupilot-hexa-x", "--candidates", "1+2,3+4,none", "--hover", "0.4", "--arm", "0.3")
    code, out = run(*given_, "--figure", tmp_path / "a.svg", "--commands", tmp_path / "a.csv")
    assert code == 0 and "1+2" in out and "tells these candidates apart" in " ".join(out.split())
    assert (tmp_path / "a.svg").stat().st_size > 1000
    rows = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    code, out = run(*given_, "--json")
    said = json.loads(out)
    assert code == 0 and rows["time_s"][-1] == pytest.approx(said["length_s"], abs=0.011)
    assert max(said["turn_deg"]) < 1.0 and len(said["pairs"]) == 3


@pytest.mark.parametrize(
    "argv, words",
    [
        ((), "Give a log"),
        (("--vehicle", "ardupilot-hexa-x"), "Name the candidates"),
        (("--vehicle", "ardupilot-quad-x", "--candidates", "1,2"), "no null space"),
        (("--vehicle", "ardupilot-hexa-x", "--candidates", "1,9"), "9 is no set of rotors"),
        (("--vehicle", "ardupilot-hexa-x", "--candidates", "1;2"), "give sets of rotors"),
        (("--vehicle", "ardupilot-hexa-x", "--candidates", "1,2", "--loss", "2"), "above 0 and up to 1"),
        (("--vehicle", "ardupilot-hexa-x", "--candidates", "1,2", "--loss", "0.1,0.2,0.3"), "one for each"),
        (("--vehicle", "ardupilot-hexa-x", "--candidates", "1,2", "--hover", "1.5"), "share of full thrust"),
        (("--vehicle", "ardupilot-hexa-x", "--candidates", "1,2", "--tilt", "0"), "tilt"),
        (("no-such.bin",), "no such file"),
    ],
)
def test_bad_requests_are_one_sentence(run, argv, words):
    code, said = run("ask", *argv)
    assert code != 0 and words in said and "Traceback" not in said
