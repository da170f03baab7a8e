"""Commands on the odds of explanations: fitted, ablated, and compared with how often they are right."""

from __future__ import annotations

import json

import click

from rotorwatch.toolkit.commands import LOG, OUT, common, progress, resumable, spread

SEED = click.IntRange(0, 2**31 - 2)


@click.command(short_help="Fit the weights of explanations to flights of known truth.")
@click.argument("plan", type=LOG)
@click.argument("logs", nargs=-1, type=LOG, metavar="[LOG]...")
@click.option("--flights", type=click.IntRange(1, 100_000), default=1800, show_default=True, help="Of PLAN, to fit to.")
@click.option("--held-out", type=click.IntRange(1, 100_000), default=900, show_default=True, help="Of PLAN, to check on.")
@click.option("--seed", type=SEED, default=101, show_default=True, help="Of the flights to fit to; the next one checks.")
@click.option("--ablate", is_flag=True, help="Also leave out every explanation, and halve and double every constant.")
@spread
@resumable
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@common
def fit_odds(plan, logs, flights, held_out, seed, ablate, jobs, scheduler, keep, as_json, quiet) -> None:
    """Fit the log weights and the temper of the comparison after the flight to claims in flights of PLAN (assessed by logs, such as
    plans/open.toml) and in healthy LOGS, and print constants in use and fitted, with their log loss in flights that were held out."""
    from rotorwatch_lab.campaign import odds_ablation, odds_fit

    with progress(quiet) as report:
        result = odds_fit.fit_odds(plan, logs, flights, held_out, seed, jobs, report, scheduler, keep)
    effects = odds_ablation.run(result.data) if ablate else None
    if as_json:
        found = {**odds_fit.to_dict(result), **({"ablation": effects.to_dict()} if effects else {})}
        click.echo(json.dumps(found, indent=1, allow_nan=False))
    else:
        click.echo(odds_fit.markdown(result) + ("\n\n" + effects.markdown() if effects else ""))


@click.command(short_help="Compare stated probabilities with how often they are right.")
@click.argument("plan", type=LOG)
@click.argument("logs", nargs=-1, type=LOG, metavar="[LOG]...")
@click.option("--flights", type=click.IntRange(1, 1_000_000), default=1000, show_default=True, help="Of PLAN, with its own seed.")
@click.option("--truth", "truths", multiple=True, type=LOG, metavar="CSV", help="Logs with a table of truth; may be repeated.")
@click.option("--loss", "losses", default="0.15,0.25,0.4", show_default=True, metavar="L,L,...", help="Put into the healthy LOGS.")
@spread
@resumable
@click.option("--figure", type=OUT, metavar="OUT.svg", help="Draw it.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@common
def reliability(plan, logs, flights, truths, losses, jobs, scheduler, keep, figure, as_json, quiet) -> None:
    """Diagnose flights of PLAN, healthy LOGS with losses put into them, and logs with a table of truth (docs/tuning.md), and print for
    each bin of stated probability the share that is right."""
    from rotorwatch.toolkit.commands import shares
    from rotorwatch_lab.campaign import reliability as study

    wanted = shares("--loss", losses)
    with progress(quiet) as report:
        bins = study.reliability(plan, logs, flights, truths, wanted, jobs, report, scheduler, keep)
    if figure:
        study.draw(bins, figure)
    click.echo(json.dumps(study.to_dict(bins), indent=1, allow_nan=False) if as_json else study.markdown(bins))
