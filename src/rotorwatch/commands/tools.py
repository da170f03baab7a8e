"""Shared by all commands: arguments and common options, the progress bar, tables and messages."""

from __future__ import annotations

import functools
import json
import os
import re
import stat
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from rotorwatch.base import incoming
from rotorwatch.base.files import printable, public
from rotorwatch.errors import BackendWarning, ConfigError, PluginWarning, WorkerWarning

PICTURES = (".svg", ".png", ".pdf")
ADDRESS = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)
BUILDING = "building native code for this computer, once; this takes some seconds."
LINE_S, FEW = 2.0, 10  # s between two lines of progress; fewest items for them


WRITER_S = 5.0  # time limit for the first data of a named pipe


class Log(click.ParamType):
    """An input file: a Path. `-` is standard input; it and other pipes are stored in a file, as readers need random access."""

    name = "file"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        from rotorwatch.base.files import no_address

        if isinstance(value, Path):
            return value
        if not value:
            raise ConfigError("An empty file name was given; give a file.")
        no_address(value)
        if value == "-":
            return _standard_input()
        path = Path(value)
        try:
            kind = path.stat().st_mode
        except (OSError, ValueError):
            return path  # the reader reports errors
        if stat.S_ISFIFO(kind):
            with _opened(path) as pipe:
                return _spooled(pipe, f"pipe {path.name}")
        if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
            raise ConfigError(f"{value} is a device, not a file; give a flight log.")
        return path


class Logs(Log):
    """A log, or several by a folder, a pattern, an address. Paths, addresses and patterns as texts."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if isinstance(value, str) and ADDRESS.match(value) and not Path(value).exists():
            return value
        return super().convert(value, param, ctx)


def _standard_input() -> Path:
    if sys.stdin is None or sys.stdin.isatty():
        raise ConfigError("- means standard input, which has no log: write `rotorwatch diagnose - < flight.bin`.")
    spool = incoming.spooled()
    if spool is not None and any(spool.glob("*/standard input")):
        raise ConfigError("Standard input (-) can be read only once.")
    return _spooled(sys.stdin.buffer, "standard input")


def _opened(path: Path) -> Any:
    """An open pipe. A named one without a writer would block for ever, hence the time limit."""
    if path.parts[:2] in (("/", "dev"), ("/", "proc")):  # of the shell, whose other end is open: <(xz -dc flight.bin.xz)
        return open(path, "rb")
    import select

    pipe = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    if not select.select([pipe], [], [], WRITER_S)[0]:
        os.close(pipe)
        raise ConfigError(f"{path} is a pipe without a writer; give a flight log, or start the writing program first.")
    os.set_blocking(pipe, True)
    return os.fdopen(pipe, "rb")


def _spooled(stream: Any, name: str) -> Path:
    """A stream's content in a file of that name, in the temporary folder of the process."""
    import tempfile

    path = Path(tempfile.mkdtemp(dir=incoming.spool())) / name
    incoming.keep(stream, path, name, waits=True)
    return path


LOG, LOGS = Log(), Logs()
OUT = click.Path(path_type=Path)


def option(names: str, help: str, default: Any = None, **more: Any) -> Callable:
    """An option by its names ("--out -o"), its help, and its default, which is shown. more: as of click.option."""
    return click.option(*names.split(), help=help, default=default, show_default=default not in (None, ""), **more)


def flag(names: str, help: str, **more: Any) -> Callable:
    """An option without a value."""
    return click.option(*names.split(), help=help, is_flag=True, **more)


JSON = flag("--json as_json", "Print JSON.")
WATCHED = option("--vehicle", "Vehicle file (TOML) for all watched vehicles.", type=LOG, metavar="FILE")
RECORD = option("--record", "Record every link in this folder as telemetry logs (.tlog).", type=OUT, metavar="DIR")
SPEED = option("--speed", "Replay speed: multiple of real time, or max.", "1", metavar="N|max")
FIGURE = option("--figure", "Draw it.", type=OUT, metavar="OUT.svg")


