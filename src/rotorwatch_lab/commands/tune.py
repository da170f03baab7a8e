"""Commands that fit estimators to an aircraft and compare them: tune, compare."""

from __future__ import annotations

from collections import Counter
from typing import Any

import click

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit.commands import (
    JSON,
    LOG,
    OUT,
    answer,
    common,
    counting,
    findable,
    flag,
    option,
    print_json,
    progress,
    say,
    shares,
    written,
)


@click.command(short_help="Fit an estimator's noise to healthy flights.")
@click.argument("logs", nargs=-1, type=LOG, metavar="LOG...")
@option("--estimator", "Published method to tune.", "ekf", metavar="NAME")
@option("-o --out", "Tuning file to write.", type=OUT, metavar="tuning.toml")
@option("--rounds", "Steps of the optimiser.", 30, type=click.IntRange(1))
@flag("--papers", "Instead: compare with each paper's hand tuning, on simulated flights.")
@JSON
@common
def tune(logs, estimator, out, rounds, papers, as_json, quiet) -> None:
    """Fit process and measurement noise and the walk of the losses to healthy LOGs of one build, by likelihood.

    Give the file to `rotorwatch diagnose --estimator NAME --tuning FILE` later.
    """
    from rotorwatch.base import files
    from rotorwatch_lab.tune import tune as run
    from rotorwatch_lab.tune import write

    if papers:
        from rotorwatch_lab.experiments.studies.hand_tuning import markdown, study

        with progress(quiet) as report:
            rows = study((), rounds, report)
        answer(as_json, rows, markdown(rows).strip())
        return
    if not logs:
        raise ConfigError("Give healthy logs of one build to tune to, or --papers.")
    findable(estimator)
    if out:
        files.writable(out, "--out")
    with progress(quiet) as report:
        found = run(logs, estimator, rounds, report)
    if out:
        write(found, out)
    if as_json:
        print_json(found.to_dict())
        return
    click.echo(f"{estimator}: log-likelihood per row {found.before:.3f} as it was, {found.after:.3f} as tuned")
    for name, values in (("process noise", found.tuning.q), ("measurement noise", found.tuning.r)):
        click.echo(f"{name}, factors on the variances: {', '.join(f'{v:.3g}' for v in values)}")
    for name, value in found.tuning.keywords.items():
        click.echo(f"{name}: {value:.3g}")
    if found.held_out:
        click.echo(
            f"on {found.held_out}, which was not fitted to: {found.held_out_before:.3f} as it was, {found.held_out_after:.3f} as tuned"
        )
    for note in found.notes:
        click.echo(f"note: {note}")
    written(quiet, tuning=out)


@click.command(short_help="Run all estimators on the same flights.")
@click.argument("logs", nargs=-1, type=LOG, metavar="[LOG]...")
@option("--truth", "Faults of the LOGs: path, faulty_rotors, thrust_loss, start_s; or a single LOG's losses over time.", type=LOG,
        metavar="FILE.csv")  # fmt: skip
@option("--estimators", "Only these estimators.", metavar="NAME,NAME,...")
@option("--method own", "Your own, against the default and the five papers' methods; may be repeated.", multiple=True,
        metavar="FILE:CLASS")  # fmt: skip
@option("--losses", "Losses to simulate and inject, 0..1.", "0.2,0.4", metavar="L,L,...")
@option("--seeds", "Simulated flights of each kind; default: 2, none with --truth.", type=click.IntRange(0, 1000))
@option("--format form", "Of the tables.", "markdown", type=click.Choice(("markdown", "latex")))
@JSON
@common
def compare(logs, truth, estimators, own, losses, seeds, form, as_json, quiet) -> None:
    """Rank all estimators, or your own against the papers', on simulated flights, on healthy LOGs with injected losses, and on LOGs whose
    faults are known: error, delay, coverage, false alarms, and whether chance explains the differences.

    Each finished estimator is reported on standard error. Ctrl-C stops and prints the results so far.
    """
    from rotorwatch_lab.experiments import tools
    from rotorwatch_lab.experiments.studies import compare as study
    from rotorwatch_lab.experiments.studies import compare_flights as flights

    wanted = shares("--losses", losses)
    if truth and not logs:
        raise ConfigError("--truth describes the faults of LOGs; give these as well.")
    names = [name.strip() for name in estimators.split(",") if name.strip()] if estimators else []
    if own:
        names = [*(names or ("default", *study.PAPERS)), *own]
    seeds = seeds if seeds is not None else 0 if truth else 2
    findable(*names)
    names = study.known(names)
    if not quiet:
        say(f"{len(names)} estimators, one after the other: {', '.join(names)}; Ctrl-C stops and shows the finished ones")
    with progress(quiet) as report:
        scenes = [] if not logs else flights.with_truth(logs, truth) if truth else flights.injected(logs, wanted)
        scenes = [*(flights.simulated(seeds, wanted, report) if seeds else ()), *scenes]
    found: list[Any] = []
    stopped = None
    with counting(quiet, "estimators") as shown:
        if shown:
            kinds = ", ".join(f"{n} {group}" for group, n in Counter(s.group for s in scenes).items())
            shown.show(f"rotorwatch: {len(scenes)} flights for each: {kinds}")
        try:
            for one in study.each(scenes, names):
                found.append(one)
                if shown:
                    shown(len(found), len(names), 0.0)
                    shown.show(f"{len(found)} of {len(names)}, {study.line(one)}")
        except KeyboardInterrupt as why:
            stopped = why
    if found:
        result = study.gathered(scenes, found)
        missing = names[len(found) :]
        text = study.markdown(result, *([tools.latex] if form == "latex" else [])).strip()
        if missing:
            result["missing"] = missing
            text += f"\n\nInterrupted: {', '.join(missing)} did not run."
        answer(as_json, result, text)
    if stopped:
        raise stopped
