"""The command of simulated flights: a scenario in, a log and its truth out."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit.commands import LOG, OUT, common, progress, say


@click.command(short_help="Simulate a flight and write its log.")
@click.argument("scenario", type=LOG)
@click.option(
    "-o",
    "--out",
    required=True,
    type=OUT,
    metavar="FLIGHT",
    help="FLIGHT.bin or .ulg; without ending: both. A helicopter's: .csv or .parquet.",
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), help="Seed, instead of the scenario's.")
@common
def simulate(scenario, out, seed, quiet) -> None:
    """Fly SCENARIO (TOML, docs/simulation.md): writes an ArduPilot .bin or a PX4 .ulg as the autopilot would have logged it (of a
    helicopter a .csv or .parquet table), with the true faults beside it in FLIGHT.truth.json and FLIGHT.truth.csv.
    """
    from rotorwatch.base import files
    from rotorwatch_lab import simulation
    from rotorwatch_lab.simulation.scenario import read

    files.writable(out, "--out")

    wanted = read(scenario)
    if seed is not None:
        wanted = wanted.with_seed(seed)
    endings = _endings(out, wanted.helicopter)
    stems = [out.with_name(out.stem if len(endings) == 1 else out.name + ending) for ending in endings]
    for stem, ending in zip(stems, endings, strict=True):
        for path in (out.with_suffix(ending), *(stem.with_name(f"{stem.name}.truth.{kind}") for kind in ("json", "csv"))):
            if path.is_dir():
                raise ConfigError(f"--out {out}: {path} is a folder.")
    with _all_or_none(out) as hidden:
        written: list[Path] = []
        for k, ending in enumerate(endings):
            with progress(quiet) as report:
                if report:
                    report(k / len(endings), "flying")
                one = wanted if wanted.helicopter else wanted.with_autopilot(simulation.SUFFIXES[ending])
                made = simulation.simulate(one)
                written += made.write(hidden / out.with_suffix(ending).name, hidden / stems[k].name)
    click.echo("\n".join(str(out.with_name(path.name)) for path in written))
    if not quiet:
        say(f"{wanted.name}: {wanted.duration_s:g} s flown")


@contextmanager
def _all_or_none(out: Path) -> Iterator[Path]:
    """A hidden folder beside `out`, whose files are moved there when all are written."""
    folder = out.absolute().parent
    with tempfile.TemporaryDirectory(prefix=".rotorwatch-", dir=folder) as hidden:
        yield Path(hidden)
        for path in Path(hidden).iterdir():
            os.replace(path, folder / path.name)


def _endings(out: Path, helicopter: bool) -> list[str]:
    """File formats to write, by the file's ending; without one all of an autopilot, .csv of a helicopter."""
    from rotorwatch_lab import simulation

    known = simulation.helicopter.table.SUFFIXES if helicopter else tuple(simulation.SUFFIXES)
    if not out.suffix:
        return [known[0]] if helicopter else list(known)
    if out.suffix.lower() not in known:
        rest = f"ends in {' or '.join(known)}, or has no ending{'' if helicopter else ' for both'}"
        what = "of a helicopter's flight " if helicopter else ""
        raise ConfigError(f"--out {out}: give a name {what}that {rest}.")
    return [out.suffix.lower()]
