"""What all commands share: their common options, the progress bar, tables and messages."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

LOG = click.Path(path_type=Path)


def say(text: str) -> None:
    """A message to the user, on standard error."""
    click.echo(f"rotorwatch: {text}", err=True)


def debug(context: click.Context, parameter: click.Parameter, on: bool) -> None:
    """Callback of --debug: tracebacks from here on."""
    if on:
        os.environ["ROTORWATCH_DEBUG"] = "1"


def common(command: Callable) -> Callable:
    """Options every command has."""
    quiet = click.option("--quiet", "-q", is_flag=True, help="No progress and no warnings on standard error.")
    tracebacks = click.option(
        "--debug", is_flag=True, expose_value=False, callback=debug, help="Show tracebacks of errors."
    )
    return quiet(tracebacks(command))


def show(table: Callable[[Any], Any]) -> None:
    """Print what `table` makes of the terminal module, on standard output."""
    from rotorwatch.report import terminal

    screen = terminal.console()
    if screen.is_terminal:
        screen.print(table(terminal))
        return
    with screen.capture() as text:  # rich pads lines to the table's width; a file does not need that
        screen.print(table(terminal))
    click.echo("\n".join(line.rstrip() for line in text.get().splitlines()))


@contextmanager
def progress(quiet: bool) -> Iterator[Callable | None]:
    """A progress bar on standard error when that is a terminal, else nothing. Yields tell(share 0..1, text)."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    from rotorwatch.report import terminal

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=terminal.console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=1.0)

        def tell(share: float, text: str = "") -> None:
            bar.update(task, completed=min(max(float(share), 0.0), 1.0), description=text or None)

        yield tell
