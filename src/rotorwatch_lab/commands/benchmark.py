"""The benchmark: fixed flights for any method, results files, and their ranking."""

from __future__ import annotations

from pathlib import Path

import click

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit.commands import OUT, common, findable, progress, say, show
from rotorwatch_lab.commands.campaign import flying


@click.command(short_help="Run methods on fixed flights and rank them.")
@click.argument("what", nargs=-1, metavar="[PLAN | --rank FILE...]")
@click.option("--methods", default="", metavar="A,B,...", help="Methods to run; default: all installed ones.")
@click.option("--method", "more", multiple=True, metavar="MODULE:CLASS", help="Estimator outside any package; may be repeated.")
@click.option("--data", multiple=True, metavar="NAME=PATH", help="Also run them on a public data set in this folder; may be repeated.")
@click.option("--jobs", type=click.IntRange(1, 256), help="Processes; default: one per processor.")
@click.option("-o", "--out", type=OUT, metavar="FILE", help="Results to write (.json); with --rank the page (.html).")
@click.option("--export", type=OUT, metavar="DIR", help="Write the flights of PLAN into this folder: logs, truth, plan and hashes.")
@click.option("--rank", is_flag=True, help="Rank the methods of results FILEs of one plan.")
@click.option("--list", "listing", is_flag=True, help="List plans, methods and data sets, and where they come from.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@common
def benchmark(what, methods, more, data, jobs, out, export, rank, listing, as_json, quiet) -> None:
    """Run methods on the fixed flights of PLAN (quick or full, docs/benchmark.md): detections at a common false-alarm rate, delay, accuracy
    and cost, with 95 % intervals. The same command resumes an interrupted run. --rank compares results files.

    \b
    rotorwatch benchmark quick --methods ekf,aukf -o mine.json
    rotorwatch benchmark quick --method my_module:MyEstimator -o own.json
    rotorwatch benchmark --rank mine.json own.json -o ranking.html
    rotorwatch benchmark quick --export flights
    """
    import json

    if rank and (methods or more or data or jobs or listing):
        raise click.UsageError("--rank takes results files, -o and --json only.")
    if listing:
        return _list(as_json)
    if rank:
        return _rank(what, out, as_json, quiet)
    if len(what) > 1:
        raise click.UsageError(f"One plan at a time, not {len(what)}; to compare results files write --rank.")
    if export:
        if methods or more or data or jobs or out or as_json:
            raise click.UsageError("--export takes a plan alone.")
        return _export(what[0] if what else "quick", export, quiet)
    if out is None:
        raise click.UsageError("No results file: give -o FILE.json.")
    from rotorwatch_lab.campaign import benchmark as benchmarks
    from rotorwatch_lab.campaign import ranking

    if out.suffix.lower() != ".json":
        raise ConfigError(f"--out {out}: results are JSON, give a name that ends in .json.")
    names = [*(part.strip() for part in methods.split(",") if part.strip()), *more]
    findable(*names)
    for spec in more:
        if ":" not in spec:
            raise ConfigError(f"--method {spec}: write package.module:Class; name installed methods with --methods.")
    sets = [_named(text) for text in data]
    plan = benchmarks.read(what[0] if what else "quick")
    if not quiet:
        say(f"plan {plan.plan.name} version {plan.version}, {plan.flights} flights; parts in {benchmarks.parts_of(out)}")
    try:
        with flying(quiet) as report:
            results = benchmarks.run(plan, names, out, jobs, sets, report, None if quiet else say)
    except KeyboardInterrupt:
        if benchmarks.parts_of(out).is_dir():
            parts = benchmarks.parts_of(out)
            say(f"finished flights are kept in {parts}: the same command resumes from there; unfinished flights are lost")
        raise
    if as_json:
        click.echo(json.dumps(results, indent=1, allow_nan=False))
    else:
        ranked = ranking.rank([out])
        show(lambda _: ranking.table(ranked))
    if not quiet:
        say(f"results written to {out}")


def _export(plan: str, folder: Path, quiet: bool) -> None:
    from rotorwatch_lab.campaign import benchmark as benchmarks

    with progress(quiet) as report:
        written = benchmarks.export(plan, folder, report)
    if not quiet:
        say(f"{len(written)} files written to {folder}")


def _rank(paths: tuple[str, ...], out: Path | None, as_json: bool, quiet: bool) -> None:
    import json

    from rotorwatch.base import files
    from rotorwatch_lab.campaign import ranking

    if out:
        files.writable(out, "--out")
        if out.suffix.lower() not in (".html", ".htm"):
            raise ConfigError(f"--out {out}: a ranking is a page, give a name that ends in .html.")
    ranked = ranking.rank(paths)
    if out:
        ranking.write_page(ranked, out)
    if as_json:
        click.echo(json.dumps(ranked, indent=1, allow_nan=False))
    else:
        show(lambda _: ranking.table(ranked))
    if out and not quiet:
        say(f"ranking written to {out}")


def _list(as_json: bool) -> None:
    import json

    from rotorwatch_lab.campaign import benchmark as benchmarks
    from rotorwatch_lab.campaign import public_data

    plans = {name: benchmarks.read(name) for name in benchmarks.shipped()}
    known = benchmarks.known_methods()
    facts = {
        "plans": {name: {"version": b.version, "flights": b.flights, "sha256": b.sha256} for name, b in plans.items()},
        "methods": [{"name": m.name, "kind": m.kind, "about": m.about, **m.source._asdict()} for m in known],
        "data": list(public_data.shipped()),
    }
    if as_json:
        click.echo(json.dumps(facts, indent=1))
        return
    from rich.console import Group
    from rich.text import Text

    from rotorwatch.report.terminal import Fitted

    rows = [[Text(t) for t in (m.name, m.kind, f"{m.source.package} {m.source.version}".strip(), m.about)] for m in known]
    lines = [Text(f"plan {name}: version {b.version}, {b.flights} flights") for name, b in plans.items()]
    last = Text(f"Data sets with an index: {', '.join(facts['data'])}.")
    show(lambda _: Group(*lines, Text(""), Fitted("Methods", ["name", "kind", "from", "what it is"], rows, wide=(2, 3)), last))


def _named(text: str) -> tuple[str, str]:
    name, _, path = text.partition("=")
    if not name or not path:
        raise ConfigError(f"--data {text}: write NAME=PATH, as in --data crazypad=CrazyPAD/data/motor_data.")
    return name, path
