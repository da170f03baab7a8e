"""The command that serves the page: vehicles while they fly, and flights afterwards."""

from __future__ import annotations

import click

from rotorwatch.commands.tools import RECORD, SPEED, WATCHED, common, rate, say


@click.command(short_help="A page: vehicles while they fly, and the list of flights.")
@click.argument("endpoints", nargs=-1, metavar="[ENDPOINT...]")
@click.option("--host", default="127.0.0.1", show_default=True, metavar="HOST", help="Address to listen on.")
@click.option("--port", default=8000, show_default=True, type=click.IntRange(0, 65535), help="Port; 0: any.")
@click.option(
    "--token",
    envvar="ROTORWATCH_TOKEN",
    default="",
    metavar="T",
    help="What a page must know; needed for other computers.",
)
@click.option("--store", envvar="ROTORWATCH_STORE", metavar="URL|FILE", help="The fleet's store (docs/fleet.md).")
@click.option("--max-upload", default=512.0, show_default=True, metavar="MB", help="Largest log that is taken.")
@click.option("--max-seconds", default=120.0, show_default=True, metavar="S", help="Longest time for judging a log.")
@click.option("--max-memory", default=4000, show_default=True, metavar="MB", help="Most memory for judging a log.")
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(1, 64), help="Logs judged at once.")
@SPEED
@WATCHED
@RECORD
@click.option("--listen-only", is_flag=True, help="Send nothing to vehicles.")
@common
def serve(endpoints, token, speed, quiet, **settings) -> None:
    """Serve one page: vehicles at each ENDPOINT while they fly, and a list of flights to which logs can be dropped.

    ENDPOINT: as for `rotorwatch watch`; none is needed. Prints the page's address. Exit code: 0 when it was stopped, 2 error.
    """
    from rotorwatch.serve import serve as run

    def ready(address: str) -> None:
        click.echo(address)
        if not quiet:
            say("the page is served at this address until Ctrl-C" + ("; it asks for the token" if token else ""))

    run(endpoints, token=token, speed=rate(speed), ready=ready, **settings)
