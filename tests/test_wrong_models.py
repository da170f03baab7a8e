"""The intermediate observer with a wrong model: the flights, what the model does not say, and the bound, against other computations."""

import dataclasses

import numpy as np
import pytest

from rotorwatch import airframes
from rotorwatch_lab.experiments.studies import error_bound, hover_flights, wrong_models
from rotorwatch_lab.experiments.studies import intermediate_as_printed as printed
from rotorwatch_lab.experiments.studies import reproduce_intermediate as study
from rotorwatch_lab.maths import intermediate_design as design

FILE = airframes.paper("f450")


def flown_again(known, real, gamma, wind, drag, lever, samples):
    """A flight of `hover_flights.uncertain`, by SciPy's integrator, from rotation matrices and moments: (T, 8) as measured."""
    from scipy.integrate import solve_ivp

    g, dt = known.gravity, 1.0 / hover_flights.PLANT_HZ
    inertia, m = np.diag(1.0 / real.D[:3]), 1.0 / real.D[3]
    Y, slow, integral, out = np.zeros(12), np.zeros(2), np.zeros(4), []

    def rate(_, Y, U, h, air):
        angles, rates, v = Y[:3], Y[6:9], Y[9:]
        (cf, ct, cp), (sf, st, sp) = np.cos(angles), np.sin(angles)
        axis = np.array([cf * st * cp + sf * sp, cf * st * sp - sf * cp, cf * ct])  # third column of eq. (1), as eq. (5) has it
        push = m * drag * (air - v)
        blown = lever * np.cross([0.0, 0.0, 1.0], push) * [1.0, 1.0, 0.0]
        torque = U[:3] + blown - np.cross(rates, inertia @ rates + [0.0, 0.0, h])
        return np.concatenate([rates, v, np.linalg.solve(inertia, torque), axis * U[3] / m - [0, 0, g] + push / m])

    inverse = np.linalg.inv(known.D[:, None] * known.M)
    for k in range(samples):
        for _ in range(hover_flights.PER_SAMPLE):
            missing = -hover_flights.POSITION * Y[3:5] - Y[9:11]
            slow = slow + missing * dt
            push = (hover_flights.VELOCITY * missing + hover_flights.VELOCITY_I * slow) / g
            wanted = np.concatenate([np.clip([-push[1], push[0]], -hover_flights.TILT, hover_flights.TILT), [0.0, 0.0]])
            error = wanted - np.append(Y[:3], Y[5])
            integral = integral + error * dt
            asked = hover_flights.KP * error - hover_flights.KD * np.append(Y[6:9], Y[11]) + hover_flights.KI * integral
            u = np.clip(inverse @ (asked + np.array([0, 0, 0, g])), 0.0, known.counts_max) * (1.0 - gamma[k])
            speeds = FILE["rotor_speed_max"] * np.sqrt(u / known.counts_max)
            h = -FILE["rotor_inertia"] * speeds @ np.array(FILE["rotors"]["spin"])
            Y = solve_ivp(rate, (0, dt), Y, args=(real.M @ u, h, wind[k]), rtol=1e-10, atol=1e-12).y[:, -1]
        out.append([*Y[:3], -Y[5], *Y[6:9], -Y[11]])
    return np.array(out)


def test_the_uncertain_flight_against_another_integrator():
    """Wrong mass, inertia and thrust, wind that gusts and pushes above the centre of mass, a fault, and the rotors' own momentum."""
    known = hover_flights.craft(FILE)
    real = wrong_models._real(FILE, "all", 0.05)
    rng, samples = np.random.default_rng(1), 60
    gamma = np.zeros((1, samples, 4))
    gamma[:, 20:, 2] = 0.2
    wind = 5.0 * rng.standard_normal((1, samples, 3))
    y = hover_flights.uncertain(known, [real], gamma, wind, np.array([0.3]), 0.01)[1]
    again = flown_again(known, real, gamma[0], wind[0], 0.3, 0.01, samples)
    assert np.abs(again[:, 4:7]).max() > 0.1  # it does turn
    np.testing.assert_allclose(y[0], again, atol=1e-8)


