"""Commands by their names, imported when they are asked for: each process runs one. Installed packages add some (`rotorwatch.commands`)."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import click

GROUP = "rotorwatch.commands"


SECTIONS = {
    "Start here": ("diagnose", "info", "watch", "fleet", "serve"),
    "Your vehicles": ("demo", "calibrate", "survive", "observability", "ask", "export-c", "mcp", "new"),
    "Your method and data": ("evaluate", "estimate", "tune", "simulate", "inject", "compare", "benchmark", "campaign", "reproduce"),
}
"""The commands in the order of what people do; all others follow by name."""


class Group(click.Group):
    """A group that lists its commands in SECTIONS."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        left = {name: command for name in self.list_commands(ctx) if (command := self.get_command(ctx, name)) and not command.hidden}
        limit = formatter.width - 6 - max(map(len, left), default=0)
        for title, names in (*SECTIONS.items(), ("More", sorted(left))):
            rows = [(name, left.pop(name).get_short_help_str(limit)) for name in names if name in left]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


class Commands(UserDict):
    """The commands of a group: click commands, files of this folder by their names, and those that installed packages offer as `NAME`, or
    as `PREFIX.NAME` in a group called PREFIX. A command of ours keeps its name. Other packages are looked at when a name is unknown, or
    all are listed. One that is not installed any more is not listed, nor is one that cannot be loaded, with a PluginWarning."""

    def __init__(self, commands: dict[str, Any], prefix: str = ""):
        super().__init__(commands)
        self._prefix = f"{prefix}." if prefix else ""
        self._listed: tuple[str, ...] | None = None

    def __getitem__(self, name: str) -> click.Command:
        command = self.data[name] if name in self.data else self._offered()[name]
        if isinstance(command, str):
            family = import_module(f"rotorwatch.commands.{command}")
            command = getattr(family, name.replace("-", "_"))
        elif not isinstance(command, click.Command):
            from rotorwatch.base import discovery

            command = discovery.load(command, ("invoke", "get_short_help_str"))
        self.data[name] = command
        return command

    def __contains__(self, name: object) -> bool:
        return name in self.data or name in self._offered()

    def __iter__(self) -> Iterator[str]:
        if self._listed is None:
            self._listed = tuple(name for name in {**self._offered(), **self.data} if self._there(name))
        return iter(self._listed)

    def __len__(self) -> int:
        return len(tuple(iter(self)))

    def _offered(self) -> dict[str, Any]:
        """Name -> entry point."""
        from rotorwatch.base import discovery

        own = self._prefix
        found = ((n.removeprefix(own), e) for n, e in discovery.offered(GROUP).items() if n.startswith(own))
        return {name: entry for name, entry in found if "." not in name}

    def _there(self, name: str) -> bool:
        """Whether a command can be loaded."""
        from rotorwatch.base import discovery
        from rotorwatch.errors import ConfigError, PluginWarning

        try:
            self[name]
        except discovery.Absent:
            return False
        except ConfigError as why:
            import warnings

            warnings.warn(str(why), PluginWarning, stacklevel=2)
            return False
        return True
