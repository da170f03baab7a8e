"""The command line: arguments in, a table or JSON out. Each command is a function of the same name in the Python API.

Standard output carries the answer and nothing else; progress, warnings and errors go to standard error.
Exit codes: 0 healthy, 1 fault found or crashed, 3 inconclusive or ambiguous only, 2 error.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import io
import os
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from rotorwatch import __version__
from rotorwatch.base import optional
from rotorwatch.base.progress import READ, portion
from rotorwatch.commands import several
from rotorwatch.commands.offered import Commands, Group
from rotorwatch.commands.tools import (
    DEBUG,
    JSON,
    LOG,
    LOGS,
    OUT,
    common,
    findable,
    flag,
    option,
    print_json,
    progress,
    say,
    show,
    spread,
    vehicle_of,
    written,
)
from rotorwatch.errors import BackendWarning, ConfigError, PluginWarning, RotorwatchError, WorkerWarning, lacking

ERROR, STOPPED, BROKEN_PIPE = 2, 128, 141  # stopped: plus the number of the signal
ENDING = "SIGTERM", "SIGHUP"  # signals that end a command as Ctrl-C does, with clean-up
SAMPLES = Path(__file__).parents[1] / "samples"


def main(argv: list[str] | None = None) -> None:
    """Entry point of the `rotorwatch` command; always leaves by SystemExit."""
    # Nearly all objects of a command live until its end, so cyclic garbage collection is of no use. Matrices
    # are small: threads of numerical libraries only cost their start.
    gc.set_threshold(100_000, 20, 50)
    atexit.register(gc.freeze)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if "_ROTORWATCH_COMPLETE" in os.environ:  # set by the shell's completion function
        cli.main(prog_name="rotorwatch")
    if not os.environ.get("ROTORWATCH_DEBUG"):
        warnings.simplefilter("ignore")  # of numerical libraries; a flight's are part of the answer
        for kind in (BackendWarning, PluginWarning):
            warnings.filterwarnings("once", category=kind)
        warnings.filterwarnings("always", category=WorkerWarning)
        warnings.showwarning = lambda message, *where, **more: say(str(message))
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the shell (>&-)
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):  # a character that the terminal lacks must not end the answer
            stream.reconfigure(errors="backslashreplace")
    for name in ENDING:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores it
            with contextlib.suppress(ValueError):  # not the main thread
                signal.signal(number, _stop)
    try:
        code = _run(sys.argv[1:] if argv is None else list(argv))
    except OSError as why:  # the error cannot be printed either
        code = BROKEN_PIPE if isinstance(why, BrokenPipeError) else ERROR
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            # The interpreter would retry unwritten output when it ends, and then end with 120.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(code)


def _run(argv: list[str]) -> int:
    """Run the command and write its output; returns the exit code. Raises OSError where standard error cannot be written to."""
    try:
        try:
            # Not cli.main: it leaves with 1 when a pipe breaks, which here means "fault found".
            with cli.make_context("rotorwatch", argv) as context:
                cli.invoke(context)
            code = 0
        except click.exceptions.Exit as leave:
            code = leave.exit_code
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader (head, less) has closed
        return BROKEN_PIPE
    except (KeyboardInterrupt, click.Abort) as why:
        say("interrupted")
        return STOPPED + (why.number if isinstance(why, Stopped) else signal.SIGINT)
    except click.ClickException as why:
        why.show()
        argument = next((a for a in sys.argv[1:] if a.startswith("-") and Path(a).is_file()), None)
        if isinstance(why, click.NoSuchOption) and argument:
            say(f"the file {argument} begins with a dash: write ./{argument}")
        return why.exit_code
    except Exception as why:
        say(explain(why))
        return ERROR


class Stopped(KeyboardInterrupt):
    """Ended by a signal other than Ctrl-C's."""

    def __init__(self, number: int):
        super().__init__()
        self.number = number


def _stop(number: int, frame: Any) -> None:
    raise Stopped(number)


