"""The commands of campaigns: many simulated flights, summarised in a table with intervals."""

from __future__ import annotations

import click

from rotorwatch.toolkit.commands import LOG, OUT, common, counting, progress, resumable, say, spread


@click.command(short_help="Diagnose thousands of simulated flights.")
@click.argument("plan", type=LOG)
@click.option("--flights", type=click.IntRange(1, 10_000_000), default=1000, show_default=True, help="How many, with those done.")
@spread
@click.option("-o", "--out", required=True, type=OUT, metavar="DIR", help="Folder of the results.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
@common
def campaign(plan, flights, jobs, scheduler, out, as_json, quiet) -> None:
    """Simulate the random flights of PLAN (TOML, docs/campaigns.md) and diagnose them with the plan's estimators and detectors, or with
    `diagnose` on the log of each. The same command resumes an interrupted run; more --flights extend it.

    Writes DIR/flights.parquet, DIR/summary.json and, where estimators are compared, DIR/index.html, and prints the summary.
    """
    import json

    from rotorwatch.base import files
    from rotorwatch_lab import campaign as campaigns
    from rotorwatch_lab.campaign import batch, open_world, page
    from rotorwatch_lab.campaign.store import Folder

    flight_plan = campaigns.read(plan)
    files.folder(out, "--out")
    by_log = flight_plan.assess == "log"
    way = open_world if by_log else campaigns
    if not quiet:
        methods = "by their logs" if by_log else f"{len(flight_plan.methods)} methods"
        say(f"{len(flight_plan.cells) * max(len(flight_plan.kinds), 1)} kinds of flights, {methods}, {batch.where()}")
    with flying(quiet) as report:
        table = way.run(flight_plan, flights, out, jobs, report, scheduler=scheduler)
    summary = way.summarise(table, flight_plan.name)
    Folder(out).finish(table, summary)
    if not by_log:
        page.write(summary, out / "index.html")
    click.echo(json.dumps(summary, indent=1, allow_nan=False) if as_json else way.markdown(summary), nl=as_json)
    if not quiet:
        say(f"table and summary written to {out}" if by_log else f"table, summary and page written to {out}")


@click.command(short_help="Diagnose simulated flights with several faults.")
@click.option("--flights", type=click.IntRange(1, 100_000), default=300, show_default=True, help="How many.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=31, show_default=True, help="Of the flights.")
@spread
@resumable
@click.option("--json", "as_json", is_flag=True, help="Print JSON: the table and every state.")
@common
def sequences(flights, seed, jobs, scheduler, keep, as_json, quiet) -> None:
    """Simulate flights in which rotors fail in turn or together, recover, change or fail intermittently (docs/experiments.md), and print
    how often the state of all rotors is known."""
    import json

    from rotorwatch_lab.campaign import sequences as study

    with progress(quiet) as report:
        result = study.run(flights, seed, jobs, report, scheduler, keep)
    click.echo(json.dumps(result, indent=1, allow_nan=False) if as_json else study.describe(result))


@click.command(short_help="Measure the effect of each constant of the default method.")
@click.argument("plan", type=LOG)
@click.argument("logs", nargs=-1, type=LOG)
@click.option("--flights", type=click.IntRange(2, 100_000), default=96, show_default=True, help="Simulated ones in all.")
@click.option("--hours", type=click.FloatRange(0.01, 1000.0), default=1.0, show_default=True, help="Of surrogates of LOGS.")
@click.option("--only", default="", metavar="NAMES", help="Constants by prefix, such as model_error.,noise.CLIP.")
@click.option("--variants", default="off,half,double", show_default=True, help="How the constants are changed.")
@click.option("--witnesses", is_flag=True, help="Leave out every witness instead, in flights of PLAN assessed by their logs.")
@spread
@resumable
@click.option("--json", "as_json", is_flag=True, help="Print JSON: measures and differences of every variant.")
@common
def ablate(plan, logs, flights, hours, only, variants, witnesses, jobs, scheduler, keep, as_json, quiet) -> None:
    """Leave out, halve and double every constant of the default method over a fixed set: flights of PLAN, flights with several faults,
    losses injected into healthy LOGS, and surrogates of those. Prints the changes, with intervals (docs/ablation.md)."""
    import json

    from rotorwatch_lab import campaign as campaigns
    from rotorwatch_lab.campaign import ablation, witness_ablation

    flight_plan = campaigns.read(plan)
    names, words = ([part for part in text.split(",") if part] for text in (only, variants))
    if set(words) - set(ablation.WORDS) or not words:
        raise click.UsageError(f"--variants {variants}: give some of {', '.join(ablation.WORDS)}.")
    if witnesses:
        with progress(quiet) as report:
            found = witness_ablation.run(flight_plan, flights, jobs, report, scheduler, keep)
        click.echo(json.dumps(found, indent=1, allow_nan=False) if as_json else witness_ablation.markdown(found))
        return
    with progress(quiet) as report:
        result = ablation.run(
            flight_plan, logs, flights, hours, only=names, words=words, jobs=jobs, progress=report, scheduler=scheduler, keep=keep
        )
    click.echo(json.dumps(result, indent=1, allow_nan=False) if as_json else ablation.markdown(result))


@click.command(short_help="Fly with an estimator in the loop of the control allocation.")
@click.argument("plan", type=LOG)
@click.option("--flights", type=click.IntRange(1, 1_000_000), default=200, show_default=True, help="How many.")
@click.option(
    "--drivers",
    default="nobody,truth,default",
    show_default=True,
    metavar="A,B,...",
    help="What drives the allocation: nobody, truth, or estimators.",
)
@click.option(
    "--by",
    type=click.Choice(["estimate", "bounds", "posterior", "certified"]),
    default="estimate",
    show_default=True,
    help="Of what is believed: the mean, the worst case within its interval, all explanations with their weights, or the mean as far as "
    "acting on it is no worse for all that is possible.",
)
@spread
@click.option("-o", "--out", required=True, type=OUT, metavar="DIR", help="Folder of the results.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@common
def closed_loop(plan, flights, drivers, by, jobs, scheduler, out, as_json, quiet) -> None:
    """Simulate the flights of PLAN (TOML, docs/control.md) with every driver: its estimate of the rotors sets the control allocation in
    flight. Prints survival, delay and needless reconfigurations. The same command resumes an interrupted run."""
    import json

    from rotorwatch.base import files
    from rotorwatch_lab.campaign import closed_loop as study
    from rotorwatch_lab.campaign import plan as plans

    flight_plan = plans.read(plan)
    files.folder(out, "--out")
    names = [name for part in drivers.split(",") if (name := part.strip())]
    with flying(quiet) as report:
        result = study.run(flight_plan, names, out, flights, jobs, by, report, scheduler)
    click.echo(json.dumps(result, indent=1, allow_nan=False) if as_json else study.markdown(result), nl=as_json)
    if not quiet:
        say(f"table and summary written to {out}")


def flying(quiet: bool):
    """Progress of the flights. Yields work.Progress."""
    return counting(quiet, "flights")
