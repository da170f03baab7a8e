"""Do flights that an estimator's beliefs save in our simulator also stay up in somebody else's? RotorPy (University of Pennsylvania).

python benchmarks/second_simulator.py plans/survival.toml --flights 50 -o second.json       # goes on where it was stopped

Wind, sensors, autopilot, allocation, battery, log and diagnosis are ours in both; how forces and moments move the vehicle is theirs: their
equations of motion (`rotorpy.vehicles.multirotor.Multirotor`). RotorPy steps vehicles of four rotors only, but its equations take any
number: they are stepped here, by the classical Runge-Kutta rule. Not in their model are the angular momentum of the rotors,
rotational gusts, and the ground: below HEIGHT the vehicle moves by our equations. It knows no losses either: a rotor with the loss theta
gets the speed that leaves 1 - theta of its thrust, which takes its drag away as well; ours keeps that. Gravity is 9.81 m/s^2.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import RotorwatchError
from rotorwatch_lab.campaign import closed_loop, plan, summary
from rotorwatch_lab.simulation import dynamics, reconfigured, rigid
from rotorwatch_lab.simulation.scenario import Scenario

RATE_HZ = 200.0
HEIGHT = 0.5  # m
FULL = 1000.0  # rad/s: any number does, RotorPy's coefficients go with it
FLIP = np.array([1.0, -1.0, -1.0])  # ours: north, east, down; forward, right, down. Theirs: north, west, up; forward, left, up
DRIVERS = (closed_loop.NOBODY, closed_loop.TRUTH, "default")
NUMBERS = ("mass", "J", "x", "y", "z", "thrust_max", "spin", "drag_ratio", "lag", "k_d", "k_z", "drag")  # of a craft


class Vehicle:
    """A craft of ours as RotorPy's vehicle; its `NUMBERS` one after the other."""

    def __init__(self, mass, J, x, y, z, thrust_max, spin, drag_ratio, lag, k_d, k_z, drag):
        from rotorpy.vehicles.hummingbird_params import quad_params
        from rotorpy.vehicles.multirotor import Multirotor

        most, n = float(thrust_max.max()), len(x)
        numbers = {"mass": float(mass), "tau_m": float(lag), "k_h": 0.0, "k_flap": 0.0, "motor_noise_std": 0.0}
        for a, i in zip("xyz", range(3), strict=True):
            numbers |= {f"I{a}{b}": float(J[i, j] * FLIP[i] * FLIP[j]) for b, j in zip("xyz", range(3)) if j >= i}
            numbers[f"c_D{a}"] = float(drag[i])
        numbers |= {"k_eta": most / FULL**2, "k_m": float(drag_ratio) * most / FULL**2}
        numbers |= {"k_d": float(k_d) / FULL, "k_z": float(k_z) / FULL}
        self.model = Multirotor({**quad_params, **numbers})
        # It can be built with four rotors only; its equations of motion ask for no more than these.
        self.model.num_rotors, self.model.rotor_dir = n, -spin
        self.model.rotor_pos = {k: FLIP * [x[k], y[k], z] for k in range(n)}
        self.model.extract_geometry()
        self.share = np.sqrt(thrust_max / most)  # a weaker rotor is a slower one

    def step(self, p, v, q, omega, w, commanded, wind, theta, dt: float) -> np.ndarray:
        """(16,) position, velocity, quaternion, body rates and mean specific force after dt [s].

        w, commanded (n,): shares of full speed that the rotors have and are driven to; theta (n,): losses.
        """
        pace = FULL * self.share * np.sqrt(1.0 - theta)
        start = np.concatenate([FLIP * p, FLIP * v, FLIP * q[1:], q[:1], FLIP * omega, FLIP * wind, pace * w])
        end = start + dt / 6.0 * self._slope(start, pace * commanded, dt)
        q_new = np.r_[end[9], FLIP * end[6:9]]
        q_new = q_new / np.linalg.norm(q_new)
        v_new = FLIP * end[3:6]
        middle = q + q_new
        felt = (v_new - v) / dt - [0.0, 0.0, self.model.g]
        return np.concatenate([FLIP * end[:3], v_new, q_new, FLIP * end[10:13], _to_body(middle, felt)])

    def _slope(self, s, commanded, dt: float) -> np.ndarray:
        """Six times the mean slope over a step: the classical Runge-Kutta rule."""
        one = self.model._s_dot_fn(0.0, s, commanded)
        two = self.model._s_dot_fn(0.0, s + 0.5 * dt * one, commanded)
        three = self.model._s_dot_fn(0.0, s + 0.5 * dt * two, commanded)
        return one + 2.0 * (two + three) + self.model._s_dot_fn(0.0, s + dt * three, commanded)


