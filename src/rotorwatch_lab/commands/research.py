"""Commands for estimation research: losses that can be distinguished on an airframe, and published experiments run again."""

from __future__ import annotations

import functools
import textwrap
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import click

from rotorwatch.errors import ConfigError
from rotorwatch.toolkit.commands import OUT, common, drawable, live, progress, say, show, spread

FIGURES = "Redraw the paper's figures as SVG files in this folder."
EVERY_S = 120.0  # between two progress lines of a run without a bar
KEPT = "Keep each paper's result in this folder, and skip papers whose result is kept there."


@click.command(short_help="Show which losses can be distinguished on an airframe.")
@click.option("--vehicle", required=True, metavar="FILE|NAME", help="Vehicle file (TOML), or an airframe's name (docs/airframes.md).")
@click.option("--figure", type=OUT, metavar="OUT.svg", help="Draw it.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@common
def observability(vehicle, figure, as_json, quiet) -> None:
    """Show which losses of which rotors can be distinguished on this airframe, in hover and in a manoeuvre."""
    from rotorwatch_lab.published.observability import observability as run

    if figure:
        drawable(figure)
    with progress(quiet) as report:
        result = run(_vehicle(vehicle), progress=report)
        if figure:
            result.figure(figure)
    if as_json:
        click.echo(result.to_json())
    else:
        from rotorwatch_lab.experiments import research_tables

        show(lambda _: research_tables.observability(result))
    if figure and not quiet:
        say(f"figure written to {figure}")


def _vehicle(name: str):
    """The vehicle of --vehicle: from a file, an autopilot's airframe, or a paper's."""
    from rotorwatch import airframes
    from rotorwatch.flight import vehicle_file

    if name in airframes.papers():
        return name
    return vehicle_file.read(name) if Path(name).suffix == ".toml" or Path(name).exists() else airframes.named(name)


class _Papers(click.Command):
    """A command whose help ends with every paper, its methods and its literal readings."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list, line by line."""
        from rotorwatch_lab.experiments.studies import reproduction

        formatter.write("\nPapers, and the errata of each that can be read literally:\n")
        for line in reproduction.listing().splitlines():
            indent = " " * (len(line) - len(line.lstrip()) + 2)
            text = textwrap.fill(line.strip(), formatter.width, initial_indent=indent, subsequent_indent=f"{indent}    ")
            formatter.write(f"{text}\n")


@click.command(cls=_Papers, short_help="Run a paper's experiments again.")
@click.argument("paper", required=False)
@click.option("--all", "every", is_flag=True, help="All papers in turn; the same as the paper `all`.")
@click.option("--seeds", type=click.IntRange(1), help="Noise seeds per experiment; default: the study's own number.")
@click.option("--literal", multiple=True, metavar="NAME", help="Run this erratum as printed in the paper, to see its effect.")
@click.option("--figures", type=OUT, metavar="DIR", help=FIGURES)
@click.option("-o", "--output", type=OUT, metavar="DIR", help=KEPT)
@spread
@click.option("--json", "as_json", is_flag=True, help="Print JSON; for `all` a list.")
@common
def reproduce(paper, every, seeds, literal, figures, output, jobs, scheduler, as_json, quiet) -> None:
    """Run the experiments of PAPER (or of `all`): each claim with the result here, a verdict, and the reason."""
    from rotorwatch.base import files, optional
    from rotorwatch_lab.experiments.studies import reproduction

    known = reproduction.studies()
    if every and paper not in (None, "all"):
        raise ConfigError(f"--all and the paper {paper!r} exclude each other; give one of them.")
    paper = "all" if every else paper
    if paper is None:
        raise ConfigError(f"Name a paper, or give --all; papers are {', '.join(known)}.")
    modules = list(known.values()) if paper == "all" else [reproduction.study(paper)]
    if paper == "all" and literal:
        raise ConfigError(f"--literal belongs to one paper; name it instead of `all`: {', '.join(known)}.")
    for folder, option in ((figures, "--figures"), (output, "--output")):
        if folder:
            files.folder(folder, option)
    if figures:
        optional.library("matplotlib.figure", "A figure")
    for module in modules:
        reproduction.check_literal(module, literal)
        reproduction.check_libraries(module)
    kept = {m.PAPER: reproduction.kept(output, m, seeds, literal) if output else None for m in modules}
    due = [name for name, one in kept.items() if one is None or figures]
    lines = None if quiet or live() else _line
    together = reproduction.reproduce_many(due, seeds, jobs, scheduler, output, lines) if paper == "all" and due else None
    with _lines(quiet, due):
        results = _results(modules, kept, due, together, seeds, literal, figures, output, as_json, quiet, lines)
    if as_json:
        import json

        out = [result.to_dict() for result in results]
        click.echo(json.dumps(out if paper == "all" else out[0], indent=1, allow_nan=False))


@contextmanager
def _lines(quiet: bool, due: Sequence[str]) -> Iterator[None]:
    """Context with lines on standard error where no bar can move: the current study and its expected time, repeated while it runs."""
    if quiet or live() or not due:
        yield
        return
    from rotorwatch_lab.experiments.studies import reproduction

    took, began, over = sum(map(reproduction.minutes, due)), time.monotonic(), threading.Event()
    say(f"running {', '.join(due)}: about {took:.0f} min of work with two cores")

    def still() -> None:
        while not over.wait(EVERY_S):
            say(f"still running, after {(time.monotonic() - began) / 60.0:.0f} min")

    thread = threading.Thread(target=still, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _results(modules, kept, due, together, seeds, literal, figures, output, as_json, quiet, lines) -> list:
    """Every study's result, run or read, shown and drawn as soon as it is available."""
    from rotorwatch_lab.experiments.studies import reproduction

    results = []
    for done, module in enumerate(modules):
        with progress(quiet) as report:
            result = kept[module.PAPER]
            if result is not None and module.PAPER not in due:
                if not quiet:
                    say(f"{module.PAPER}: read from {output}; not run again")
            else:
                if together and report:
                    report(done / len(modules), f"waiting for {module.PAPER}")
                reported = report or (functools.partial(lines, module.PAPER) if lines else None)
                result = next(together) if together else reproduction.reproduce(module.PAPER, seeds, literal, reported)
                if output:
                    reproduction.keep(output, result)
        results.append(result)
        if not as_json:
            from rotorwatch_lab.experiments import research_tables

            show(lambda _, r=result: research_tables.reproduction(r))
        if figures:
            for path in _draw(module, result, figures):
                if not quiet:
                    say(f"figure written to {path}")
    return results


def _line(paper: str, share: float, text: str = "") -> None:
    """Progress where no bar can move: a line."""
    say(f"{paper}: {share:.0%} done{f'; {text}' if text else ''}")


def _draw(module, result, folder: Path) -> list[Path]:
    """The study's figures as SVG files in a folder; returns where."""
    from rotorwatch.base import files

    paths = []
    for stem, figure in module.figures(result).items():
        paths.append(folder / f"{stem}.svg")
        with files.replacing(paths[-1]) as unfinished:
            figure.savefig(unfinished, metadata={"Date": None})
    return paths
