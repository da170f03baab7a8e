"""Whole-flight damage: calibrated on flights drawn from the model, and right on real ones."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from rotorwatch import airframes, logs
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight, Signal
from rotorwatch.witnesses.healthy import whole_flight as wf

SHARED = Path(__file__).resolve().parents[2] / "shared" / "flights"
shared = pytest.mark.skipif(not SHARED.is_dir(), reason="needs the test logs in ../shared/flights")
QUAD = airframes.named("ardupilot-quad-x")
HEXA = airframes.named("ardupilot-hexa-x")


# Flights drawn from the model


def drawn(rng, vehicle, between, drift, share=None, extra_yaw=0.0, shift=(0.0, 0.0)):
    """Features of a flight: spread `between` of w (3, 3) or of w and ln of the mean command (4, 4), `drift` of its change, within-flight
    noise; share: commands."""
    n = len(vehicle.rotors)
    share = np.ones(n) if share is None else np.asarray(share, float)
    within = np.diag([0.004, 0.005, 0.003]) ** 2
    w = vehicle.effectiveness()[:3] @ share / share.sum() + [*shift, extra_yaw]
    apart = rng.multivariate_normal(np.zeros(len(between)), between)
    w = w + apart[:3] + rng.multivariate_normal(np.zeros(3), within)
    share = share * np.exp(apart[3:].sum())
    change = rng.multivariate_normal(np.zeros(3), drift + 4.0 * within)
    table = wf._no_hover("drawn", n).to_dict() | {
        "share": 0.4 * share, "wrench": w, "slope_sd": [0.5, 0.5], "covariance": within, "change": change,
        "change_covariance": 4.0 * within, "seconds": 60.0, "blocks": 20.0,
    }  # fmt: skip
    return wf.Features.from_dict(table)


def build(rng, vehicle):
    """One build's covariances between its flights, from the inverse Wishart priors."""
    from scipy.stats import invwishart

    return [
        invwishart.rvs(wf.PRIOR_FLIGHTS + len(prior) + 1, wf.PRIOR_FLIGHTS * prior, random_state=rng)
        for prior in (wf.prior_covariance(len(vehicle.rotors)), np.eye(3) * wf.HALVES_SD**2)
    ]


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("vehicle, flights", [(QUAD, 1), (QUAD, 6), (HEXA, 2)], ids=["quad 1", "quad 6", "hexa 2"])
def test_false_alarm_rate_is_the_stated_one(vehicle, flights):
    rng, count = np.random.default_rng(flights), 120
    alarms = faults = 0
    for _ in range(count):
        spreads = build(rng, vehicle)
        baseline = [drawn(rng, vehicle, *spreads) for _ in range(flights)]
        result = wf.assess(drawn(rng, vehicle, *spreads), baseline, vehicle)
        alarms += result.verdict != "healthy"
        faults += result.verdict == "fault"
    # Four standard errors of the count, on both sides: a test that never alarms would be no better.
    sd = np.sqrt(count * wf.FALSE_ALARM * (1 - wf.FALSE_ALARM))
    assert abs(alarms - count * wf.FALSE_ALARM) < 4 * sd
    assert faults <= count * wf.FALSE_FAULT + 4 * np.sqrt(count * wf.FALSE_FAULT)


def damaged(rng, vehicle, spreads, rotor, theta):
    """A flight whose rotor lost theta; its yaw balance as the prior of rho has it."""
    share = np.ones(len(vehicle.rotors))
    share[rotor - 1] = 1.0 / (1.0 - theta)
    yaw = vehicle.rotors[rotor - 1].spin * (share[rotor - 1] - 1.0) / len(share)
    return drawn(rng, vehicle, *spreads, share=share, extra_yaw=wf.RHO_SD * rng.standard_normal() * yaw)


def test_damage_is_found_named_and_its_interval_holds():
    rng, found, named, inside, faults, wrong = np.random.default_rng(5), [], 0, 0, 0, 0
    for k in range(250):
        spreads, rotor = build(rng, QUAD), 1 + k % 4
        extra = rng.exponential(wf.LOSS_MEAN)
        theta = extra / (1.0 + extra)
        result = wf.assess(damaged(rng, QUAD, spreads, rotor, theta), [drawn(rng, QUAD, *spreads) for _ in range(3)], QUAD)
        if theta > 0.25:
            found.append(result.verdict != "healthy")
        if result.verdict == "healthy":
            continue
        low, high = result.interval[rotor - 1]
        inside += low <= theta <= high
        named += 1
        if result.verdict == "fault":
            faults += 1
            wrong += result.rotors != (rotor,)
    assert np.mean(found) > 0.9
    assert 0.90 <= inside / named <= 0.995
    assert faults > 30 and wrong / faults < 0.03


