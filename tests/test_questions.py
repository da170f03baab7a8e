"""docs/questions.md: each command is run, and its answer holds what the page says."""

import re
import shutil
from pathlib import Path

import pytest

from rotorwatch.commands import cli
from test_cli import run  # noqa: F401

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "questions.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| \[(.+?\?)\]\((.+?)\) \| `rotorwatch (.+?)` \| (.+?) \|$", PAGE, re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("questions")
    (place / "LOGS").mkdir()
    for name, sample in (("flight.bin", "hexax*.xz"), ("healthy.bin", "quadx*.xz"), ("fpv.bbl", "fpv*.xz")):
        (log,) = cli.SAMPLES.glob(sample)
        shutil.copy(log, place / f"{name}.xz")
        if name != "fpv.bbl":
            shutil.copy(log, place / "LOGS" / f"{name}.xz")
    (place / "mine.py").write_text(re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1])
    return place


def test_there_are_ten():
    assert len(ROWS) == 10 == len({question for question, *_ in ROWS})


@pytest.mark.parametrize(
    ("question", "page", "command", "answer"), ROWS, ids=[row[2].partition(" ")[0] + str(k) for k, row in enumerate(ROWS)]
)
def test_a_question_is_answered(question, page, command, answer, folder, run, monkeypatch):  # noqa: F811
    monkeypatch.chdir(folder)
    monkeypatch.setenv("ROTORWATCH_STORE", str(folder / "fleet.db"))
    assert (ROOT / "docs" / page.partition("#")[0]).exists()
    words = [f"{word}.xz" if (folder / f"{word}.xz").exists() else word for word in command.split()]
    code, out, err = run(*words)
    assert code in (0, 1, 3), err
    said = " ".join((out + err).split())
    for expected in re.findall(r"`(.+?)`", answer):
        assert expected in said, f"{question} {expected!r} is not in: {said}"