def explain(why: Exception) -> str:
    """A sentence for any exception: its own if it was raised on purpose, else a request to report it."""
    if os.environ.get("ROTORWATCH_DEBUG"):
        import traceback

        traceback.print_exc()
    if isinstance(why, RotorwatchError):
        return str(why)
    if missing := lacking(why):
        return missing
    if isinstance(why, OSError) and why.filename:
        return f"{why.filename}: {why.strerror}."
    if isinstance(why, OSError) and why.errno:
        return f"Reading or writing failed: {why.strerror}."
    if isinstance(why, MemoryError):
        return "Out of memory; try a shorter log."
    text = " ".join(f"{type(why).__name__}: {why}".split())[:200]
    return f"Internal error of rotorwatch ({text}); please report it with the output of the same command with --debug."


ELSEWHERE = {"export-c": "export", "fleet": "fleet_flights", "mcp": "mcp", "new": "new", "serve": "serve", "watch": "watching"}
"""Name of a command -> the file that it is in."""


@click.group(cls=Group, commands=Commands(ELSEWHERE), context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="rotorwatch", message="%(prog)s %(version)s")
@DEBUG
def cli() -> None:
    """Diagnose multirotor flight logs: which rotor lost effectiveness, how much, since when and how certain that is.

    New here? Run `rotorwatch demo`, then `rotorwatch diagnose YOUR.LOG --report report.html`.
    """


@cli.command(short_help="Diagnose flights: verdict, rotors, events.")
@click.argument("logs", nargs=-1, required=True, type=LOGS, metavar="LOG...")
@option("--baseline baselines", "A healthy flight of the same build.", multiple=True, type=LOG, metavar="LOG")
@option("--vehicle", "Vehicle file (TOML), as `rotorwatch calibrate` writes it.", type=LOG, metavar="FILE")
@option("--estimator", "Estimator to use.", "default", metavar="NAME")
@option("--tuning", "Tuning of a published estimator (TOML), as `rotorwatch tune` writes it.", type=LOG, metavar="FILE")
@option(
    "--matters", "Loss of one rotor, 0 to 1, that `healthy` must rule out; where more could go undetected, the verdict is inconclusive.",
    0.2, type=click.FloatRange(0, 1, min_open=True), metavar="X",
)  # fmt: skip
@option("--report", "Write an HTML report; for several logs a folder or {name}.html.", type=OUT, metavar="OUT.html")
@option("--html", "Write a report for each log and a page that lists them.", type=OUT, metavar="DIR")
@option("--mcap", "Write an MCAP file for Foxglove or PlotJuggler; for several logs as --report.", type=OUT, metavar="OUT.mcap")
@option("--parquet", "Write tables of flights, ticks, losses and events as Parquet files (docs/parquet.md).", type=OUT, metavar="DIR")
@option(
    "--markdown",
    "Write Markdown for a forum or an issue, and a picture beside it; without FILE.md, or for -, on standard output.",
    is_flag=False,
    flag_value="-",
    type=OUT,
    metavar="[FILE.md]",
)
@flag("--identify", "With --markdown: include the serial number, the time of day, and unedited texts of the log.")
@flag("--line", "Print one line for a forum, without private data.")
@flag("--verbose", "Print all details: events, other checks, assumptions, blind times.")
@flag("--json as_json", "Print JSON (docs/json.md): an object, or a list for several logs.")
@flag("--jsonl", "Print JSON lines: one per log, as soon as it is diagnosed.")
@option("-o --out", "With --jsonl: file to append to.", type=OUT, metavar="FILE")
@flag("--resume", "Resume FILE: skip unchanged logs that already have a line.")
@spread
@common
@click.pass_context
def diagnose(context, **options) -> None:
    """Diagnose each LOG: PX4 .ulg, ArduPilot .bin/.log, Betaflight and INAV .bbl, MAVLink .tlog, ROS 2 bag, CSV, also .xz and .gz; - is
    standard input. A folder stands for all logs in it, a file for all flights in it; also quoted patterns, and addresses such as
    s3://BUCKET/FOLDER/ (docs/cluster.md).

    Exit code: 0 healthy, 1 fault found or crashed, 3 inconclusive or ambiguous only, 2 error; of several logs the worst.
    """
    from rotorwatch import gathering
    from rotorwatch.base import files

    request = several.Request(**options)
    findable(request.estimator)
    if request.as_json + request.jsonl + request.line > 1:
        raise ConfigError("--json, --jsonl and --line exclude each other; give one.")
    if (request.out or request.resume) and not (request.jsonl and request.out):
        raise ConfigError("--out and --resume belong to --jsonl: write --jsonl -o FILE, and --resume to continue it.")
    _check_markdown(request)
    if request.parquet and request.resume:
        raise ConfigError("--parquet and --resume exclude each other: the tables would lack the logs of earlier calls.")
    several_ways = request.jsonl or request.html or request.scheduler or request.parquet
    many = len(request.logs) > 1 or bool(several_ways) or gathering.is_several(request.logs[0])
    gathered = gathering.Gathered(request.logs)
    logs = gathering.Found(gathered) if many else request.logs
    pages, recordings = report_paths(logs, request.report), report_paths(logs, request.mcap, "--mcap", ".mcap")
    posts, document = _post_paths(logs, request.markdown)
    if pages or request.html:
        optional.library("bokeh", "--report" if pages else "--html")
    if recordings:
        optional.library("mcap", "--mcap")
    request = request._replace(logs=logs, pages=pages, recordings=recordings, posts=posts, document=document, others=gathered.others)
    if request.tuning:
        from rotorwatch.base import discovery

        tune = discovery.first("rotorwatch.api", "A tuning of a published estimator", "tune")
        request = request._replace(tuned=tune.read(request.tuning, request.estimator))
    if not many:
        context.exit(_diagnose(request))
    out = files.writable(request.out, "--out", make=True) if request.out else None
    html = files.folder(request.html, "--html") if request.html else None
    context.exit(several.diagnose(request._replace(out=out, html=html), explain))


