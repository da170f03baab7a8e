"""Text of a report section as structured rows: the HTML page, the terminal, Markdown posts and notebooks render each block in their way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


class Logged(str):
    """Text from a log: a post shows it as code, without long numbers. Every view escapes it, as it does any other text."""


class Strong(str):
    """Text in bold face."""


@dataclass(frozen=True)
class Title:
    """A title that depends on the flight, in place of the section's `title`."""

    text: str


@dataclass(frozen=True)
class Text:
    """A paragraph. mark: sign before it in the terminal."""

    text: str
    mark: str = ""


@dataclass(frozen=True)
class Bullets:
    """A list; an item is a text or the pieces of one, such as ("31.00 s text: ", Logged(..))."""

    items: Sequence[str | tuple[str, ...]]


@dataclass(frozen=True)
class Pairs:
    """(name, text) rows."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Notes:
    """Sentences of one kind: a list on the page and in posts, `word` before each in the terminal, at its end. named: everywhere."""

    word: str
    items: Sequence[str]
    named: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of cells under column names.

    right: columns of numbers; long: columns that may wrap in the terminal; short: where the terminal is too narrow for the table, each row
    is one line and only these columns are named (None: a line for each cell); most: rows of a post (None: all); ranks: indices of the rows,
    most important first, where a post shows as many as it has room for; noun: what a row is, for "2 more events are not shown"; name: CSS
    class.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    right: Sequence[int] = ()
    long: Sequence[int] = (-1,)
    short: Sequence[int] | None = None
    most: int | None = 8
    ranks: Sequence[int] | None = None
    noun: str = "row"
    name: str = ""


Block = Title | Text | Bullets | Pairs | Notes | Table
