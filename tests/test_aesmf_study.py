"""The helicopter study's figures with one seed: what covers, what does not, and what is tighter; and what follows from them."""

import time

import numpy as np
import pytest

from rotorwatch.errors import ConfigError
from rotorwatch_lab.experiments.studies import reproduce_aesmf as study
from rotorwatch_lab.experiments.studies import reproduction, ruav_filters, ruav_flight


@pytest.fixture(scope="module")
def assessed():
    system = ruav_flight.plant()
    flights = ruav_flight.fly(system, 1)
    made = study.runs()
    names = ("esmf", "aesmf", "aekf", "aukf", "ekf", "aesmf/own_no_restart", "aekf/no_restart")
    return flights, {name: study._assessed(study._program(made[name]), flights)[0] for name in names}


@pytest.mark.thorough
def test_the_flight_keeps_its_bounds_and_its_fault(assessed):
    flights, _ = assessed
    assert np.isfinite(flights.x).all() and np.abs(flights.x[..., :3]).max() < 3
    form = ((flights.y - flights.x) ** 2 / ruav_flight.MEASUREMENT**2).sum(-1)
    assert form.max() <= 1 + 1e-9
    fault = round(ruav_flight.FAULT_S / ruav_flight.DT)
    np.testing.assert_allclose(flights.theta[0, fault] - flights.theta[0, fault - 1], ruav_flight.FAULT, atol=2e-5)
    system, u, x, theta = ruav_flight.plant(), flights.u[0], flights.x[0], flights.theta[0]
    import jax

    step = jax.jit(jax.vmap(lambda x, u, theta: system.f(x, u, theta, ruav_flight.DT)))
    w = x[1:] - np.asarray(step(x[:-1], u[1:], theta[:-1] + (np.arange(1, len(u)) == fault)[:, None] * ruav_flight.FAULT))
    assert ((w / ruav_flight.PROCESS[:6]) ** 2).sum(-1).max() <= 1.0


@pytest.mark.thorough
def test_no_actuator_reaches_a_stop(assessed):
    flights, _ = assessed
    commands = flights.u[..., :4]
    U = commands * (1.0 - flights.theta[..., :4]) + flights.theta[..., 4:]
    assert U.min() > 0.0 and U.max() < 1.0


@pytest.mark.thorough
def test_sets_and_a_generous_kalman_filter_cover(assessed):
    _, result = assessed
    assert result["esmf"]["containment_worst_seed"] == 1.0 and result["esmf"]["ellipsoid"] == 1.0
    assert result["aesmf"]["containment_worst_seed"] == 1.0
    assert result["esmf"]["half_width"] < 0.58 and result["aesmf"]["half_width"] < 0.215
    assert result["ekf"]["containment"] > 0.99
    assert result["ekf"]["half_width_last_5s"] < 0.1 * result["esmf"]["half_width_last_5s"]


@pytest.mark.thorough
def test_no_certain_set_could_be_much_narrower(assessed):
    """Coefficients d off the truth, with the noise that makes up for them, explain the same measurements while that noise keeps
    the filters' bounds: every guaranteed set holds them. To first order in d, a cone program for each coefficient."""
    cp = pytest.importorskip("cvxpy")
    import jax

    flights, result = assessed
    system, u, x, theta = ruav_flight.plant(stops=False), flights.u[0], flights.x[0], flights.theta[0]

    def step(x, u, theta):
        return system.f(x, u, theta, ruav_flight.DT)

    late = slice(round(ruav_flight.FAULT_S / ruav_flight.DT) + 1, None, 8)
    before, given, losses = x[:-1][late], u[1:][late], theta[1:][late]
    bound = study.TOO_WIDE * ruav_flight.PROCESS[:6]
    w = (x[1:][late] - np.asarray(jax.vmap(step)(before, given, losses))) / bound
    slope = np.asarray(jax.vmap(jax.jacfwd(step, 2))(before, given, losses)) / bound[:, None]
    d = cp.Variable(8)
    off = cp.reshape(slope.reshape(-1, 8) @ d, w.shape, order="C")
    least = [cp.Problem(cp.Maximize(d[i]), [cp.norm(w - off, 2, axis=1) <= 1]).solve(solver="CLARABEL") for i in range(8)]
    assert 0.1 < np.mean(least) < result["esmf"]["half_width"] < 4 * np.mean(least)


