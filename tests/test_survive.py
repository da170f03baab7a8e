"""What a vehicle survives: known verdicts, margins and wind against a second way, files and options, the command and its refusals."""

import json

import numpy as np
import pytest
from scipy.optimize import linprog

import rotorwatch as rw
from rotorwatch import airframes
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import VehicleError
from rotorwatch.flight import vehicle_file
from rotorwatch_lab.planning.survive import FULL, NO, NO_YAW, SPINNING
from rotorwatch_lab.simulation import dynamics, prepare, rotation, scenario
from rotorwatch_lab.simulation.rigid import Air, Body

jax = load_jax()
jnp = jax.numpy
QUAD, HEXA, OCTA = "ardupilot-quad-x", "ardupilot-hexa-x", "ardupilot-octa-x"
USUAL = {"mass_kg": 2.0, "thrust_to_weight": 2.2, "arm_m": 0.3}


@pytest.fixture(scope="module")
def quad():
    return rw.survive(QUAD)


@pytest.mark.thorough
def test_a_quadrotor_only_spins_without_a_rotor_or_two_opposite_ones(quad):
    """Mueller and D'Andrea 2014; ArduPilot numbers the rotors so that 1 and 2, 3 and 4 are opposite."""
    ends = {case.rotors: case.verdict for case in quad.cases}
    assert all(ends[k,] == SPINNING for k in range(1, 5))
    assert ends[1, 2] == ends[3, 4] == SPINNING and ends[1, 3] == ends[1, 4] == NO
    assert quad.healthy.verdict == FULL and quad.count(2, 1.0)[NO] == 4
    spinning = next(case for case in quad.cases if case.rotors == (1,))
    assert spinning.rate > 5.0 and spinning.tilt > 0.05 and spinning.wind is None and spinning.roll is None


@pytest.mark.thorough
def test_an_octorotor_keeps_full_control_and_a_hexarotor_gives_up_yaw():
    """Du, Quan, Yang and Cai 2015: the hexarotor with alternating spins is not controllable after any loss, but without yaw it is."""
    hexa, octa = (rw.survive(name, **USUAL) for name in (HEXA, OCTA))
    assert hexa.count(1, 1.0) == {FULL: 0, NO_YAW: 6, SPINNING: 0, NO: 0}
    assert octa.count(1, 1.0) == {FULL: 8, NO_YAW: 0, SPINNING: 0, NO: 0}
    assert "yaw given up in 6 of 6" in hexa.summary and len(hexa.assumptions) == 1


def test_margins_are_those_of_a_linear_programme(quad):
    half = rw.survive(QUAD, loss=(0.4,), **USUAL)
    for case in (half.cases[1], half.cases[-1]):
        e = np.ones(4)
        e[[k - 1 for k in case.rotors]] = 0.6
        B, weight = half.airframe.B * e, half.airframe.mass * 9.80665
        hover = np.array([weight, 0, 0, 0])
        for found, axis in ((case.roll, 1), (case.pitch, 2), (case.yaw, 3)):
            sides = []
            for sign in (1.0, -1.0):
                lp = linprog([0, 0, 0, 0, -1.0], np.zeros((0, 5)), [], np.column_stack([B, -sign * np.eye(4)[axis]]), hover,
                             [(0, 1)] * 4 + [(0, None)])  # fmt: skip
                sides.append(lp.x[-1])
            assert found == pytest.approx(min(sides), rel=1e-6)


def test_wind_is_what_the_simulator_blows():
    """At the wind it says, the simulator's forces balance with commands within limits; a little above they do not."""
    plan = scenario.from_table({"airframe": {"frame": "quad-x", "ground_effect": False}})
    craft, found = prepare.craft(plan), rw.survive(QUAD, loss=(0.4,), **USUAL)
    case = found.cases[0]
    e = np.array([0.6, 1, 1, 1])
    # The rotors' speeds are taken as in hover, which is good for a few tenths of a m/s.
    assert held(craft, e, case.wind - 0.5) > 0.0 and held(craft, e, case.wind + 1.0) < 0.0


