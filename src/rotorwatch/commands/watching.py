"""The command that assesses vehicles while they fly."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from typing import Any

import click

from rotorwatch.commands.tools import LOG, RECORD, SPEED, WATCHED, common, flag, label, option, progress, rate, say, vehicle_of
from rotorwatch.errors import ConfigError

FAULT, ERROR, NOTHING = 1, 2, 3


def _channels(command: Callable) -> Callable:
    """The options of all channels (live/channels/)."""
    from rotorwatch.live.channels import found

    for channel in reversed(found()):
        about = channel.OPTION
        more = {"metavar": about.metavar, "envvar": about.envvar or None, "show_envvar": bool(about.envvar)} if about.metavar else {}
        command = (option if about.metavar else flag)(about.name, about.help, **more)(command)
    return command


class Node(click.Command):
    """A command that may be started as a node of ROS 2."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """What follows --ros-args is ROS's, which takes it from the process."""
        return super().parse_args(ctx, args[: args.index("--ros-args")] if "--ros-args" in args else args)


@click.command(cls=Node, short_help="Diagnose vehicles in flight.")
@click.argument("endpoints", nargs=-1, required=True, metavar="ENDPOINT...")
@SPEED
@WATCHED
@RECORD
@flag("--listen-only", "Send nothing: request neither parameters nor rates.")
@click.option("--seconds", type=float, default=math.inf, metavar="S", help="Stop after this time.")
@option("--patience", "Time to wait for the first vehicle on a link.", 30.0, type=float, metavar="S")
@_channels
@flag("--jsonl", "Print alerts as JSON lines (docs/watch.md) instead of the display.")
@common
def watch(endpoints, speed, vehicle, record, listen_only, seconds, patience, jsonl, quiet, **channels) -> None:
    """Diagnose vehicles in flight. ENDPOINT: udp:PORT, udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD, or a
    recorded log, which is replayed in real time.

    Exit code, once all endpoints have ended: 0 no event, 1 a fault was found, 3 nothing could be assessed, 2 error.
    """
    from rotorwatch.live.endpoint import is_endpoint, open_endpoint

    # Open endpoints before slow imports, so that packets of the meantime are buffered.
    opened = {}
    for endpoint in filter(is_endpoint, endpoints):
        opened[endpoint] = open_endpoint(endpoint)
        click.get_current_context().call_on_close(opened[endpoint].close)
    from rotorwatch.live.guard import Guard
    from rotorwatch.live.link import Link
    from rotorwatch.live.watch import Guarded
    from rotorwatch.live.watch import watch as run

    pace, known = rate(speed), vehicle_of(vehicle)
    display = _lines if jsonl else (lambda alert: None) if _screen() else _sentences(quiet)
    sources: list[Any] = []
    outlets = _outlets(channels, listen_only, display)
    background = Guard(say)
    unread: list[OSError] = []

    def publish(alert: dict) -> None:
        if not unread or not isinstance(unread[0], BrokenPipeError):
            try:
                display(alert)
            except OSError as why:  # the reader has closed, or the disk is full: raised at the end
                unread.append(why)
                del unread[1:]
        for outlet in outlets:
            background.run(type(outlet).__name__.lower(), outlet.take, alert)

    def reader_gone() -> bool:
        """True if the reader of standard output (head) has closed, and the results go nowhere else."""
        return bool(unread) and isinstance(unread[0], BrokenPipeError) and not outlets and record is None

    try:
        for endpoint in endpoints:
            if endpoint in opened:
                sources.append(Link(opened[endpoint], publish, known, record, not listen_only, patience))
            else:
                sources.append(_replay(endpoint, publish, known, pace, quiet))
    except BaseException:
        for left in (*sources, *outlets):
            left.leave()
        raise
    guarded = [Guarded(name, source, publish) for name, source in zip(endpoints, sources)]
    if jsonl or not _screen():
        run(guarded, None, seconds, outlets, background, reader_gone)
    else:
        _drawn(lambda show: run(guarded, show, seconds, outlets, background, reader_gone))
    if unread:
        raise unread[0]
    code = _code([v for source in sources for v in source.vehicles])
    ended = next((source.why for source in guarded if source.why is not None), None)
    if code != FAULT and ended is not None and (jsonl or quiet or _screen()):
        raise ended
    if code != FAULT and (ended or background.failed or any(getattr(source, "trouble", "") for source in sources)):
        code = ERROR
    raise click.exceptions.Exit(code)


