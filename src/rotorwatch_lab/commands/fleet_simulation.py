"""The command `rotorwatch fleet simulate`."""

from __future__ import annotations

import click

from rotorwatch.toolkit.commands import OUT, common, flag, option, print_json, progress

JSON = flag("--json as_json", "Print JSON (docs/fleet.md).")


@click.command(short_help="A simulated fleet with known truth.")
@option("-o --out", "Folder for fleet.db and truth.json; it is made.", required=True, type=OUT, metavar="DIR")
@option("--aircraft", "How many.", 10, type=click.IntRange(1, 10_000))
@option("--flights", "Of each.", 40, type=click.IntRange(5, 100_000))
@option("--seed", "Same seed, same fleet.", 0, type=click.IntRange(0))
@flag("--logs", "Also write every flight as an ArduPilot log.")
@option("--store url", "Another store than DIR/fleet.db.", "", metavar="FILE|URL")
@JSON
@common
def simulate(out, aircraft, flights, seed, logs, url, as_json, quiet) -> None:
    """Fly and assess a fleet in which rotors wear, are damaged and exchanged, and compare what its store says with the truth.

    Needs JAX, which the extra `research` brings (docs/fleet.md). About 0.2 s a flight on one processor; broken off, it
    goes on when called again.
    """
    from rotorwatch.toolkit import Store
    from rotorwatch_lab import fleet_score as score
    from rotorwatch_lab import synthetic_fleet as synthetic

    with progress(quiet) as report:
        truth, _ = synthetic.fly_fleet(out, aircraft, flights, seed, url, logs, report)
    with Store(url or truth.parent / synthetic.STORE) as store:
        found = score.score(store, truth.parent)
    if as_json:
        print_json(found)
        return
    for name, value in found.items():
        if name != "change_off":
            click.echo(f"{name.replace('_', ' '):<18}{'-' if value is None else f'{value:.3f}' if isinstance(value, float) else value}")