def test_healthy_interval_says_what_could_hide():
    rng, inside = np.random.default_rng(8), 0
    for _ in range(150):
        spreads = build(rng, QUAD)
        theta = rng.uniform(0.02, 0.12)
        result = wf.assess(damaged(rng, QUAD, spreads, 2, theta), [drawn(rng, QUAD, *spreads) for _ in range(2)], QUAD)
        low, high = result.interval[1]
        inside += result.verdict != "healthy" or low <= theta <= high
    assert inside >= 0.9 * 150


def test_a_weight_is_never_sure_to_be_a_rotor():
    rng, verdicts = np.random.default_rng(2), []
    for _ in range(120):
        spreads, angle = build(rng, QUAD), rng.uniform(0.0, 2.0 * np.pi)
        shift = 0.12 * np.array([np.cos(angle), np.sin(angle)])
        weighted = drawn(rng, QUAD, *spreads, shift=shift)
        verdicts.append(wf.assess(weighted, [drawn(rng, QUAD, *spreads) for _ in range(3)], QUAD).verdict)
    assert verdicts.count("ambiguous") >= 0.9 * len(verdicts)
    assert verdicts.count("fault") <= 0.03 * len(verdicts)


def commanded(vehicle, theta):
    """(n,) commands with which the rotors, of losses theta (n,), make what healthy ones make of 1: f = 1 + B+ B diag(theta) f."""
    B = vehicle.effectiveness()
    return np.linalg.solve(np.eye(len(theta)) - np.linalg.pinv(B) @ B @ np.diag(theta), np.ones(len(theta)))


@pytest.mark.parametrize("vehicle", [QUAD, HEXA], ids=["quad", "hexa"])
@pytest.mark.parametrize("losses", [{2: 0.4}, {1: 0.3, 4: 0.2}], ids=["one", "two"])
def test_the_size_is_what_the_mixer_makes_up_for(vehicle, losses):
    """Of a hexa the others help: a loss of 0.4 asks rotor 2 for 0.36 more than its share, not for 0.67."""
    B, n = vehicle.effectiveness(), len(vehicle.rotors)
    theta = np.zeros(n)
    theta[[r - 1 for r in losses]] = list(losses.values())
    f = commanded(vehicle, theta)
    shift = np.array([*(B[:3] @ f / f.sum() - B[:3].sum(axis=1) / n), np.log(f.mean())])
    found = wf._weigh(shift, np.eye(4) * 1e-5, 1e6, np.ones(n), vehicle)
    reported = next(h for h in found if h.rotors == tuple(losses))
    assert reported.mass @ reported.theta == pytest.approx(list(losses.values()), abs=0.02)


@pytest.mark.thorough
def test_batteries_put_in_otherwise_accuse_nobody():
    """Healthy flights whose centre of mass lies elsewhere each time, by up to four times what real ones show."""
    rng, faults, count = np.random.default_rng(12), 0, 0
    for size in (0.01, 0.02, 0.04, 0.06):
        between = np.diag(np.square([size, size, 0.022, 0.05]))
        for flights in (2, 3, 6):
            for _ in range(35):
                one, *baseline = (drawn(rng, QUAD, between, np.eye(3) * 0.008**2) for _ in range(flights + 1))
                faults += wf.assess(one, baseline, QUAD).verdict == "fault"
                count += 1
    assert faults <= 0.01 * count


