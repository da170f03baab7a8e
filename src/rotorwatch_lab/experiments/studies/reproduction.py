"""Results of the `reproduce_<paper>` studies: the paper's claims, the results obtained here, and the numbers behind them.

A study is a module `studies/reproduce_<paper>.py` with

    PAPER = "axkf"                      the name on the command line, and of papers/PAPER.toml: title, errata and the words of all claims
    TITLE, LITERAL = about(PAPER)       LITERAL: name -> what the paper prints, and what it does: errata that can be read literally
    SEEDS = 10                          noise seeds when the user names none
    def reproduce(seeds=SEEDS, literal=(), progress=silent) -> Reproduction     of names in LITERAL; progress(share)
    def figures(result) -> {"file_stem": matplotlib Figure}             the paper's figures, drawn again
    def tables(figures) -> [Table]                                      of the result's figures, for its page; may be left out

and is found by looking into this folder.
"""

from __future__ import annotations

import functools
import importlib
import json
import math
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import numpy as np

from rotorwatch.base import files, many, optional
from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError

Verdict = Literal["holds", "partly", "not reproduced", "refuted"]


@dataclass(frozen=True)
class Claim:
    """A claim: its text, the paper's result, the result here, the verdict and its reason. Short sentences. only_if: condition under which
    it holds, for the verdict "partly"."""

    claim: str
    paper: str
    measured: str
    verdict: Verdict
    why: str
    only_if: str = ""


class Table(NamedTuple):
    """Numbers of a study as its page shows them: title, head, and rows of texts."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Reproduction:
    """A paper's experiments run again. figures: the numbers, JSON-able. series: arrays for drawing, not in the JSON. forms: claim -> form
    of the method -> the verdict on that claim for it, where a study runs a method in several forms."""

    paper: str
    title: str
    claims: tuple[Claim, ...]
    figures: Mapping[str, Any]
    literal: tuple[str, ...] = ()
    seeds: int = 0
    series: Mapping[str, Any] = field(default_factory=dict, repr=False)
    forms: Mapping[str, Mapping[str, Verdict]] = field(default_factory=dict)

    def to_dict(self) -> dict:
        """Plain lists, numbers and strings; NaN and infinity become None."""
        return {
            "paper": self.paper,
            "title": self.title,
            "seeds": self.seeds,
            "literal": list(self.literal),
            "claims": [vars(claim) for claim in self.claims],
            "figures": plain(self.figures),
            **({"forms": plain(self.forms)} if self.forms else {}),
        }

    def to_json(self) -> str:
        """JSON text of `to_dict`."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False)


@functools.cache
def _words(paper: str) -> dict[str, Any]:
    return files.toml(Path(__file__).parent / "papers" / f"{paper}.toml", "study")[0]


def about(paper: str) -> tuple[str, dict[str, str]]:
    """Title of the paper, and the errata that can be read literally."""
    return _words(paper)["title"], _words(paper)["literal"]


def methods(paper: str) -> tuple[str, ...]:
    """Names of the methods that a paper's study tries, its own first."""
    return tuple(_words(paper)["methods"])


def claimed(paper: str) -> tuple[str, ...]:
    """The paper's claims, in the order of its study; {names} are filled in by a run."""
    return tuple(row["claim"] for row in _words(paper)["claims"].values())


def claimed_as(paper: str, key: str) -> str:
    """Text of the claim with that key."""
    return _words(paper)["claims"][key]["claim"]


def note(paper: str) -> str:
    """Prerequisites for reading the claims: what was evaluated, or not run. Empty where there is nothing."""
    return _words(paper).get("note", "")


def minutes(paper: str) -> float:
    """About how long the study takes with two cores."""
    return float(_words(paper)["minutes"])


def listing() -> str:
    """Every paper, its methods and its literal readings, for the help of the command line."""
    lines = []
    for name in studies():
        title, literal = about(name)
        lines += [f"{name}: {title}", f"    about {minutes(name):g} min; methods: {', '.join(methods(name))}"]
        lines += [f"    --literal {key}: {text}" for key, text in literal.items()]
    return "\n".join(lines)


def claims(paper: str, verdicts: Mapping[str, Any], **values: Any) -> tuple[Claim, ...]:
    """The claims of these keys in the words and the order of papers/PAPER.toml, filled in with `values`."""
    known = _words(paper)["claims"]
    return tuple(
        Claim(verdict=verdicts[key], **{part: text.format_map(values) for part, text in row.items()})
        for key, row in known.items()
        if key in verdicts
    )


def graded(holds: Any, partly: Any = False) -> Verdict:
    """The verdict on a claim that holds, or does in part."""
    return "holds" if holds else "partly" if partly else "not reproduced"


def across(verdicts: Mapping[str, Verdict]) -> Verdict:
    """The verdict on a claim that was assessed for several forms of a method: theirs where they agree; else it holds in part, or not at all
    where it does for none."""
    distinct = set(verdicts.values())
    if len(distinct) == 1:
        return distinct.pop()
    return "partly" if distinct & {"holds", "partly"} else "not reproduced"


def by_form(forms: Mapping[str, Mapping[str, Verdict]]) -> list[tuple[list[str], list[list[str]]]]:
    """Tables of `Reproduction.forms`: (heads, rows), one for all claims that were assessed for the same forms."""
    tables: dict[tuple[str, ...], list[list[str]]] = {}
    for claim, verdicts in forms.items():
        tables.setdefault(tuple(verdicts), []).append([claim, *verdicts.values()])
    return [(["claim", *labels], rows) for labels, rows in tables.items()]


