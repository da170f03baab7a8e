"""Runs the steps of the Dockerfile without Docker: `python tools/image_steps.py ROOT`, where no container can be started.

COPY and RUN of every stage are done in order below ROOT in the place of `/`, with this Python in the place of the image's. What needs
root's rights (useradd, install -o) is shown and left out. At the end the image's command must assess the sample flights.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

REPOSITORY = Path(__file__).resolve().parents[1]
RIGHTS = ("useradd", "install -d -o", "apt-get", "chown")


class Step(NamedTuple):
    """One instruction of a Dockerfile: its word in capitals, and the rest on one line."""

    word: str
    rest: str


def steps(text: str) -> list[Step]:
    """The instructions, comments left out and continued lines joined."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    return [Step(*(" ".join(line.split()).split(" ", 1))) for line in joined.splitlines()]


def moved(command: str, root: Path) -> str:
    """A shell command with the image's folders below root."""
    for folder in ("/opt/", "/data", "/src"):
        command = command.replace(f" {folder}", f" {root}{folder}")
        if command.startswith(folder):
            command = f"{root}{command}"
    return command


def copy(rest: str, folder: Path, root: Path) -> None:
    """COPY a b ... target, from the repository; from another stage nothing is to be done, because all stages share ROOT."""
    words = shlex.split(rest)
    if words[0].startswith("--from="):
        return
    *sources, target = words
    for source in sources:
        goal = folder / target / Path(source).name if target.endswith("/") else folder / target
        goal.parent.mkdir(parents=True, exist_ok=True)
        if (REPOSITORY / source).is_dir():
            shutil.copytree(REPOSITORY / source, goal, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(REPOSITORY / source, goal)


def main() -> int:
    """Every step; ends with the exit code of the first that fails."""
    if len(sys.argv) != 2:
        print("usage: python tools/image_steps.py ROOT", file=sys.stderr)
        return 2
    root = Path(sys.argv[1]).resolve()
    folder = root
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    clean["PATH"] = f"{Path(sys.executable).parent}:{clean['PATH']}"
    for word, rest in steps((REPOSITORY / "Dockerfile").read_text(encoding="utf-8")):
        print(f"{word} {rest}", flush=True)
        if word == "WORKDIR":
            folder = root / rest.lstrip("/")
            folder.mkdir(parents=True, exist_ok=True)
        elif word == "COPY":
            copy(rest, folder, root)
        elif word == "RUN" and any(part in rest for part in RIGHTS):
            print("   left out: it needs the rights of root in an image")
        elif word == "RUN":
            done = subprocess.run(["sh", "-c", moved(rest, root)], cwd=folder, env=clean, check=False)
            if done.returncode:
                return done.returncode
    return subprocess.run([root / "opt/rotorwatch/bin/rotorwatch", "demo"], cwd=folder, env=clean, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
