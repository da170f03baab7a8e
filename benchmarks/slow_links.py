"""What can be seen at 1, 2, 4, 10 and 50 outputs a second: the same simulated flights, thinned as a telemetry radio thins them.

    python benchmarks/slow_links.py --flights 30 --healthy 40 -o /tmp/slow_links.json
    python benchmarks/slow_links.py --table /tmp/slow_links.json

Quads and hexas of any size, calm to 7 m/s of wind, hovering, turning, climbing and flying squares and eights at 1 to 3 m/s; one rotor loses
20, 40 or 60 % of its thrust at once and for good. Outputs come at the rate, attitude rates, accelerations and attitude at twice the rate
(4 a second at least), the controller's outputs not at all. Each thinned flight is assessed by `diagnose`; beside it stands the bound on any
diagnoser that sees the same ticks, knows the rotor and raises one false alarm in ten hours (rotorwatch_lab/experiments/limits.py).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from logging_rate import thinned

from rotorwatch import airframes
from rotorwatch.diagnose import diagnose
from rotorwatch.engine.bindings import program
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import ASSESS, GROUND, LAG_S, READY_S, tick_length
from rotorwatch_lab.campaign import methods, summary
from rotorwatch_lab.experiments import limits
from rotorwatch_lab.simulation import logbook, scenario
from rotorwatch_lab.simulation import plan as flight_plan
from rotorwatch_lab.simulation.loop import fly_each
from rotorwatch_lab.simulation.multirotor import MULTIROTOR

RATES_HZ, LOSSES, FRAMES = (1.0, 2.0, 4.0, 10.0, 50.0), (0.2, 0.4, 0.6), ("quad-x", "hexa-x")
ONSET_S, DURATION_S, HEALTHY_S = (60.0, 80.0), 125.0, 240.0
WITHIN_S, FALSE_ALARM_PERIOD_S = 40.0, 36_000.0
SIZE_S = 20.0  # after the onset sizes are compared with their bound
LEAST_MOTION_HZ = 4.0


def drawn(k: int, loss: float | None):
    """The scenario of flight k, the same for every loss."""
    rng = np.random.default_rng([7, k])

    def log_uniform(low, high):
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    frame = FRAMES[k % len(FRAMES)]
    rotor = int(rng.integers(1, 5 if frame == "quad-x" else 7))
    onset = float(rng.uniform(*ONSET_S))
    return scenario.from_table(
        {
            "name": f"slow {k}", "seed": k, "duration_s": HEALTHY_S if loss is None else DURATION_S, "autopilot": "px4",
            "airframe": {
                "frame": frame, "mass_kg": log_uniform(0.8, 8.0), "arm_m": log_uniform(0.15, 0.6), "lag_s": float(rng.uniform(0.02, 0.05)),
                "thrust_to_weight": float(rng.uniform(1.8, 3.0)),
            },
            "trajectory": {
                "kind": str(rng.choice(["hover", "square", "figure-eight", "climb", "yaw"])), "speed_m_s": float(rng.uniform(1.0, 3.0)),
                "land": False,
            },
            "wind": {"speed_m_s": float(rng.uniform(0.0, 7.0)), "from_deg": float(rng.uniform(0.0, 360.0))},
            "sensors": {"vibration": log_uniform(0.2, 4.0)},
            "logging": {"profile": "fast"},
            "faults": [] if loss is None else [{"kind": "loss", "rotor": rotor, "onset_s": onset, "strength": loss}],
        }
    )  # fmt: skip


def over_link(flight, hz: float):
    """The flight as a link of that rate brings it: samples are left out, not averaged."""
    motion = max(2.0 * hz, LEAST_MOTION_HZ)
    return thinned(flight, {name: hz if name == "motors" else motion for name in flight.signals if name != "control"})


def assessed(k: int, made, record, hz: float) -> tuple[dict, dict | None]:
    """The row of one flight at one rate, and what its bound needs."""
    flight = over_link(logbook.flight(made, flight_plan(made), record), hz)
    craft = airframes.identify(flight)
    air = airborne(flight)
    table = observe(flight, craft, air, READY_S)
    fault = made.faults[0] if made.faults else None
    onset = fault["onset_s"] if fault else np.inf
    lost = np.flatnonzero(record.flies < 0.5)
    row = {
        "flight": k, "hz": hz, "frame": made.airframe["frame"], "wind_m_s": made.wind["speed_m_s"],
        "loss": fault["strength"] if fault else 0.0,
        "fell_s": float(record.time[lost[0]]) - onset if lost.size and fault else None,
    }  # fmt: skip
    if table is None:
        return {**row, "healthy_s": 0.0, "false_alarms": 0, "found": False}, None
    began = time.perf_counter()
    answer = diagnose(flight)
    row["wall_s"] = time.perf_counter() - began
    healthy = (table.mode == ASSESS) & (table.time < onset)
    accused = [e for e in answer.events if e.rotors]
    early = [e for e in accused if e.detected_s < onset - table.dt]
    row |= {
        "healthy_s": float(healthy.sum() * table.dt),
        "false_alarms": len(early),
        "sure_false_alarms": sum(not e.alternatives for e in early),
    }
    if fault is None:
        return row, None
    rotor = fault["rotor"]
    later = [e for e in accused if onset - table.dt <= e.detected_s < onset + WITHIN_S]
    ours = [e for e in later if any(rotor in who for who in (e.rotors, *e.alternatives))]
    alone = [e for e in ours if e.rotors == (rotor,) and not e.alternatives]
    # Named without an event: evidence that none explains, or a trend.
    suspect = answer.rotors[rotor - 1].status == "suspect"
    row |= {
        "suspect": suspect,
        "verdict": answer.verdict,
        "found": bool(ours),
        "right": bool(alone) and ours[0] is later[0],
        "wrong": len(later) - len(ours),
    }
    if ours:
        row["delay_s"] = max(0.0, ours[0].detected_s - onset)
    if alone:
        (lower, upper), size = alone[0].interval[0], alone[0].loss[0]
        row |= {"error": size - fault["strength"], "covered": bool(lower <= fault["strength"] <= upper)}
    at = np.clip(np.searchsorted(record.time, table.command_time + LAG_S), 0, len(record.time) - 1)
    return row, {"row": row, "table": table, "B": craft.effectiveness(), "theta": record.theta[at], "rotor": rotor - 1, "onset": onset}


def add_bounds(parts: list[dict]) -> None:
    """Least mean delay and least error of flights with one geometry and tick, into their rows."""
    tables = [program.inputs(p["table"], p["B"]) for p in parts]
    u, y, valid = methods.stacked(tables, len(parts))
    length, n = u.shape[1], parts[0]["B"].shape[1]
    theta = np.stack([np.concatenate([np.nan_to_num(p["theta"]), np.zeros((length - len(p["theta"]), n))]) for p in parts])
    onset = [int(np.searchsorted(p["table"].command_time + LAG_S, p["onset"])) for p in parts]
    found = limits.on_ticks(
        parts[0]["B"], u[..., :-2], y, valid, u[..., -2] > GROUND, theta, np.array([p["rotor"] for p in parts]), np.array(onset),
        parts[0]["table"].dt, batch=True,
    )  # fmt: skip
    for p, known in zip(parts, found.information, strict=True):
        table, row = p["table"], p["row"]
        known = known[: len(table.time)]
        row["bound_delay_s"] = limits.delay(table.time, known, row["loss"], p["onset"], FALSE_ALARM_PERIOD_S)
        usable = np.flatnonzero((table.mode == ASSESS) & ~table.upset & (table.time <= p["onset"] + SIZE_S))
        if usable.size and known[usable[-1]] > 0.0:
            row["bound_sd"] = float(limits.loss_sd(known[usable[-1]]))


def run(flights: int, healthy: int) -> list[dict]:
    """All rows. Each flight is flown once and assessed at every rate."""
    rows, parts = [], defaultdict(list)
    flights_and_losses = [(k, loss) for loss in LOSSES for k in range(flights)] + [(1000 + k, None) for k in range(healthy)]
    for done, (k, loss) in enumerate(flights_and_losses):
        made = drawn(k, loss)
        (record,) = fly_each(MULTIROTOR, [flight_plan(made)], made.duration_s, made.rate_hz, made.record_hz, logbook.needed)
        for hz in RATES_HZ:
            row, part = assessed(k, made, record, hz)
            rows.append(row)
            if part is not None:
                parts[made.airframe["frame"], hz].append(part)
        print(f"{done + 1} of {len(flights_and_losses)} flights", end="\r", file=sys.stderr)
    for group in parts.values():
        # Geometries are those of the frame; sizes differ, and with them nothing that the balance knows of.
        for same in _alike(group):
            add_bounds(same)
    return rows


def _alike(parts: list[dict]) -> list[list[dict]]:
    groups: list[list[dict]] = []
    for p in parts:
        home = next((g for g in groups if np.allclose(g[0]["B"], p["B"])), None)
        if home is None:
            groups.append([p])
        else:
            home.append(p)
    return groups


def show(rows: list[dict]) -> str:
    """The tables of docs/slow-links.md."""

    def shares(flags) -> str:
        found = summary.share(np.array(flags, bool))
        return "-" if found is None else f"{100 * found['value']:.0f} ({100 * found['low']:.0f} to {100 * found['high']:.0f})"

    def of(values, statistic, digits=1) -> str:
        found = summary.boot(np.array(values, float), statistic)
        return "-" if found is None else f"{found['value']:.{digits}f} ({found['low']:.{digits}f} to {found['high']:.{digits}f})"

    def rms(values):
        return 100.0 * float(np.sqrt(np.mean(np.square(values))))

    out = [
        "| outputs, Hz | loss, % | flights | found, % | found or suspected, % | right rotor, alone, % | delay, s | bound, s "
        "| size error, % | bound, % | in interval, % |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for hz in sorted({r["hz"] for r in rows}):
        for loss in LOSSES:
            d = [r for r in rows if r["hz"] == hz and r["loss"] == loss]
            if not d:
                continue
            both = [r for r in d if "delay_s" in r and np.isfinite(r.get("bound_delay_s", np.inf))]
            sized = [r for r in d if "error" in r and "bound_sd" in r]
            out.append(
                f"| {hz:g} | {100 * loss:.0f} | {len(d)} | {shares([r['found'] for r in d])} | "
                f"{shares([r['found'] or r.get('suspect', False) for r in d])} | {shares([r.get('right', False) for r in d])} | "
                f"{of([r['delay_s'] for r in both], np.median)} | {of([r['bound_delay_s'] for r in both], np.median)} | "
                f"{of([r['error'] for r in sized], rms)} | {of([r['bound_sd'] for r in sized], rms)} | "
                f"{shares([r['covered'] for r in sized])} |"
            )
    out += [
        "",
        "| outputs, Hz | tick, s | healthy time assessed, h | false alarms | an hour | without alternatives |",
        "|---|---|---|---|---|---|",
    ]
    for hz in sorted({r["hz"] for r in rows}):
        d = [r for r in rows if r["hz"] == hz]
        hours = sum(r["healthy_s"] for r in d) / 3600.0
        count = sum(r["false_alarms"] for r in d)
        rate = summary.rate(count, hours)
        hourly = "-" if rate is None else f"{rate['value']:.2f} ({rate['low']:.2f} to {rate['high']:.2f})"
        sure = sum(r.get("sure_false_alarms", 0) for r in d)
        out.append(f"| {hz:g} | {tick_length(hz):g} | {hours:.2f} | {count} | {hourly} | {sure} |")
    fell = {loss: sum(r["fell_s"] is not None for r in rows if r["loss"] == loss and r["hz"] == 50.0) for loss in LOSSES}
    out += ["", "Fell: " + ", ".join(f"{n} at {100 * loss:.0f} %" for loss, n in fell.items())]
    return "\n".join(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=30, help="for each loss")
    parser.add_argument("--healthy", type=int, default=40)
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--table", type=Path, help="show the rows of this file instead")
    options = parser.parse_args()
    rows = json.loads(options.table.read_text()) if options.table else run(options.flights, options.healthy)
    if options.out:
        options.out.write_text(json.dumps(rows))
    print(show(rows))


if __name__ == "__main__":
    main()
