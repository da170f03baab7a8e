"""Agreement of the standings of a simulated fleet with its truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit import Store, assess, prognosis
from rotorwatch_lab.synthetic_fleet import TRUTH, Story

COUNTS = 0.05  # loss at the last flight, from which a rotor has to be found
NEAR = 2  # flights


def score(store: Store, folder: str | Path) -> dict[str, Any]:
    """auc: of the evidence, rotors that have lost COUNTS by the last flight against healthy ones. found: share of those named; right: of
    aircraft with a weak rotor and any named one, the share whose first named rotor is right. false: share of all named rotors without a
    loss. change: share of found damage whose first flight is right to NEAR. prognosis: share of intervals that contain the truth."""
    try:
        truth = json.loads((Path(folder) / TRUTH).read_text())
    except (OSError, ValueError) as why:
        raise ConfigError(f"{folder}: no truth of a simulated fleet found ({why}).") from None
    flights = int(truth["flights"])
    found = {a["name"]: a["standing"] for a in store.aircraft()}
    if any(a["stale"] for a in store.aircraft()):
        fresh, _ = assess.assess(store)
        found = {a["name"]: fresh.get(a["key"]) for a in store.aircraft()}
    bad, good, rows, named, wrong = [], [], [], 0, 0
    held, near, off, right, with_named = [], [], [], 0, 0
    for t in truth["aircraft"]:
        story = Story(**{k: v for k, v in t.items() if k != "loss"})
        standing = found.get(story.name)
        if standing is None:
            raise ConfigError(f"The store has no aircraft {story.name} of the truth; give the store that belongs to it.")
        ever = story.rotor if story.size else -1
        weak = story.rotor if t["loss"] >= COUNTS else -1
        for r in standing["rotors"]:
            i = r["rotor"] - 1
            if i == weak:
                bad.append(r["evidence"])
            elif i != ever:
                good.append(r["evidence"])
            named += r["named"]
            wrong += r["named"] and i != ever
        names = [r["rotor"] - 1 for r in standing["rotors"] if r["named"]]
        if weak >= 0:
            rows.append(weak in names)
            if names:
                with_named += 1
                right += names == [weak]
        if story.kind == "damage" and story.rotor in names:
            mine = (c for c in standing["changes"] if c["kind"] == "loss" and c["rotor"] == story.rotor + 1)
            onsets = [c["flight"] - 1 for c in mine]
            off.append(min((abs(k - story.start) for k in onsets), default=flights))
            near.append(off[-1] <= NEAR)
        if story.kind == "wear" and story.rotor >= 0:
            p = standing["rotors"][story.rotor]["prognosis"]
            if p["word"] == "growing":
                hours = standing["hours"] / flights
                true = (prognosis.LIMIT / story.size * (flights - story.start) - (flights - story.start)) * hours
                low, high = p["hours_left_interval"]
                held.append(bool(low <= max(true, 0.0) and (high is None or true <= high)))
    return {
        "aircraft": len(truth["aircraft"]), "flights": store.count(), "weak": len(bad), "healthy_rotors": len(good),
        "auc": _auc(bad, good), "found": _share(rows), "right": right / with_named if with_named else None,
        "named": named, "false": wrong / named if named else 0.0, "change_within_2": _share(near), "changes": len(near),
        "change_off": off, "prognosis_holds": _share(held), "prognoses": len(held),
    }  # fmt: skip


def _share(rows: list) -> float | None:
    return float(np.mean(rows)) if rows else None


def _auc(bad: list[float], good: list[float]) -> float | None:
    """Area under the ROC curve: probability that a weak rotor ranks above a healthy one, ties half."""
    if not bad or not good:
        return None
    above = np.subtract.outer(np.array(bad), np.array(good))
    return float(np.mean((above > 0) + 0.5 * (above == 0)))