def panels(rows: int, columns: int, size: tuple[float, float], grid: bool = True, **shared: Any) -> tuple[Any, Any]:
    """(figure, its axes (rows, columns)). Raises ConfigError without matplotlib."""
    figure = optional.library("matplotlib.figure", "A figure").Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **shared)
    for axis in axes.flat if grid else ():
        axis.grid(alpha=0.3)
    return figure, axes


def tables(paper: str, figures: Mapping[str, Any]) -> list[Table]:
    """The tables that a study makes of the numbers of a result."""
    make = getattr(study(paper), "tables", None)
    return make(figures) if make else []


def studies() -> dict[str, ModuleType]:
    """Paper name -> its study module, in the order of names."""
    package = importlib.import_module("rotorwatch_lab.experiments.studies")
    names = [info.name for info in pkgutil.iter_modules(package.__path__) if info.name.startswith("reproduce_")]
    modules = [importlib.import_module(f"{package.__name__}.{name}") for name in names]
    return {module.PAPER: module for module in sorted(modules, key=lambda module: module.PAPER)}


def study(paper: str) -> ModuleType:
    """The study of that paper. Raises ConfigError that lists the known ones, or names the paper in which a method is tried."""
    known = studies()
    if paper in known:
        return known[paper]
    for name in known:
        if paper in methods(name):
            raise ConfigError(f"{paper!r} is a method, not a paper; it is tried in {name}: rotorwatch reproduce {name}.")
    raise ConfigError(f"There is no paper called {paper!r}{meant(paper, known)}; known are {', '.join(known)}.")


def reproduce(paper: str, seeds: int | None = None, literal: tuple[str, ...] = (), progress: Callable | None = None) -> Reproduction:
    """Run the experiments of a paper.

    paper: its name (`studies` lists them). seeds: how many repetitions; None: the study's own number. literal: errata read as printed.
    progress: called with the finished share. Raises ConfigError for an unknown paper or literal reading.
    """
    module = study(paper)
    check_libraries(module)
    seeds = module.SEEDS if seeds is None else seeds
    return module.reproduce(seeds, check_literal(module, literal), progress or silent)


def reproduce_many(
    papers: Sequence[str],
    seeds: int | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    folder: Path | None = None,
    progress: Callable | None = None,
) -> Iterator[Reproduction]:
    """`reproduce` of each of several papers, in this order. jobs, scheduler: as for `many.run`. folder: where each result is kept as soon
    as it is there, whichever comes first (not by other computers, which have another disk). progress(paper, share, text): called where the
    paper is run, so it can be sent there."""
    one = functools.partial(_reproduced, seeds=seeds, folder=None if scheduler else folder, progress=progress)
    return many.ordered(one, papers, jobs, scheduler)


def _reproduced(paper: str, seeds: int | None, folder: Path | None, progress: Callable | None) -> Reproduction:
    result = reproduce(paper, seeds, progress=functools.partial(progress, paper) if progress else None)
    if folder:
        keep(folder, result)
    return result


def keep(folder: Path, result: Reproduction) -> Path:
    """Write a result to a folder, whole or not at all, for `kept`; returns where."""
    path = folder / _file_name(result.paper, result.literal)
    with files.replacing(path) as unfinished:
        unfinished.write_text(result.to_json() + "\n", encoding="utf-8")
    return path


def kept(folder: Path, module: ModuleType, seeds: int | None, literal: Sequence[str]) -> Reproduction | None:
    """The result that `keep` wrote for the same paper, seeds and readings (without its series), or None when there is none."""
    path = Path(folder) / _file_name(module.PAPER, literal)
    if not path.exists():
        return None
    try:
        row = json.loads(path.read_text(encoding="utf-8"))
        stored = tuple(Claim(**claim) for claim in row["claims"])
        result = Reproduction(
            row["paper"], row["title"], stored, row["figures"], tuple(row["literal"]), row["seeds"], forms=row.get("forms", {})
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is no result of a study; delete it, or choose another folder.") from error
    asked = module.PAPER, module.SEEDS if seeds is None else seeds, tuple(literal)
    return result if (result.paper, result.seeds, result.literal) == asked else None


def _file_name(paper: str, literal: Sequence[str]) -> str:
    return "-".join([paper, *literal]) + ".json"


def silent(share: float, text: str = "") -> None:
    """Progress callback that does nothing."""


def check_libraries(module: ModuleType) -> None:
    """Raise ConfigError when the study needs a library that is not installed; NEEDS of a study names those that not everybody has."""
    for name in getattr(module, "NEEDS", ()):
        optional.library(name, f"The study {module.PAPER}")


def check_literal(module: ModuleType, literal: tuple[str, ...]) -> tuple[str, ...]:
    """The chosen literal readings; raises ConfigError for one the study does not have."""
    for name in literal:
        if name not in module.LITERAL:
            known = ", ".join(module.LITERAL) or "none"
            raise ConfigError(f"{module.PAPER} has no literal reading {name!r}; it has {known}.")
    return tuple(literal)


def plain(value: Any) -> Any:
    """Arrays and NumPy numbers as plain Python, for JSON."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    return value
