"""Ground truth of a simulated flight, in separate files STEM.truth.json and STEM.truth.csv. No log holds any of it."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch_lab.simulation.scenario import Scenario

HZ = 50.0


def write(scenario: Scenario, record: Any, stem: Path, about: Mapping[str, Any], series: Mapping[str, np.ndarray]) -> tuple[Path, Path]:
    """Write faults and their times, and the motion at HZ; times count from the log's start. Returns both paths.

    record: with time, flies, p, v, q, omega and wind (T, ..). about, series: what the aircraft adds; keys of series are the columns'
    names with spaces between, its values (T, columns).
    """
    down = np.flatnonzero(np.asarray(record.flies) < 0.5)
    facts = {
        "name": scenario.name, "seed": scenario.seed, "frame": scenario.airframe["frame"],
        "faults": [{k: v for k, v in f.items() if v is not None} for f in scenario.faults],
        "crashed_s": float(record.time[down[0]]) if down.size else None,
        "wind_m_s": [round(float(v), 6) for v in record.wind.mean(axis=0)], **about,
    }  # fmt: skip
    about_path, table_path = (stem.with_name(stem.name + f".truth.{kind}") for kind in ("json", "csv"))
    about_path.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    stride = max(1, round(1.0 / HZ / float(record.time[1] - record.time[0])))
    motion = {
        "time_s": record.time[:, None], "north east down": record.p, "v_north v_east v_down": record.v,
        "q_w q_x q_y q_z": record.q, "p q r": record.omega, "wind_north wind_east wind_down": record.wind,
    }  # fmt: skip
    columns = {**motion, **series}
    write_csv(table_path, " ".join(columns).split(), np.concatenate(list(columns.values()), axis=1)[::stride])
    return about_path, table_path


def write_csv(path: Path, names: list[str], rows: np.ndarray) -> None:
    """Write a table of numbers (T, columns), nine digits each."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(names)
        out.writerows([f"{v:.9g}" for v in row] for row in rows)
