"""Makes docs/papers.md: every claim of the five papers beside what comes out here.

    rotorwatch reproduce --all -o results      each paper's result, kept in a folder
    python docs/make_papers.py results         the claims and tables of these results into docs/papers.json, and the page

A paper that the folder does not hold stays as it is. Without a folder the page is made from docs/papers.json as it is.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rotorwatch.lab.experiments.studies import reproduction

HERE = Path(__file__).parent
DATA, PAGE = HERE / "papers.json", HERE / "papers.md"
HEAD = """# The five papers

What each paper claims, and what comes out here. The page is made from the results of `rotorwatch reproduce --all` by
`python docs/make_papers.py`. "Refuted": the opposite is shown. "Not reproduced": it does not come out, and the paper leaves enough open
that it may have been so there.
"""


def rows(folder: Path, before: list[dict]) -> list[dict]:
    """Of every study in its order: paper, title, seeds, claims and tables of the result that is kept in the folder, else as before."""
    known, found = {row["paper"]: row for row in before}, []
    for name in reproduction.studies():
        kept = folder / f"{name}.json"
        if kept.exists():
            whole = json.loads(kept.read_text(encoding="utf-8"))
            known[name] = {key: whole[key] for key in ("paper", "title", "seeds", "claims")}
            known[name]["tables"] = [table._asdict() for table in reproduction.tables(name, whole["figures"])]
        found.append(known[name])
    return found


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
        table = ["| claim | the paper | here | verdict |", "|---|---|---|---|"]
        for claim in row["claims"]:
            cells = (
                f"{claim['claim'].rstrip('.')}. {claim['why']}",
                claim["paper"],
                claim["measured"],
                _verdict(claim),
            )
            table.append("| " + " | ".join(_cell(text) for text in cells) + " |")
        parts.append("\n".join(table) + "\n")
        for table in row.get("tables", ()):
            head = ["| " + " | ".join(table["head"]) + " |", "|---" * len(table["head"]) + "|"]
            lines = ["| " + " | ".join(_cell(text) for text in cells) + " |" for cells in table["rows"]]
            parts.append("\n".join([f"{table['title']}:\n", *head, *lines]) + "\n")
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


def _verdict(claim: dict) -> str:
    """In the page's words: of what holds in part the condition, where one is given."""
    if claim["verdict"] != "partly":
        return str(claim["verdict"])
    return f"holds only if {claim['only_if']}" if claim.get("only_if") else "holds only in part"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        now = rows(Path(sys.argv[1]), json.loads(DATA.read_text(encoding="utf-8")))
        DATA.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(json.loads(DATA.read_text(encoding="utf-8"))), encoding="utf-8")