@pytest.mark.thorough
def test_certainty_is_how_often_it_is_right():
    """Flights drawn from the model with 2, 3 and 6 healthy ones: of what is said with a probability, that share is true."""
    rng, said, true = np.random.default_rng(21), [], []
    for k in range(500):
        spreads, share, yaw, shift = build(rng, QUAD), np.ones(4), 0.0, np.zeros(2)
        damaged, weight = (), 0.0
        kind = rng.choice(3, p=[0.5, 0.5 * (wf.SINGLE + wf.PAIR), 0.5 * wf.CENTRE])
        if kind == 1:
            pair = rng.random() < wf.PAIR / (wf.SINGLE + wf.PAIR)
            damaged = tuple(rng.choice(4, 2 if pair else 1, replace=False))
            extra = np.minimum(rng.exponential(wf.LOSS_MEAN, len(damaged)), 5.0)
            share[list(damaged)] += extra
            yaw = wf.RHO_SD * rng.standard_normal() * extra.max() / share.sum()
        elif kind == 2:
            shift = wf.SHIFT_SD * rng.standard_normal(2)
            yaw = wf.CENTRE_RHO_SD * np.hypot(*shift) * rng.standard_normal()
            weight = wf.WEIGHT_SD * np.hypot(*shift) * rng.standard_normal()
        flight = drawn(rng, QUAD, *spreads, share=share, extra_yaw=yaw, shift=shift)
        flight = flight._replace(share=tuple(np.exp(weight) * np.array(flight.share)))
        baseline = [drawn(rng, QUAD, *spreads) for _ in range((2, 3, 6)[k % 3])]
        found = wf._weigh(
            *wf._difference(flight, baseline), np.mean([np.array(one.share) / np.mean(one.share) for one in baseline], axis=0), QUAD
        )
        total = sum(h.weight for h in found)
        for rotor in range(4):
            said.append(sum(h.weight for h in found if rotor + 1 in h.rotors) / total)
            true.append(rotor in damaged)
    said, true = np.array(said), np.array(true)
    for low, high in ((0.0, 0.05), (0.05, 0.3), (0.3, 0.7), (0.7, 0.95), (0.95, 1.0)):
        inside = (said >= low) & (said <= high)
        mean = said[inside].mean()
        assert inside.sum() > 20
        assert abs(true[inside].mean() - mean) < 0.01 + 4.0 * np.sqrt(mean * (1.0 - mean) / inside.sum()), (low, high)


def test_yaw_and_thrust_speak_for_a_rotor_against_a_shifted_mass():
    """The same roll and pitch: with a rotor's yaw and thrust it is the rotor, with neither the mass."""
    B = QUAD.effectiveness()[:3]
    f = np.array([1.4, 1.0, 1.0, 1.0])
    moved = B @ f / f.sum()
    scale = np.diag(np.square([0.014, 0.014, 0.028, 0.06]))

    def rotor(yaw, thrust):
        found = wf._weigh(np.array([*moved[:2], yaw * moved[2], thrust]), scale, 9.0, np.ones(4), QUAD)
        centre = next(h.weight for h in found if h.kind == "centre_of_mass")
        return sum(h.weight for h in found if 1 in h.rotors) / centre

    more = np.log(f.mean())
    assert rotor(1.0, more) > 20.0 > 1.0 > rotor(0.0, 0.0)
    assert rotor(1.0, more) > 3.0 * rotor(1.0, -0.05)


def test_a_balance_that_moves_in_flight_is_ambiguous():
    rng = np.random.default_rng(3)
    spreads = [np.eye(3) * 1e-6] * 2
    moved = drawn(rng, QUAD, *spreads)
    moved = wf.Features.from_dict(moved.to_dict() | {"change": [0.0, 0.1, -0.1]})
    result = wf.assess(moved, [drawn(rng, QUAD, *spreads)], QUAD)
    assert result.verdict == "ambiguous" and "changed in flight" in result.reason


def test_no_odds_are_claimed_that_few_flights_cannot_show():
    """However far off a flight is: its p-value ends where the verdicts' own rates do, and the sentence says what it rests on."""
    rng = np.random.default_rng(9)
    spreads = [np.eye(3) * 1e-6] * 2
    bent = drawn(rng, QUAD, *spreads, share=[1.6, 1.0, 1.0, 1.0])
    for count, words in ((1, "one flight cannot show that"), (3, "3 flights are too few to show that"), (12, "12 flights were")):
        baseline = [drawn(rng, QUAD, *spreads) for _ in range(count)]
        result = wf.assess(bent, baseline, QUAD)
        assert result.verdict == "fault" and result.p_value == wf.FALSE_FAULT
        assert "fewer than 1 in 100 healthy flights would differ by this much if they vary as assumed" in result.reason
        assert words in result.reason
        assert wf.rarity(bent, baseline) < 1e-3 * wf.FALSE_FAULT  # which orders flights, and is shown to nobody


