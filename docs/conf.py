"""The documents' site, built by Sphinx: `python -m sphinx -W --keep-going -b html -c docs . site`.

The source is the whole repository, so that the pages' links to README, CONTRIBUTING and the examples lead somewhere, as they do on a
code host. Pages hold nothing of Sphinx: their navigation is made here of the tables of docs/index.md and of the pages that it opens, and
the API reference of docstrings.
"""

from __future__ import annotations

import re
import sys
from functools import cache
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "src")]

import make_api  # noqa: E402  # pyright: ignore[reportMissingImports]: found by the line above

import rotorwatch  # noqa: E402

project, author = "rotorwatch", "The rotorwatch developers"
version = release = rotorwatch.__version__
project_copyright = author

extensions = ["myst_parser"]
root_doc = "docs/index"
source_suffix = {".md": "markdown"}
include_patterns = ["*.md", "docs/*.md", "docs/**/*.md", "examples/*/README.md", "embedded/**/*.md"]
exclude_patterns = ["site", "build", ".venv", "**/.pytest_cache"]
myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]
suppress_warnings = ["myst.header"]  # pages that begin with a heading of the second level, which code hosts allow
html_theme = "furo"
html_title = f"rotorwatch {release}"
html_copy_source = False
pygments_style = "friendly"

_LINK = re.compile(r"\]\(([^)#\s]+\.md)(?:#[^)]*)?\)")


# Pages that open a part of the documents. What their tables and lists link to is below them in the navigation; a page has its place
# below the first.
PARTS = ("my-log", "my-vehicle", "my-research", "development", "reference", "my-fleet")
# Pages below another page.
BELOW = {
    "docs/methods/index": sorted(f"/docs/methods/{p.stem}" for p in HERE.glob("methods/*.md") if p.stem != "index"),
    "docs/plug-ins": sorted(f"/examples/{p.parent.name}/README" for p in HERE.parent.glob("examples/*/README.md")),
}


def navigation(text: str, folder: str) -> str:
    """The page of contents with a table of contents below each heading, of the pages that are linked to there and have no other place."""
    made, elsewhere = [], set().union(*below().values())
    for part in re.split(r"(?m)^(?=## )", text):
        caption = part.splitlines()[0].lstrip("# ") if part.startswith("## ") else "Start"
        pages = list(dict.fromkeys(_document(link, folder) for link in _LINK.findall(part)))
        pages = [page for page in pages if page not in elsewhere]
        made.append(f"{part.rstrip()}\n\n{_tree(pages, caption)}\n")
    return "".join(made)


@cache
def below() -> dict[str, list[str]]:
    """Name of a document -> the documents that are below it in the navigation."""
    found, placed = dict(BELOW), {page for pages in BELOW.values() for page in pages}
    placed |= {f"/docs/{part}" for part in PARTS}
    placed |= {_document(link, "docs") for link in _LINK.findall((HERE / "index.md").read_text().split("\n## ")[0])}
    for part in PARTS:
        rows = "\n".join(row for row in (HERE / f"{part}.md").read_text().splitlines() if row.startswith(("|", "- ")))
        pages = dict.fromkeys(_document(link, "docs") for link in _LINK.findall(rows))
        found[f"docs/{part}"] = [page for page in pages if page not in placed]
        placed |= set(pages)
    return found


def _tree(pages: list[str], caption: str = "") -> str:
    options = [f":caption: {caption}"] if caption else []
    return "\n".join(["```{toctree}", *options, ":hidden:", "", *pages, "```", ""])


def _document(link: str, folder: str) -> str:
    """A link to a Markdown file as the name of a document, from the root."""
    parts: list[str] = folder.split("/")
    for part in link.removesuffix(".md").split("/"):
        if part == "..":
            parts.pop()
        else:
            parts.append(part)
    return "/" + "/".join(parts)


def _read(app, docname: str, source: list[str]) -> None:
    if docname == root_doc:
        source[0] = navigation(source[0], "docs")
    elif docname in below():
        source[0] += "\n" + _tree(below()[docname])
    elif docname == "docs/api":
        source[0] += "\n" + make_api.page()


def setup(app) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _read)