def label(text: Any) -> str:
    """A name, or a sentence with one, for display: without the folder of a spooled pipe and without control characters."""
    spool = incoming.spooled()
    shortened = str(text) if spool is None else re.sub(re.escape(str(spool)) + r"/[^/]*/", "", str(text))
    return public(printable(shortened))


def say(text: str) -> None:
    """A message to the user, on standard error."""
    click.echo(f"rotorwatch: {label(text)}", err=True)


def debug(context: click.Context, parameter: click.Parameter, on: bool) -> None:
    """Callback of --debug: show tracebacks."""
    if on:
        os.environ["ROTORWATCH_DEBUG"] = "1"


def _hush(context: click.Context, parameter: click.Parameter, on: bool) -> bool:
    """Callback of --quiet: suppress also the warning about missing native code."""
    if on:
        for kind in (BackendWarning, PluginWarning, WorkerWarning):
            warnings.filterwarnings("ignore", category=kind)
    return on


DEBUG = flag("--debug", "Show tracebacks of errors.", expose_value=False, callback=debug)


def common(command: Callable) -> Callable:
    """Options every command has."""
    return flag("--quiet -q", "No progress and no warnings on standard error.", callback=_hush)(DEBUG(command))


def spread(command: Callable) -> Callable:
    """Options of commands with many items: number of processes, or the cluster."""
    jobs = option("--jobs", "Processes; default: one per processor.", type=click.IntRange(1, 256))
    scheduler = option("--scheduler", "Use the workers of this Dask scheduler (docs/cluster.md).", metavar="tcp://HOST:PORT")
    return jobs(scheduler(command))


def resumable(command: Callable) -> Callable:
    """The option --keep of long work that can be interrupted and resumed."""
    text = "Keep finished results in DIR; the same call resumes from it."
    return click.option("--keep", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help=text)(command)


def numbers(option: str, text: str, such: str = "0.2,0.3") -> tuple[float, ...]:
    """Numbers separated by commas; such: an example. Raises ConfigError."""
    try:
        return tuple(float(x) for x in text.split(","))
    except ValueError:
        raise ConfigError(f"{option} {text}: give numbers with commas, as in {such}.") from None


def shares(option: str, text: str) -> tuple[float, ...]:
    """Losses separated by commas. Raises ConfigError unless each is above 0 and below 1."""
    losses = numbers(option, text)
    if not all(0 < x < 1 for x in losses):
        raise ConfigError(f"{option} {text}: a loss must be above 0 and below 1; no vehicle flies on unchanged with a dead rotor.")
    return losses


def findable(*specs: str) -> None:
    """Before methods are looked up: put the current folder on the path for module:Class, as `python` does. Worker processes inherit it."""
    here = os.getcwd()
    if any(":" in spec for spec in specs) and here not in sys.path:
        sys.path.append(here)


def vehicle_of(path: Path | None) -> Any:
    """The Vehicle of a vehicle file; None without one."""
    from rotorwatch.flight.vehicle_file import read

    return read(path) if path else None


def rate(speed: str) -> float:
    """The value of --speed: times real time, infinite for max. Raises ConfigError."""
    try:
        factor = float("inf") if speed == "max" else float(speed)
    except ValueError:
        factor = 0.0
    if not factor > 0.0:
        raise ConfigError(f"--speed {speed}: give a number above 0, or max.")
    return factor


def print_json(value: Any) -> None:
    """A result as JSON on standard output; never NaN or Infinity."""
    click.echo(json.dumps(value, indent=1, allow_nan=False))


def answer(as_json: bool, value: Any, text: str) -> None:
    """A result on standard output: as JSON, or as this text."""
    if as_json:
        print_json(value)
    else:
        click.echo(text)


def written(quiet: bool, **paths: Path | None) -> None:
    """Report the files that were written: what=path."""
    for what, path in paths.items():
        if path and not quiet:
            say(f"{what.replace('_', ' ')} written to {path}")


