"""The command that makes flights: a scenario in, a log and its truth out."""

from __future__ import annotations

from pathlib import Path

import click

from rotorwatch.commands.tools import LOG, common, progress, say
from rotorwatch.errors import ConfigError


def register(group: click.Group) -> None:
    """Add the command of this module to the command line."""
    group.add_command(simulate)


@click.command(short_help="Simulate a flight and write its log.")
@click.argument("scenario", type=LOG)
@click.option(
    "-o", "--out", required=True, type=LOG, metavar="FLIGHT", help="FLIGHT.bin or .ulg; without ending: both."
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), help="Another seed than the scenario's.")
@common
def simulate(scenario, out, seed, quiet) -> None:
    """Fly SCENARIO (TOML, docs/simulation.md): writes an ArduPilot .bin or a PX4 .ulg as the autopilot would have logged it, and
    what was broken beside it, as FLIGHT.truth.json and FLIGHT.truth.csv.
    """
    from rotorwatch import simulation
    from rotorwatch.simulation.scenario import read

    asked = read(scenario)
    if seed is not None:
        asked = asked.with_seed(seed)
    endings = [out.suffix.lower()] if out.suffix else list(simulation.SUFFIXES)
    if endings[0] not in simulation.SUFFIXES:
        raise ConfigError(f"--out {out}: give a name that ends in .bin or .ulg, or has no ending for both.")
    if not out.absolute().parent.is_dir():
        raise ConfigError(f"--out {out}: there is no folder {out.parent}.")
    written: list[Path] = []
    for k, ending in enumerate(endings):
        with progress(quiet) as tell:
            if tell:
                tell(k / len(endings), "flying")
            made = simulation.simulate(asked.with_autopilot(simulation.SUFFIXES[ending]))
            written += made.write(
                out.with_suffix(ending), out.with_name(out.stem if len(endings) == 1 else out.name + ending)
            )
    click.echo("\n".join(str(path) for path in written))
    if not quiet:
        say(f"{asked.name}: {asked.duration_s:g} s flown")
