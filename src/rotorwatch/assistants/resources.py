"""Resources: the glossary and the limits of diagnosis, from the documentation."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from mcp.server.mcpserver import MCPServer
from mcp.server.mcpserver.exceptions import ResourceError, ResourceNotFoundError

PLACES = (Path(__file__).parent / "documents", Path(__file__).parents[3] / "docs")
"""Where the documents lie: in the package, or in the sources that an editable installation is of."""


@cache
def document(name: str) -> str:
    """The text of a document. Raises ResourceError where this installation has none."""
    for place in PLACES:
        if (place / f"{name}.md").is_file():
            return (place / f"{name}.md").read_text(encoding="utf-8")
    raise ResourceError("This installation has no documents; reinstall rotorwatch.")


def terms() -> dict[str, str]:
    """The glossary: term -> meaning."""
    rows = [line.split("|")[1:3] for line in document("glossary").splitlines() if line.startswith("| ")]
    return {term.strip(): meaning.strip() for term, meaning in rows if term.strip() != "term"}


def sections() -> dict[str, str]:
    """The limits: heading -> its text."""
    parts = document("limits").split("\n## ")[1:]
    return {part.partition("\n")[0].strip(): part.partition("\n")[2].strip() for part in parts}


def register(server: MCPServer) -> None:
    """Register the resources with the server."""

    @server.resource("rotorwatch://glossary", title="Glossary", mime_type="text/markdown")
    def glossary() -> str:
        """Terms as rotorwatch's answers use them."""
        return document("glossary")

    @server.resource("rotorwatch://glossary/{term}", title="Term", mime_type="text/plain")
    def term(term: str) -> str:
        """Meaning of a term, such as `ambiguous` or `onset`."""
        known = {name.lower(): f"{name}: {meaning}" for name, meaning in terms().items()}
        if term.lower() not in known:
            raise ResourceNotFoundError("The glossary has no such term; rotorwatch://glossary holds all of them.")
        return known[term.lower()]

    @server.resource("rotorwatch://limits", title="Limits: contents", mime_type="text/plain")
    def limits() -> str:
        """Headings of the limits: what a log can distinguish and what it cannot. rotorwatch://limits/HEADING holds the text of each."""
        return "\n".join(sections())

    @server.resource("rotorwatch://limits/{heading}", title="One limit", mime_type="text/markdown")
    def limit(heading: str) -> str:
        """The text under one heading of the limits."""
        known = {name.lower(): text for name, text in sections().items()}
        if heading.lower() not in known:
            raise ResourceNotFoundError("The limits have no such heading; rotorwatch://limits lists them.")
        return known[heading.lower()]
