"""The command of the server for assistants, by the Model Context Protocol."""

from __future__ import annotations

import click

from rotorwatch.commands.tools import OUT, common, flag, option, say


@click.command(short_help="Serve logs to assistants (Model Context Protocol).")
@click.argument("folders", nargs=-1, type=OUT, metavar="[FOLDER...]")
@option("--store", "Fleet store to read (docs/fleet.md).", envvar="ROTORWATCH_STORE", metavar="URL|FILE")
@flag("--http", "Serve on a local port instead of standard input and output.")
@option("--host", "With --http: address to listen on, a loopback address.", "127.0.0.1", metavar="HOST")
@option("--port", "With --http: port; 0: any.", 8765, type=click.IntRange(0, 65535))
@option("--token", "With --http: token that clients must send; better set in the environment.", "", envvar="ROTORWATCH_TOKEN", metavar="T")
@option("--max-size", "Maximum size of a log.", 512.0, metavar="MB")
@option("--max-seconds", "Maximum time per request.", 120.0, metavar="S")
@option("--max-memory", "Maximum memory per request.", 4000, metavar="MB")
@option("--jobs", "Requests served at once.", 1, type=click.IntRange(1, 64))
@common
def mcp(folders, http, quiet, **settings) -> None:
    """Serve the Model Context Protocol: an assistant may ask about the logs in each FOLDER, and about the fleet's store (docs/mcp.md).

    Only files in these folders are read, and nothing is written. Exit code: 0 when the client has gone or it was stopped, 2 error.
    """
    from rotorwatch.assistants import mcp as run

    def ready(address: str) -> None:
        click.echo(address)
        if not quiet:
            say("assistants are served at this address until Ctrl-C; they need the token")

    run(folders, http=http, ready=ready, **settings)
