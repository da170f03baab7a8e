"""The commands that ask a vehicle which of several sets of rotors is weak, and that fly this in the simulator."""

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
    kept,
    numbers,
    progress,
    show,
    spread,
    written,
)
from rotorwatch.errors import ConfigError


@click.command(short_help="How to ask a vehicle which rotors are weak.")
@click.argument("log", required=False, type=OUT)
@click.option("--vehicle", metavar="FILE|NAME", help="Vehicle file (TOML), or an airframe's name (docs/airframes.md).")
@click.option(
    "--candidates", metavar="1+4,2+5,none", help="Sets of rotors, by numbers; default: what the log leaves open."
)
@click.option(
    "--loss", default="0.3", show_default=True, metavar="X,...", help="Their losses: one for all, or one each."
)
@click.option("--hover", type=float, metavar="X", help="Command in hover, share of full thrust.")
@click.option("--arm", type=float, metavar="M", help="Centre to the outermost rotor.")
@click.option("--within", type=float, default=10.0, show_default=True, metavar="S", help="No longer than that.")
@click.option("--tilt", type=float, default=1.0, show_default=True, metavar="DEG", help="Largest turn of the vehicle.")
@click.option(
    "--amplitude", type=float, default=0.2, show_default=True, metavar="X", help="Largest change of a command."
)
@click.option(
    "--commands", type=OUT, metavar="OUT.csv", help="Write what is added to each command, 100 times a second."
)
@FIGURE
@JSON
@common
def ask(log, vehicle, candidates, loss, hover, arm, within, tilt, amplitude, commands, figure, as_json, quiet) -> None:
    """Design the small excitation of the commands that tells apart soonest which of the candidates is weak: of LOG, whose answer is
    ambiguous, or of a vehicle. It moves no thrust and no moment while all rotors are well."""
    from rotorwatch import files
    from rotorwatch.ask import ask as run

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
        from rotorwatch.report import research_tables

        show(lambda _: research_tables.asking(result))
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
@click.option("--flights", type=click.IntRange(1, 100_000), default=96, show_default=True, help="How many.")
@click.option("--frames", default="hexa-x,hexa-plus,octa-x,octa-plus", show_default=True, help="Airframes, in turn.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Same seed, same flights.")
@spread
@kept
@click.option("--json", "as_json", is_flag=True, help="Print JSON: measures and every flight.")
@common
def ask_flights(flights, frames, seed, jobs, scheduler, keep, as_json, quiet) -> None:
    """Fly pairs of rotors that lose thrust in the simulator; where the diagnosis is ambiguous, ask and diagnose again. Says how often that
    names the broken rotors, with 95 % intervals (docs/control.md)."""
    from rotorwatch.campaign import asking

    with progress(quiet) as tell:
        wanted = [f for f in frames.split(",") if f]
        result = asking.run(flights, wanted, seed, progress=tell, jobs=jobs, scheduler=scheduler, keep=keep)
    answer(as_json, result, asking.markdown(result))
