"""What releases are made of: package files, image, compose file, workflows, action, citation, recipe and lock files fit the project.

`tools/release.py` and `tools/image_steps.py` do the rest by hand: they build and install, which takes minutes.
"""

import json
import lzma
import os
import re
import runpy
import shlex
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from rotorwatch.base.optional import tomllib
from rotorwatch.commands import cli

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
IMAGE = runpy.run_path(str(ROOT / "tools" / "image_steps.py"))
DOCKERFILE = IMAGE["steps"]((ROOT / "Dockerfile").read_text())


def understood(words):
    """The command line takes these words: command and options exist."""
    command, *arguments = words
    cli.cli.commands[command].make_context(command, list(arguments))


def test_the_version_is_one():
    version = PROJECT["version"]
    assert re.search(rf"^version: {re.escape(version)}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert f'version = "{version}"' in (ROOT / "conda" / "meta.yaml").read_text()
    images = set(re.findall(r"image: rotorwatch:(\S+)", (ROOT / "compose.yaml").read_text()))
    assert images == {version}


def test_nothing_is_used_that_the_oldest_python_lacks():
    """Of the standard library: what rotorwatch itself once used of Python 3.11."""
    later = re.compile(r"^\s*(?:import tomllib$|from datetime import .*\bUTC\b)|\.add_note\(|asyncio\.timeout\(", re.MULTILINE)
    assert PROJECT["requires-python"].startswith(">=3.10")
    for path in (ROOT / "src").rglob("*.py"):
        assert path.name == "optional.py" or not later.search(path.read_text()), path


def test_nothing_is_used_that_the_oldest_numpy_lacks():
    """Names that came with NumPy 2: Linux distributions and ROS have 1.26."""
    later = re.compile(
        r"\bnp\.(?:acosh?|asinh?|atan[2h]?|astype|bitwise_(?:count|invert|left_shift|right_shift)|bool|concat|cumulative_(?:prod|sum)|isdtype|"
        r"u?long|matrix_transpose|matvec|permute_dims|pow|strings|trapezoid|unique_(?:all|counts|inverse|values)|unstack|vecdot|vecmat)\b"
    )
    assert "numpy>=1.26" in PROJECT["dependencies"]
    for path in (ROOT / "src").rglob("*.py"):
        assert not (found := later.search(path.read_text())), f"{path}: {found and found[0]}"


def test_the_recipe_has_the_packages_that_the_project_needs():
    run = (ROOT / "conda" / "meta.yaml").read_text().split("  run:\n")[1].split("\ntest:")[0]
    named = {line.split()[1]: "".join(line.split()[2:]) for line in run.splitlines() if line.strip()}
    python = named.pop("python")
    assert set(python.split(",")) == set(PROJECT["requires-python"].split(","))
    report = PROJECT["optional-dependencies"]["report"]  # conda has no extras
    for requirement in (*PROJECT["dependencies"], *report):
        name, least = re.match(r"([\w-]+)(>=[\d.]+)", requirement).groups()
        assert named.pop(name) == least, name
    assert not named


@pytest.mark.parametrize(
    ("lock", "extras"), [("development", ("test", "docs", "release")), ("image", ("serve", "postgres", "cluster")), ("build", ())]
)
def test_lock_files_have_every_package_with_hashes_and_no_index(lock, extras):
    text = (ROOT / "lock" / f"{lock}.txt").read_text()
    assert not re.search(r"https?://|--index|--find-links|file:", text)
    pinned = re.split(r"(?m)^(?=[a-z0-9])", text)[1:]
    assert all("--hash=sha256:" in entry and "==" in entry for entry in pinned)
    names = {re.match(r"[\w.-]+", entry).group().lower().replace("_", "-") for entry in pinned}
    wanted = [
        *(PROJECT["dependencies"] if lock != "build" else ["hatchling", "numpy"]),
        *(r for extra in extras for r in PROJECT["optional-dependencies"][extra]),
    ]
    for requirement in wanted:
        if "python_version <" not in requirement:
            assert re.match(r"[\w-]+", requirement).group().lower().replace("_", "-") in names, f"make the lock file anew: {requirement}"


def test_every_file_that_the_image_copies_is_there():
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    for word, rest in DOCKERFILE:
        if word == "COPY" and not rest.startswith("--from"):
            for source in shlex.split(rest)[:-1]:
                assert (ROOT / source).exists() and f"!{source}" in ignored, source


def test_the_steps_of_the_image_are_commands(tmp_path):
    for word, rest in DOCKERFILE:
        if word == "RUN":
            moved = IMAGE["moved"](rest, tmp_path)
            assert subprocess.run(["sh", "-nc", moved], check=False).returncode == 0
            assert not re.search(r"(?<![\w}])/(?:opt|data|src)\b", moved.replace(str(tmp_path), "")) or str(tmp_path) in moved
    assert [word for word, _ in DOCKERFILE].count("FROM") == 2
    assert any(word == "USER" and rest.isdigit() and rest != "0" for word, rest in DOCKERFILE)


def test_copies_land_where_the_image_has_them(tmp_path):
    IMAGE["copy"]("lock/image.txt lock/image.txt", tmp_path / "src", tmp_path)
    IMAGE["copy"]("pyproject.toml README.md ./", tmp_path / "src", tmp_path)
    IMAGE["copy"]("tools tools", tmp_path / "src", tmp_path)
    assert (tmp_path / "src/lock/image.txt").exists() and (tmp_path / "src/README.md").exists()
    assert (tmp_path / "src/tools/image_steps.py").exists()


@pytest.mark.skipif(not shutil.which("hadolint", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}"), reason="no hadolint")
def test_the_dockerfile_is_linted():
    tool = shutil.which("hadolint", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    done = subprocess.run([tool, "--no-color", "Dockerfile"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_compose_file_asks_for_commands_that_exist():
    yaml = pytest.importorskip("yaml")
    services = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]
    assert set(services) == {"serve", "database", "scheduler", "worker"}
    words = [re.sub(r"\$\{(\w+)[^}]*\}", r"\1", word) for word in services["serve"]["command"]]
    assert words[0] == "serve"
    understood(words)
    for name, service in services.items():
        assert set(service.get("depends_on", ())) <= set(services), name
        secrets = [v for v in service.get("environment", {}).values() if "PASSWORD" in v or "TOKEN" in v]
        assert all(":?" in secret for secret in secrets), f"{name} would start without a secret"


def test_scripts_that_workflows_name_are_there():
    for file in (*WORKFLOWS, ROOT / "action.yml"):
        text = file.read_text()
        for path in re.findall(r"(?:python |/)((?:tools|lock|docs)/[\w./-]+|check\.py)", text):
            assert (ROOT / path).exists(), f"{file.name}: {path}"
        for script in re.findall(r"run: (.*)", text):
            assert "${{" not in script, f"{file.name}: an input inside a script could be a command"


@pytest.fixture
def assess(tmp_path):
    """assess(exit code of rotorwatch, **environment) -> what tools/action/assess.sh does, with a rotorwatch that only answers."""

    def run(code, **environment):
        (tmp_path / "bin").mkdir(exist_ok=True)
        tool = tmp_path / "bin" / "rotorwatch"
        tool.write_text(f"#!/bin/sh\nprintf '%s\\n' \"$@\" > said.txt\necho '{{}}' > \"$4\"\necho '**Rotor 3 lost 36 %.**'\nexit {code}\n")
        tool.chmod(tool.stat().st_mode | stat.S_IEXEC)
        clean = {k: v for k, v in os.environ.items() if not k.startswith("GITHUB_")}
        path = f"{tmp_path / 'bin'}:{Path(sys.executable).parent}:{os.environ['PATH']}"
        return subprocess.run(
            ["bash", ROOT / "tools" / "action" / "assess.sh"], cwd=tmp_path, env={**clean, "PATH": path, **environment},
            capture_output=True, text=True,
        )  # fmt: skip

    return run


@pytest.mark.parametrize(
    ("code", "fail_on", "leaves"),
    [(0, "fault", 0), (1, "fault", 1), (3, "fault", 0), (3, "undecided", 1), (1, "never", 0), (2, "never", 2), (0, "x", 2)],
)
def test_the_action_fails_when_it_is_asked_to(assess, code, fail_on, leaves):
    assert assess(code, LOGS="a.bin", FAIL_ON=fail_on).returncode == leaves


def test_the_action_hands_on_what_it_was_given(assess, tmp_path):
    logs = "my logs/a.bin\n$(touch stolen)\n-x.bin\n"
    done = assess(1, LOGS=logs, VEHICLE="v.toml", BASELINE="h1.bin\nh2.bin", REPORTS="r", GITHUB_OUTPUT="out.txt")
    words = (tmp_path / "said.txt").read_text().splitlines()
    assert words[words.index("--") + 1 :] == ["my logs/a.bin", "$(touch stolen)", "-x.bin"]
    assert words[:8] == ["diagnose", "--jsonl", "--out", "r/verdicts.jsonl", "--html", "r", "--markdown", "-"]
    assert words[8:14] == ["--vehicle", "v.toml", "--baseline", "h1.bin", "--baseline", "h2.bin"]
    understood([*words[:8], "--", "a.bin"])
    assert not (tmp_path / "stolen").exists()
    assert "exit-code=1" in (tmp_path / "out.txt").read_text()
    assert "summary=r/summary.md" in (tmp_path / "out.txt").read_text()
    assert (tmp_path / "r" / "summary.md").read_text() == "**Rotor 3 lost 36 %.**\n" in done.stdout


def test_the_action_prints_no_commands_of_others(assess):
    done = assess(0, LOGS="a.bin")
    stop, *_ = said = done.stdout.splitlines()
    assert stop.startswith("::stop-commands::")
    assert f"::{stop.rpartition('::')[2]}::" in said[1:]


@pytest.mark.parametrize("reports", ["r", "r/inside", "there"])
def test_the_action_writes_through_no_link(assess, tmp_path, reports):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "there").mkdir()
    (tmp_path / "r").symlink_to("elsewhere")
    (tmp_path / "there" / "a.html").symlink_to("../elsewhere/a.html")
    done = assess(0, LOGS="a.bin", REPORTS=reports)
    assert done.returncode == 2 and "symbolic link" in done.stdout
    assert not list((tmp_path / "elsewhere").iterdir()) and not (tmp_path / "said.txt").exists()


@pytest.fixture
def pull_request(tmp_path):
    """pull_request(files, folder="") -> the commit of a repository, after these files (name -> bytes) were written and added in it."""

    def commit(files, folder=""):
        at = tmp_path / folder
        at.mkdir(exist_ok=True)
        git = ["git", "-c", "user.name=x", "-c", "user.email=x@example.org"]
        if not (at / ".git").exists():
            subprocess.run([*git, "init", "-q"], cwd=at, check=True)
        for name, data in files.items():
            (at / name).write_bytes(data)
            subprocess.run([*git, "add", name], cwd=at, check=True)
        subprocess.run([*git, "commit", "-qm", "x", "--allow-empty"], cwd=at, check=True)
        said = subprocess.run([*git, "rev-parse", "HEAD"], cwd=at, check=True, capture_output=True, text=True)
        return said.stdout.strip()

    return commit


def test_the_action_assesses_the_logs_that_a_pull_request_changes(assess, pull_request, tmp_path):
    base = pull_request({"old.bin": b"x"})
    text = b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    pull_request({"readme.txt": b"x", "build.log": b"compiled\n", "prices.csv": b"timestamp,price\n1,2\n", "model.parquet": b""})
    assert "no flight logs" in assess(1, BASE_SHA=base).stdout
    named = ["00000012.BIN", "btfl.BFL", "b.bbl", "r.db3", "r.MCAP", "c.bin.bz2", "d.Tlog.xz", "new flight.ulg", "e.bin.zip"]
    content = {"t.log": text, "t.log.xz": lzma.compress(text), "t.TXT": text, "nameless": text, "t.csv": b"time_s,gyro_x_rad_s\n"}
    pull_request({**dict.fromkeys(named, b"x"), **content})
    assert assess(1, BASE_SHA=base).returncode == 1
    said = (tmp_path / "said.txt").read_text().splitlines()
    assert sorted(said[said.index("--") + 1 :]) == sorted(f"./{name}" for name in (*named, *content))


def test_the_action_follows_no_link(assess, pull_request, tmp_path):
    base = pull_request({})
    (tmp_path / "link.bin").symlink_to("/etc/hostname")
    subprocess.run(["git", "add", "link.bin"], cwd=tmp_path, check=True)
    pull_request({})
    assert "no flight logs" in (done := assess(1, BASE_SHA=base)).stdout and "::notice::1 symbolic link" in done.stdout


def test_the_action_fails_where_it_cannot_tell_what_changed(assess, pull_request, tmp_path):
    """A checkout without the base, one without a place to fetch it from, one that leaves a log out, and none at all."""
    base = pull_request({"a.txt": b"x"}, "theirs")
    pull_request({"a.bin": b"x"}, "theirs")
    for command in (["clone", "-q", "--depth=1", f"file://{tmp_path}/theirs", "shallow"], ["init", "-q"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    shallow = {"BASE_SHA": base, "GIT_DIR": f"{tmp_path}/shallow/.git", "GIT_WORK_TREE": f"{tmp_path}/shallow"}
    done = assess(1, BASE_SHA=base)
    assert done.returncode == 2 and "::error::git fetch failed" in done.stdout and "fetch-depth: 0" in done.stdout
    assert assess(1, BASE_SHA="main").returncode == 2
    done = assess(1, **shallow)
    assert done.returncode == 2 and "leaves out" in done.stdout, "the base was fetched, but a.bin is not in the folder"
    assert not (tmp_path / "said.txt").exists()
    (tmp_path / "a.bin").write_bytes(b"x")
    assert assess(1, **shallow).returncode == 1
    assert (tmp_path / "said.txt").read_text().splitlines()[-1] == "./a.bin"


# The action's steps, as a runner runs them, beside a gh that has one pull request with comments

GH = """#!{python}
import json, os, sys
from pathlib import Path

said, data = sys.argv[1:], Path(os.environ["PULL"])
refused = os.environ.get("REFUSED", "")
comments = json.loads(data.read_text())
assert said[0] == "api" and os.environ["GH_TOKEN"] == "secret"
with open(os.environ["PULL"] + ".said", "a") as file:
    print(*said, file=file)
if "graphql" in said:
    if "read" in refused:
        sys.exit("HTTP 403: Resource not accessible by integration")
    assert "number=5" in said and "owner=them" in said and "name=drones" in said and "viewerDidAuthor" in said[said.index("--jq") + 1]
    for n, (mine, body) in enumerate(comments):
        if mine and body.startswith(os.environ["MARKER"]):
            print(n)
else:
    if "write" in refused:
        sys.exit("HTTP 403: Resource not accessible by integration")
    body = Path(said[said.index("-F") + 1].removeprefix("body=@")).read_text()
    where = next(w for w in said if w.startswith("repos/"))
    if "PATCH" in said:
        assert where.startswith("repos/them/drones/issues/comments/")
        comments[int(where.rpartition("/")[2])][1] = body
    else:
        assert where == "repos/them/drones/issues/5/comments" and "POST" in said
        comments.append([True, body])
    data.write_text(json.dumps(comments))
"""
ROTORWATCH = '#!/bin/sh\nexec {python} -m rotorwatch "$@"\n'


@pytest.fixture
def runner(tmp_path):
    """runner(inputs, **environment) -> (exit codes of the steps of action.yml that have a script, by name; what they printed; the
    comments of the pull request). The installing step is left out."""
    (tmp_path / "bin").mkdir()
    for name, text in (("gh", GH), ("rotorwatch", ROTORWATCH)):
        tool = tmp_path / "bin" / name
        tool.write_text(text.replace("{python}", sys.executable))
        tool.chmod(0o755)
    pull = tmp_path / "pull.json"
    pull.write_text(json.dumps([[False, "<!-- rotorwatch flights/logs -->\nof somebody else"]]))
    action = pytest.importorskip("yaml").safe_load((ROOT / "action.yml").read_text())

    def run(inputs, base="", **environment):
        values = {f"inputs.{name}": str(about["default"]) for name, about in action["inputs"].items()}
        values |= {f"inputs.{name}": text for name, text in inputs.items()}
        values |= {"github.action_path": str(ROOT), "github.event.pull_request.number": "5", "github.token": "secret"}
        values |= {"inputs.token": "secret", "github.event.pull_request.base.sha": base}
        path = f"{tmp_path / 'bin'}:{Path(sys.executable).parent}:{os.environ['PATH']}"
        clean = {k: v for k, v in os.environ.items() if not k.startswith(("GITHUB_", "GH_"))}
        clean |= {"PATH": path, "PULL": str(pull), "GITHUB_REPOSITORY": "them/drones", "GITHUB_JOB": "logs", "GITHUB_WORKFLOW": "flights",
                  "GITHUB_RUN_ID": "9", "GITHUB_STEP_SUMMARY": str(tmp_path / "summary.md"), **environment}  # fmt: skip
        clean["PYTHONPATH"] = str(ROOT / "src")
        codes, printed = {}, ""
        for step in action["runs"]["steps"]:
            if step.get("shell") != "bash" or step["name"].startswith("Install"):
                continue
            if "comment" in step.get("if", "") and values["inputs.comment"] != "true":
                continue
            out = tmp_path / "output.txt"
            out.write_text("")
            given = {k: re.sub(r"\$\{\{ *(.*?) *\}\}", lambda m: values.get(m[1], ""), v) for k, v in step["env"].items()}
            done = subprocess.run(
                ["bash", "-e", "-o", "pipefail", "-c", step["run"]], cwd=tmp_path, capture_output=True, text=True,
                env={**clean, **given, "GITHUB_OUTPUT": str(out)},
            )  # fmt: skip
            codes[step["name"]] = done.returncode
            printed += done.stdout + done.stderr
            for line in out.read_text().splitlines():
                values[f"steps.{step.get('id')}.outputs.{line.partition('=')[0]}"] = line.partition("=")[2]
        return codes, printed, json.loads(pull.read_text())

    return run


ASSESS, COMMENT = "Assess the logs", "Comment on the pull request"
SAMPLE = ROOT / "src" / "rotorwatch" / "samples" / "quadx_healthy_hover.bin.xz"


def test_the_action_writes_a_summary_and_one_comment(runner, tmp_path):
    (tmp_path / "flight.bin.xz").write_bytes(SAMPLE.read_bytes())
    codes, printed, comments = runner({"logs": "flight.bin.xz"})
    summary = (tmp_path / "summary.md").read_text(encoding="utf-8")
    assert codes == {ASSESS: 0} and len(comments) == 1, printed
    assert summary.startswith("## Flight logs\n\n**1 log: 1 healthy**") and "`flight.bin.xz`" in summary
    assert str(tmp_path) not in summary and "![" not in summary
    (tmp_path / "broken.bin").write_bytes(b"no log")
    for logs in ("broken.bin", "flight.bin.xz\nbroken.bin"):
        codes, printed, comments = runner({"logs": logs, "comment": "true"})
        assert codes == {ASSESS: 2, COMMENT: 0}, printed
        assert len(comments) == 2, "the second time it is updated"
        assert comments[1][1].startswith("<!-- rotorwatch flights/logs -->\n### Flight logs\n\n**")
        assert "1 error" in comments[1][1] and ("1 healthy" in comments[1][1]) == ("flight" in logs)
        assert "[this run](https://github.com/them/drones/actions/runs/9)" in comments[1][1]
    assert comments[0][1].endswith("of somebody else") and len(comments[1][1]) < 65_536


@pytest.fixture
def commented(runner, tmp_path):
    """The same with a rotorwatch that only answers."""
    tool = tmp_path / "bin" / "rotorwatch"
    tool.write_text("#!/bin/sh\necho '{}' > \"$4\"\necho '**2 logs**'\nexit 1\n")
    return lambda inputs, base="", **environment: runner({"logs": "a.bin", "comment": "true", **inputs}, base, **environment)


@pytest.mark.parametrize(
    ("environment", "words"),
    [
        ({"REFUSED": "read"}, "its comments cannot be read"),
        ({"REFUSED": "write"}, "GitHub refused it"),
        ({"GITHUB_REPOSITORY": ""}, "the repository is not known"),
    ],
)
def test_a_comment_that_cannot_be_written_fails_nothing(commented, tmp_path, environment, words):
    codes, printed, comments = commented({}, **environment)
    assert codes == {ASSESS: 1, COMMENT: 0} and len(comments) == 1
    assert f"::notice::No comment was written: {words}" in printed
    assert "secret" not in printed


def test_a_comment_on_logs_that_are_gone_is_updated(commented, tmp_path):
    for command in (["init", "-q"], ["-c", "user.name=x", "-c", "user.email=x@y.org", "commit", "-qm", "x", "--allow-empty"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.strip()
    codes, _, comments = commented({"logs": ""}, head)
    assert codes == {ASSESS: 0, COMMENT: 0} and len(comments) == 1, "nothing was said, and there is nothing to say"
    codes, _, comments = commented({})
    assert codes == {ASSESS: 1, COMMENT: 0} and "**2 logs**" in comments[1][1]
    codes, _, comments = commented({"logs": ""}, head)
    assert codes == {ASSESS: 0, COMMENT: 0} and "changes no flight logs any more" in comments[1][1] and len(comments) == 2
    codes, _, comments = commented({"fail-on": "sometimes"})
    assert codes == {ASSESS: 2, COMMENT: 0} and "could not be diagnosed" in comments[1][1] and len(comments) == 2
