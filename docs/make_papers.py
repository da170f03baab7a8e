"""Write docs/papers.md: every claim of the five papers beside the reproduction.

    rotorwatch reproduce --all -o results      each paper's result, kept in a folder
    python docs/make_papers.py results         the claims and tables of these results into docs/papers.json, and the page

A paper that the folder does not hold stays as it is. Without a folder the page is made from docs/papers.json as it is.
"""

from __future__ import annotations

import csv
import io
import json
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

from rotorwatch.base import files
from rotorwatch_lab.experiments.studies import reproduction

HERE = Path(__file__).parent
DATA, PARTS, PAGE = HERE / "papers.json", HERE / "papers_parts.toml", HERE / "papers.md"
LONG = 4  # rows of a table that goes into a file of its own
WORDS = {"partly": "in part"}  # where no condition is given
EQUATIONS = "papers-equations.csv"
HEAD = f"""# The five papers

Claims of each paper beside our reproduction (`rotorwatch reproduce --all`); made by `python docs/make_papers.py`.
[{EQUATIONS}]({EQUATIONS}) has the place in the code of every equation and table; figures not listed are drawings without data.
"Only if": holds under that condition. "In part": holds for some forms. "Refuted": the opposite is shown. "Not reproduced": it does not come
out, but the paper leaves enough open that it may have. `--literal NAME` takes an erratum as printed (`rotorwatch reproduce --help`). What
to cite for each method: [CITATION.cff](../CITATION.cff).
"""


def rows(folder: Path, before: list[dict]) -> list[dict]:
    """Paper, title, seeds, claims and tables of every study in order: of the result in the folder, else as before."""
    known, found = {row["paper"]: row for row in before}, []
    for name in reproduction.studies():
        kept = folder / f"{name}.json"
        if kept.exists():
            whole = json.loads(kept.read_text(encoding="utf-8"))
            known[name] = {key: whole[key] for key in ("paper", "title", "seeds", "claims", "forms") if key in whole}
            known[name]["tables"] = [table._asdict() for table in reproduction.tables(name, whole["figures"])]
        found.append(known[name])
    return found


def page(data: list[dict]) -> str:
    """The page of these rows."""
    parts, known = [HEAD], files.toml(PARTS, "parts")[0]
    for row in data:
        paper = row["paper"]
        methods = ", ".join(f"[`{name}`](methods/{name}.md)" for name in reproduction.methods(paper))
        parts.append(f"## {row['title']}\n\n`rotorwatch reproduce {paper}`, {row['seeds']} seeds. Methods: {methods}.\n")
        if reproduction.note(paper):
            parts.append(textwrap.fill(f"**{reproduction.note(paper)}**", 140, break_on_hyphens=False) + "\n")
        if row.get("forms"):
            parts.append(f"Verdicts by form of the method: [{_forms(paper)}]({_forms(paper)}).\n")
        claims = [[f"{c['claim'].rstrip('.')}. {c['why']}", c["paper"], c["measured"], _verdict(c)] for c in row["claims"]]
        parts.append(_table(["claim", "the paper", "here", "verdict"], claims))
        parts += [_shown(paper, k, table) for k, table in enumerate(row.get("tables", ()))]
        literal = ", ".join(f"`{name}`" for name in reproduction.about(paper)[1])
        parts.append(f"{_figures(paper, known[paper]['figures'])}\n`--literal`: {literal}. {known[paper]['numbers']}".rstrip() + "\n")
    return "\n".join(parts)


def _shown(paper: str, k: int, table: dict) -> str:
    """A table of a study, or where it is when it is long."""
    if len(table["rows"]) > LONG:
        return f"{table['title']}: [{_file(paper, k)}]({_file(paper, k)}).\n"
    return f"{table['title']}:\n\n{_table(table['head'], table['rows'])}"


def _file(paper: str, k: int) -> str:
    return f"papers-{paper}-{k + 1}.csv"


def long_tables(data: list[dict]) -> dict[str, str]:
    """Name -> text of the files of long tables, of verdicts by form and of the equations."""
    files_: dict[str, str] = {}
    for row in data:
        for k, table in enumerate(row.get("tables", ())):
            if len(table["rows"]) > LONG:
                files_[_file(row["paper"], k)] = _csv([table["head"], *table["rows"]])
        if row.get("forms"):
            files_[_forms(row["paper"])] = _csv(by_form(row["forms"]))
    return files_ | {EQUATIONS: _csv(equations())}


def by_form(forms: dict[str, dict[str, str]]) -> list[list[str]]:
    """A row for each claim, a column for each form of the method; empty where a claim is not about that form."""
    labels = list(dict.fromkeys(label for found in forms.values() for label in found))
    return [
        ["claim", *labels],
        *([claim, *(WORDS.get(found.get(label, ""), found.get(label, "")) for label in labels)] for claim, found in forms.items()),
    ]


def _forms(paper: str) -> str:
    return f"papers-{paper}-forms.csv"


def _csv(lines: Iterable[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def equations() -> list[list[str]]:
    """Place in the code of every equation and table of the papers, with a head."""
    lines = [["paper", "printed", "what", "code", "note"]]
    for paper, parts in files.toml(PARTS, "parts")[0].items():
        lines += [[paper, number, what, code.removesuffix(": "), note] for number, what, code, note in parts["equations"] + parts["tables"]]
    return lines


def _figures(paper: str, figures: list[list[str]]) -> str:
    """The paper's figures as drawn here, and the plots beyond them."""
    ours = _pictures(paper)
    found = [f"{number}: {_linked(picture)}" for number, _, picture in figures if picture in ours]
    more = [_linked(name) for name in ours if name not in [picture for *_, picture in figures]]
    return f"Figures. {'; '.join(found)}." + (f" More: {', '.join(more)}." if more else "") + "\n"


def _linked(picture: str) -> str:
    return f"[{picture}](methods/{picture}.svg)"


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *[[_cell(text) for text in row] for row in rows]]
    return "\n".join("|" + "|".join(line) + "|" if line[0] == "---" else "| " + " | ".join(line) + " |" for line in lines) + "\n"


def _pictures(paper: str) -> list[str]:
    prefix = paper.split("-")[0]
    return sorted(path.stem for path in (HERE / "methods").glob(f"{prefix}-*.svg"))


def _verdict(claim: dict) -> str:
    """The verdict in the page's words, with its condition."""
    verdict = str(claim["verdict"])
    return f"only if {claim['only_if']}" if verdict == "partly" and claim.get("only_if") else WORDS.get(verdict, verdict)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        now = rows(Path(sys.argv[1]), json.loads(DATA.read_text(encoding="utf-8")))
        DATA.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    known = json.loads(DATA.read_text(encoding="utf-8"))
    PAGE.write_text(page(known), encoding="utf-8")
    for name, text in long_tables(known).items():
        (HERE / name).write_text(text, encoding="utf-8")
