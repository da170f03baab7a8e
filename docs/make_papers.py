"""Makes docs/papers.md: every claim of the five papers beside what comes out here.

    rotorwatch reproduce --all -o results      each paper's result, kept in a folder
    python docs/make_papers.py results         the claims of these results into docs/papers.json, and the page

Papers that have no result in the folder stay as they are. Without a folder the page is made from docs/papers.json as it is.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rotorwatch.lab.experiments import tools
from rotorwatch.lab.experiments.studies import reproduction

HERE = Path(__file__).parent
DATA, PAGE = HERE / "papers.json", HERE / "papers.md"
WORDS = {"partly": "holds only in part"}
HEAD = """# The five papers

What each paper claims, and what comes out here. The page is made from the results of `rotorwatch reproduce --all` by
`python docs/make_papers.py`. "Refuted": the opposite is shown. "Not reproduced": it does not come out, and the paper leaves enough open
that it may have been so there.
"""


def rows(folder: Path, before: list[dict]) -> list[dict]:
    """Of every study in its order: paper, title, seeds, claims and forms of the result that is kept in the folder, or else of `before`."""
    found = {row["paper"]: row for row in before}
    for path in (folder / f"{name}.json" for name in reproduction.studies()):
        if path.exists():
            whole = json.loads(path.read_text(encoding="utf-8"))
            kept = {key: whole[key] for key in ("paper", "title", "seeds", "claims", "forms") if key in whole}
            found[kept["paper"]] = kept
    return [found[name] for name in reproduction.studies()]


def page(data: list[dict]) -> str:
    """The page of these rows."""
    parts = [HEAD]
    for row in data:
        methods = ", ".join(f"[`{name}`](methods/{name}.md)" for name in reproduction.methods(row["paper"]))
        pictures = ", ".join(f"[{stem}](methods/{stem}.svg)" for stem in _pictures(row["paper"]))
        parts.append(
            f"## {row['title']}\n\n`rotorwatch reproduce {row['paper']}`, {row['seeds']} seeds. Methods: {methods}.\n"
        )
        parts.append(f"Pictures: {pictures}.\n")
        if reproduction.note(row["paper"]):
            parts.append(f"**{reproduction.note(row['paper'])}**\n")
        for heads, lines in reproduction.by_form(row.get("forms", {})):
            told = [[_cell(WORDS.get(text, text)) for text in line] for line in lines]
            parts.append(tools.table(heads, told) + "\n")
        table = ["| claim | the paper | here | verdict |", "|---|---|---|---|"]
        for claim in row["claims"]:
            verdict = str(claim["verdict"])
            cells = (
                f"{claim['claim']}. {claim['why']}",
                claim["paper"],
                claim["measured"],
                WORDS.get(verdict, verdict),
            )
            table.append("| " + " | ".join(_cell(text) for text in cells) + " |")
        parts.append("\n".join(table) + "\n")
        literal = reproduction.about(row["paper"])[1]
        parts.append(
            "Errata that `--literal` reads as printed:\n\n"
            + "\n".join(f"- `{k}`: {v}" for k, v in literal.items())
            + "\n"
        )
    return "\n".join(parts)


def _pictures(paper: str) -> list[str]:
    prefix = paper.split("-")[0]
    return sorted(path.stem for path in (HERE / "methods").glob(f"{prefix}-*.svg"))


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


if __name__ == "__main__":
    data = json.loads(DATA.read_text(encoding="utf-8"))
    if len(sys.argv) > 1:
        data = rows(Path(sys.argv[1]), data)
        DATA.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(data), encoding="utf-8")