def _diagnose(request: several.Request) -> int:
    """`rotorwatch diagnose` of one log; returns the exit code."""
    from rotorwatch.diagnose_many import timed
    from rotorwatch.witnesses.healthy.baselines import Candidate

    vehicle = vehicle_of(request.vehicle)
    with progress(request.quiet) as report:
        healthy = tuple(Candidate(_read(path, report), vehicle) for path in request.baselines)
    with progress(request.quiet) as report:
        result = timed(
            lambda: _read(request.logs[0], portion(report, 0.0, READ)),
            vehicle,
            healthy,
            request.estimator,
            request.tuned,
            request.matters,
            report,
        )
    if request.pages:
        result.to_html(request.pages[0])
    if request.recordings:
        result.to_mcap(request.recordings[0])
    post = next(iter(request.posts), request.document)
    if post and not request.to_stdout:
        from rotorwatch.report import markdown

        why = markdown.write(result, post, request.identify).why
        if why and not request.quiet:
            say(f"No picture beside {post}: {why}")
    if request.as_json:
        click.echo(result.to_json())
    elif request.line:
        click.echo(result.to_line())
    elif request.to_stdout:
        click.echo(result.to_markdown(identify=request.identify), nl=False)
    else:
        show(lambda terminal: terminal.diagnosis(result, request.verbose))
        files = (next(iter(paths), None) for paths in (request.pages, request.recordings))
        written(request.quiet, **dict(zip(("report", "MCAP_file"), files)), post=post)
    return result.exit_code


def _check_markdown(request: several.Request) -> None:
    """Raises ConfigError for --markdown and --identify with incompatible options."""
    if request.identify and not request.markdown:
        raise ConfigError("--identify needs --markdown.")
    if request.to_stdout and (request.as_json or (request.jsonl and not request.out)):
        raise ConfigError("--markdown and JSON cannot both go to standard output: write --markdown FILE.md.")


def _post_paths(logs: Sequence[Any], out: Path | None) -> tuple[list[Path], Path | None]:
    """(a post for each log, the post of all): --markdown FILE.md is one post of all logs, a folder or a name with {name} one each."""
    if out is None or str(out) == "-":
        return [], out
    from rotorwatch.base import files
    from rotorwatch.report.markdown import ENDINGS

    each = "{name}" in str(out) or out.is_dir()
    if not out.is_dir() and out.suffix.lower() not in ENDINGS:  # a log after the option would be overwritten
        raise ConfigError(f"--markdown {out}: give a name that ends in .md; --markdown - writes to standard output.")
    if each:
        return report_paths(logs, out, "--markdown", ".md"), None
    return [], files.writable(out, "--markdown", make=True)


