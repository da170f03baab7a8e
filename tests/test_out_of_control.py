"""No flight that was out of control for more than a second is `healthy`: a law over every log at hand, by a check of its own."""

from pathlib import Path

import numpy as np
import pytest

from rotorwatch import diagnose, errors, logs

FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
LOGS = sorted(p for p in FLIGHTS.glob("*/*.xz") if not p.name.endswith((".csv.xz", ".bbl.xz", ".bfl.xz")))
LOST_DEG, LOST_S, LATE_S = 60.0, 1.0, 0.7  # from what was wanted at any time in the last LATE_S
BACK_DEG, BACK_S = 20.0, 0.3
FLIES = 0.1  # of the range between the outputs' least and greatest: at less the motors stand


def up(q):
    """(n, 3) direction of thrust, of quaternions (n, 4): the third column of the rotation matrix."""
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z])


def out_of_control_s(flight):
    """The longest time for which the thrust pointed elsewhere than it was wanted to, or down where that is not known, with motors on."""
    if not flight.has("attitude", "motors"):
        return 0.0
    attitude, motors = flight["attitude"], flight["motors"]
    good = attitude.valid.all(axis=1)
    time, axis = attitude.time[good], up(attitude.values[good])
    known = motors.valid.all(axis=1)
    mean = motors.values[known].mean(axis=1)
    if not time.size or not mean.size or np.ptp(mean) == 0.0:
        return 0.0
    on = np.interp(time, motors.time[known], (mean - mean.min()) / np.ptp(mean)) > FLIES
    angle = np.degrees(np.arccos(np.clip(axis[:, 2], -1, 1))) - 60.0  # on its side is fine where nothing is known
    if flight.has("attitude_wanted"):
        wanted = flight["attitude_wanted"]
        ok = wanted.valid.all(axis=1)
        at, want = wanted.time[ok], up(wanted.values[ok])
        for k, t in enumerate(time):
            near = want[np.searchsorted(at, t - LATE_S) : np.searchsorted(at, t, "right")]
            angle[k] = np.degrees(np.arccos(np.clip(near @ axis[k], -1, 1).max())) if len(near) else 0.0
    longest, since, back = 0.0, None, None
    for t, flies, away in zip(time, on, angle):
        if away > LOST_DEG and flies:
            since, back = t if since is None else since, None
        elif not flies or away < BACK_DEG:  # who tumbles points anywhere for a moment
            back = t if back is None else back
            if t - back > BACK_S:
                since = None
        if since is not None and back is None:
            longest = max(longest, t - since)
    return longest


def test_the_check_sees_who_fell():
    crash = FLIGHTS / "crash" / "quad-off-1.bin.xz"
    if not crash.exists():
        pytest.skip("the shared flight crash/quad-off-1 is not here")
    assert out_of_control_s(logs.read(crash)) > LOST_S
    assert out_of_control_s(logs.read(FLIGHTS / "crash" / "flips-1.bin.xz")) < LOST_S


@pytest.mark.thorough(keep=3)
@pytest.mark.parametrize("folder", sorted({p.parent.name for p in LOGS}) or ["missing"])
def test_nobody_who_was_out_of_control_is_healthy(folder, amount):
    if not LOGS:
        pytest.skip("../shared/flights is not here")
    wrong = []
    for path in [p for p in LOGS if p.parent.name == folder][:: amount(3, 1)]:
        try:
            flight = logs.read(path)
            if out_of_control_s(flight) > LOST_S and diagnose(flight).verdict == "healthy":
                wrong.append(path.name)
        except errors.RotorwatchError:
            continue
    assert wrong == []
