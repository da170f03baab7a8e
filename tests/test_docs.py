"""What the documents say is so: commands, examples, links, names and tables."""

import ast
import functools
import itertools
import lzma
import re
import shlex
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import click
import pytest

import rotorwatch as rw
from rotorwatch import airframes, logs
from rotorwatch.base import discovery
from rotorwatch.base.optional import tomllib
from rotorwatch.commands import cli
from rotorwatch.engine.motion.allocation import ambiguous_sets
from rotorwatch.flight import diagnosis
from source_imports import imports

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.md")])
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
README = (ROOT / "README.md").read_text()
ANSWER = (ROOT / "docs" / "answer.md").read_text()
SOURCES = ("src", "tests", "benchmarks", "tools", "docs", "examples", "embedded")
COMMANDS = (ROOT / "docs" / "commands.md").read_text()


def name(path):
    return str(path.relative_to(ROOT))


def blocks(text, language):
    """Fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def prose(text):
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


@functools.cache
def anchors(page):
    """What headings of a page can be linked to by, as code hosts make it of them."""
    heads = re.findall(r"^#+ (.*)$", prose(page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def table(text, after):
    """Rows of the first table after a heading, each a list of its cells; header and rule left out."""
    rows = re.search(r"((?:^\|.*\n)+)", text[text.index(after) :], re.MULTILINE)
    assert rows, f"no table after {after}"
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows.group(1).splitlines()[2:]]


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page.read_text())):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        goal = page.parent / path if path else page
        assert goal.exists(), f"{target} does not exist"
        assert not anchor or anchor in anchors(goal), f"{target}: no such heading"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_named_files_exist(page):
    """`logs/series.py` and its like, seen from the root, the package or the page's folder."""
    for path in re.findall(r"`((?:[\w.]+/)+[\w.]*\.(?:py|md|toml|png))`", prose(page.read_text())):
        homes = (ROOT, ROOT / "src" / "rotorwatch", ROOT / "src" / "rotorwatch_lab", ROOT / "src", page.parent)
        assert "NAME" in path or any((home / path).exists() for home in homes), f"{path} does not exist"


@functools.cache
def sources():
    return {path.name for folder in SOURCES for path in (ROOT / folder).rglob("*.py")} | {p.name for p in ROOT.glob("*.py")}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_named_sources_exist(page):
    """`bank.py` and its like, wherever they stand, also in diagrams."""
    named = set(re.findall(r"(\w+\.py)\b", page.read_text())) - {"NAME.py"}
    assert named <= sources(), named - sources()


def test_a_term_is_explained_once():
    terms = re.findall(r"^\| ([^|]+) \|", (ROOT / "docs" / "glossary.md").read_text(), re.MULTILINE)
    terms = [term for term in terms if term != "term"]
    assert len(terms) > 30 and sorted(set(terms)) == sorted(terms)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_named_objects_exist(page):
    for dotted in re.findall(r"`(rotorwatch(?:\.\w+)+)", prose(page.read_text())):
        if dotted in discovery.GROUPS or dotted.endswith(".NAME"):  # a group of entry points
            continue
        parts, found = dotted.split("."), rw
        for k, part in enumerate(parts[1:], 2):
            found = getattr(found, part, None) or import_module(".".join(parts[:k]))
        assert found is not None, dotted


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_are_understood(page):
    """Every `rotorwatch ...` line of a shell block, or of a unit of systemd, has a command and options that exist."""
    for line in "".join([*blocks(page.read_text(), "sh"), *blocks(page.read_text(), "ini")]).splitlines():
        words = shlex.split(line, comments=True)
        starts = [k for k, word in enumerate(words) if word == "rotorwatch" or word.endswith("/rotorwatch")]
        for k in starts:
            if "install" in words[:k] and "&&" not in words[:k]:
                continue  # the name of the package
            end = words.index("&&", k) if "&&" in words[k:] else len(words)
            command, *arguments = words[k + 1 : end]
            cli.cli.commands[command].make_context(command, arguments)  # raises what the command line would print