def _to_body(q, a):
    """The world's vector a (3,) in body axes; q (4,) body to world, of any length."""
    q = q / np.linalg.norm(q)
    u = -q[1:]
    return a + 2.0 * np.cross(u, np.cross(u, a) + q[0] * a)


class Steps:
    """RotorPy's answers, each worked out once: flights that are flown again are the same up to a new belief."""

    def __init__(self):
        self.known: dict[bytes, tuple[Vehicle, dict[bytes, np.ndarray]]] = {}
        self.made = 0  # steps worked out

    def __call__(self, dt: float, craft: Sequence, state: Sequence) -> np.ndarray:
        """(B, 16) of B flights: numbers of their crafts and states of the step, flights first."""
        craft, state = ([np.asarray(a, float) for a in part] for part in (craft, state))
        return np.stack([self._one(dt, [a[k] for a in craft], [a[k] for a in state]) for k in range(len(state[0]))])

    def _one(self, dt: float, craft: list, state: list) -> np.ndarray:
        if state[0][2] > -HEIGHT:  # ours is taken here
            return np.concatenate([*state[:4], np.zeros(3)])
        who, now = (b"".join(a.tobytes() for a in part) for part in (craft, state))
        if who not in self.known:
            self.known[who] = Vehicle(*craft), {}
        vehicle, steps = self.known[who]
        if now not in steps:
            steps[now] = vehicle.step(*state, dt=dt)
            self.made += 1
        return steps[now]


STEPS = Steps()


class Elsewhere(reconfigured.Reconfigured):
    """The same aircraft, moved by RotorPy."""

    def __init__(self, B: np.ndarray, by: str = "estimate"):
        super().__init__(B, by)
        self.made = None  # Python is called: no native code

    def moved(self, plan, body, w, share, lag, air, theta, dt) -> tuple:
        """Theirs above HEIGHT, ours below."""
        jax = load_jax()
        jnp = jax.numpy
        near, w_new, force = dynamics.step(plan.craft, body, w, share, lag, air, theta, dt)

        def slopes(craft, state):
            # Called for one flight while shapes are worked out, else for all of a batch.
            many = np.ndim(state[0]) > 1
            batch = (craft, state) if many else [[np.asarray(a)[None] for a in part] for part in (craft, state)]
            found = STEPS(dt, *batch)
            return found if many else found[0]

        craft = [getattr(plan.craft, name) for name in NUMBERS]
        state = [*body, w, share, air.wind, theta]
        out = jax.pure_callback(slopes, jax.ShapeDtypeStruct((16,), body.p.dtype), craft, state, vmap_method="broadcast_all")
        high = body.p[2] < -HEIGHT
        far = rigid.Body(out[:3], out[3:6], out[6:10], out[10:13])
        body = jax.tree.map(lambda a, b: jnp.where(high, a, b), far, near)
        return body, w_new, jnp.where(high, out[13:], force)


class Slower:
    """A plan's flights at RATE_HZ, with one of two simulators."""

    def __init__(self, whole_plan: plan.Plan):
        self.whole_plan = whole_plan

    def flight(self, k: int) -> Scenario:
        """Scenario of flight k."""
        return replace(self.whole_plan.flight(k), rate_hz=RATE_HZ)