def report_paths(logs: Sequence[Any], out: Path | None, option: str = "--report", ending: str = ".html") -> list[Path]:
    """Path of each log's page: OUT, OUT/NAME.html in a folder, or OUT with {name} filled in; never the same twice."""
    from rotorwatch.base import files

    if out is None:
        return []
    several = len(logs) > 1
    if "{name}" not in str(out) and (out.is_dir() or (several and not out.suffix)):
        out = out / f"{{name}}{ending}"
    if several and "{name}" not in str(out):
        raise ConfigError(f"{option} {out} names one file for {len(logs)} logs; give a folder, or a name with {{name}} in it.")
    pages: list[Path] = []
    for log in logs:
        name = log.name if isinstance(log, Path) else log.rstrip("/").rpartition("/")[2]
        stem = name.removesuffix(".xz").removesuffix(".gz").rpartition(".")[0] or name
        page, n = Path(str(out).replace("{name}", stem)), 1
        while page in pages:
            n += 1
            page = Path(str(out).replace("{name}", f"{stem}-{n}"))
        pages.append(page)
    return [files.writable(page, option, make=True) for page in pages]


@cli.command(short_help="Learn a vehicle file from healthy flights.")
@click.argument("logs", nargs=-1, required=True, type=LOG, metavar="LOG...")
@option("-o --out", "Vehicle file to write.", required=True, type=OUT, metavar="vehicle.toml")
@common
def calibrate(logs, out, quiet) -> None:
    """Learn the healthy behaviour of a build from its healthy flights and write a vehicle file.

    Give the file to `rotorwatch diagnose --vehicle` later.
    """
    from rotorwatch.base import files
    from rotorwatch.calibrate import calibrate as run
    from rotorwatch.flight.vehicle_file import write

    files.writable(out, "--out")
    with progress(quiet) as report:
        learned = run([_read(path, report) for path in logs], progress=report)
    write(learned, out)
    for sentence in learned.assumptions:
        if ("was set aside" in sentence or "does not hover" in sentence) and not quiet:
            say(sentence)
    count = (learned.identified or {}).get("flights", len(logs))
    click.echo(f"{learned.name}: learned from {count} {'flight' if count == 1 else 'flights'}, written to {out}")


@cli.command(short_help="Show which signals a log has and lacks.")
@click.argument("log", type=LOG)
@JSON
@common
def info(log, as_json, quiet) -> None:
    """Show the signals in LOG, those missing for a diagnosis, and the logging settings that would record them."""
    from rotorwatch.report.info import info as run

    with progress(quiet) as report:
        facts = run(_read(log, portion(report, 0.0, 0.6)), portion(report, 0.6, 1.0))
    if as_json:
        print_json(facts)
    else:
        show(lambda terminal: terminal.info(facts))


@cli.command(short_help="Diagnose the sample flights.")
@option("--report", "Also write the faulty flight's HTML page.", type=OUT, metavar="OUT.html")
@common
def demo(report, quiet) -> None:
    """Diagnose the sample flights that come with rotorwatch, and explain the output."""
    from rotorwatch.diagnose import diagnose as run

    samples = sorted(SAMPLES.glob("*.bin.xz"), key=lambda p: ("healthy" not in p.name, p.name))
    if not samples:
        raise ConfigError("This installation has no sample flights; reinstall rotorwatch.")
    page = report_paths((samples[-1],), report)
    if page:
        optional.library("bokeh", "--report")
    for sample in samples:
        with progress(quiet) as advance:
            result = run(_read(sample, advance), progress=advance)
        click.echo(f"$ rotorwatch diagnose {sample.name}\n")
        show(lambda terminal, r=result: terminal.diagnosis(r))
        click.echo("")
        if page and sample is samples[-1]:
            result.to_html(page[0])
    click.echo(
        "How to read this: the word in capitals is the verdict. The rotor table shows how much\n"
        "thrust each rotor has lost, with its 95 % interval; the line below it says since when.\n"
        "`rotorwatch diagnose --verbose` also shows all events."
    )
    if page:
        click.echo(f"Report of the faulty flight: {page[0]} (open it in a browser; it needs no network).")
    else:
        click.echo("For an interactive page: rotorwatch demo --report rotorwatch-demo.html")


def _read(path: Any, report: Callable | None) -> Any:
    from rotorwatch.diagnose_many import read

    return read(path, report)


if __name__ == "__main__":
    main()