def parsed(line):
    """A command line of one cell of a table: the name of its command, as in `fleet add`. Raises what the command line would print."""
    _, name, *arguments = shlex.split(line)
    command = cli.cli.commands[name]
    if isinstance(command, click.Group):
        name, (inner, *arguments) = f"{name} {arguments[0]}", arguments
        command = command.commands[inner]
    command.make_context(name, list(arguments))
    return name


def test_every_command_has_its_question():
    """docs/commands.md: every command of `rotorwatch --help` is there, every line is understood, and every question has a page to read."""
    rows = re.findall(r"^\| \[(.+?\?)\]\([^)]+\) \| `(rotorwatch [^`]+)` \|$", COMMANDS, re.MULTILINE)
    assert len(rows) == COMMANDS.count("| `rotorwatch ") and len({question for question, _ in rows}) == len(rows)
    commands = cli.cli.commands
    groups = {name: command for name, command in commands.items() if isinstance(command, click.Group)}
    every = set(commands) - set(groups) | {f"{g} {inner}" for g, group in groups.items() for inner in group.commands}
    assert {parsed(line) for _, line in rows} == every
    for line in re.findall(r"\| `(rotorwatch [^`]+)` \|", README):
        parsed(line)


def python_blocks():
    return [pytest.param(code, id=f"{name(page)}-{k}") for page in PAGES for k, code in enumerate(blocks(page.read_text(), "python"))]


@pytest.mark.parametrize("code", python_blocks())
def test_examples_use_what_is_there(code):
    """Every example parses, and what it imports from rotorwatch exists."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("rotorwatch"):
            module = import_module(node.module)
            for alias in node.names:
                there = hasattr(module, alias.name) or find_spec(f"{node.module}.{alias.name}")
                assert there, f"{node.module} has no {alias.name}"
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "rw":
            assert hasattr(rw, node.attr), f"rotorwatch has no {node.attr}"


def test_the_examples_in_python_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sample = next(path for path in sorted(cli.SAMPLES.glob("*.bin.xz")) if "healthy" not in path.name)
    Path("flight.bin").write_bytes(lzma.open(sample).read())
    log, own, method = blocks((ROOT / "docs" / "python.md").read_text(), "python")
    names = {}
    exec(compile(log, "python.md", "exec"), names)
    assert capsys.readouterr().out.startswith("fault - ")
    exec(compile(own, "python.md", "exec"), names)
    assert capsys.readouterr().out.count("[") == 3 and Path("axkf.html").exists()
    exec(compile(method, "python.md", "exec"), {})
    assert capsys.readouterr().out.count("[") == 2
    assert Path("report.html").stat().st_size > 100_000


def test_limits_example_runs(capsys):
    (code,) = blocks((ROOT / "docs" / "limits.md").read_text(), "python")
    exec(compile(code, "limits.md", "exec"), {})
    assert "(1, 2) looks like (3, 5)" in capsys.readouterr().out


def test_ci_runs_what_the_readme_says():
    """The README's two commands to set up, and the check command that it and CONTRIBUTING.md name."""
    script = (ROOT / ".ci" / "run").read_text()
    commands = [line for line in "".join(blocks(README, "sh")).splitlines() if line.startswith("python3 -m venv")]
    main, tests = (re.fullmatch("(.*) && (.*)", command) for command in commands)
    assert f"'{main[0]}'" in script and all(f"'{part}'" in script for part in tests.groups())
    assert "python check.py" in script and "python check.py" in (ROOT / "CONTRIBUTING.md").read_text()
    assert subprocess.run(["bash", "-n", str(ROOT / ".ci" / "run")], check=False).returncode == 0


