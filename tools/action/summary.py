"""A Markdown table of verdicts for the summary of a job: `python summary.py verdicts.jsonl`. Needs nothing but Python."""

from __future__ import annotations

import json
import sys
from pathlib import Path


def table(lines: list[str]) -> str:
    """A row for each JSON line of `rotorwatch diagnose --jsonl`, faults first."""
    order = {"fault": 0, "ambiguous": 1, "inconclusive": 2, "healthy": 3}
    rows = []
    for line in lines:
        answer = json.loads(line)
        verdict = answer.get("verdict", "error")
        sentence = answer.get("headline") or answer.get("error") or ""
        rows.append((order.get(verdict, -1), Path(answer["path"]).name, verdict, sentence))
    made = "".join(
        f"| {cell(name)} | {cell(verdict)} | {cell(sentence)} |\n" for _, name, verdict, sentence in sorted(rows)
    )
    return f"## Flight logs\n\n| log | verdict | |\n|---|---|---|\n{made}"


def cell(text: str) -> str:
    """Text that cannot leave its cell, nor become markup: names of files in a pull request are a stranger's."""
    text = "".join(c if c.isprintable() else " " for c in text)
    for sign in "\\`*_[]<>|!":
        text = text.replace(sign, f"\\{sign}" if sign not in "<>" else {"<": "&lt;", ">": "&gt;"}[sign])
    return text


if __name__ == "__main__":
    print(table(Path(sys.argv[1]).read_text(encoding="utf-8").splitlines()), end="")