def test_rotors_momentum_does_no_work():
    """As eq. (6) prints it, it would: both of its terms have one sign there."""
    known = hover_flights.craft(FILE)
    y = np.zeros((1, 1, 8))
    y[0, 0, 4:7] = rates = np.array([0.3, -0.5, 0.2])
    u = np.array([[[500.0, 500.0, 700.0, 600.0]]])
    still = dataclasses.replace(known, spun=0.0 * known.spun)
    with_it, without = (error_bound.truth(craft, u, y, np.zeros((1, 1, 4)))[1][0, 0, :3] for craft in (known, still))
    torque = (with_it - without) / known.D[:3]
    assert np.abs(torque).max() > 0
    np.testing.assert_allclose(torque @ rates, 0.0, atol=1e-18)


def test_what_the_model_does_not_say_is_xi_where_the_model_is_right():
    known, T = hover_flights.craft(FILE), 300
    gamma = np.zeros((1, T, 4))
    gamma[:, 100:, 1] = 0.1
    u, y = hover_flights.uncertain(known, [known], gamma, np.zeros((1, T, 3)), np.zeros(1), 0.0)
    fault, xi = wrong_models.unmodelled(known, u, y, gamma)
    true_fault, true_xi = error_bound.truth(known, u, y, gamma)
    np.testing.assert_allclose(fault, true_fault, atol=1e-9)
    np.testing.assert_allclose(xi, true_xi, atol=0.02 * np.abs(true_fault).max())


