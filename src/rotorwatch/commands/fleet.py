"""The commands of a fleet: flights into a store, and the state of every aircraft from all of them."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NoReturn

import click

from rotorwatch.commands.offered import Commands
from rotorwatch.commands.tools import LOG, OUT, common, flag, label, live, option, print_json, progress, say, show, spread, vehicle_of
from rotorwatch.errors import ConfigError

ADDED, FAILED = 0, 2
REFUSED_SHOWN = 5  # names in a line
STYLES = {"fault": "bold red", "crashed": "bold red", "suspect": "yellow", "ambiguous": "yellow", "healthy": "green"}
JSON = flag("--json as_json", "Print JSON (docs/fleet.md).")


def _store(make: bool) -> Callable:
    """The option --store of a command, which passes the named store as `store`; make: whether a missing one is created."""
    text = "SQLite file or postgresql://USER@HOST/DATABASE; default: a file in your data folder."
    add_option = option("--store url", text, envvar="ROTORWATCH_STORE", metavar="FILE|URL")

    def around(command: Callable) -> Callable:
        @functools.wraps(command)
        def with_store(url, **options):
            from rotorwatch.fleet.store import Store

            with Store(url or None, make=make) as store:
                command(store, **options)

        return add_option(with_store)

    return around


STORE = _store(make=False)


@click.group(commands=Commands({}, "fleet"), short_help="Store flights and track every rotor of a fleet over time.")
def fleet() -> None:
    """Store flights, and report for every aircraft which rotor is losing thrust, since when, and when to replace it.

    Start with `rotorwatch fleet add FOLDER`, then `rotorwatch fleet list` (docs/fleet.md).
    """


@fleet.command(short_help="Diagnose logs and add them to the store.")
@click.argument("logs", nargs=-1, required=True, metavar="LOG|DIR...")
@option("--aircraft", "Aircraft, for logs that do not name it.", "", metavar="NAME")
@option("--vehicle", "Vehicle file (TOML), for logs that do not name their frame.", type=LOG, metavar="FILE")
@flag("--follow", "Then watch the folders and add new logs until interrupted.")
@option("--mqtt", "Publish new flights and the state of each aircraft to this MQTT broker.", metavar="URL", envvar="ROTORWATCH_MQTT")
@option(
    "--webhook", "With --follow: POST an alert as JSON to this address (docs/fleet.md#alerts).", metavar="URL", envvar="ROTORWATCH_WEBHOOK"
)
@spread
@_store(make=True)
@common
def add(store, logs, aircraft, vehicle, follow, mqtt, webhook, jobs, scheduler, quiet) -> None:
    """Diagnose every LOG, and all logs in every DIR, that the store does not have yet (by content), and assess each aircraft.

    After an interruption, even a lost database, the same command resumes. Exit code: 0, or 2 when a log could not be diagnosed; one in
    a DIR that failed before is named, and retried when it or rotorwatch has changed, or when it is given by itself.
    """
    from rotorwatch.fleet import add as run
    from rotorwatch.fleet import assess

    known = vehicle_of(vehicle)
    folders = [Path(one) for one in logs if Path(one).is_dir()]
    if follow and not folders:
        raise ConfigError("--follow watches folders; give at least one.")
    broker = None
    if mqtt:
        from rotorwatch.fleet.publish import Publisher

        broker = Publisher(mqtt, say)
        click.get_current_context().call_on_close(broker.leave)

    def tell(outcome) -> None:
        _print_outcome(outcome)
        if broker:
            broker.outcome(outcome)

    def assessed(store) -> None:
        if broker:
            broker.aircraft(store)

    if webhook and follow:
        from rotorwatch.live.channels import webhook as posts

        posts.checked(webhook)
    with progress(quiet or not live()) as report:
        outcomes, others = run.add(store, logs, aircraft, known, tell, report, jobs, scheduler)
        if any(a["stale"] for a in store.aircraft()):
            assess.refresh(store, report)
    assessed(store)
    count = {state: sum(t.state == state for t in outcomes) for state in ("added", "known", "failed")}
    if not quiet:
        parts = [f"{count['added']} added"]
        parts += [f"{count['known']} known already"] if count["known"] else []
        parts += [f"{others} files that are not logs"] if others else []
        parts += [f"{count['failed']} could not be diagnosed"] if count["failed"] else []
        say(f"{', '.join(parts)}; {store.count()} flights in {store.label}")
        _say_refused([label(Path(t.path).name) for t in outcomes if t.state == "refused"])
        lost = sum(t.state == "added" and not t.aircraft for t in outcomes)
        if lost:
            say(f"{lost} of them name no aircraft and belong to no history: add such logs with --aircraft NAME to an empty store.")
    if follow:
        if not quiet:
            say(f"watching {', '.join(map(str, folders))}; Ctrl-C stops it")
        outlet = None
        if webhook:
            from rotorwatch.live.channels.webhook import Webhook

            outlet = Webhook(webhook, say)
        try:
            run.follow(store, folders, aircraft, known, tell, say, assessed=assessed, alert=lambda reported: _alert(reported, outlet))
        finally:
            if outlet:
                outlet.leave()
    click.get_current_context().exit(FAILED if count["failed"] else ADDED)


def _alert(reported: Mapping, outlet) -> None:
    """Print and post an alert of `fleet.add.follow`."""
    if reported["type"] == "aircraft":
        say(f"{reported['aircraft']} is {reported['state']} now, it was {reported['was']}: {reported['headline']}")
    if outlet:
        outlet.take(dict(reported))
        outlet.step()


def _say_refused(names: list[str]) -> None:
    if names:
        listed = ", ".join(names[:REFUSED_SHOWN]) + (f" and {len(names) - REFUSED_SHOWN} more" if names[REFUSED_SHOWN:] else "")
        say(f"{len(names)} could not be diagnosed before and, unchanged, were not retried: {listed}; give one by itself to see why.")


def _print_outcome(outcome) -> None:
    name = label(Path(outcome.path).name)
    if outcome.state == "failed":
        say(outcome.text if name in outcome.text else f"{name}: {outcome.text}")
    elif outcome.state == "added":
        click.echo(f"{outcome.verdict:<13}{outcome.aircraft or '(no aircraft)'}  {name}  {outcome.text}")


@fleet.command("show", short_help="Show one aircraft: every rotor, what changed and when.")
@click.argument("aircraft")
@STORE
@JSON
@common
def show_(store, aircraft, as_json, quiet) -> None:
    """Show the state of each rotor of AIRCRAFT (its name, key or serial number) over its flights."""
    key = store.find(aircraft)["key"]
    (found,) = [a for a in store.aircraft() if a["key"] == key]
    if as_json:
        print_json(found | {"points": store.points(key)})
        return
    assessment = found["standing"]
    click.echo(f"{found['name']}: {found['flights']} flights, {found['airborne_s'] / 3600:.1f} h in the air; {found['build']}")
    click.echo(f"known by: {'; '.join(found['identities'])}")
    if assessment is None:
        click.echo("Not assessed yet: run `rotorwatch fleet assess`.")
        return
    if last := assessment.get("last"):
        click.echo(f"last flight: {last['verdict']}, {label(last['name'])}, {day(last['utc'])}")
    click.echo(f"\n{assessment['headline']}\n")
    rows = []
    for r in assessment["rotors"]:
        loss, low, high = (f"{100 * v:.1f}" for v in (r["loss"], *r["interval"]))
        rows.append((str(r["rotor"]), r["status"], f"{loss} %", f"{low} to {high} %", _outlook(r["prognosis"])))
    table("", ("rotor", "state", "lost", "95 %", "outlook"), rows, right=(0, 2, 3))
    for c in assessment["changes"]:
        click.echo(_change_text(c))
    for s in assessment["services"]:
        what = f"rotor {s['rotor']}" if s["rotor"] else "the whole aircraft"
        click.echo(f"service before flight {s['before_flight']}: {what}, {s['what']}")
    many, sisters = len(assessment["left_out"]), assessment["sisters"]
    compared = f"compared with {sisters} of the same build" if sisters else "no others of the same build to compare with"
    click.echo(f"\n{assessment['used']} of {assessment['flights']} flights were used; {compared}.")
    for one in assessment["left_out"][:5]:
        click.echo(f"  not used: {label(one['name'])}: {one['why']}")
    if many > 5:
        click.echo(f"  and {many - 5} more")


def _change_text(c: dict) -> str:
    first, last = c["between"]
    when = f"flight {c['flight']}" + (f" ({first} to {last})" if first != last else "")
    when += f", {day(c['utc'])}" if c["utc"] else ""
    if c["from_the_first"]:
        when = "the first flight"
    if c["kind"] == "centre of mass":
        return f"centre of mass shifted at {when}"
    others = [x for x in c["candidates"] if x["rotor"] != c["rotor"] and x["probability"] > 0.05]
    instead = [f"rotor {x['rotor']}" if x["rotor"] else "the centre of mass" for x in others]
    doubt = f"; or {' or '.join(instead)}" if instead else ""
    size = f"{100 * abs(c['size']):.1f} %" + (" an hour in the air" if c["kind"] == "wear" else "")
    return f"{c['kind']} of rotor {c['rotor']}: {size} from {when} on{doubt}"


def _outlook(p: dict | None) -> str:
    if not p or p["word"] == "no trend":
        return "no trend"
    if p["word"] == "reached":
        return f"{100 * p['limit']:.0f} % reached"
    low, high = p["hours_left_interval"]
    until = f"{low:.1f} to {high:.1f} h" if high is not None else f"{low:.1f} h or later"
    return f"{100 * p['limit']:.0f} % in {p['hours_left']:.1f} h ({until}), about {p['flights_left']} flights"


def day(utc: str | None) -> str:
    """A time of the store, in minutes."""
    return utc[:16].replace("T", " ") if utc else "-"


@fleet.command(short_help="Record maintenance, which restarts a rotor's history.")
@click.argument("aircraft")
@click.argument("what")
@option("--rotor", "Rotor number; default: all.", type=click.IntRange(1), metavar="N")
@option("--at", "Time in UTC: 2026-05-01 or 2026-05-01T14:30; default: after its last flight.", metavar="TIME")
@option("--after", "After this flight (first digits of its hash), for logs without a time.", metavar="FLIGHT")
@STORE
@common
def service(store, aircraft, what, rotor, at, after, quiet) -> None:
    """Record that WHAT ("new propeller") was done to AIRCRAFT: the rotor's history restarts there."""
    from rotorwatch.fleet import assess, listing

    if at and after:
        raise ConfigError("Give --at or --after, not both.")
    utc = listing.moment("--at", at)[0] if at else ""
    number = None
    if after:
        flight = store.flight(after) or unknown(after)
        number = flight["ordinal"]
    row = store.service(aircraft, rotor or 0, what, utc, number)
    assess.refresh(store)
    name = store.find(row["aircraft"])["name"]
    who = f"rotor {rotor}" if rotor else "all rotors"
    when = day(utc) if utc else f"after flight {after}" if after else "after its last flight"
    click.echo(f"{name}: {who}, {what}, {when}")


