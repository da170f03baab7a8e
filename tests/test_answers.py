"""What every answer to a log from somewhere keeps to: `healthy` is a claim, a headline says why, and what is unknown is left out."""

import re
from pathlib import Path

import pytest

import rotorwatch as rw
from rotorwatch.engine.events.decisions import MATTERS
from rotorwatch.report import terminal
from rotorwatch.report.sections import grades

SHARED = Path(__file__).resolve().parents[2] / "shared" / "flights"
LOGS = (
    "wild/vibration-wrong-reason-1.bin.xz", "wild/short-flight-wrong-reason-1.BFL.xz", "blackbox/LOG00001.BFL.xz",
    "wild/healthy-says-nothing-130.tlog.xz", "wild/knock-1.bin.xz", "wild/sdlog2-1.ulg.xz", "px4-pyulog/sample.ulg.xz",
    "crash/disarmed-1.bin.xz", "crash/quad-off-1.bin.xz", "open/ap_tri_healthy_square.bin.xz", "wild/on-its-side-1.bin.xz",
    "wild/healthy-sim-1.bin.xz", "wild/all-equal-1.bin.xz", "corrupt/time_jumps_backwards.bin", "wild/yaw-step-unsaid-1.bin.xz",
    "crazypad/normal_flight__E8_log01.usd.xz", "ardupilot-real-rrc/25_mm_cut_hover_2.bin.xz", "blackbox/LOG00006.BFL.xz",
)  # fmt: skip
REASONS = {  # of logs whose reason is known
    "vibration-wrong-reason-1.bin.xz": "vibration of 20 m/s2", "sdlog2-1.ulg.xz": "outputs do not explain",
    "sample.ulg.xz": "never took off",
    "knock-1.bin.xz": "made contact at 11.22 s and 22.62 s", "normal_flight__E8_log01.usd.xz": "11 s of flight without landing are needed",
    "on-its-side-1.bin.xz": "no motor outputs", "time_jumps_backwards.bin": "clock jumps at 53.2 s",
}  # fmt: skip
NEVER = (
    "This log cannot say", r"\b0 % (of one rotor )?could", r"at most 0 %", "in all", r"weak to critical", r"-\d+ to \d+ % a minute",
    "hardly in the air, or its motion",
)  # fmt: skip


@pytest.fixture(scope="module", params=LOGS, ids=lambda log: log.rpartition("/")[2])
def answer(request):
    if not (SHARED / request.param).exists():
        pytest.skip("no ../shared/flights")
    return rw.diagnose(SHARED / request.param)


def printed(answer, width=80, verbose=True):
    from rich.console import Console

    console = Console(width=width, color_system=None, highlight=False, emoji=False, markup=False)
    with console.capture() as out:
        console.print(terminal.diagnosis(answer))
    return out.get()


@pytest.mark.thorough(keep=6)
def test_an_answer_says_what_is_known_and_why_no_more_is(answer):
    name = answer.flight["name"]
    if answer.verdict == "healthy":
        assert all(r.since_takeoff is not None and r.since_takeoff[1] <= MATTERS for r in answer.rotors)
    if answer.verdict in ("inconclusive", "crashed"):
        reason = re.sub(r"[;:].*", "", answer.reason)
        assert ": " in answer.headline or reason.lower() in answer.headline.lower() or "control" in answer.headline
        assert answer.advice
    assert REASONS.get(name, "") in answer.headline
    for text in (answer.headline, answer.reason, printed(answer)):
        assert not [pattern for pattern in NEVER if re.search(pattern, " ".join(text.split()))]
    assert not grades.rows(answer) or any("not assessed" not in row for row in grades.rows(answer))


@pytest.mark.parametrize(("matters", "verdict"), [(0.2, "healthy"), (0.001, "inconclusive")])
def test_what_matters_is_asked_for(matters, verdict):
    log = Path(rw.__file__).parent / "samples" / "quadx_healthy_hover.bin.xz"
    found = rw.diagnose(log, matters=matters)
    assert found.verdict == verdict and ("No loss was detected, but a loss of up to" in found.headline) == (verdict == "inconclusive")


@pytest.mark.parametrize("matters", [0.0, -0.1, 1.5, float("nan")])
def test_what_matters_is_a_share(matters):
    with pytest.raises(rw.errors.ConfigError, match="share above 0"):
        rw.diagnose(Path(rw.__file__).parent / "samples" / "quadx_healthy_hover.bin.xz", matters=matters)
