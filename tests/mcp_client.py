"""An assistant's side of `rotorwatch mcp`, for tests: the SDK's own client in a thread, so that one session serves many tests."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

from mcp import Client
from mcp.client.stdio import StdioServerParameters

ROOT = Path(__file__).resolve().parents[1]
COMMAND = [sys.executable, "-m", "rotorwatch.commands.cli", "mcp"]
ENVIRONMENT = {k: v for k, v in os.environ.items() if k != "ROTORWATCH_STORE"} | {"PYTHONPATH": str(ROOT / "src")}
CURRENT, PREVIOUS = "2026-07-28", "2025-11-25"
MODES = {CURRENT: CURRENT, PREVIOUS: "legacy"}


def command(*words: Any) -> StdioServerParameters:
    """`rotorwatch mcp WORDS` over its standard input and output."""
    return StdioServerParameters(command=COMMAND[0], args=[*COMMAND[1:], *map(str, words)], env=ENVIRONMENT)


class Answer:
    """What a call came to. data: the structured answer, or {"error": ...}; text: what stands in its text block."""

    def __init__(self, result: Any):
        self.failed, self.content = bool(result.is_error), result.content
        (self.text,) = [part.text for part in result.content if part.type == "text"]
        self.data = json.loads(self.text)
        if not self.failed:
            assert result.structured_content == self.data

    def __getitem__(self, name: str) -> Any:
        return self.data[name]


class Session:
    """A client that is connected until it is closed. server: as for `mcp.Client`; mode: of the protocol."""

    def __init__(self, server: Any, mode: str = CURRENT):
        self._loop = asyncio.new_event_loop()
        self._ready, self._failed = threading.Event(), None
        self._thread = threading.Thread(target=self._run, args=(server, mode), daemon=True)
        self._thread.start()
        assert self._ready.wait(90), "the server does not answer"
        if self._failed is not None:
            raise self._failed

    def _run(self, server: Any, mode: str) -> None:
        async def stay() -> None:
            self._end = asyncio.Event()
            try:
                async with Client(server, mode=MODES[mode]) as self.client:
                    self._ready.set()
                    await self._end.wait()
            except Exception as why:
                self._failed = why
                self._ready.set()

        self._loop.run_until_complete(stay())

    def do(self, what: Any) -> Any:
        """The result of a coroutine of the client."""
        return asyncio.run_coroutine_threadsafe(what, self._loop).result(120)

    def call(self, tool: str, **arguments: Any) -> Answer:
        return Answer(self.do(self.client.call_tool(tool, arguments)))

    def read(self, uri: str) -> str:
        return self.do(self.client.read_resource(uri)).contents[0].text

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(30)
