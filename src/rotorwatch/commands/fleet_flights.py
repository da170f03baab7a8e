"""The commands of a fleet that list, compare and delete its flights; the list is one of aircraft by default."""

from __future__ import annotations

import sys
from contextlib import suppress

import click

from rotorwatch.commands.fleet import JSON, STORE, STYLES, day, fleet, table, unknown
from rotorwatch.commands.tools import common, flag, label, option, print_json, say
from rotorwatch.errors import ConfigError, StoreError


@fleet.command("list", short_help="List aircraft, those that need attention first, or flights.")
@flag("--flights", "List flights; implied by any option for flights.")
@option("--search", "Flights: words in name, verdict, headline or aircraft.", "", metavar="WORDS")
@option("--verdict", "Flights: healthy, fault, crashed, ambiguous, inconclusive; several with commas.", "", metavar="VERDICT,...")
@option("--aircraft", "Flights: only of this aircraft.", metavar="NAME")
@option("--since", "Flights: on this day or later, in UTC; also yesterday.", "", metavar="TIME")
@option("--until", "Flights: on this day or earlier, in UTC.", "", metavar="TIME")
@option("--min-loss", "Flights: worst loss at least this share, 0..1.", 0.0, metavar="X")
@option("--min-duration", "Flights: minimum duration.", 0.0, metavar="S")
@option("--sort", "Flights: by date, verdict, loss, duration, aircraft or name; a leading - reverses the order.", "-date", metavar="ORDER")
@option("--limit", "Flights: maximum number.", 50, type=click.IntRange(1))
@option("--offset", "Flights: number to skip.", 0, type=click.IntRange(0))
@STORE
@JSON
@common
def list_(store, flights, sort, limit, offset, as_json, quiet, **filters) -> None:
    """List the aircraft of the store, those that need attention first, or its flights.

    state: fault (a rotor has lost thrust, or the last diagnosed flight crashed or had a fault), suspect (signs of a fault, or an earlier
    fault without a recorded service since), not assessed, healthy. new: flights since this list was last shown.
    """
    from rotorwatch.fleet import condition

    if flights or any(filters.values()) or sort != "-date" or offset:
        rows = store.flights(sort, limit, offset, **filters)
        total = store.count(**filters)
        if as_json:
            print_json({"total": total, "flights": rows})
            return
        cells = []
        for r in rows:
            found = f"{label(r['name'])}: {r['headline']}"
            worst = f"{100 * r['loss']:.0f} %" if r["loss"] else "-"
            flown = f"{r['duration_s']:.0f} s"
            cells.append((r["hash"][:8], r["aircraft_name"] or "-", day(r["utc"]), r["verdict"], worst, flown, found))
        head = ("flight", "aircraft", "time", "verdict", "loss", "duration", "what was found")
        table(f"{len(rows)} of {total} flights", head, cells, right=(4, 5))
        return
    found = condition.by_urgency(store.aircraft())
    nobody = store.count() - sum(a["flights"] for a in found)
    if as_json:
        print_json({"aircraft": found, "flights_of_no_aircraft": nobody})
        return
    rows = []
    for a in found:
        headline = a["standing"]["headline"] if a["standing"] else "not assessed yet"
        last = (a["standing"] or {}).get("last") or {}
        new = ", ".join(f"{count} {verdict}" for verdict, count in a["new"].items()) or "-"
        rows.append((a["name"], a["state"], str(a["flights"]), day(a["last"]), last.get("verdict", "-"), new, headline))
    head = ("aircraft", "state", "flights", "last flight", "verdict", "new", "status")
    table(f"{len(found)} aircraft", head, rows, right=(2,), styles=STYLES)
    with suppress(StoreError):  # the store may be read-only
        store.look()
    if nobody and not quiet:
        say(f"{nobody} flights name no aircraft: add such logs with --aircraft NAME.")
    if any(a["stale"] for a in found) and not quiet:
        say("The store has changed since this assessment; run `rotorwatch fleet assess` again.")


@fleet.command(short_help="Compare two flights side by side.")
@click.argument("a", metavar="FLIGHT")
@click.argument("b", metavar="FLIGHT")
@STORE
@JSON
@common
def compare(store, a, b, as_json, quiet) -> None:
    """Show the diagnoses of two flights side by side. FLIGHT: the first digits of its hash (`rotorwatch fleet list --flights`).

    ! marks what differs: losses whose 95 % intervals do not overlap, and all but times and durations.
    """
    from rotorwatch.fleet.compare import compare as run

    comparison = run(store, a, b)
    if as_json:
        print_json(comparison.to_dict())
        return
    rows: list[tuple[str, ...]] = [(_marked(row.what, row.differs), *row.values) for row in (*comparison.facts, *comparison.rotors)]
    for k in range(max(map(len, comparison.events))):
        pair = [events[k] if k < len(events) else None for events in comparison.events]
        alone = any(event and event.alone for event in pair)
        rows.append((_marked(f"event {k + 1}", alone), *(event.text if event else "-" for event in pair)))
    click.echo(comparison.headline)
    table("", ("", *(label(flight["name"]) for flight in comparison.flights)), rows, wide=(-2, -1))


def _marked(what: str, differs: bool) -> str:
    return f"! {what}" if differs else what


@fleet.command(short_help="Delete flights, with their reports.")
@click.argument("flights", nargs=-1, required=True, metavar="FLIGHT...")
@flag("--yes", "Do not ask for confirmation.")
@STORE
@common
def delete(store, flights, yes, quiet) -> None:
    """Delete flights and their reports permanently. FLIGHT: the first digits of its hash (`rotorwatch fleet list --flights`).

    Logs are not touched. An aircraft is removed with its last flight, unless it has recorded maintenance or another aircraft was merged
    into it.
    """
    from rotorwatch.fleet import assess

    store.reports.settle()  # finish interrupted deletions first
    rows = {row["hash"]: row for row in (store.flight(one) or unknown(one) for one in flights)}
    if not yes:
        if not sys.stdin.isatty():
            raise ConfigError("Deleting cannot be undone: give --yes to delete without confirmation.")
        for row in rows.values():
            say(f"{row['hash'][:8]}  {row['aircraft_name'] or '(no aircraft)'}  {label(row['name'])}: {row['headline']}")
        what = "this flight" if len(rows) == 1 else f"these {len(rows)} flights"
        click.confirm(f"Delete {what} permanently?", abort=True, err=True)
    try:
        for hash in rows:
            row = store.delete(hash)
            click.echo(f"deleted {hash[:8]}  {label(row['name'])}")
    finally:
        assess.refresh(store)