@pytest.mark.thorough
def test_adapted_kalman_bounds_are_the_narrowest(assessed):
    _, result = assessed
    for name in ("aekf", "aukf"):
        assert result[name]["half_width_last_5s"] < 0.5 * result["ekf"]["half_width_last_5s"]
        assert result[name]["restarts"] >= 1


@pytest.mark.thorough
def test_without_a_restart_less_is_known_after_the_fault(assessed):
    _, result = assessed
    assert result["aesmf/own_no_restart"]["half_width"] > study.KNOWN > 5 * result["aesmf"]["half_width"]
    assert result["aesmf/own_no_restart"]["half_width_healthy"] == pytest.approx(result["aesmf"]["half_width_healthy"])
    assert result["aekf/no_restart"]["restarts"] == 0 and result["aekf/no_restart"]["containment"] < 0.95


def test_literal_readings_choose_the_form_of_the_sets():
    """And all four forms are run whatever is chosen."""
    seen = set()
    for literal in ((), ("printed",), ("no_restart",), ("printed", "no_restart")):
        made, form = study.runs(literal), ruav_filters.form_of(literal)
        seen.add(form)
        for name in ruav_filters.SETS:
            assert made[name] == made[f"{name}/{form}"]
            forms = {
                key: (one.estimator.form, one.estimator.remainder, one.estimator.restart)
                for key in ruav_filters.FORMS
                for one in [made[f"{name}/{key}"]]
            }
            assert forms == {
                "printed": ("batch", "interval", False),
                "printed_restart": ("batch", "interval", True),
                "own_no_restart": ("joint", "taylor", False),
                "own": ("joint", "taylor", True),
            }
        for name in ruav_filters.KALMAN:
            assert made[name] == made[f"{name}/{'no_restart' if 'no_restart' in literal else 'restart'}"]
            assert [made[f"{name}/{how}"].restart for how in ("no_restart", "restart")] == [False, True]
    assert seen == set(ruav_filters.FORMS)


def numbers(**changed):
    """What the study might measure: sets by form, Kalman filters by restart, cost by run. changed: (form, filter) -> other values."""
    one = {
        "containment": 1.0, "containment_worst_seed": 1.0, "ellipsoid": 1.0, "ellipsoid_healthy": 1.0, "off_centre": 0.2,
        "least_q": 0.5, "error": 0.1, "half_width": 0.4, "half_width_healthy": 0.1, "restarts": 0.0, "outgrown_s": np.inf,
    }  # fmt: skip
    gd = one | {"half_width": 0.1, "half_width_healthy": 0.05}
    forms = {form: {"esmf": dict(one), "aesmf": dict(gd)} for form in ruav_filters.FORMS}
    for both in (forms["printed"], forms["printed_restart"]):
        for row in both.values():
            row.update(half_width=50.0, half_width_healthy=50.0)
    cost = dict.fromkeys(study.TIMED, 100.0) | {"aekf/no_restart": 10.0, "aukf/no_restart": 30.0}
    flat = {"aesmf_floor": 0.2, "ekf": 0.02}
    found = {
        "forms": forms,
        "kalman": {
            how: {name: {"containment": 0.8, "half_width": 0.01, "error": 0.01} for name in (*ruav_filters.KALMAN, "ekf")}
            for how in study.RESTARTS
        },
        "ekf_true_q": {"containment": 0.9},
        "microseconds_per_step": cost | changed.pop("cost", {}),
        "adversarial_escapes": changed.pop("escapes", 0),
        **{key: flat for key in ("half_width", "ellipsoid", "ellipsoid_healthy")},
        "containment": {"ekf": 1.0},
    }
    for form, values in changed.items():
        for row in forms[form].values():
            row.update(values)
    return found


