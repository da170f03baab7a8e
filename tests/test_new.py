"""`rotorwatch new`: what it writes is a plug-in whose test passes; and what it refuses."""

import re
import subprocess
import sys

import pytest

import rotorwatch as rw
from rotorwatch import templates
from rotorwatch.commands.cli import cli
from test_cli import run  # noqa: F401

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@pytest.mark.parametrize("kind", templates.KINDS)
def test_its_test_passes(kind, tmp_path):
    folder = rw.new(kind, f"my_{kind}", tmp_path)
    assert folder == tmp_path / f"my_{kind}" and len(list(folder.iterdir())) == 4
    assert not re.search("@(NAME|TITLE|NUMBER)@", (folder / f"my_{kind}.py").read_text())
    done = subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", "/dev/null", folder],
                          cwd=tmp_path, capture_output=True, text=True, timeout=300)  # fmt: skip
    assert done.returncode == 0 and "passed" in done.stdout, done.stdout + done.stderr
    project = tomllib.loads((folder / "pyproject.toml").read_text())
    for entries in project["project"]["entry-points"].values():
        ((name, value),) = entries.items()
        assert name == f"my_{kind}" and value.partition(":")[0] == name


def test_the_command_says_what_comes_next(run, tmp_path):  # noqa: F811
    code, out, err = run("new", "witness", "hot", "-o", tmp_path)
    assert code == 0 and out.strip() == str(tmp_path / "hot") and f"python -m pytest {tmp_path / 'hot'}" in err
    assert "new" in cli.commands


@pytest.mark.parametrize(("kind", "name", "says"), [
    ("raeder", "mine", "did you mean reader"), ("reader", "My-log", "small letters"), ("method", "class", "small letters"),
    ("witness", "../up", "small letters"), ("witness", "there", "exists already"),
])  # fmt: skip
def test_what_cannot_be_written_is_one_sentence(kind, name, says, tmp_path):
    (tmp_path / "there").mkdir()
    with pytest.raises(rw.ConfigError, match=says) as why:
        rw.new(kind, name, tmp_path)
    assert str(why.value).endswith(".") and [p.name for p in tmp_path.iterdir()] == ["there"]
