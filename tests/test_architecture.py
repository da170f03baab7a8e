"""Dependency rules of the two packages, how light the product loads, and that a new plug-in is one new file."""

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from rotorwatch.base import discovery
from source_imports import imports

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src"
PACKAGES = ("rotorwatch", "rotorwatch_lab")
FILES = sorted(path for package in PACKAGES for path in (SOURCE / package).rglob("*.py"))
MOST_LINES = 600

# What must not be imported, and the contract of pyproject.toml that forbids it.
FORBIDDEN = (
    ("rotorwatch/flight/flight.py", "rotorwatch.logs", "Layers: a package"),
    ("rotorwatch/logs/series.py", "rotorwatch.engine.motion.tick_table", "Layers: a package"),
    ("rotorwatch/detectors/esc_current.py", "rotorwatch.engine.bindings.default", "Detectors know"),
    ("rotorwatch/airframes/px4.py", "rotorwatch.commands.cli", "Layers: a package"),
    ("rotorwatch/diagnose.py", "rotorwatch_lab.published.decide", "The product does not know"),
    ("rotorwatch_lab/estimate.py", "rotorwatch.engine.motion.tick_table", "The laboratory uses"),
    ("rotorwatch_lab/simulation/faults.py", "rotorwatch_lab.campaign.plan", "Layers of the laboratory"),
    ("rotorwatch_lab/experiments/tools.py", "rotorwatch_lab.experiments.inject", "Inside the experiments"),
    ("rotorwatch/diagnose.py", "rotorwatch.calibrate", "Inside the healthy"),
    ("rotorwatch/witnesses/hindsight.py", "rotorwatch.witnesses.leaning", "Witnesses do not"),
    ("rotorwatch/answer/advice.py", "rotorwatch.answer.conclusion", "Inside the answer"),
    ("rotorwatch_lab/published/log_plant.py", "rotorwatch_lab.published.published", "Inside the published"),
    ("rotorwatch_lab/compiling/native.py", "rotorwatch_lab.compiling.run", "Inside the compiling"),
    ("rotorwatch/engine/motion/air_spans.py", "rotorwatch.engine.motion.tick_table", "Inside motion"),
    ("rotorwatch/flight/flight.py", "rotorwatch.flight.vehicle_file", "Inside the flight"),
    ("rotorwatch_lab/estimators/planted.py", "rotorwatch_lab.estimators.ekf", "Estimators do not"),
    ("rotorwatch_lab/systems/planted.py", "rotorwatch_lab.systems.rate_dynamics", "Plants do not"),
    ("rotorwatch/detectors/thrust_loss.py", "rotorwatch.detectors.esc_current", "Detectors do not"),
    ("rotorwatch/airframes/crazyflie.py", "rotorwatch.airframes.ardupilot", "Airframes do not"),
    ("rotorwatch/logs/ulog.py", "rotorwatch.logs.tlog", "Log formats do not"),
    ("rotorwatch/serve/hub.py", "rotorwatch.serve.live", "Inside the served"),
    ("rotorwatch/flight/vehicle.py", "jax", "The nouns"),
)
PUBLIC = {"core", "errors", "flight", "airframes", "logs", "base", "stats", "detectors", "report", "toolkit"}