def show(table: Callable[[Any], Any]) -> None:
    """Print the table that `table` makes with the terminal module, on standard output."""
    from rotorwatch.report import terminal

    screen = terminal.console()
    if screen.is_terminal:
        screen.print(table(terminal), crop=False)
        return
    with screen.capture() as text:  # strip rich's padding of lines, which a file does not need
        screen.print(table(terminal), crop=False)  # a path on a line of its own may be longer
    click.echo("\n".join(line.rstrip() for line in text.get().splitlines()))


def live() -> bool:
    """True if a bar can move on standard error: a terminal with cursor control."""
    dumb = os.environ.get("TERM", "").lower() in ("dumb", "unknown")
    return sys.stderr is not None and sys.stderr.isatty() and not dumb


@contextmanager
def _bar(*columns: Any) -> Iterator[Any]:
    """rich's progress bar on standard error: the task's text, a bar, and these columns."""
    from rich.progress import BarColumn, Progress, TextColumn

    from rotorwatch.report import terminal

    parts = (TextColumn("{task.description}"), BarColumn(), *columns)
    with Progress(*parts, console=terminal.console(stderr=True), transient=True) as bar:
        yield bar


@functools.cache
def _say_once(text: str) -> None:
    say(text)


@contextmanager
def progress(quiet: bool) -> Iterator[Callable | None]:
    """A progress bar on standard error when that is a terminal, else nothing. Yields report(share 0..1, text)."""
    from rotorwatch.base.compiling import toolchain

    if quiet or not live():
        toolchain.waiting = None if quiet else lambda what: _say_once(BUILDING)
        yield None
        return
    from rich.progress import TaskProgressColumn, TimeElapsedColumn

    with _bar(TaskProgressColumn(), TimeElapsedColumn()) as bar:
        task = bar.add_task("reading", total=1.0)
        toolchain.waiting = lambda what: bar.update(task, description="building for this computer, once")

        def report(share: float, text: str = "") -> None:
            bar.update(task, completed=min(max(float(share), 0.0), 1.0), description=text or None)

        yield report


class Counting:
    """Progress without a bar: periodic lines on standard error. Called with the count, the total, and the rate per second."""

    def __init__(self, what: str):
        self.what, self.tenth, self.reported = what, 0, time.monotonic()

    def __call__(self, done: int, total: int, speed: float) -> None:
        tenth = 10 * done // total
        if total >= FEW and speed and tenth > self.tenth and time.monotonic() - self.reported > LINE_S:
            self.tenth, self.reported = tenth, time.monotonic()
            say(f"{done} of {total} {self.what}, {speed:.1f} a second, {(total - done) / speed:.0f} s left")

    def show(self, line: Any) -> None:
        """Print a line of its own on standard error."""
        from rotorwatch.report import terminal

        terminal.console(stderr=True).print(line, soft_wrap=True)


class _CountingBar(Counting):
    """Progress as a bar, with the time left."""

    def __init__(self, what: str, bar: Any):
        super().__init__(what)
        self.bar, self.task = bar, bar.add_task(what, total=None)

    def __call__(self, done: int, total: int, speed: float) -> None:
        text = f"{speed:.1f} {self.what}/s" if speed else self.what
        self.bar.update(self.task, completed=done, total=total, description=text)

    def show(self, line: Any) -> None:
        self.bar.console.print(line, soft_wrap=True)


@contextmanager
def counting(quiet: bool, what: str) -> Iterator[Counting | None]:
    """A bar with the rate of `what` per second and the time left on a terminal; periodic lines elsewhere; None when quiet."""
    if quiet:
        yield None
    elif not live():
        yield Counting(what)
    else:
        from rich.progress import MofNCompleteColumn, TimeRemainingColumn

        with _bar(MofNCompleteColumn(), TimeRemainingColumn()) as bar:
            yield _CountingBar(what, bar)


def drawable(figure: Path) -> None:
    """Check before the work that --figure can be drawn. Raises ConfigError."""
    from rotorwatch.base import files, optional

    files.writable(figure, "--figure")
    if figure.suffix.lower() not in PICTURES:
        raise ConfigError(f"--figure {figure}: give a name that ends in {', '.join(PICTURES[:-1])} or {PICTURES[-1]}.")
    optional.library("matplotlib.figure", "A figure")