def faulty(whole_plan: plan.Plan, most: int) -> list[int]:
    """The first flights of the plan in which something breaks, equally many of each kind of flight."""
    cells = len(whole_plan.cells)
    each = [k for c in range(cells) for k in _first(whole_plan, c, -(-most // cells))]
    return sorted(each)[:most]


def _first(whole_plan: plan.Plan, cell: int, most: int) -> list[int]:
    found, k = [], cell
    while len(found) < most:
        found += [k] if whole_plan.flight(k).faults else []
        k += len(whole_plan.cells)
    return found


def fly(whole_plan: plan.Plan, flights: Sequence[int], out: Path, drivers: Sequence[str]) -> list[dict]:
    """A row for each flight, driver and simulator; parts that `out` holds already are not flown again."""
    rows = json.loads(out.read_text())["rows"] if out.exists() else []
    cells = len(whole_plan.cells)
    for c in range(cells):
        here = [k for k in flights if k % cells == c]
        for name, aircraft in (("ours", reconfigured.Reconfigured), ("rotorpy", Elsewhere)):
            for driver in drivers:
                done = {r["flight"] for r in rows if (r["simulator"], r["driver"]) == (name, driver)}
                if not here or set(here) <= done:
                    continue
                for outcome in closed_loop.fly(Slower(whole_plan), here, driver, aircraft=aircraft):
                    frame = whole_plan.flight(outcome["flight"]).airframe["frame"]
                    rows.append({"simulator": name, "driver": driver, "frame": frame, **outcome})
                out.write_text(json.dumps({"plan": whole_plan.name, "rows": rows}, indent=1))
                print(f"cell {c + 1} of {cells}, {name}, {driver}; {STEPS.made} steps", file=sys.stderr, flush=True)
        STEPS.known.clear()
    return rows


def markdown(rows: Sequence[dict], drivers: Sequence[str]) -> str:
    """The two simulators side by side, driver by driver."""
    text = [
        "| driver | flights | survive in ours | in RotorPy | in both, in neither | only in ours, only in RotorPy "
        "| largest tilt, degrees: ours, RotorPy, apart | largest distance from the track, m: ours, RotorPy, apart |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for driver in drivers:
        ours, theirs = ({r["flight"]: r for r in rows if (r["simulator"], r["driver"]) == (name, driver)} for name in ("ours", "rotorpy"))
        numbers = sorted(set(ours) & set(theirs))
        up = np.array([(ours[k]["survived"], theirs[k]["survived"]) for k in numbers], bool).reshape(-1, 2)
        both = [k for k, row in zip(numbers, up, strict=True) if row.all()]
        counts = [(up[:, 0] & up[:, 1]).sum(), (~up[:, 0] & ~up[:, 1]).sum(), (up[:, 0] & ~up[:, 1]).sum()]
        counts += [(~up[:, 0] & up[:, 1]).sum()]
        cells = [driver, str(len(numbers)), _share(up[:, 0]), _share(up[:, 1])]
        cells += [f"{counts[0]}, {counts[1]}", f"{counts[2]}, {counts[3]}"]
        for name in ("tilt_deg", "off_m"):
            pair = np.array([(ours[k][name], theirs[k][name]) for k in both]).reshape(-1, 2)
            if len(pair):
                middle = (*np.median(pair, axis=0), np.median(np.abs(pair[:, 0] - pair[:, 1])))
                cells.append(", ".join(f"{v:.2f}" for v in middle))
            else:
                cells.append("-")
        text.append(f"| {' | '.join(cells)} |")
    return "\n".join(text)


def _share(which: np.ndarray) -> str:
    found = summary.share(which)
    if not found:
        return "-"
    return f"{which.sum()} ({100 * found['low']:.0f} to {100 * found['high']:.0f} %)"


def main() -> None:
    """Fly, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plan", help="plan (TOML) of flights that end in the air")
    parser.add_argument("--flights", type=int, default=50, help="faulty flights (default: 50)")
    parser.add_argument("--drivers", default=",".join(DRIVERS), help="default: nobody,truth,default")
    parser.add_argument("-o", "--out", type=Path, required=True, help="results (JSON)")
    options = parser.parse_args()
    try:
        import rotorpy  # noqa: F401
    except ImportError:
        sys.exit("RotorPy is not installed: install it with `pip install rotorpy` and run this again.")
    try:
        whole_plan = plan.read(options.plan)
        drivers = options.drivers.split(",")
        rows = fly(whole_plan, faulty(whole_plan, options.flights), options.out, drivers)
    except RotorwatchError as error:
        sys.exit(str(error))
    print(markdown(rows, drivers))


if __name__ == "__main__":
    main()