def unknown(hash: str) -> NoReturn:
    """Raises ConfigError for a hash without a flight."""
    raise ConfigError(f"{label(hash)}: the store holds no flight, or several, with such a hash; `rotorwatch fleet list --flights`.")


@fleet.command(short_help="Rename an aircraft.")
@click.argument("aircraft")
@click.argument("name")
@STORE
@common
def rename(store, aircraft, name, quiet) -> None:
    """Rename AIRCRAFT to NAME; its serial number still finds it."""
    store.rename(aircraft, name)
    click.echo(f"{aircraft} is called {name} now")


@fleet.command(short_help="Merge two entries of one aircraft, for example after an autopilot swap.")
@click.argument("aircraft")
@click.argument("other")
@STORE
@common
def merge(store, aircraft, other, quiet) -> None:
    """Merge the flights and services of OTHER into AIRCRAFT, now and for all future logs."""
    from rotorwatch.fleet import assess

    store.merge(aircraft, other)
    assess.refresh(store)
    click.echo(f"{other} is part of {aircraft} now")


@fleet.command(short_help="Assess every aircraft again.")
@STORE
@common
def assess(store, quiet) -> None:
    """Assess every aircraft of the store again; `add`, `service` and `merge` do so automatically."""
    from rotorwatch.fleet import assess as run

    with progress(quiet) as report:
        run.refresh(store, report)
        click.echo(f"{len(store.aircraft())} aircraft assessed")


