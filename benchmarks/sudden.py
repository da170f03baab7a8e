"""How soon a rotor that is gone is told, with and without the fast comparison, and how often it errs.

    python benchmarks/sudden.py [--flights 12] [--healthy 8] [--seed 0] [LOG...]

Simulated flights of four airframes, 400 Hz, arms of 17 to 45 cm, rotor lags of 20 to 50 ms, winds to 8 m/s, in hover, squares, eights,
climbs and aggressive flight; one rotor loses 60, 80 or 100 % at once. Healthy ones have pushes and twists of 10 to 600 ms, aggressive
flight and wash, and land. Logs are healthy ones. The delay without is that of the estimator's announcement in the same flight.
"""

from __future__ import annotations

import argparse

import numpy as np

import rotorwatch as rw
from rotorwatch import airframes
from rotorwatch.engine.driver import fly
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import JUDGE, READY_S
from rotorwatch_lab.experiments import tools
from rotorwatch_lab.simulation import scenario, simulate

FRAMES = {"quad-x": 4, "hexa-x": 6, "octa-x": 8, "y6": 6}
LOSSES = 0.6, 0.8, 1.0
KINDS = "hover", "square", "figure-eight", "climb", "aggressive"
OUTSIDE = "twist", "push", "wash", "aggressive"


def drawn(frame: str, rng: np.random.Generator, number: int, seconds: float, land: bool) -> dict:
    """A flight without a fault."""
    return {
        "name": frame, "duration_s": seconds, "seed": int(rng.integers(10**6)),
        "autopilot": "px4" if frame != "y6" and number % 2 else "ardupilot", "logging": {"profile": "full"},
        "airframe": {
            "frame": frame, "arm_m": float(np.exp(rng.uniform(np.log(0.17), np.log(0.45)))), "mass_kg": 2.0, "rotor_spread": 0.03,
            "lag_s": float(rng.uniform(0.02, 0.05)),
        },
        "trajectory": {"kind": str(rng.choice(KINDS)), "altitude_m": 10.0, "land": land},
        "wind": {"speed_m_s": float(rng.uniform(0.0, 8.0)), "from_deg": float(rng.uniform(0.0, 360.0))},
    }  # fmt: skip


def disturbed(table: dict, rotors: int, rng: np.random.Generator, what: str) -> dict:
    """The same flight, disturbed."""
    if what in ("twist", "push"):
        onset, angle = float(rng.uniform(20.0, 40.0)), rng.uniform(0.0, 2.0 * np.pi)
        size = rng.uniform(0.3, 1.5) * 10.0 / table["airframe"]["arm_m"] * 4 / rotors  # of about one rotor's torque
        outside = {
            "push_m_s2": float(rng.uniform(0.0, 4.0)), "push_to_deg": float(rng.uniform(0.0, 360.0)), "push_onset_s": onset,
            "push_end_s": onset + float(np.exp(rng.uniform(np.log(0.01), np.log(0.6)))),
            "push_down_m_s2": float(rng.choice([0.0, 3.0, -3.0])),
        }  # fmt: skip
        turned = {"twist_rad_s2": [float(size * np.cos(angle)), float(size * np.sin(angle)), float(rng.uniform(-2.0, 2.0))]}
        return {**table, "outside": {**outside, **(turned if what == "twist" else {"push_above_m": float(rng.uniform(-0.1, 0.3))})}}
    if what == "wash":
        return {**table, "airframe": {**table["airframe"], "wash": 0.15}, "trajectory": {**table["trajectory"], "kind": "climb"}}
    return {**table, "trajectory": {**table["trajectory"], "kind": "aggressive", "speed_m_s": 8.0}}


def judged(flight):
    """(estimator's ticks and outputs, records of losses) of a flight."""
    vehicle = airframes.identify(flight)
    found = fly(flight, vehicle, airborne(flight), READY_S)
    assert found is not None
    return found[1], found[0].losses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=12, help="with a loss, of each airframe")
    parser.add_argument("--healthy", type=int, default=8, help="of each airframe")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("logs", nargs="*")
    options = parser.parse_args()
    rng, hours, alarms, withdrawn = np.random.default_rng(options.seed), 0.0, 0, 0
    print("| airframe | flights | median, ms | worst, ms | not told | without: median, ms | worst, ms |\n|---|---|---|---|---|---|---|")
    for frame, rotors in FRAMES.items():
        with_it, without = [], []
        for k in range(options.flights):
            onset, rotor = float(rng.uniform(20.0, 30.0)), int(rng.integers(1, rotors + 1))
            table = drawn(frame, rng, k, onset + 2.5, False)
            fault = {"kind": "loss", "rotor": rotor, "onset_s": onset, "strength": float(rng.choice(LOSSES))}
            done, record = judged(simulate(scenario.from_table({**table, "faults": [fault]})).flight)
            found = next((e for e in record.events() if rotor in e.rotors), None)
            with_it.append(np.inf if found is None else found.detected_s - onset)
            told = done.table.time[np.asarray(done.out.announced) & (done.table.time > onset)]
            without.append(told[0] - onset if len(told) else np.inf)
            withdrawn += int(record.state["refuted"][0])
        cells = [f"{1e3 * f(x):.0f}" for x in (with_it, without) for f in (np.median, np.max)]
        print(
            f"| {frame} | {options.flights} | {cells[0]} | {cells[1]} | {int(np.isinf(with_it).sum())} | {cells[2]} | {cells[3]} |",
            flush=True,
        )
    healthy = (
        simulate(scenario.from_table(disturbed(drawn(frame, rng, k, 60.0, True), rotors, rng, OUTSIDE[k % len(OUTSIDE)]))).flight
        for frame, rotors in FRAMES.items()
        for k in range(options.healthy)
    )
    for flights in (healthy, map(rw.read, options.logs)):
        for flight in flights:
            done, record = judged(flight)
            hours += float((done.table.mode == JUDGE).sum() * done.table.dt) / 3600.0
            alarms += int(record.state["suspicions"][0])
    rate = tools.rate(alarms, hours)
    print(f"withdrawn in flights with a loss: {withdrawn}; alarms in {hours:.2f} h of healthy flights: {alarms}; per hour: {rate}")


if __name__ == "__main__":
    main()