@pytest.fixture
def copy(tmp_path):
    """A folder with copies of the packages to plant things in, and a way to run a command that sees them instead of the originals."""
    for package in PACKAGES:
        shutil.copytree(SOURCE / package, tmp_path / package, ignore=shutil.ignore_patterns("samples", "__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)

    def run(*command):
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)

    return tmp_path, run


def lint(run):
    """Exit code of the import linter and what it says, spaces and line breaks made one."""
    tool = shutil.which("lint-imports", path=str(Path(sys.executable).parent)) or shutil.which("lint-imports")
    assert tool, "import-linter is missing: pip install -e '.[test]'"
    done = run(tool, "--no-cache", "--config", "pyproject.toml")
    return done.returncode, " ".join((done.stdout + done.stderr).split())


def module_name(path):
    return path.removesuffix(".py").replace("/", ".")


def test_planted_imports_are_found(copy):
    """That all contracts hold as it is, check.py sees."""
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
    for package in PACKAGES:
        (folder / package / "attic.py").write_text('"""Anything."""\n')
    code, said = lint(run)
    assert code == 1 and "attic" in said
    for contract in ("Layers: a package", "Layers of the laboratory"):
        assert re.search(contract + r".*?(KEPT|BROKEN)", said)[1] == "BROKEN"


def test_a_plug_in_is_one_file(copy):
    """An estimator, a plant, a detector, a format, an airframe and a report section are found as soon as their file is there."""
    folder, run = copy
    (folder / "rotorwatch_lab" / "estimators" / "planted.py").write_text(
        "class Planted:\n    name = 'planted'\n    def init(self): ...\n    def step(self, carry, u, y, valid): ...\n"
    )
    (folder / "rotorwatch_lab" / "systems" / "planted.py").write_text(
        "class Planted:\n    name = 'planted'\n    def f(self): ...\n    def h(self): ...\n"
    )
    (folder / "rotorwatch" / "detectors" / "planted.py").write_text(
        "name = 'planted'\nautopilot = 'PX4'\ndef detect(flight, vehicle, airborne): ...\n"
    )
    (folder / "rotorwatch" / "logs" / "planted.py").write_text("FORMAT = 'planted'\ndef sniff(head, name): ...\n")
    (folder / "rotorwatch" / "airframes" / "planted.py").write_text("NAMES = {'planted': None}\ndef identify(flight): ...\n")
    (folder / "rotorwatch" / "report" / "sections" / "planted.py").write_text(
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
    room = folder / "rotorwatch_lab" / "estimators"
    shutil.copy(room / "ekf.py", room / "planted.py")
    done = run(sys.executable, "-c", "from rotorwatch.base import discovery; discovery.estimators()")
    assert done.returncode != 0 and "both called 'ekf'" in done.stderr


def test_importing_loads_nothing_heavy():
    """`import rotorwatch` and `rotorwatch --help` do not wait for numerics, plots or parsers."""
    heavy = {"numpy", "jax", "scipy", "bokeh", "pymavlink", "pyulog", "pandas", "pyarrow", "rich"}
    code = f"import sys, rotorwatch, rotorwatch.commands.cli; print(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == []


def test_every_module_can_be_imported():
    for module in (module for package in PACKAGES for module in discovery.modules(package)):
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
    said = set(re.findall(r"^(\w+)(?:\.py|/) ", ast.get_docstring(ast.parse(room.read_text(encoding="utf-8"))) or "", re.M))
    there = {p.stem for p in room.parent.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()} - {"__init__"}
    assert not said or said == there


def test_the_laboratory_imports_public_modules_alone():
    """Also for types, which import-linter leaves out. One definition is compiled with the estimator's, which it extends."""
    found, extends = [], SOURCE / "rotorwatch_lab" / "experiments" / "known_losses.py"
    for path in (SOURCE / "rotorwatch_lab").rglob("*.py"):
        for line, _, name in imports(path):
            top, *rest = name.split(".")
            own = path == extends and rest[:2] == ["engine", "estimator"]
            if top == "rotorwatch" and rest[:1] != ["__version__"] and rest[0] not in PUBLIC and not own:
                found.append(f"{path}:{line} {name}")
    assert found == []


def test_the_product_names_the_laboratory_only_for_types():
    """Those of `rotorwatch.NAME` that our own entry points offer."""
    files = [path for path in (SOURCE / "rotorwatch").rglob("*.py") if path != SOURCE / "rotorwatch" / "__init__.py"]
    assert [f"{path}:{line}" for path in files for line, _, name in imports(path) if name.startswith("rotorwatch_lab")] == []
    offered = {name for name in discovery.offered("rotorwatch.api")}
    typed = {name.rpartition(".")[2] for _, _, name in imports(SOURCE / "rotorwatch" / "__init__.py") if "_lab." in name}
    assert typed < offered


def test_the_toolkit_lists_what_it_has():
    from rotorwatch import toolkit

    tree = ast.parse(Path(toolkit.__file__).read_text(encoding="utf-8"))
    (typed,) = [n for n in tree.body if isinstance(n, ast.If)]
    named = {}
    for node in typed.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            module = import_module(node.module)
            member = f"{node.module}.{alias.name}"
            named[alias.asname] = getattr(module, alias.name) if hasattr(module, alias.name) else import_module(member)
    assert set(named) | {"DEFINITIONS"} == set(toolkit.__all__)
    assert all(getattr(toolkit, name) is found for name, found in named.items())


BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "rotorwatch_lab":
            raise ModuleNotFoundError(f"No module named {name!r}", name="rotorwatch_lab")
sys.meta_path.insert(0, Blocked())
"""


def without_laboratory(code, tmp_path):
    """What code prints where rotorwatch_lab cannot be imported, and its error output."""
    command = [sys.executable, "-c", BLOCKED + code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def test_the_product_works_without_the_laboratory(tmp_path):
    said, _ = without_laboratory(
        """
import rotorwatch as rw
from rotorwatch.commands.cli import SAMPLES
log = SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"
found = rw.diagnose(log)
print(found.verdict)
for ask in (lambda: rw.estimate, lambda: rw.diagnose(log, estimator="axkf"), lambda: rw.simulate("x.toml")):
    try:
        ask()
        print("nothing was raised")
    except rw.ConfigError as why:
        print(why)
""",
        tmp_path,
    )
    verdict, *sentences = said.splitlines()
    assert verdict == "fault" and len(sentences) == 3
    assert "pip install 'rotorwatch[research]'" in sentences[0] and "rotorwatch_lab" in sentences[0]
    assert "axkf" in sentences[1] and "pip install 'rotorwatch[research]'" in sentences[2]


def test_the_command_line_works_without_the_laboratory(tmp_path):
    code = """
from rotorwatch.commands.cli import main
try:
    main({})
except SystemExit as end:
    print("exit", end.code)
"""
    listed, complaints = without_laboratory(code.format(["--help"]), tmp_path)
    assert "diagnose" in listed and "watch" in listed and "simulate" not in listed and "exit 0" in listed
    assert complaints == ""
    listed, complaints = without_laboratory(code.format(["fleet", "--help"]), tmp_path)
    assert "add" in listed and "simulate" not in listed and complaints == ""
    said, complaints = without_laboratory(code.format(["survive", "--help"]), tmp_path)
    assert "exit 2" in said and "pip install 'rotorwatch[research]'" in complaints


def test_listing_the_commands_loads_nothing_heavy(tmp_path):
    code = "import sys\nfrom rotorwatch.commands.cli import cli\nprint(len(cli.commands), 'jax' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["29", "False", "False"]
