"""The logs that a pull request adds or changes, for assess.sh: `changed.py BASE FILE` writes their paths into FILE, each with a zero byte.

BASE: the commit that the pull request is compared with; one that a shallow checkout lacks is fetched. Prints what a runner shows. Leaves
with 2 where it cannot be known what has changed: what is not assessed must not pass.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from rotorwatch import gathering, logs

FIX = "give actions/checkout `fetch-depth: 0`, or name the logs in the input 'logs'."


class Unknown(Exception):
    """What has changed cannot be known. The text is one sentence."""


def git(*words: str) -> bytes:
    """What git says. Raises Unknown."""
    try:
        return subprocess.run(["git", *words], check=True, capture_output=True, timeout=600).stdout
    except FileNotFoundError:
        raise Unknown("The runner has no git; name the logs in the input 'logs'.") from None
    except subprocess.SubprocessError as why:
        said = (getattr(why, "stderr", None) or b"").decode("utf-8", "replace").split()
        # Words of git, in one line: at the start of a line they could be a command to the runner.
        raise Unknown(f"git {words[0]} failed ({' '.join(said)[:200] or type(why).__name__}): {FIX}") from None


def changed(base: str) -> list[Path]:
    """Files that HEAD has and `base` has not, or otherwise. Raises Unknown."""
    if not re.fullmatch(r"[0-9a-f]{40,64}", base):
        raise Unknown(f"The base of the pull request is no commit; {FIX}")
    try:
        git("cat-file", "-e", f"{base}^{{tree}}")
    except Unknown:
        git("fetch", "--quiet", "--no-tags", "--depth=1", "origin", base)
    said = git("diff", "-z", "--name-only", "--no-renames", "--diff-filter=d", base, "HEAD")
    return [Path(os.fsdecode(name)) for name in said.split(b"\0") if name]


def chosen(files: list[Path]) -> tuple[list[Path], int]:
    """(those that are logs, or are meant as logs; how many links and submodules were passed over). Raises Unknown."""
    found, passed = [], 0
    for file in files:
        if file.is_symlink() or file.is_dir():
            passed += 1
        elif file.is_file():
            if gathering.is_meant(file, archives=True):
                found.append(file)
        elif logs.named(archives=True).search(file.name):
            raise Unknown("The pull request changes a log that this checkout leaves out; check out all of it.")
    return found, passed


def main(base: str, out: str) -> int:
    try:
        found, passed = chosen(changed(base))
    except Unknown as why:
        print(f"::error::{why}")
        return 2
    if passed:
        print(f"::notice::{passed} symbolic links or submodules of this pull request were not followed.")
    Path(out).write_bytes(b"".join(b"./" + os.fsencode(file) + b"\0" for file in found))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
