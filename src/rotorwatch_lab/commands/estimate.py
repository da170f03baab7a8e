"""The command that runs published methods on a log and writes their own estimates."""

from __future__ import annotations

from typing import Any

import click

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit.commands import JSON, LOG, OUT, common, findable, option, print_json, progress, say, vehicle_of

TIMES = 6  # printed times
AROUND_S = 0.5  # before and after each of them, of which medians are printed
LANDING_S = 1.0  # at the end, where no method's plant holds: not printed
HELICOPTER = "aesmf"  # the method for helicopters when none is named


@click.command(short_help="Show the estimates of published methods over time.")
@click.argument("log", type=LOG)
@option("--method --estimator methods", "Published method (docs/methods); may be repeated.", multiple=True, metavar="NAME")
@option("-o --out outs", "Write .csv, .parquet, .json, .png, .svg, .pdf or .html; may be repeated.", multiple=True, type=OUT,
        metavar="FILE")  # fmt: skip
@option("--vehicle", "Vehicle file (TOML), as `rotorwatch calibrate` writes it.", type=LOG, metavar="FILE")
@option("--baseline baselines", "A healthy flight of the same build.", multiple=True, type=LOG, metavar="LOG")
@option("--plant", "rates: rotation, identified from the flight; paper: that of the method's paper; both.", "rates",
        type=click.Choice(("rates", "paper", "both")))  # fmt: skip
@option("--tuning", "Tuning of the method (TOML), as `rotorwatch tune` writes it.", type=LOG, metavar="FILE")
@option("--calibrated", "Widen the intervals of losses so that they hold (docs/estimate.md).", is_flag=True)
@option("--truth", "True losses (CSV), to plot and compare.", type=LOG, metavar="FILE")
@option("--airframe", "For a helicopter log: an airframe of a paper, such as ruav-40kg, or an airframe file.", metavar="NAME|FILE")
@option("--lag", "Of a helicopter's actuators, s.", 0.03, type=click.FloatRange(0.001, 1.0))
@JSON
@common
def estimate(log, methods, outs, vehicle, baselines, plant, tuning, calibrated, truth, airframe, lag, as_json, quiet) -> None:
    """Run published methods over LOG and show their own estimates over time: losses with intervals or bounds, states and innovations.
    `rotorwatch diagnose --estimator NAME` decides which rotor is faulty.
    """
    from rotorwatch.base import checks
    from rotorwatch_lab.estimate import estimate as run
    from rotorwatch_lab.estimate import writable

    checks.finite("--lag", lag)
    names = list(methods) or ([HELICOPTER] if airframe else [])
    findable(*names)
    for path in outs:
        writable(path)
    tuned = None
    if tuning:
        from rotorwatch_lab.tune import read

        if len(names) != 1:
            raise ConfigError("--tuning belongs to one method; give that one alone.")
        tuned = read(tuning, names[0])
    with progress(quiet) as report:
        found = run(
            log, names, vehicle=vehicle_of(vehicle), baseline=baselines, plant=plant, tuning=tuned, airframe=airframe, lag_s=lag,
            truth=truth, calibrated=calibrated, progress=report,
        )  # fmt: skip
    for path in outs:
        found.write(path)
    if as_json:
        print_json(found.to_dict())
    else:
        click.echo("\n\n".join(filter(None, map(str, _texts(found)))))
    for path in outs:
        if not quiet:
            say(f"written to {path}")


def _texts(found: Any) -> list[str]:
    """The printed output: a table for each method."""
    texts = [_of(found, one) for one in found.series]
    texts.append("\n".join(f"{who}: {note}." for note, who in found.notes().items()))
    return texts + [f"{name} could not run: {why}" for name, why in found.failed.items()]


def _of(found: Any, series: Any) -> str:
    """A method's estimates over time: medians around some times."""
    import numpy as np

    first, end = float(series.time[0]), float(series.time[-1])
    last = max(first, end - LANDING_S)
    lines = [f"{series.title}: {len(series.time)} steps of {series.dt:g} s, {first:.1f} to {end:.1f} s. {series.whose}"]
    lines.append(f"Medians over {2 * AROUND_S:g} s:")
    times = (first + (last - first) * part / (TIMES - 1) for part in range(TIMES))
    rows = sorted({k for t in times if (k := series.at(t)) is not None})
    width = max(22, *(len(name) + 2 for name in series.theta_names))
    lines.append("  time".ljust(10) + "".join(name.replace("_", " ").ljust(width) for name in series.theta_names))
    for k in rows:
        near = (np.abs(series.time - series.time[k]) <= AROUND_S) & (series.hop == series.hop[k])
        values, low, high = (np.median(part[near], axis=0) for part in (series.theta, series.lower, series.upper))
        cells = (f"{v:6.2f} ({a:.2f} to {b:.2f})".ljust(width) for v, a, b in zip(values, low, high))
        lines.append(f"{series.time[k]:7.1f} s ".ljust(10) + "".join(cells).rstrip())
    for name, one in found.found.get(series.method, {}).items():
        verdict = "sound" if one["found_s"] is None else f"FAULTY, found at {one['found_s']:.2f} s"
        lines.append(
            f"{name:13s} {verdict:29s} off by {one['deviation']:+.3f} +- {one['deviation_off']:.3f}   "
            f"loss {one['loss']:.2f} +- {one['loss_off']:.2f}, displaced {one['bias']:+.2f} +- {one['bias_off']:.2f}"
        )
    coverage = found.coverage(series)
    if coverage is not None:
        shares = ", ".join(f"{name.replace('_', ' ')} {share:.0%}" for name, share in zip(series.theta_names, coverage))
        lines.append(f"Share of the steps in which the interval contains the truth: {shares}.")
    return "\n".join(lines)