def test_a_rotor_at_its_limit_cannot_be_reported_from_a_weight():
    rng = np.random.default_rng(4)
    spreads = [np.eye(3) * 1e-6] * 2
    flight = drawn(rng, QUAD, *spreads, share=[1.6, 1.0, 1.0, 1.0])
    baseline = [drawn(rng, QUAD, *spreads) for _ in range(2)]
    assert wf.assess(flight, baseline, QUAD).verdict == "fault"
    limited = wf.Features.from_dict(flight.to_dict() | {"limited": [0.5, 0.0, 0.0, 0.0]})
    result = wf.assess(limited, baseline, QUAD)
    assert result.verdict == "ambiguous" and "rotor 1 was at its limit 50 %" in result.reason


def test_opposite_rotors_of_a_hexa_balance_each_other():
    rng = np.random.default_rng(6)
    spreads = [np.eye(3) * 1e-6] * 2
    flight = drawn(rng, HEXA, *spreads, share=[1.3, 1.3, 1.0, 1.0, 1.0, 1.0])
    result = wf.assess(flight, [drawn(rng, HEXA, *spreads)], HEXA)
    assert result.verdict == "healthy"  # as any equal loss: battery and payload do the same
    assert result.common == pytest.approx(np.log(1.1), abs=0.01)


def test_without_what_is_needed():
    rng = np.random.default_rng(7)
    spreads = [np.eye(3) * 1e-6] * 2
    flight = drawn(rng, QUAD, *spreads)
    nothing = wf._no_hover("ground", 4)
    assert wf.assess(nothing, [flight], QUAD).verdict == "inconclusive"
    assert wf.assess(flight, [nothing], QUAD).verdict == "inconclusive"
    assert wf.assess(flight, [nothing, flight], QUAD).flights == 1
    with pytest.raises(ConfigError, match="healthy flights"):
        wf.assess(flight, [], QUAD)
    with pytest.raises(ConfigError, match="number of rotors"):
        wf.assess(flight, [drawn(rng, HEXA, *spreads)], QUAD)


def test_damaged_tables_are_refused():
    table = wf._no_hover("x", 4).to_dict()
    assert wf.Features.from_dict(table).to_dict() == table
    for change in ({"share": [0.1, float("nan"), 0.1, 0.1]}, {"wrench": [1.0]}, {"force": "north"}, {"seconds": None}):
        with pytest.raises(ConfigError, match="run calibrate again"):
            wf.Features.from_dict(table | change)
    with pytest.raises(ConfigError):
        wf.Features.from_dict({"name": "empty"})


# Flights made sample by sample


