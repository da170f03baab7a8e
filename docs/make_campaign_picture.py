"""Draw docs/campaigns.svg from a campaign's folder: `python docs/make_campaign_picture.py DIR`. Needs matplotlib."""

import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt

METHOD = "default"


def main(folder: str) -> None:
    """Draw the achieved performance with its 95 % interval, beside the bounds."""
    found = json.loads((Path(folder) / "summary.json").read_text())["methods"][METHOD]
    plt.rcParams.update({"svg.hashsalt": "campaigns", "svg.fonttype": "none", "font.size": 9})
    figure, (roc, delay, loss) = plt.subplots(1, 3, figsize=(11, 3.3), layout="constrained")

    points = [p for p in found["roc"] if p["false_alarms_h"]["value"] > 0]
    for key, label in (("detected_2s", "within 2 s"), ("detected_10s", "within 10 s")):
        roc.plot([p["false_alarms_h"]["value"] for p in points], [p[key]["value"] for p in points], label=label)
    used = next(p for p in found["roc"] if p["threshold"] == 0)
    roc.plot(used["false_alarms_h"]["value"], used["detected_2s"]["value"], "kx", label="threshold in use")
    roc.axvline(0.1, color="0.6", ls=":", label="one in 10 h")
    roc.set(xscale="log", ylim=(0, 1.02), xlabel="false alarms per healthy hour", ylabel="detected", title="ROC of the statistic")

    points = found["delay_curve"]
    x = [p["delay_s"] for p in points]
    delay.plot(x, [p["detected"]["value"] for p in points], label="achieved")
    delay.fill_between(x, *([p["detected"][e] for p in points] for e in ("low", "high")), alpha=0.2)
    delay.plot(x, [p["bound"]["value"] for p in points], "k--", label="optimal CUSUM")
    delay.set(xscale="log", ylim=(0, 1.02), xlabel="s after the onset", ylabel="detected by then", title="Delay")

    points = [p for p in found["loss_error"] if p["rmse"]]
    x = [(p["low"] * p["high"]) ** 0.5 for p in points]
    for key, style, label in (("rmse", "o-", "achieved"), ("bound_rmse", "k--", "Cramér-Rao bound")):
        loss.plot(x, [p[key]["value"] for p in points], style, label=label)
        loss.vlines(x, *([p[key][e] for p in points] for e in ("low", "high")), color="0.5")
    loss.set(xscale="log", yscale="log", xlabel="true loss", ylabel="RMS error", title="Error of announced losses")
    for axes in (roc, delay, loss):
        axes.legend(fontsize=7)
        axes.grid(alpha=0.3)
    figure.savefig(Path(__file__).with_name("campaigns.svg"), metadata={"Date": None})


if __name__ == "__main__":
    main(sys.argv[1])