def verdicts(**changed):
    claims, forms = study._claims(numbers(**changed))
    assert [claim.claim for claim in claims] == list(reproduction.claimed("aesmf"))[: len(claims)]
    return {name: list(row.values()) for name, row in forms.items()}, [claim.verdict for claim in claims]


def test_cost_is_computing_time_per_step_of_the_best_round(monkeypatch):
    """Waiting costs nothing; what is slow is not timed again."""
    flights, reported = ruav_flight.Flights(*np.zeros((4, 2, 50, 6))), []
    monkeypatch.setattr(study, "LONG_S", 0.015)
    work = {"long": iter([0.02]), "short": iter([0.01, 0.008, 0.003, 0.006, 0.004])}

    def program(name):
        def run(u, y):
            time.sleep(0.005)
            until = time.process_time() + next(work[name])
            while time.process_time() < until:
                pass

        return run

    cost = study._microseconds({name: program(name) for name in work}, flights, lambda *row: reported.append(row))
    assert 200.0 <= cost["long"] < 1000.0 and 30.0 <= cost["short"] < 75.0
    assert len(reported) == 1 + study.ROUNDS and all(next(left, None) is None for left in work.values())


def test_each_claim_is_assessed_for_each_form():
    forms, whole = verdicts()
    assert forms["cover"] == ["partly", "partly", "holds", "holds"]
    assert forms["tightest"] == ["not reproduced", "not reproduced", "holds", "holds"]
    assert forms["stable"] == ["not reproduced", "not reproduced", "holds", "holds"]
    assert forms["centre"] == ["not reproduced"] * 4 and forms["kalman"] == ["holds"] * 4
    assert forms["cheapest"] == ["holds"] * 2 and forms["best_cost"] == ["refuted"] * 2
    assert forms["alike"] == ["holds"] * 2 and forms["accuracy"] == ["not reproduced"] * 4
    assert whole == ["partly", "partly", "holds", "partly", "holds", "not reproduced", "not reproduced", "holds", "holds", "refuted"]


def test_verdicts_follow_from_the_numbers():
    assert verdicts(own={"containment_worst_seed": 0.99})[0]["cover"][3] == "not reproduced"
    assert verdicts(own={"containment_worst_seed": 0.99})[0]["tightest"][3] == "not reproduced"
    assert verdicts(own_no_restart={"half_width": 1.3})[0]["cover"][2] == "partly"
    assert verdicts(own_no_restart={"half_width": 1.3})[0]["tightest"][2] == "partly"
    assert verdicts(own={"least_q": 0.05})[0]["stable"][3] == "partly"
    assert verdicts(escapes=1)[0]["stable"] == ["not reproduced"] * 4
    sharper = numbers()
    sharper["forms"]["own"]["aesmf"]["error"] = 0.05
    sharper["kalman"]["restart"]["aukf"]["half_width"] = 0.012
    claims, forms = study._claims(sharper)
    assert [list(forms[name].values())[-1] for name in ("accuracy", "alike")] == ["holds", "not reproduced"]
    assert [claim.verdict for claim in claims[4:6]] == ["partly", "partly"]
    cheap = {"aesmf/printed": 5.0, "esmf/printed": 5.0}
    assert verdicts(cost=cheap)[0]["best_cost"] == ["holds", "refuted"]
    assert verdicts(cost=cheap)[0]["cheapest"] == ["not reproduced", "holds"]
    assert verdicts(cost={"aekf/no_restart": 20.0})[1][8] == "partly"
    assert verdicts(cost={"aekf/no_restart": 40.0})[1][8] == "not reproduced"


def test_unknown_literal_readings_are_refused():
    with pytest.raises(ConfigError, match="no literal reading"):
        reproduction.check_literal(study, ("nonsense",))
