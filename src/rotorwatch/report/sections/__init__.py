"""Sections of the report: one file each, found by a scan of this folder and by entry points `rotorwatch.sections` of other packages.

A section is a module or an object with

    name, title      texts; `name` also is the CSS class and the id of a figure that has no name of its own
    order            number: place on the page, where the built-in sections have 10 to 350
    data(diagnosis)  the data that the section shows; None: no such section in this report

and, where it needs them,

    words(data)      its blocks (report/blocks.py), plain texts among them; none: no such section in this view
    plot(data)       a Bokeh figure, or figures by name. Those over `axes.flight_range` share the time axis, the crosshair and the events
    views            the views that show `words`: some of VIEWS, by default all
    summary(data)    blocks (or renderables of rich) for the terminal without --verbose; by default nothing
    post_order       place in the folded part of a post, which is cut at its end; by default `order`
    post_top         True: in a post above the fold
    page(data, divs) its HTML on the page, escaped, in place of `words` and figures; divs: figure's name -> HTML element
    screen(data)     renderables of rich for the terminal, in place of `words`

The verdict with the story, the reason and the advice heads every view and is no section. Bokeh and rich are imported inside functions.
A section of another package that raises an exception is left out, with a PluginWarning.
"""

from __future__ import annotations

from typing import Any

from rotorwatch.base import discovery
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.blocks import Block, Text

PARTS = ("name", "title", "order", "data")
VIEWS = ("page", "terminal", "post", "notebook")


class Shown:
    """A section with its data of one diagnosis."""

    def __init__(self, section: Any, entry: Any, diagnosis: Diagnosis):
        """entry: the entry point of a section of another package, else None."""
        self.section, self._entry = section, entry
        self.figures: dict[str, Any] = {}
        self.data = self.call("data", diagnosis)

    def has(self, part: str) -> bool:
        return hasattr(self.section, part)

    def call(self, part: str, *given: Any) -> Any:
        """The result of a function of the section; None where one of another package raises."""
        return self._guarded(part, lambda: getattr(self.section, part)(*given))

    def blocks(self, part: str = "words") -> tuple[Any, ...]:
        """Result of `words` or `summary`, () without any. Raises TypeError where `words` gives anything but blocks and texts."""

        def made() -> tuple[Any, ...]:
            found = getattr(self.section, part)(self.data) if self.has(part) else None
            blocks = [Text(block) if isinstance(block, str) else block for block in found or ()]
            for block in blocks:
                if not isinstance(block, Block) and part == "words":
                    raise TypeError(f"{type(block).__name__} is no block of rotorwatch.report.blocks")
            return tuple(blocks)

        return self._guarded(part, made) or ()

    def draw(self) -> None:
        """Fill `figures`: Bokeh figures by name."""
        if self.has("plot"):
            made = self.call("plot", self.data) or {}
            self.figures = dict(made) if isinstance(made, dict) else {self.section.name: made}

    def _guarded(self, part: str, made: Any) -> Any:
        if self._entry is None:
            return made()
        try:
            return made()
        except Exception as why:
            discovery.failed(self._entry, part, why)
            return None


def registered() -> list[tuple[Any, Any]]:
    """(section, its entry point or None), in order: this folder's, and those of other packages; one that is broken is left out, with a
    PluginWarning."""
    found: list[tuple[Any, Any]] = [(module, None) for module in discovery.modules(__name__)]
    taken = {section.name for section, _ in found}
    others = discovery.others("rotorwatch.sections", PARTS, lambda s: "its name is taken" if s.name in taken else "")
    found += [(section, entry) for entry, section in others]
    return sorted(found, key=lambda pair: (pair[0].order, pair[0].name))


def shown(diagnosis: Diagnosis, view: str) -> list[Shown]:
    """The sections that a view has of this diagnosis, in order; view: one of VIEWS, or "summary"."""
    of_view = (
        (section, entry)
        for section, entry in registered()
        if (hasattr(section, "summary") if view == "summary" else view in getattr(section, "views", VIEWS))
    )
    found = (Shown(section, entry, diagnosis) for section, entry in of_view)
    return [one for one in found if one.data is not None]