@fleet.command(short_help="Diagnose flights again with this version and show what changed.")
@flag("--all every", "Include flights that this version has diagnosed.")
@option("--aircraft", "Only of this aircraft.", metavar="NAME")
@spread
@STORE
@JSON
@common
def reassess(store, every, aircraft, jobs, scheduler, as_json, quiet) -> None:
    """Diagnose the store's flights again from their logs, where these still exist, and show what changed."""
    from dataclasses import asdict

    from rotorwatch.fleet import add as run
    from rotorwatch.fleet import assess

    with progress(quiet) as report:
        count, changes = run.reassess(store, every, aircraft, report, jobs, scheduler)
        assess.refresh(store, report)
    if as_json:
        print_json({"assessed": count, "changes": [asdict(c) for c in changes]})
        return
    for c in changes:
        text = f"kept as it was: {c.lost}" if c.lost else f"{c.before[0]} -> {c.after[0]}: {c.after[1]}"
        click.echo(f"{c.aircraft or '(no aircraft)'}  {label(c.name)}  {text}")
    changed = sum(not c.lost for c in changes)
    click.echo(f"{count} diagnosed again, {changed} changed")


@fleet.command(short_help="Write pages of the fleet and of each aircraft.")
@option("-o --out", "Folder; created if missing.", required=True, type=OUT, metavar="DIR")
@STORE
@common
def report(store, out, quiet) -> None:
    """Write DIR/index.html and a page for each aircraft, which need no network."""
    from rotorwatch.fleet import fleet_pages

    paths = fleet_pages.write(store, out)
    click.echo(f"{len(paths)} pages written; begin with {paths[0]}")


@fleet.command(short_help="Export the store as Parquet files.")
@option("-o --out", "Folder; created if missing.", required=True, type=OUT, metavar="DIR")
@STORE
@common
def export(store, out, quiet) -> None:
    """Write flights, aircraft, rotors and services as Parquet files (extra `parquet`)."""
    from rotorwatch.fleet import csv_export as run

    paths = run.export(store, out)
    click.echo("\n".join(map(str, paths)))


def table(
    title: str,
    head: tuple[str, ...],
    rows: list[tuple[str, ...]],
    right: tuple[int, ...] = (),
    wide: tuple[int, ...] = (-1,),
    styles: Mapping[str, str] = {},
) -> None:
    """A table that fits the terminal. right: columns of numbers; wide: columns that are wrapped; styles: of cells of these words."""
    from rich.text import Text

    clean = [[Text(re.sub(r"[\x00-\x1f\x7f]", " ", str(cell)), style=styles.get(str(cell), "")) for cell in row] for row in rows]
    show(lambda terminal: terminal.Fitted(title, head, clean, right, wide))
