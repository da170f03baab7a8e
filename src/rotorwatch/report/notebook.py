"""A diagnosis in a notebook: a few lines of HTML without scripts, in the colours of the page around them."""

from __future__ import annotations

from html import escape

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.display import table
from rotorwatch.report import blocks, frame, sections, verdict


def page(result: Diagnosis) -> str:
    """Verdict, sections and advice."""
    return "".join(
        [
            f"<p><b>{escape(verdict(result))}</b> {escape(result.headline)}<br>"
            f"<small>{escape(str(result.flight.get('name', '')))}, {escape(frame(result))}</small></p>",
            *(_section(one) for one in sections.shown(result, "notebook")),
            *(f"<p>&rarr; {escape(text)}</p>" for text in result.advice),
        ]
    )


def _section(shown: sections.Shown) -> str:
    """Tables with the section's title, texts below them."""
    found = shown.blocks()
    title = next((b.text for b in found if isinstance(b, blocks.Title)), str(shown.section.title))
    out, texts = [], []
    for block in found:
        match block:
            case blocks.Table():
                out.append(table(title, block.head, block.rows))
            case blocks.Text():
                texts.append(block.text)
            case blocks.Bullets():
                texts += ["".join(item) for item in block.items]
            case blocks.Pairs():
                texts += [f"{name}: {text}" for name, text in block.rows]
            case blocks.Notes():
                texts += block.items
    head = [] if out else [f"<p><b>{escape(title)}</b></p>"]
    return "".join([*head, *out, *(f"<p>{escape(text)}</p>" for text in texts)]) if out or texts else ""
