"""The commands that design an excitation to decide which of several sets of rotors is weak, and that fly it in the simulator."""

from __future__ import annotations

from pathlib import Path

import click

from rotorwatch.commands.tools import (
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
from rotorwatch.errors import ConfigError


@click.command(short_help="How to ask a vehicle which rotors are weak.")
@click.argument("log", required=False, type=OUT)
@option("--vehicle", "Vehicle file (TOML), or an airframe's name (docs/airframes.md).", metavar="FILE|NAME")
@option("--candidates", "Sets of rotors, by numbers; default: what the log leaves open.", metavar="1+4,2+5,none")
@option("--loss", "Their losses: one for all, or one each.", "0.3", metavar="X,...")
@option("--hover", "Command in hover, share of full thrust.", type=float, metavar="X")
@option("--arm", "Centre to the outermost rotor.", type=float, metavar="M")
@option("--within", "No longer than that.", 10.0, type=float, metavar="S")
@option("--tilt", "Largest turn of the vehicle.", 1.0, type=float, metavar="DEG")
@option("--amplitude", "Largest change of a command.", 0.2, type=float, metavar="X")
@option("--commands", "Write what is added to each command, 100 times a second.", type=OUT, metavar="OUT.csv")
@FIGURE
@JSON
@common
def ask(log, vehicle, candidates, loss, hover, arm, within, tilt, amplitude, commands, figure, as_json, quiet) -> None:
    """Design the small excitation of the commands that tells apart soonest which of the candidates is weak: of LOG, whose answer is
    ambiguous, or of a vehicle. It moves no thrust and no moment while all rotors are well."""
    from rotorwatch.base import files
    from rotorwatch.lab.planning.ask import ask as run

    if (log is None) == (vehicle is None):
        raise ConfigError("Give a log whose answer is ambiguous, or --vehicle with --candidates.")
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
        from rotorwatch.lab.experiments import research_tables

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


@click.command("ask-flights", short_help="Fly ambiguous losses with and without an excitation.")
@option("--flights", "How many.", 96, type=click.IntRange(1, 100_000))
@option("--frames", "Airframes, in turn.", "hexa-x,hexa-plus,octa-x,octa-plus")
@option("--seed", "Same seed, same flights.", 1, type=click.IntRange(0))
@spread
@resumable
@flag("--json as_json", "Print JSON: measures and every flight.")
@common
def ask_flights(flights, frames, seed, jobs, scheduler, keep, as_json, quiet) -> None:
    """Fly pairs of rotors that lose thrust in the simulator; where the diagnosis is ambiguous, ask and diagnose again. Says how often that
    names the broken rotors, with 95 % intervals (docs/control.md)."""
    from rotorwatch.lab.campaign import excitation_flights

    with progress(quiet) as report:
        wanted = [f for f in frames.split(",") if f]
        result = excitation_flights.run(
            flights, wanted, seed, progress=report, jobs=jobs, scheduler=scheduler, keep=keep
        )
    answer(as_json, result, excitation_flights.markdown(result))
