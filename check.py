"""Everything that can be checked without running rotorwatch: `python check.py`, in an environment with the test extra.

Style and layout (ruff), types (pyright), who imports whom (import-linter), spelling (codespell). All of them run, whatever fails; the exit
code is 1 when any did.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent
TOOLS = Path(sys.executable).parent  # not resolved: the environment's own, not its interpreter's

SPELLED = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs", "src", "examples", "benchmarks")

COMMANDS = (
    (sys.executable, "-m", "ruff", "check", "--output-format", "concise"),
    (sys.executable, "-m", "ruff", "format", "--check", "--output-format", "concise"),
    (sys.executable, "-m", "pyright", "--pythonpath", sys.executable),
    (str(TOOLS / "lint-imports"), "--no-cache"),
    (str(TOOLS / "codespell"), *SPELLED),
)


def main() -> int:
    """Run every check in the repository's root; 0 when all pass."""
    failed = []
    text = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    running = [subprocess.Popen(command, cwd=ROOT, **text) for command in COMMANDS]  # side by side: types take longest
    for command, process in zip(COMMANDS, running, strict=True):
        name = " ".join(Path(part).name if part == command[0] else part for part in command)
        print(f"== {name}\n{process.communicate()[0]}", end="", flush=True)
        if process.returncode:
            failed.append(name)
    print("\n".join(f"FAILED: {name}" for name in failed) if failed else "all checks passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
