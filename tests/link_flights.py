"""Flights over a MAVLink link against their own logs: does `watch` say what `diagnose` does, and how much later?

    python -m tests.link_flights --jobs 2

The recorded flights of a real autopilot in ../shared/flights/ardupilot-sitl, and simulated ones: quad, hexa, octaquad, Y6, in hover and
squares, healthy, with one weak rotor (10 to 100 %) and with a pair. Each is sent over a link at the rates that `watch` asks for, at those
that ground stations ask for unless asked otherwise (4 Hz), and once more with 3 s cut out in its middle.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from tests.link_faults import ALARMS, Faults, arriving, watched
from tests.mavlink_vehicle import Autopilot, messages

from rotorwatch import diagnose, logs
from rotorwatch_lab.simulation import scenario, simulate

RECORDED = Path(__file__).resolve().parents[2] / "shared" / "flights" / "ardupilot-sitl"
TRUTH = {  # shared/flights/truth.csv
    "hexaplus_m6_mul0.00_fwdback_wind": (6,), "hexax_healthy_square_wind": (), "hexax_m2_ramp1.0-0.6_hover": (2,),
    "hexax_m3_mul0.80_square_wind": (3,), "octa_healthy_circle_wind": (), "octa_m7_mul0.70_square_wind": (7,),
    "quadx_healthy_hover": (), "quadx_m1_mul0.90_hover": (1,), "quadx_m2_mul0.80_hover_wind": (2,), "quadx_m3_mul0.85_tlog": (3,),
}  # fmt: skip
FRAMES = {"quad-x": 2, "hexa-x": 13, "octaquad-x": 14, "y6-b": 13}  # with their MAV_TYPE
SIMULATED = tuple(
    (frame, way, weak)
    for frame in FRAMES
    for way in ("hover", "square")
    for weak in ((), ((2, 0.1),), ((1, 0.3),), ((3, 0.6),), ((2, 1.0),), ((1, 0.4), (2, 0.3)))
)
LINKS = {"asked for": (25.0, 50.0, 0.0), "4 Hz": (4.0, 4.0, 0.0), "asked for, 3 s cut": (25.0, 50.0, 3.0)}
SECONDS, ONSET_S = 70.0, 30.0


def flight_of(which):
    """(flight, its MAV_TYPE, rotors that are weak) of a recorded flight's name, or of a row of SIMULATED."""
    if isinstance(which, str):
        flight = logs.read(RECORDED / f"{which}.bin.xz")
        return flight, {4: 2, 6: 13, 8: 14}[len(flight["motors"].values[0])], TRUTH[which]
    frame, way, weak = which
    table = {
        "duration_s": SECONDS, "seed": 7, "airframe": {"frame": frame}, "trajectory": {"kind": way}, "wind": {"speed_m_s": 2.0},
        "logging": {"profile": "full"},
        "faults": [{"kind": "loss", "rotor": r, "onset_s": ONSET_S, "strength": s} for r, s in weak],
    }  # fmt: skip
    return simulate(scenario.from_table(table)).flight, FRAMES[frame], tuple(r for r, _ in weak)


def rotors_of(events) -> set[tuple[int, ...]]:
    """The rotors of each event that accuses any."""
    return {tuple(e["rotors"]) for e in events if e["kind"] in ALARMS}


def compared(which, link: str) -> dict:
    """What `watch` reported over that link, what `diagnose` says of the flight's own log and of the recorded link, and how much later [s of
    the vehicle's time] the link's first event was reported than the recording's was known; None without either."""
    flight, kind, weak = flight_of(which)
    reported, recording, announced_s = sent(flight, kind, link)
    own = diagnose(flight).to_dict()["events"]
    known = [e["detected_s"] for e in recording if e["kind"] in ALARMS]
    late = announced_s - min(known) if announced_s is not None and known else None
    sets = [[s for s in (e["rotors"], *e["alternatives"]) if s] for e in reported if e["kind"] in ALARMS]
    wrong = any(not any(set(s) <= set(weak) for s in named) for named in sets)
    return {
        "flight": which, "link": link, "weak": weak, "watch": rotors_of(reported), "own": rotors_of(own), "recording": rotors_of(recording),
        "late_s": late, "wrong": wrong,
    }  # fmt: skip


def sent(flight, kind: int, link: str) -> tuple[list[dict], list[dict], float | None]:
    """The events that `watch` reported of a flight over that link and holds, those that `diagnose` finds in the recorded link, and when the
    first fault was reported [s since the first sample]."""
    outputs_hz, motion_hz, cut = LINKS[link]
    said = messages(flight, kind=kind, outputs_hz=outputs_hz, motion_hz=motion_hz)
    autopilot = Autopilot({})
    frames = [(at, bytes(autopilot.packed(m))) for at, m in said]
    first = next(at for at, m in said if m.get_type() in ("ATTITUDE", "RAW_IMU"))
    middle = 0.5 * (said[0][0] + said[-1][0])
    faults = Faults(cuts=((middle, cut),)) if cut else Faults()
    parameters = {n: v for n, v in flight.parameters.items() if n.startswith(("FRAME", "MOT_", "SERVO")) and len(n) <= 16}
    with tempfile.TemporaryDirectory() as folder:
        alerts, _ = watched(arriving(frames, faults, np.random.default_rng(0)), parameters, kind, Path(folder))
        (path,) = Path(folder).glob("*.tlog")
        recording = diagnose(logs.read(path)).to_dict()["events"]
    last = {a["number"]: a for a in alerts if a["type"] == "event"}
    reported = [a["event"] for a in last.values() if a["state"] != "withdrawn"]
    announced = [a for a in alerts if a["type"] == "event" and a["state"] == "announced" and a["event"]["kind"] in ALARMS]
    return reported, recording, announced[0]["at"] - first if announced else None


def one(task) -> dict:
    return compared(*task)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    flights = [*(name for name in TRUTH if (RECORDED / f"{name}.bin.xz").exists()), *SIMULATED]
    tasks = [(which, link) for which in flights for link in LINKS]
    rows, bad = [], 0
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        for row in pool.map(partial(one), tasks):
            rows.append(row)
            print(row, flush=True)
    for link in LINKS:
        mine = [r for r in rows if r["link"] == link]
        late = sorted(r["late_s"] for r in mine if r["late_s"] is not None)
        counts = Counter(
            weak=sum(bool(r["weak"]) for r in mine), own=sum(bool(r["own"]) for r in mine), reported=sum(bool(r["watch"]) for r in mine),
            as_recorded=sum(r["watch"] == r["recording"] for r in mine), as_own_log=sum(r["watch"] == r["own"] for r in mine),
            wrong=sum(r["wrong"] for r in mine),
        )  # fmt: skip
        bad += counts["wrong"]
        print(link, len(mine), dict(counts), f"late: median {late[len(late) // 2]:.2f} s, longest {late[-1]:.2f} s")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
