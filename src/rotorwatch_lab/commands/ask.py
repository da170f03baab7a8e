"""The commands that design an excitation to decide which of several sets of rotors is weak, and that fly it in the simulator."""

from __future__ import annotations

from pathlib import Path

import click

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit.commands import (
    FIGURE,
    JSON,
    OUT,
    answer,
    common,
    drawable,
    flag,
    numbers,
    option,
    progress,
    resumable,
    show,
    spread,
    written,
)


@click.command(short_help="Plan an excitation that shows which rotors are weak.")
@click.argument("log", required=False, type=OUT)
@option("--vehicle", "Vehicle file (TOML), or an airframe's name (docs/airframes.md).", metavar="FILE|NAME")
@option("--candidates", "Candidate sets of rotors, by number; default: those of the log's diagnosis.", metavar="1+4,2+5,none")
@option("--loss", "Losses of the candidates: one for all, or one each.", "0.3", metavar="X,...")
@option("--hover", "Hover command, share of full thrust.", type=float, metavar="X")
@option("--arm", "Distance from the centre to the outermost rotor.", type=float, metavar="M")
@option("--within", "Maximum duration.", 10.0, type=float, metavar="S")
@option("--tilt", "Maximum angular rate of the vehicle.", 1.0, type=float, metavar="DEG")
@option("--amplitude", "Maximum change of a command.", 0.2, type=float, metavar="X")
@option("--commands", "Write the excitation of each command at 100 Hz.", type=OUT, metavar="OUT.csv")
@FIGURE
@JSON
@common
def ask(log, vehicle, candidates, loss, hover, arm, within, tilt, amplitude, commands, figure, as_json, quiet) -> None:
    """Design the smallest excitation of the commands that distinguishes the candidate rotors soonest, for an ambiguous LOG or for a
    vehicle. With healthy rotors it changes neither thrust nor moments."""
    from rotorwatch.base import files
    from rotorwatch_lab.planning.ask import ask as run

    if (log is None) == (vehicle is None):
        raise ConfigError("Give a log with an ambiguous diagnosis, or --vehicle with --candidates.")
    if log is not None and not Path(log).exists():
        raise ConfigError(f"{log}: no such file.")
    if figure:
        drawable(figure)
    if commands:
        files.writable(commands, "--commands")
    sizes = numbers("--loss", loss, "0.3,0.5")
    result = run(
        log if log is not None else vehicle, _sets(candidates), loss=sizes[0] if len(sizes) == 1 else sizes, hover=hover,
        arm_m=arm, within_s=within, tilt_deg=tilt, amplitude=amplitude,
    )  # fmt: skip
    if figure:
        result.figure(figure)
    if commands:
        time, added = result.commands()
        head = ",".join(["time_s", *(f"r{k + 1}" for k in range(result.rotors))])
        rows = [",".join(f"{v:.6f}" for v in (t, *row)) for t, row in zip(time, added, strict=True)]
        with files.replacing(commands) as unfinished:
            Path(unfinished).write_text("\n".join([head, *rows]) + "\n")
    if as_json:
        click.echo(result.to_json())
    else:
        from rotorwatch_lab.experiments import research_tables

        show(lambda _: research_tables.excitation(result))
    written(quiet, figure=figure, commands=commands)


def _sets(text: str | None) -> list[tuple[int, ...]] | None:
    """'1+4,none' -> [(1, 4), ()]. Raises ConfigError."""
    if text is None:
        return None
    try:
        return [() if part.strip() == "none" else tuple(int(k) for k in part.split("+")) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"--candidates {text}: give sets of rotors as in 1+4,2+5,none.") from None


@click.command("ask-flights", short_help="Fly simulated ambiguous losses with and without an excitation.")
@option("--flights", "How many.", 96, type=click.IntRange(1, 100_000))
@option("--frames", "Airframes, in turn.", "hexa-x,hexa-plus,octa-x,octa-plus")
@option("--seed", "Same seed, same flights.", 1, type=click.IntRange(0))
@spread
@resumable
@flag("--json as_json", "Print JSON: measures and every flight.")
@common
def ask_flights(flights, frames, seed, jobs, scheduler, keep, as_json, quiet) -> None:
    """Simulate losses of rotor pairs; where the diagnosis is ambiguous, excite and diagnose again. Prints how often that names the
    faulty rotors, with 95 % intervals (docs/control.md)."""
    from rotorwatch_lab.campaign import excitation_flights

    with progress(quiet) as report:
        wanted = [f for f in frames.split(",") if f]
        result = excitation_flights.run(flights, wanted, seed, progress=report, jobs=jobs, scheduler=scheduler, keep=keep)
    answer(as_json, result, excitation_flights.markdown(result))