def hover(loss=0.0, rotor=1, slope=1.8, gust=0.02, seed=0, duration=80.0):
    """A quad at 10 Hz that wind pushes and pitches (slope per g); one rotor's loss makes its command rise."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 0.1)
    force = np.cumsum(rng.standard_normal((len(time), 2)), axis=0) * gust * 0.1 + gust * rng.standard_normal(2)
    B = QUAD.effectiveness()
    w = np.stack([-slope * force[:, 1], slope * force[:, 0], 0.01 * rng.standard_normal(len(time))], axis=1)
    share = 0.4 * (1.0 + w @ B[:3] + 0.02 * rng.standard_normal((len(time), 4)))
    share = np.maximum(share, 0.02)
    share[:, rotor - 1] /= 1.0 - loss
    share[(time < 4.0) | (time > duration - 4.0)] = 0.0
    curve = QUAD.curve
    a = (np.sqrt((1 - curve.expo) ** 2 + 4 * curve.expo * share) - (1 - curve.expo)) / (2 * curve.expo)
    pwm = curve.u_min + a * (curve.u_max - curve.u_min)
    accel = np.column_stack([force, -np.ones(len(time))]) * wf.G0
    signals = {"motors": Signal(time, pwm, ("r1", "r2", "r3", "r4"), "us"), "accel": Signal(time, accel, ("x", "y", "z"), "m/s^2")}
    return Flight("made", "ArduPilot", signals, duration, name=f"hover {seed}")


def of(flight):
    return wf.features(flight, QUAD, ((4.0, flight.duration - 4.0),))


def test_wind_is_not_damage_and_damage_is_seen_through_wind():
    baseline = [of(hover(seed=k)) for k in range(3)]
    assert baseline[0].slope == pytest.approx((-1.8, 1.8), abs=0.5)
    windy = of(hover(seed=7, gust=0.06))
    assert np.abs(windy.wrench[:2]).max() > 0.05  # wind shifts the raw balance as much as a quarter of a rotor's thrust
    assert wf.assess(windy, baseline, QUAD).verdict == "healthy"
    result = wf.assess(of(hover(0.3, rotor=3, seed=8, gust=0.06)), baseline, QUAD)
    assert result.verdict == "fault" and result.rotors == (3,)
    assert result.interval[2][0] < 0.3 < result.interval[2][1]
    assert result.loss[2] == pytest.approx(0.3, abs=0.08)


def test_nothing_to_see_is_not_usable():
    short = hover(duration=12.0)
    assert not wf.features(short, QUAD, ((4.0, 8.0),)).usable
    assert not wf.features(short, QUAD, ()).usable
    assert not wf.features(short, QUAD, ((0.0, 1e15),)).seconds > 12.0  # damaged clocks cost no memory
    assert not wf.features(Flight("made", "ArduPilot", {}, 10.0), QUAD, ((0.0, 10.0),)).usable


# Real flights: a cut propeller against good ones. The answers in docs/whole-flight.md are those of `python
# tests/test_whole_flight.py`.


def verdicts(folder):
    """file name -> (WholeFlight, build) for every flight in the folder against the other healthy ones of its build."""
    flights = {}
    for path in sorted((SHARED / folder).glob("*.xz")):
        flight = logs.read(path)
        vehicle = airframes.identify(flight)
        group = path.name.split("__")[1][:2] if "__" in path.name else "rrc"
        flights[path.name] = (wf.features(flight, vehicle, airborne(flight)), vehicle, group)
    found = {}
    for name, (features, vehicle, group) in flights.items():
        good = [f for other, (f, _, g) in flights.items() if g == group and other != name and _good(other)]
        found[name] = (wf.assess(features, good, vehicle), group)
    return found


def _good(name):
    return name.startswith(("good_prop", "normal_flight"))


@shared
def test_cut_tips_of_a_real_quad():
    for name, (result, _) in verdicts("ardupilot-real-rrc").items():
        if name.startswith(("20_mm", "25_mm")):
            assert result.verdict == "fault" and result.rotors == (1,), name
        elif _good(name):
            assert result.verdict == "healthy", name


@shared
def test_no_two_flights_of_a_real_quad_accuse_a_wrong_rotor():
    """Baselines of two flights whose tips are whole or cut by so little that healthy flights differ as much."""
    flights = {p.name: logs.read(p) for p in sorted((SHARED / "ardupilot-real-rrc").glob("*.xz"))}
    vehicle = airframes.identify(next(iter(flights.values())))
    found = {name: wf.features(flight, vehicle, airborne(flight)) for name, flight in flights.items()}
    for baseline in itertools.combinations([n for n in found if not n.startswith("2")], 2):
        for name in set(found) - set(baseline):
            result = wf.assess(found[name], [found[n] for n in baseline], vehicle)
            assert result.verdict != "fault" or result.rotors == (1,), (name, baseline)
            if name.startswith("25_mm"):
                assert result.verdict in ("fault", "ambiguous") and 1 in result.rotors, (name, baseline)


@shared
def test_crazyflie_cuts_weights_and_normal_flights():
    from scipy.stats import spearmanr

    found, cuts, losses = verdicts("crazypad"), [], []
    for name, (result, group) in found.items():
        if _good(name):
            assert result.verdict == "healthy", name
        elif "weight" in name:
            assert result.verdict == "ambiguous", name
        elif group == "E8":
            left = float(name.split("mm__")[0].rsplit("_", 1)[1])  # diameter left, of 47 mm
            cuts.append(47.0 - left)
            losses.append(result.loss[2])
            if left <= 44.0:
                assert result.verdict in ("fault", "ambiguous"), name
                assert result.rotors == (3,), name
            if left <= 41.0:
                assert result.verdict == "fault", name
    assert spearmanr(cuts, losses).statistic >= 0.9


if __name__ == "__main__":
    for folder in ("ardupilot-real-rrc", "crazypad"):
        for name, (r, group) in sorted(verdicts(folder).items(), key=lambda item: (item[1][1], item[0])):
            likely = [c for c in r.causes if c.probability > 0.05]
            causes = ", ".join(f"{'+'.join(map(str, c.rotors)) or 'centre'} {c.probability:.2f}" for c in likely)
            loss = " ".join(f"{v:.2f}" for v in r.loss)
            short = name.split(".bin")[0].split(".usd")[0]
            print(f"| {group} | {short} | {r.verdict} | {r.p_value:.2g} | {loss} | {causes} |")