@pytest.fixture(scope="module")
def found():
    """A few cases of the grid."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            wrong_models,
            "GRID",
            {
                "nothing": (0.0,),
                "mass": (0.1,),
                "thrust": (-0.1,),
                "inertia": (2.0,),
                "drag factor": (0.2,),
                "one thrust": (-0.1,),
                "wind": (5.0,),
                "all": (0.05,),
            },
        )
        return wrong_models.grid(FILE, study._watcher(FILE), study.GAINS, study.EPSILON)


def test_losses_come_out_as_the_balance_of_forces_says(found):
    """Lift is what the weight wants: 1 - loss = (1 - gamma) (1 + thrust error) / (1 + mass error); inertia is no part of it."""
    rows = {row["wrong"]: row for row in found["rows"]}
    true = np.array(wrong_models.LOSS)
    for kind, ratio in (("nothing", 1.0), ("mass", 1 / 1.1), ("thrust", 0.9), ("inertia", 1.0), ("drag factor", 1.0)):
        np.testing.assert_allclose(rows[kind]["losses"], 1 - (1 - true) * ratio, atol=1e-5)
    np.testing.assert_allclose(rows["one thrust"]["losses"], [0.0, 0.1, 0.2, 0.0], atol=1e-5)
    assert rows["nothing"]["weak"] < 1e-5 and rows["wind"]["weak"] > 0.02


def test_the_bound_is_held_with_a_wrong_model_and_the_claims_say_what_came_out(found):
    assert all(row["held"] and 0 < row["error"] <= row["bound_best_epsilon"] <= row["bound"] for row in found["rows"])
    assert [c.verdict for c in wrong_models.claims(found)] == ["holds", "partly"]
    assert wrong_models.claims(found)[1].only_if
    given = {**found, "rows": [{**row, "held": False, "weak": 0.0, "healthy": 0.0} for row in found["rows"]]}
    assert [c.verdict for c in wrong_models.claims(given)] == ["not reproduced", "holds"]
    given = {**found, "rows": [{**row, "weak": 0.5} for row in found["rows"]]}
    assert wrong_models.claims(given)[1].verdict == "not reproduced"
    head, rows = wrong_models.table(found)[1:]
    assert len(rows) == 8 and all(len(row) == len(head) for row in rows) and wrong_models.figure(found).axes


def test_the_bound_by_integrating_the_errors_densely():
    """Eqs. (15), (16) with a disturbance and a fault that move: V stays below the solution of dV/dt = -sigma V + eta."""
    from scipy.integrate import solve_ivp

    A, C, E = design.double_integrators()
    alpha, epsilon, L = 1.0, 50.0, np.diag([10.0] * 4 + [20.0] * 4)
    S = alpha * E.T
    way, phase = np.random.default_rng(2).standard_normal((2, 4))

    def push(t):
        return 3.0 * way * np.sin(2.0 * t + phase)

    def fault(t):
        return 10.0 * np.cos(0.7 * t + phase)

    def rate(t):
        return -7.0 * np.sin(0.7 * t + phase)

    def errors(t, e):
        e_x, e_tau = e[:8], e[8:]
        e_f = e_tau + S @ e_x
        return np.concatenate([
            (A - L @ C) @ e_x + E @ (e_f + push(t)),
            rate(t) - alpha * E.T @ (A @ e_x + E @ e_tau + E @ S @ e_x + E @ push(t)),
        ])  # fmt: skip

    t = np.arange(0.0, 12.0, error_bound.DT)
    start = np.concatenate([np.full(8, 0.3), fault(0.0)])
    e = solve_ivp(errors, (0, t[-1]), start, t_eval=t, rtol=1e-9, atol=1e-11).y.T
    e_f = e[:, 8:] + e[:, :8] @ S.T
    flights = {"one": (e[:, :8], e_f, np.array([fault(s) for s in t]), np.array([push(s) for s in t]), (1,))}
    found = error_bound.compare(flights, alpha, (10.0, 20.0), epsilon)
    row = found["flights"]["one"]
    size, limit = row["series"]
    np.testing.assert_allclose(size, np.linalg.norm(e, axis=1), rtol=1e-9)
    assert row["held"] and size[-300:].max() < row["bound"]
    # The same differential equation, solved by another integrator with eta as a function of time.
    eta = lambda s: epsilon * (2.0 * push(s) @ push(s) + rate(s) @ rate(s))  # noqa: E731
    V = solve_ivp(lambda s, V: -found["sigma"] * V + eta(s), (t[1], t[-1]), [size[1] ** 2], t_eval=t[1:], rtol=1e-8).y[0]
    assert (limit[1:] ** 2 >= V * (1 - 1e-6)).all()  # steps of eta are rounded up
    np.testing.assert_allclose(limit[-1] ** 2, V[-1], rtol=0.03)


def test_without_rates_the_observer_converges_and_the_theorem_is_silent():
    """A channel's errors have the poles of s^3 + 10 s^2 + 25 s + 25 alpha; no L reaches the rates' part of Sigma, 2 alpha + 1 / epsilon."""
    found = printed.matching(1.0, 50.0)
    assert found["rank_CE"] == {"all eight": 4, "angles and height": 0} and found["least"] == pytest.approx(2.02)
    assert found["slowest"] == pytest.approx(np.roots([1.0, 10.0, 25.0, 25.0]).real.max(), abs=1e-6) and found["slowest"] < 0


def test_the_printed_observer_is_its_equations():
    """`observe` against SciPy's integration of eqs. (11)-(14), for gains that are not diagonal."""
    from scipy.integrate import solve_ivp

    vehicle, rng, T, alpha = hover_flights.craft(FILE), np.random.default_rng(3), 40, 1.7
    L = np.kron([[3.0, 0.4], [0.7, 5.0]], np.eye(4))
    u, y = 500.0 + 5.0 * rng.standard_normal((T, 4)), 0.1 * rng.standard_normal((T, 8))
    A, C, E = design.double_integrators()
    S, down = alpha * E.T, np.array([1.0, 1.0, 1.0, -1.0])
    x, tau = y[0], -S @ y[0]
    for k in range(T):
        seen, a = (y[k] + y[max(k - 1, 0)]) / 2, down * (vehicle.D * (vehicle.M @ u[k])) + [0, 0, 0, vehicle.gravity]

        def rate(_, z, seen=seen, a=a):
            x, tau = z[:8], z[8:]
            return np.concatenate([
                A @ x + E @ (a + tau + S @ x) + L @ (seen - C @ x), -S @ (A @ x + E @ a + E @ tau + E @ S @ x),
            ])  # fmt: skip

        z = solve_ivp(rate, (0, study.DT), np.concatenate([x, tau]), rtol=1e-11, atol=1e-12).y[:, -1]
        x, tau = z[:8], z[8:]
    fault, theta = printed.observe(vehicle, L, alpha, u, y)
    np.testing.assert_allclose(fault[-1], tau + S @ x, rtol=1e-6, atol=1e-7)
    DM = (vehicle.D * down)[:, None] * vehicle.M
    np.testing.assert_allclose(-DM @ (u[-1] * theta[-1]), fault[-1], atol=1e-9)
