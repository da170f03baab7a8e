"""The tutorials do what they say: their commands and Python blocks are run, and what they show as output is shown."""

import contextlib
import io
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from rotorwatch.commands import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
STEP = re.compile(r"^```(sh|python|text)\n(.*?)^```", re.DOTALL | re.MULTILINE)
NEEDS_A_VEHICLE = "rotorwatch watch udp:14550"


def command(line: str) -> str:
    """What a line of a shell block says. rotorwatch runs in this process, where compiled programs are kept."""
    words = shlex.split(line, comments=True)
    if words[:1] != ["rotorwatch"]:
        return subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=True, timeout=60).stdout
    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit) as leave:
        cli.main(words[1:])
    assert leave.value.code in (0, 1), line
    return out.getvalue()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_does_what_it_says(page, tmp_path, monkeypatch):
    text = page.read_text()
    if "\ncc " in text and not shutil.which("cc"):
        pytest.skip("this tutorial needs a C compiler")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "src").symlink_to(ROOT / "src")
    said, names = "", {}
    for language, block in STEP.findall(text):
        if language == "sh":
            for line in block.splitlines():
                said += "" if line.startswith(NEEDS_A_VEHICLE) else command(line)
        elif language == "python":
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile(block, page.name, "exec"), names)
            said += out.getvalue()
        else:
            for line in block.splitlines():
                assert " ".join(line.split()) in " ".join(said.split()), f"{line!r} is not shown"
