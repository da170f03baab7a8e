"""Draw docs/methods/default-parts.svg: `python docs/make_default_picture.py LOG`, a healthy flight into which a loss is put (matplotlib).

Inputs, state and outputs of every part of the default method, tick by tick.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np

import rotorwatch as rw
from rotorwatch import airframes
from rotorwatch.engine.bindings import program
from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses
from rotorwatch.engine.bindings.plant_rows import AXES
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.tick_table import READY_S
from rotorwatch_lab.experiments.inject import inject

ROTOR, LOSS, ONSET = 2, 0.35, 45.0
OUT = Path(__file__).parent / "methods" / "default-parts.svg"


def main(log: str) -> None:
    """Draw the picture of one log."""
    flight = rw.read(log)
    vehicle, air = airframes.identify(flight), airborne(flight)
    start = air[0][0]
    table = observe(inject(flight, vehicle, ROTOR, LOSS, start + ONSET), vehicle, air, READY_S)
    if table is None:
        raise SystemExit(f"{log} shows no flight.")
    B = vehicle.effectiveness()
    seen = steps(table, B)
    t, hyp = table.time - start, list_hypotheses(B.shape[1])
    some = (t > 2) & (t < ONSET + 20)
    plt.rcParams.update({"svg.hashsalt": "default-parts", "svg.fonttype": "none", "font.size": 8})
    figure, axes = plt.subplots(7, 1, figsize=(9, 13), sharex=True, layout="constrained")
    plant, noise, trust, bank, announcing, after, size = axes

    for a in (0, 2, 3):
        plant.plot(t[some], seen["y"][some, a] - seen["y"][some, a].mean(), lw=0.6, color=f"C{a}", label=AXES[a])
        plant.plot(t[some], (seen["y"] - seen["innovation"])[some, a] - seen["y"][some, a].mean(), "k", lw=0.5, alpha=0.6)
    plant.set(ylabel="hover thrusts", title="plant and filter: commanded wrench (colour), and what the filter expected (black)")
    for j, name in enumerate(("white", "0.25 s", "1 s", "drift, per root s")):
        noise.plot(t[some], np.sqrt(seen["variances"][some, j, 1]), label=name)
    noise.set(yscale="log", ylabel="sd, hover thrusts", title="noise: pitch, learned from differences of the residual")
    for a in range(4):
        trust.plot(t[some], seen["calm"][some, a], color=f"C{a}", label=AXES[a])
    trust.set(ylim=(0, 1.05), ylabel="weight", title="model error: what a tick's evidence counts")
    for i in range(B.shape[1]):
        bank.plot(t[some], seen["odds"][some, i], label=f"rotor {i + 1}")
    other = seen["odds"][:, ~hyp.fault].max(axis=1)
    bank.plot(t[some], other[some], "k--", lw=0.8, label="best disturbance")
    bank.set(ylim=(-10, None), ylabel="nats", title="bank, hypotheses and evidence: for a jump at any time since the last explanation")
    announcing.plot(t[some], seen["statistic"][some], label="statistic, over the threshold")
    announcing.fill_between(t[some], 0, 1, where=~seen["plausible"][some], transform=announcing.get_xaxis_transform(), color="0.9",
                      label="best one is not possible")  # fmt: skip
    announcing.axhline(0, color="k", lw=0.5)
    announcing.set(ylabel="nats", title="announcement and plausibility")
    for k in range(seen["share"].shape[1]):
        after.plot(t[some], seen["share"][some, k], label=("leads", "second", "third", "fourth")[k])
    after.set(ylim=(-0.02, 1.05), ylabel="probability", title="posterior: explanations after the announcement")
    for i in range(B.shape[1]):
        theta, sd = seen["theta"][some, i], seen["theta_sd"][some, i]
        size.plot(t[some], theta, color=f"C{i}", label=f"rotor {i + 1}")
        size.fill_between(t[some], theta - 1.96 * sd, theta + 1.96 * sd, color=f"C{i}", alpha=0.2, lw=0)
    size.plot([2, ONSET, ONSET, ONSET + 20], [0, 0, LOSS, LOSS], "k:", lw=1, label=f"true loss of rotor {ROTOR}")
    size.set(ylim=(-0.02, 0.6), ylabel="loss", xlabel="s after take-off", title="what is announced")
    for a in axes:
        a.axvline(ONSET, color="0.5", lw=0.6, ls=":")
        a.legend(loc="upper left", fontsize=7, ncols=3)
    figure.savefig(OUT, metadata={"Date": None})


def steps(table, B) -> dict[str, np.ndarray]:
    """State and outputs of the step at every tick."""
    estimator, found = program.steps(table.dt, B), []
    for u, y, valid in zip(*program.inputs(table, B), strict=True):
        out = estimator.run(u[None], y[None], valid[None])
        memory = estimator.state.part("memory")
        found.append({
            "y": y, "innovation": out.innovation[0], "variances": estimator.learned.variances,
            "calm": 1.0 / np.maximum(np.maximum(memory["burst"][0], memory["lasting"][0]), 1.0), "odds": out.log_odds[0],
            "statistic": out.statistic[0], "plausible": out.plausible[0], "share": out.share[0], "theta": out.theta[0],
            "theta_sd": out.theta_sd[0],
        })  # fmt: skip
    return {name: np.array([one[name] for one in found]) for name in found[0]}


if __name__ == "__main__":
    main(sys.argv[1])