def test_picture_of_a_report():
    picture = (ROOT / "docs" / "report.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) < 500_000
    assert "docs/report.png" in README


def test_verdicts_and_exit_codes():
    rows = {row[0].strip("`"): int(row[1]) for row in table(ANSWER, "## Verdicts")}
    assert rows == {**diagnosis.EXIT_CODES, "(error)": cli.ERROR}


def test_supported_logs():
    """A row for every format there is, by its most telling word."""
    page = (ROOT / "docs" / "readers.md").read_text()
    rows = " ".join(" ".join(row) for row in table(page, "## Supported logs")).lower()
    for module in logs.formats():
        assert module.__name__.rpartition(".")[2].removesuffix("_binary") in rows, module.FORMAT


def test_ambiguous_sets_in_limits():
    text = (ROOT / "docs" / "limits.md").read_text()
    rows = table(text, "## Rotor sets with the same effect")
    for frame, said in ((frame, said) for frames, said in rows for frame in frames.split(", ")):
        found = ambiguous_sets(airframes.named(frame.strip("`")).effectiveness())
        pairs = set()
        for family in re.findall(r"\d\+\d(?: = \d\+\d)+", said):  # a = b = c says a = b, a = c and b = c
            members = [tuple(int(k) for k in s.split("+")) for s in family.split(" = ")]
            pairs |= {(a, b) for i, a in enumerate(members) for b in members[i + 1 :]}
        assert pairs == set(found), frame


def test_layers_of_the_architecture_page():
    """The lists of layers on the page, of the product and of the laboratory, are those that import-linter checks."""
    contracts = [c for c in PROJECT["tool"]["importlinter"]["contracts"] if c["name"].startswith("Layers")]
    page = (ROOT / "docs" / "architecture.md").read_text()
    texts = blocks(page[page.index("## Dependency rules") :], "text")[:2]
    assert [contract["containers"] for contract in contracts] == [["rotorwatch"], ["rotorwatch_lab"]]
    for text, contract in zip(texts, contracts, strict=True):
        said = [re.split(r"\s{2,}", line)[0] for line in text.splitlines()]
        assert [re.findall(r"\w+", line) for line in said] == [re.findall(r"\w+", line) for line in contract["layers"]]
        assert ["|" in line for line in said] == ["|" in line for line in contract["layers"]]


def test_dependencies_are_explained():
    project = PROJECT["project"]
    text = (ROOT / "docs" / "dependencies.md").read_text()

    def bare(requirements):
        return {re.match(r"[\w-]+", r).group().lower() for r in requirements}

    extras = project["optional-dependencies"]
    assert {row[0] for row in table(text, "## Needed to run")} == bare(project["dependencies"])
    needed = [package for row in table(text, "## To develop") for package in row[0].split(", ")]
    assert set(needed) == bare(extras.pop("test")) and len(set(needed)) == len(needed)
    said = {(extra, row[1]) for row in table(text, "## Optional") for extra in row[0].split(", ")}
    assert said == {(extra, package) for extra, needs in extras.items() for package in bare(needs)}


def test_everything_imported_is_declared():
    """No library is used that only happens to be installed by another one."""
    project = PROJECT["project"]
    declared = [*project["dependencies"], *itertools.chain(*project["optional-dependencies"].values())]
    known = (
        {re.match(r"[\w-]+", r).group().lower() for r in declared}
        | set(sys.stdlib_module_names)
        | {"rotorwatch", "rotorwatch_lab", "tomllib"}
    )
    for path in sorted((ROOT / "src").rglob("*.py")):
        host = {"MAVProxy"} if path.name == "mavproxy.py" else set()  # it is what calls that module
        assert {name.partition(".")[0] for _, level, name in imports(path) if not level} <= known | host, path


def test_version_is_one():
    version = PROJECT["project"]["version"]
    assert rw.__version__ == version
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text()


def test_the_list_of_places_that_use_jax_is_complete():
    source = ROOT / "src"
    uses = re.compile(r"^\s*(import jax\b|from jax\b|from rotorwatch\.base\.backend import .*\b(jax|jnp)\b)", re.MULTILINE)
    places = (p.relative_to(source).parts for p in source.rglob("*.py") if uses.search(p.read_text()))
    found = {parts[0] if parts[0] != "rotorwatch" else parts[1].removesuffix(".py") for parts in places}
    part = (ROOT / "docs" / "architecture.md").read_text().split("### Where JAX is used")[1].split("\n## ")[0]
    named = {name for line in part.splitlines() if line.startswith("| `") for name in re.findall(r"`(\w+)`", line.split("|")[1])}
    assert found == named