def held(craft, e, wind):
    """How far, in the worst direction of the wind, the commands of the balance stay from 0 and 1: Newton's method on the simulator's own
    accelerations, over commands and lean."""
    calm = Air(np.zeros(3), np.zeros(3), 0.0)

    def accelerations(z, blows):
        q = rotation.unit(jnp.stack([1.0, z[4] / 2, z[5] / 2, 0.0]))
        rotors = dynamics.sums(craft, jnp.sqrt(jnp.maximum(z[:4], 1e-9)), jnp.zeros(4), 1.0 - e)
        body = Body(np.array([0, 0, -50.0]), np.zeros(3), q, np.zeros(3))
        change, _ = dynamics.derivative(craft, body, rotors, calm._replace(wind=blows))
        return jnp.concatenate([change.v, 0.05 * change.omega])

    def solve(blows):
        def turn(_, z):
            slope = jax.jacfwd(accelerations)(z, blows)
            return z - jnp.clip(jnp.linalg.solve(slope, accelerations(z, blows)), -0.3, 0.3)

        return jax.lax.fori_loop(0, 12, turn, jnp.array([0.5, 0.5, 0.5, 0.5, 0.0, 0.0]))

    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    z = np.asarray(jax.jit(jax.vmap(solve))(wind * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)))
    return min(z[:, :4].min(), (1.0 - z[:, :4]).min())


def test_files_and_options_say_how_heavy_and_strong(tmp_path, quad):
    known = airframes.named(QUAD)
    bare = tmp_path / "bare.toml"
    vehicle_file.write(known, bare)
    with pytest.raises(VehicleError, match="does not say mass_kg, thrust_to_weight, arm_m: give --mass"):
        rw.survive(bare)
    found = rw.survive(bare, loss=(0.2,), **USUAL)
    assert found.healthy.roll == pytest.approx(quad.healthy.roll, rel=1e-9)
    full = tmp_path / "full.toml"
    vehicle_file.write(known.__class__(known.name, known.rotors, known.curve, known.mixer, extra={**USUAL, "mass_kg": 4.0}), full)
    assert rw.survive(full, loss=(0.2,)).healthy.roll == pytest.approx(2 * quad.healthy.roll, rel=1e-9)
    assert rw.survive(full, loss=(0.2,), mass_kg=2.0).healthy.roll == pytest.approx(quad.healthy.roll, rel=1e-9)


@pytest.mark.parametrize(
    "argv, words",
    [
        (("nonsense",), "no airframe called 'nonsense'"),
        (("no.toml",), "no.toml"),
        ((QUAD, "--thrust-to-weight", "0.9"), "carries no vehicle"),
        ((QUAD, "--mass", "-1"), "mass_kg must be above zero"),
        ((QUAD, "--loss", "half"), "give numbers with commas"),
        ((QUAD, "--loss", "0.3,1.5"), "above 0 and up to 1"),
        ((QUAD, "--figure", "f.xyz"), "ends in .svg, .png or .pdf"),
        (("f450", "--mass", "2"), "a paper's airframe"),
        (("ruav-40kg",), "helicopter"),
        (("ardupilot-quad-vtail",), "tilted"),
    ],
)
def test_bad_requests_are_one_sentence(run, argv, words):
    code, out, err = run("survive", "--vehicle", *argv)
    assert code == 2 and out == "" and words in err and "Traceback" not in err


def test_a_vehicle_that_does_not_hover_is_refused():
    """All rotors turn alike: no yaw can be held."""
    known = airframes.named(QUAD)
    rotors = tuple(rotor.__class__(rotor.x, rotor.y, 1) for rotor in known.rotors)
    with pytest.raises(VehicleError, match="cannot hover under full control even with sound rotors"):
        rw.survive(known.__class__("alike", rotors, known.curve), **USUAL)


def test_a_tricopter_yaws_by_its_servo():
    found = rw.survive("ardupilot-tri", loss=(0.2,))
    assert found.healthy.verdict == FULL and found.healthy.yaw is None
    assert any("servo" in sentence for sentence in found.assumptions)


def test_the_command_prints_a_table_json_and_a_picture(run, tmp_path):
    picture = tmp_path / "out.svg"
    code, out, err = run("survive", "--vehicle", QUAD, "--loss", "0.3", "--figure", picture)
    assert code == 0 and "full control" in out and "taken as usual" in out and "out.svg" in err
    assert picture.read_text().count("<path") > 10
    code, out, _ = run("survive", "--vehicle", QUAD, "--loss", "0.3", "--json", "-q")
    reported = json.loads(out)
    assert code == 0 and len(reported["cases"]) == 10 and reported["cases"][0]["verdict"] == FULL
    assert reported["healthy"]["rotors"] == [] and reported["losses"] == [0.3]
