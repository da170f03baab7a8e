"""The command that computes which losses a vehicle survives."""

from __future__ import annotations

import click

from rotorwatch.toolkit.commands import FIGURE, JSON, common, drawable, numbers, option, progress, show, written


@click.command(short_help="Show which losses of one and two rotors a vehicle survives.")
@option("--vehicle", "Vehicle file (TOML), or an airframe's name (docs/airframes.md).", required=True, metavar="FILE|NAME")
@option("--loss", "Losses; 1 is a total loss.", "1", metavar="X,...")
@option("--mass", "Mass; default: that of the vehicle file.", type=float, metavar="KG")
@option("--thrust-to-weight", "Thrust-to-weight ratio; default: that of the vehicle file.", type=float, metavar="X")
@option("--arm", "Distance from the centre to the outermost rotor; default: that of the vehicle file.", type=float, metavar="M")
@FIGURE
@JSON
@common
def survive(vehicle, loss, mass, thrust_to_weight, arm, figure, as_json, quiet) -> None:
    """Show what remains after the loss of any rotor and of any two: full control, hover without yaw, hover only while spinning, or none;
    with the attainable thrust, moments and wind."""
    from rotorwatch_lab.planning.survive import survive as run

    sizes = numbers("--loss", loss, "0.3,0.6,1")
    if figure:
        drawable(figure)
    with progress(quiet) as report:
        result = run(vehicle, loss=sizes, mass_kg=mass, thrust_to_weight=thrust_to_weight, arm_m=arm, progress=report)
        if figure:
            result.figure(figure)
    if as_json:
        click.echo(result.to_json())
    else:
        from rotorwatch_lab.experiments import research_tables

        show(lambda _: research_tables.survival(result))
    written(quiet, figure=figure)
