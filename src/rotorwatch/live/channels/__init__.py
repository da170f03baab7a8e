"""Destinations of alerts besides the screen, a file each, which nothing lists: each has

    OPTION: Option                      the option of `rotorwatch watch` that opens it
    opened(value, notify) -> Outlet     value: of the option; notify: takes a sentence on the channel itself. Raises ConfigError

and is loaded before the endpoints are opened: slow imports belong into functions.
"""

from __future__ import annotations

from typing import NamedTuple

from rotorwatch.base import discovery


class Option(NamedTuple):
    """name: with its dashes. metavar: of its value; empty for a flag. envvar: that may hold the value. sends: messages to the vehicles'
    links, which `--listen-only` forbids."""

    name: str
    help: str
    metavar: str = ""
    envvar: str = ""
    sends: bool = False

    @property
    def key(self) -> str:
        """The parameter's name in Python."""
        return self.name.lstrip("-").replace("-", "_")


def found() -> list:
    """The modules of all channels, in the order of their names."""
    return list(discovery.modules(__name__))