def _outlets(values: dict[str, Any], listen_only: bool, shown) -> list[Any]:
    """Destinations of alerts besides the screen. values: of the channels' options."""
    from rotorwatch.live.channels import found

    outlets: list[Any] = []
    try:
        for channel in found():
            name, value = channel.OPTION.name, values[channel.OPTION.key]
            if not value:
                continue
            if channel.OPTION.sends and listen_only:
                raise ConfigError(f"{name} sends and --listen-only forbids it; leave out one of them.")
            who = name.lstrip("-")
            outlets.append(channel.opened(value, lambda text, who=who: shown({"type": "notice", "vehicle": who, "text": text})))
    except BaseException:
        for outlet in outlets:
            outlet.leave()
        raise
    return outlets


def _screen() -> bool:
    """True if standard output can show a live table."""
    dumb = os.environ.get("TERM", "").lower() in ("dumb", "unknown", "")
    return sys.stdout is not None and sys.stdout.isatty() and not dumb


def _drawn(run) -> None:
    """Run with a live table of all vehicles."""
    from rich.live import Live

    from rotorwatch.live.view import table
    from rotorwatch.report import terminal

    with Live(console=terminal.console(), auto_refresh=False, vertical_overflow="crop") as picture:
        run(lambda sources: picture.update(table(sources), refresh=True))


def _replay(endpoint: str, publish, known, speed: float, quiet: bool) -> Any:
    from rotorwatch.live.endpoint import KINDS
    from rotorwatch.live.replay import Replay
    from rotorwatch.live.watched import Watched
    from rotorwatch.logs import read

    path = LOG.convert(endpoint, None, None)
    if not path.exists():
        raise ConfigError(f"{endpoint}: no such log; give a log file, or an endpoint: {KINDS}.")
    with progress(quiet) as report:
        flight = read(path, report)
    return Replay(flight, Watched(label(path.name), publish, known), speed)


def _lines(alert: dict) -> None:
    """Alerts for programs."""
    from rotorwatch.live.guard import as_json

    click.echo(as_json(alert))


def _sentences(quiet: bool):
    """Alerts as sentences, where no live table can be drawn."""
    from rotorwatch.live.ground import gist, worth_sending
    from rotorwatch.live.view import announced

    printed: dict[tuple[str, int], tuple] = {}  # (vehicle, event) -> its last printed state

    def show(alert: dict) -> None:
        if alert["type"] == "vehicle":  # a new flight restarts the numbers of events
            for key in [key for key in printed if key[0] == alert["vehicle"]]:
                del printed[key]
        elif alert["type"] == "event":
            key = alert["vehicle"], alert["number"]
            if alert["state"] != "changed" or worth_sending(printed.get(key), alert):
                printed[key] = gist(alert)
                click.echo(f"{alert['vehicle']}: {announced(alert)}")
        elif not quiet:
            say(alert["text"] if alert["vehicle"] in alert["text"] else f"{alert['vehicle']}: {alert['text']}")

    return show


def _code(vehicles) -> int:
    faults = [e for v in vehicles for e in v.events if e.means.wrong]
    if any(e.means.accuses or e.rotors for e in faults):
        return FAULT
    open_ = any(v.trouble or v.session is None or v.session.doubt or not v.session.assessed for v in vehicles)
    return NOTHING if not vehicles or open_ or faults else 0
