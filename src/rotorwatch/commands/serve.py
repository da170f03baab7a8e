"""The command that serves the page: vehicles while they fly, and flights afterwards."""

from __future__ import annotations

import click

from rotorwatch.commands.tools import RECORD, SPEED, WATCHED, common, flag, option, rate, say


@click.command(short_help="Serve a page with live vehicles and the list of flights.")
@click.argument("endpoints", nargs=-1, metavar="[ENDPOINT...]")
@option("--host", "Address to listen on.", "127.0.0.1", metavar="HOST")
@option("--port", "Port; 0: any.", 8000, type=click.IntRange(0, 65535))
@option("--token", "Token for the page; required for access from other computers.", "", envvar="ROTORWATCH_TOKEN", metavar="T")
@option("--store", "Fleet store (docs/fleet.md).", envvar="ROTORWATCH_STORE", metavar="URL|FILE")
@option("--max-upload", "Maximum size of an upload.", 512.0, metavar="MB")
@option("--max-seconds", "Maximum time to diagnose a log.", 120.0, metavar="S")
@option("--max-memory", "Maximum memory to diagnose a log.", 4000, metavar="MB")
@option("--jobs", "Logs diagnosed at once.", 1, type=click.IntRange(1, 64))
@flag("--allow-delete", "Allow everyone who can open the page to delete flights.")
@SPEED
@WATCHED
@RECORD
@flag("--listen-only", "Send nothing to vehicles.")
@common
def serve(endpoints, token, speed, quiet, **settings) -> None:
    """Serve one page with the vehicles at each ENDPOINT in flight and a list of flights that accepts dropped logs.

    ENDPOINT: as for `rotorwatch watch`; optional. Prints the page's address. Exit code: 0 when it was stopped, 2 error.
    """
    from rotorwatch.serve import serve as run

    def ready(address: str) -> None:
        click.echo(address)
        if not quiet:
            say("the page is served at this address until Ctrl-C" + ("; it asks for the token" if token else ""))

    run(endpoints, token=token, speed=rate(speed), ready=ready, **settings)
