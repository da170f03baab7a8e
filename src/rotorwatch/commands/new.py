"""The command that writes the beginning of a plug-in."""

from __future__ import annotations

import click

from rotorwatch.commands.tools import OUT, common, option, say


@click.command(short_help="Write the beginning of a reader, a method or a witness.")
@click.argument("kind", metavar="reader|method|witness")
@click.argument("name")
@option("-o --out", "Folder to write NAME into.", ".", type=OUT, metavar="DIR")
@common
def new(kind, name, out, quiet) -> None:
    """Write a plug-in to begin with into the folder NAME: its file, a sample flight, and a test that passes (docs/plug-ins.md).

    \b
    rotorwatch new reader my_log
    python -m pytest my_log
    pip install -e my_log
    """
    from rotorwatch import templates

    target = templates.new(kind, name, out)
    click.echo(str(target))
    if not quiet:
        say(f"{target / f'{name}.py'} is yours to change; test it with: python -m pytest {target}")
