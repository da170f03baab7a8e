"""The house rules: who imports whom, how light the package loads, and that a new plug-in is one new file."""

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rotorwatch.base import discovery

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "rotorwatch"
FILES = sorted(SOURCE.rglob("*.py"))
MOST_LINES = 600

# What must not be imported, and the contract of pyproject.toml that forbids it.
FORBIDDEN = (
    ("flight/flight.py", "rotorwatch.logs", "Layers"),
    ("logs/series.py", "rotorwatch.engine.motion.ticks", "Layers"),
    ("methods/published/detectors/esc_current.py", "rotorwatch.engine.host.default", "Detectors know"),
    ("airframes/px4.py", "rotorwatch.commands.cli", "Layers"),
    ("lab/experiments/tools.py", "rotorwatch.lab.experiments.inject", "Inside the experiments"),
    ("diagnose.py", "rotorwatch.witnesses.healthy.tune", "Inside the healthy"),
    ("answer/advice.py", "rotorwatch.answer.conclusion", "Inside the answer"),
    ("methods/published/log_plant.py", "rotorwatch.methods.published.published", "Inside the published"),
    ("methods/compiling/native.py", "rotorwatch.methods.compiling.run", "Inside the compiling"),
    ("engine/motion/airborne.py", "rotorwatch.engine.motion.ticks", "Inside motion"),
    ("flight/flight.py", "rotorwatch.flight.vehicle_file", "Inside the flight"),
    ("methods/estimators/planted.py", "rotorwatch.methods.estimators.ekf", "Estimators do not"),
    ("methods/maths/systems/planted.py", "rotorwatch.methods.maths.systems.rate_dynamics", "Plants do not"),
    (
        "methods/published/detectors/thrust_loss.py",
        "rotorwatch.methods.published.detectors.esc_current",
        "Detectors do not",
    ),
    ("airframes/crazyflie.py", "rotorwatch.airframes.ardupilot", "Airframes do not"),
    ("logs/ulog.py", "rotorwatch.logs.tlog", "Log formats do not"),
    ("serve/hub.py", "rotorwatch.serve.live", "Inside the served"),
    ("flight/vehicle.py", "jax", "The nouns"),
)


@pytest.fixture
def copy(tmp_path):
    """A copy of the package to plant things in, and a way to run a command that sees it instead of the original."""
    shutil.copytree(SOURCE, tmp_path / "rotorwatch", ignore=shutil.ignore_patterns("samples", "__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)

    def run(*command):
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)

    return tmp_path / "rotorwatch", run


def lint(run):
    """Exit code of the import linter and what it says, spaces and line breaks made one."""
    tool = shutil.which("lint-imports", path=str(Path(sys.executable).parent)) or shutil.which("lint-imports")
    assert tool, "import-linter is missing: pip install -e '.[test]'"
    done = run(tool, "--no-cache", "--config", "pyproject.toml")
    return done.returncode, " ".join((done.stdout + done.stderr).split())


def module_name(path):
    return "rotorwatch." + path.removesuffix(".py").replace("/", ".")


def test_the_contracts_hold(copy):
    code, said = lint(copy[1])
    assert code == 0, said
    assert " 0 broken" in said


def test_planted_imports_are_found(copy):
    folder, run = copy
    for path, target, _ in FORBIDDEN:
        with (folder / path).open("a") as file:
            file.write(f"\nimport {target}\n")
    code, said = lint(run)
    assert code == 1
    for path, target, contract in FORBIDDEN:
        verdict = re.search(contract + r".*?(KEPT|BROKEN)", said)
        assert verdict and verdict.group(1) == "BROKEN", contract
        assert f"{module_name(path)} -> {target}" in said, f"{path} importing {target} went unnoticed"


def test_a_module_without_a_place_is_found(copy):
    folder, run = copy
    (folder / "attic.py").write_text('"""Anything."""\n')
    code, said = lint(run)
    assert code == 1 and "attic" in said


def test_a_plug_in_is_one_file(copy):
    """An estimator, a plant, a detector, a format, an airframe and a report section are found as soon as their file is there."""
    folder, run = copy
    (folder / "methods" / "estimators" / "planted.py").write_text(
        "class Planted:\n    name = 'planted'\n    def init(self): ...\n    def step(self, carry, u, y, valid): ...\n"
    )
    (folder / "methods" / "maths" / "systems" / "planted.py").write_text(
        "class Planted:\n    name = 'planted'\n    def f(self): ...\n    def h(self): ...\n"
    )
    (folder / "methods" / "published" / "detectors" / "planted.py").write_text(
        "name = 'planted'\nautopilot = 'PX4'\ndef detect(flight, vehicle, airborne): ...\n"
    )
    (folder / "logs" / "planted.py").write_text("FORMAT = 'planted'\ndef sniff(head, name): ...\n")
    (folder / "airframes" / "planted.py").write_text("NAMES = {'planted': None}\ndef identify(flight): ...\n")
    (folder / "report" / "sections" / "planted.py").write_text(
        "name, title, order = 'planted', 'Planted', 400\ndef data(diagnosis): ...\n"
    )
    done = run(
        sys.executable,
        "-c",
        "from rotorwatch import airframes, detectors, logs\nfrom rotorwatch.base import discovery\n"
        "from rotorwatch.report import sections\n"
        "print('planted' in discovery.estimators(), 'planted' in discovery.systems(), 'planted' in airframes.names(),\n"
        "      'planted' in [m.name for m in detectors.modules()], 'planted' in [m.FORMAT for m in logs.formats()],\n"
        "      'planted' in [section.name for section, _ in sections.registered()])",
    )
    assert done.stdout.split() == ["True"] * 6, done.stderr


def test_two_plug_ins_of_one_name_are_refused(copy):
    folder, run = copy
    shutil.copy(folder / "methods" / "estimators" / "ekf.py", folder / "methods" / "estimators" / "planted.py")
    done = run(sys.executable, "-c", "from rotorwatch.base import discovery; discovery.estimators()")
    assert done.returncode != 0 and "both called 'ekf'" in done.stderr


def test_importing_loads_nothing_heavy():
    """`import rotorwatch` and `rotorwatch --help` do not wait for numerics, plots or parsers."""
    heavy = {"numpy", "jax", "scipy", "bokeh", "pymavlink", "pyulog", "pandas", "pyarrow", "rich"}
    code = f"import sys, rotorwatch, rotorwatch.commands.cli; print(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == []


def test_every_module_can_be_imported():
    for module in discovery.modules("rotorwatch"):
        assert importlib.import_module(module.__name__) is module


def test_unknown_estimator_is_named():
    from rotorwatch.errors import ConfigError

    with pytest.raises(ConfigError, match=r"'nonsense'.*default"):
        discovery.estimator("nonsense")


def test_files_are_short_and_say_what_they_are():
    texts = {str(path.relative_to(SOURCE)): path.read_text(encoding="utf-8") for path in FILES}
    long = [name for name, text in texts.items() if len(text.splitlines()) > MOST_LINES]
    assert long == [], "split these files by what changes together"
    silent = [name for name, text in texts.items() if not ast.get_docstring(ast.parse(text))]
    assert silent == [], "a module begins with a sentence on what it holds"


@pytest.mark.parametrize("room", [p for p in FILES if p.name == "__init__.py"], ids=lambda p: p.parent.name)
def test_a_room_that_lists_its_files_lists_all(room):
    said = set(
        re.findall(r"^(\w+)(?:\.py|/) ", ast.get_docstring(ast.parse(room.read_text(encoding="utf-8"))) or "", re.M)
    )
    there = {p.stem for p in room.parent.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()} - {"__init__"}
    assert not said or said == there
