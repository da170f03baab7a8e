"""Do the tests bite? Small errors are planted, one at a time, and the tests of that file must fail: `python tests/mutants.py`.

Cosmic Ray (extra `mutants`) says where an error can be planted and writes the changed file. A fixed sample of them is drawn, by a hash of
the seed, the file, the line's text and the change: the same seed draws the same errors, also after other files have changed. To them come
those written down in mutants_by_hand.toml. Each is tried in a copy of the repository, with the tests that are named for the file
(`tests_of`), until the first of them fails.

Found is written to docs/mutants.csv, a row for each error; the column `explanation` is written by hand and kept. The table of
docs/mutants.md is made of it. A campaign, not a test: about an hour on two cores. Nothing else of the working tree is touched.
"""

from __future__ import annotations

import argparse
import ast
import csv
import fnmatch
import functools
import hashlib
import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import SimpleQueue

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).resolve().parents[1]
SOURCE = Path("src")
PACKAGE, LABORATORY = "rotorwatch", "rotorwatch_lab"
TABLE, PAGE = Path("docs") / "mutants.csv", Path("docs") / "mutants.md"
BY_HAND, HAND = Path(__file__).with_name("mutants_by_hand.toml"), "by hand"

# Parts of the package, their files, and the share of the sample that each gets.
PARTS: dict[str, tuple[tuple[str, ...], float]] = {
    "readers": (("logs/*.py",), 0.25),
    "motion": (("engine/motion/allocation.py", "engine/motion/tick_table.py"), 0.15),
    "campaign": (("rotorwatch_lab/campaign/score.py", "rotorwatch_lab/campaign/summary.py", "rotorwatch_lab/campaign/sequences.py"), 0.15),
    "report": (("report/*.py", "report/sections/*.py"), 0.13),
    "estimators": (("rotorwatch_lab/estimators/*.py",), 0.15),
    "default": (("engine/bindings/*.py", "engine/estimator/*.py", "witnesses/*.py"), 0.17),
}

# Tests of a file besides tests/test_<its name>.py: the ones that fail soonest first.
NAMED: dict[str, tuple[str, ...]] = {
    "rotorwatch_lab/simulation/prepare.py": ("simulate",),
    "rotorwatch_lab/planning/question.py": ("excitation_response",),
    "rotorwatch_lab/published/origin.py": ("plugins", "benchmark"),
    "rotorwatch_lab/control/certified.py": ("closed_loop",),
    "logs/container.py": ("logs_open",),
    "logs/lone_values.py": ("plausible",),
    "engine/intake/planning.py": ("ticks", "slow_logs", "log_reader"),
    "engine/estimator/prior.py": ("plant", "learning"),
    "engine/events/carried.py": ("rivals", "log_reader"),
    "engine/spin/subsets.py": ("spinning",),
    "engine/spin/rotors_off.py": ("spinning",),
    "engine/spin/turning.py": ("spinning",),
    "engine/spin/many_ticks.py": ("spinning",),
    "export/export_log_reader.py": ("log_reader",),
    "engine/bindings/explaining.py": ("rivals", "pushes"),
    "witnesses/odds.py": ("odds", "rivals"),
    "witnesses/pushes.py": ("pushes",),
    "witnesses/comparing.py": ("rivals", "pushes"),
    "witnesses/ends.py": ("rivals",),
    "logs/raw_sensors.py": ("balance",),
    "engine/estimator/explanations.py": ("rivals", "pushes"),
    "engine/motion/ground_contact.py": ("rivals", "near_ground"),
    "logs/__init__.py": ("logs_open",),
    "logs/usd.py": ("logs_crazyflie",),
    "logs/dataflash_esc.py": ("esc_readers", "dataflash"),
    "logs/dataflash_text.py": ("dataflash_pymavlink", "dataflash_old", "dataflash"),
    "logs/dataflash_binary.py": ("dataflash", "dataflash_damage", "dataflash_pymavlink"),
    "logs/dataflash*.py": ("dataflash", "dataflash_old", "dataflash_damage"),
    "logs/table.py": ("logs_table",),
    "logs/parquet_pages.py": ("logs_table", "logs_review"),
    "report/parquet_tables.py": ("parquet_tables",),
    "logs/review.py": ("logs_review",),
    "logs/log_memory.py": ("logs_table", "logs_px4"),
    "logs/*esc*.py": ("esc_readers",),
    "logs/mavlink_frames.py": ("logs_tlog",),
    "logs/mavlink_messages.py": ("link_frames", "logs_tlog"),
    "logs/tlog.py": ("logs_tlog", "esc_readers"),
    "logs/parameter_ranges.py": ("plausible", "damaged_logs"),
    "logs/px4_*.py": ("logs_px4",),
    "witnesses/battery.py": ("reports", "upset"),
    "answer/settings.py": ("fitness", "readiness", "cli"),
    "live/reported.py": ("watch_reports", "watch"),
    "live/channels/*.py": ("watch_alerts",),
    "live/channels/ros2_diagnostics.py": ("ros2_diagnostics",),
    "live/channels/mqtt.py": ("mqtt",),
    "fleet/publish.py": ("mqtt",),
    "live/channels/tell_ground.py": ("watch_alerts", "ground_events"),
    "live/snapshot.py": ("watch_alerts", "ground_events"),
    "logs/ulog*.py": ("logs_px4",),
    "logs/series.py": ("logs_px4", "logs_table", "dataflash"),
    "logs/sdlog2.py": ("logs_sdlog2",),
    "logs/bag_storage.py": ("logs_ros2",),
    "logs/cdr.py": ("logs_ros2",),
    "logs/mavros.py": ("logs_ros2",),
    "logs/ros2*.py": ("logs_ros2",),
    "engine/bindings/shipping.py": ("shipped",),
    "engine/intake/mixer.py": ("front_mixer", "allocation"),
    "engine/intake/sense.py": ("ticks", "allocation"),
    "report/__init__.py": ("words",),
    "report/colours.py": ("figures",),
    "report/html.py": ("figures", "words"),
    "report/terminal.py": ("words",),
    "rotorwatch_lab/experiments/research_tables.py": ("cli_research",),
    "report/sections/all_rotors.py": ("all_rotors",),
    "report/sections/*.py": ("sections", "figures", "words"),
    "report/*.py": ("report",),
    "engine/motion/tick_table.py": ("ticks",),
    "engine/bindings/event_rows.py": ("events",),
    "engine/bindings/hypothesis_list.py": ("hypotheses",),
    "engine/bindings/plant_rows.py": ("plant",),
    "witnesses/attainable.py": ("control_attainable",),
    "witnesses/null_space.py": ("excitation",),
    "witnesses/witness.py": ("own_witness",),
    "engine/events/losses.py": ("hypotheses", "announcement", "events"),
    "rotorwatch_lab/experiments/known_losses.py": ("limits", "plant"),
    "engine/estimator/*.py": ("default_estimator", "engine"),
    "rotorwatch_lab/estimators/__init__.py": ("architecture",),
    "rotorwatch_lab/estimators/akf.py": ("axkf",),
    "rotorwatch_lab/estimators/adaptive_ekf.py": ("axkf",),
    "rotorwatch_lab/estimators/ekf.py": ("axkf",),
    "rotorwatch_lab/estimators/aekf.py": ("aesmf",),
    "rotorwatch_lab/maths/augmented_ekf.py": ("axkf", "aesmf"),
    "rotorwatch_lab/estimators/aukf.py": ("atsukf",),
    "rotorwatch_lab/estimators/ukf.py": ("atsukf",),
    "rotorwatch_lab/estimators/tsukf.py": ("atsukf",),
    "rotorwatch_lab/estimators/esmf.py": ("aesmf",),
    "rotorwatch_lab/estimators/lyapunov.py": ("lyapunov_mhe",),
    "rotorwatch_lab/estimators/mh*.py": ("lyapunov_mhe",),
    "engine/bindings/default.py": ("laws",),
    "engine/bindings/program.py": ("coaxial_share",),
}

# Of what Cosmic Ray can do, changes that programmers make: one opposite for each operator, not all eleven.
BINARY = (
    "Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul", "FloorDiv_Mul", "Mod_Mul", "BitAnd_BitOr", "BitOr_BitAnd", "BitXor_BitAnd",
    "LShift_RShift", "RShift_LShift",
)  # fmt: skip
COMPARISON = (
    "Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is", "Lt_LtE", "LtE_Lt", "Gt_GtE", "GtE_Gt", "Lt_GtE", "LtE_Gt", "Gt_LtE", "GtE_Lt",
)  # fmt: skip
OTHERS = (
    "ReplaceUnaryOperator_Delete_USub", "ReplaceUnaryOperator_Delete_Not", "ReplaceUnaryOperator_Delete_Invert", "AddNot",
    "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd", "ReplaceContinueWithBreak",
    "ReplaceBreakWithContinue", "ZeroIterationForLoop", "NumberReplacer",
)  # fmt: skip
OPERATORS = (*(f"ReplaceBinaryOperator_{pair}" for pair in BINARY), *(f"ReplaceComparisonOperator_{pair}" for pair in COMPARISON), *OTHERS)
# Arguments whose numbers only place and colour things on a page.
APPEARANCE = {
    "width", "height", "min_width", "min_height", "line_width", "line_alpha", "fill_alpha", "alpha", "size", "margin", "padding",
    "text_font_size", "border_radius", "spacing", "ncols", "level", "angle", "dodge", "line_dash", "min_border", "min_border_left",
    "min_border_right", "outline_line_alpha", "x_offset", "y_offset", "toolbar_options",
}  # fmt: skip

CAUGHT, SURVIVED = "caught", "survived"
FIELDS = ("part", "file", "line", "operator", "before", "after", "outcome", "test", "explanation")


@dataclass(frozen=True)
class Mutant:
    """One planted error. file: below src/rotorwatch, or below src where it begins with rotorwatch_lab/.

    occurrence: which place of the operator in it. before, after: the line."""

    part: str
    file: str
    line: int
    operator: str
    occurrence: int
    before: str
    after: str
    outcome: str = ""
    test: str = ""
    explanation: str = ""

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What says which error this is, also when lines have moved."""
        return self.file, self.operator, self.before, self.after


def place(file: str) -> Path:
    """A mutant's file, from the repository's root."""
    return SOURCE / file if file.startswith(f"{LABORATORY}/") else SOURCE / PACKAGE / file


def tests_of(file: str) -> tuple[str, ...]:
    """Names of the test files for a file below src/rotorwatch, the one with its own name first."""
    names = [Path(file).stem] if file != "logs/__init__.py" else []
    for pattern, more in NAMED.items():
        if fnmatch.fnmatch(file, pattern):
            names += more
    paths = dict.fromkeys(f"tests/test_{name}.py" for name in names)
    return tuple(path for path in paths if (ROOT / path).exists())


def parts() -> dict[str, tuple[str, ...]]:
    """Part -> its files, as `Mutant.file`, but for rooms that hold no code."""
    found = {}
    for part, (patterns, _) in PARTS.items():
        files = sorted(f for pattern in patterns for f in (ROOT / SOURCE).glob(str(place(pattern).relative_to(SOURCE))))
        files = [f for f in files if len(ast.parse(f.read_text(encoding="utf-8")).body) > 1]
        found[part] = tuple(f.relative_to(ROOT / SOURCE).as_posix().removeprefix(f"{PACKAGE}/") for f in files)
    return found


def left_out(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Spans ((line, column), (line, column)) where a change cannot matter or matters to nobody: type hints, decorators, the words of an
    exception, measures of a page."""
    spans: list[ast.AST] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.AnnAssign | ast.arg) and node.annotation:
            spans.append(node.annotation)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            spans += node.decorator_list
            spans += [node.returns] if isinstance(node, ast.FunctionDef) and node.returns else []
        elif isinstance(node, ast.Raise):
            spans.append(node)
        elif isinstance(node, ast.keyword) and node.arg in APPEARANCE:
            spans.append(node)
    return [((s.lineno, s.col_offset), (s.end_lineno, s.end_col_offset)) for s in spans]  # type: ignore[attr-defined]


@functools.cache
def _operators():
    from cosmic_ray.plugins import get_operator

    return {name: get_operator(f"core/{name}")() for name in OPERATORS}


def places(source: str) -> Iterator[tuple[str, int, int]]:
    """(operator, occurrence, line) of every error that can be planted."""
    from cosmic_ray.ast import Visitor, get_ast

    skipped, found, counts = left_out(source), [], Counter()

    class Look(Visitor):
        def visit(self, node):
            for name, operator in _operators().items():
                for start, _ in operator.mutation_positions(node):
                    if not any(a <= start < b for a, b in skipped):
                        found.append((name, counts[name], start[0]))
                    counts[name] += 1
            return node

    Look().walk(get_ast(source))
    return iter(found)


def changed(source: str, operator: str, occurrence: int) -> str | None:
    """The file with the error in it; None where it says the same or is no Python."""
    from cosmic_ray.mutating import mutate_code

    text = mutate_code(source, _operators()[operator], occurrence)
    try:
        same = text is None or ast.dump(ast.parse(text)) == ast.dump(ast.parse(source))
    except SyntaxError:
        return None
    return None if same else text


def ranked(part: str, seed: int) -> list[tuple[bytes, str, str, int, int]]:
    """(digest, file, operator, occurrence, line) of all that can be planted in a part, in the order in which they are drawn. Of a
    number's two neighbours only one is there."""
    found = []
    for file in parts()[part]:
        source = (ROOT / place(file)).read_text(encoding="utf-8")
        lines, seen = source.splitlines(), Counter()
        for operator, occurrence, line in places(source):
            text = lines[line - 1].strip()
            seen[operator, text] += 1
            digest = hashlib.sha256(f"{seed} {file} {operator} {text} {seen[operator, text]}".encode()).digest()
            if operator != "NumberReplacer" or digest[-1] % 2 == 0:
                found.append((digest, file, operator, occurrence, line))
    return sorted(found)


def draw(sample: int, seed: int) -> list[Mutant]:
    """The sample: each part has its share of it."""
    chosen: dict[tuple[str, ...], Mutant] = {}
    for part, (_, share) in PARTS.items():
        left = round(sample * share)
        for _, file, operator, occurrence, line in ranked(part, seed):
            if not left:
                break
            source = (ROOT / place(file)).read_text(encoding="utf-8")
            new = changed(source, operator, occurrence)
            if new is None:
                continue
            before, after = next((a, b) for a, b in zip(source.splitlines(), new.splitlines()) if a != b)
            one = Mutant(part, file, line, operator, occurrence, before.strip(), after.strip())
            if one.key not in chosen:
                chosen[one.key], left = one, left - 1
    return list(chosen.values())


def by_hand() -> list[Mutant]:
    """Those of mutants_by_hand.toml whose place is still there; the others are said."""
    found = []
    for kind, rows in tomllib.loads(BY_HAND.read_text(encoding="utf-8")).items():
        for row in rows:
            source = (ROOT / place(row["file"])).read_text(encoding="utf-8")
            if source.count(row["before"]) != 1:
                print(f"No longer once in {row['file']}: {row['before']}", file=sys.stderr)
                continue
            line = source[: source.index(row["before"])].count("\n") + 1
            found.append(Mutant(HAND, row["file"], line, kind, 0, row["before"], row["after"]))
    return found


# Tests run in children of a process that has imported the heavy libraries, but nothing of rotorwatch: starting them is half of the work.
FORKS = multiprocessing.get_context("forkserver")
PRELOADED = [
    "jax.numpy", "scipy.integrate", "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.stats", "bokeh.plotting", "hypothesis",
    "pytest",
]  # fmt: skip


def _pytest(root: Path, cache: Path, tests: Sequence[str], log: Path) -> None:
    """In a child: run the tests of a copy until one fails, and exit as pytest does."""
    os.setsid()
    os.chdir(root)
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.environ |= {"PYTHONPATH": str(root / "src"), "ROTORWATCH_CACHE": str(cache), "XDG_CACHE_HOME": str(cache)}
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    sys.path[:0] = [str(root / "src"), str(root)]  # the second, as `python -m pytest` has it
    assert "rotorwatch" not in sys.modules, "the tests would try the working tree, not the copy"
    import pytest

    code = pytest.main(["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--tb=no", *tests])
    sys.stdout.flush()
    os._exit(int(code))


class Copy:
    """A copy of the repository in a folder of its own, where tests can be run."""

    def __init__(self, folder: Path):
        self.root, self.cache = folder / "repository", folder / "cache"
        skip = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache", ".hypothesis", "build", "dist")
        shutil.copytree(ROOT, self.root, ignore=skip)
        if (ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to(ROOT.parent / "shared")

    def run(self, tests: Sequence[str], limit_s: float) -> tuple[str, str]:
        """CAUGHT or SURVIVED, and the test that failed; raises RuntimeError when pytest itself could not be run."""
        shutil.rmtree(self.root / ".hypothesis", ignore_errors=True)
        log = self.root.with_name("said.txt")
        process = FORKS.Process(target=_pytest, args=(self.root, self.cache, tests, log))
        process.start()
        process.join(limit_s)
        if process.is_alive() and process.pid:
            os.killpg(process.pid, signal.SIGKILL)
            process.join()
            return CAUGHT, f"more than {limit_s:.0f} s"
        if process.exitcode == 0:
            return SURVIVED, ""
        said = log.read_text(errors="replace")
        failed = re.search(r"^(?:FAILED|ERROR) (?:tests/)?([^\s\[]+)", said, re.M)
        if process.exitcode not in (1, 2) or not failed:
            raise RuntimeError(f"pytest ended with {process.exitcode} in {' '.join(tests)}:\n{said}")
        return CAUGHT, failed.group(1)

    def assess(self, mutant: Mutant, limit_s: float) -> Mutant:
        """The error planted, tried and taken out again."""
        path = self.root / place(mutant.file)
        original = path.read_text(encoding="utf-8")
        if mutant.part == HAND:
            text = original.replace(mutant.before, mutant.after)
        else:
            text = changed(original, mutant.operator, mutant.occurrence)
        assert text is not None
        path.write_text(text, encoding="utf-8")
        try:
            outcome, test = self.run(tests_of(mutant.file), limit_s)
        finally:
            path.write_text(original, encoding="utf-8")
        return replace(mutant, outcome=outcome, test=test)


def campaign(mutants: Sequence[Mutant], jobs: int, limit_s: float, unchecked: bool = False) -> Iterator[Mutant]:
    """Every mutant with its outcome, as they come; raises SystemExit when the tests fail without any error planted (not tried where
    `unchecked`)."""
    FORKS.set_forkserver_preload(PRELOADED)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(jobs) as pool:
        free: SimpleQueue[Copy] = SimpleQueue()
        for k in range(jobs):
            free.put(Copy(Path(folder) / str(k)))

        def healthy(tests: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
            copy = free.get()
            try:
                begun = time.perf_counter()
                failed = copy.run(tests, 10 * limit_s)[1]
                print(f"{time.perf_counter() - begun:.0f} s: {' '.join(tests)}", flush=True)
                return tests, failed
            finally:
                free.put(copy)

        def assessed(mutant: Mutant) -> Mutant:
            copy = free.get()
            try:
                return copy.assess(mutant, limit_s)
            finally:
                free.put(copy)

        if untested := {m.file for m in mutants if not tests_of(m.file)}:
            sys.exit(f"No tests are named for {', '.join(sorted(untested))}: tests/test_<name>.py, or a row of NAMED.")
        groups = () if unchecked else dict.fromkeys(tests_of(m.file) for m in mutants)
        for _, failed in pool.map(healthy, groups):
            if failed:
                sys.exit(f"Tests fail before any error is planted: {failed}.")
        yield from pool.map(assessed, mutants)


def read(path: Path) -> list[Mutant]:
    """The rows of a table that this file has written."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [Mutant(**{**row, "line": int(row["line"]), "occurrence": -1}) for row in csv.DictReader(file)]  # type: ignore[arg-type]


def write(path: Path, mutants: Iterable[Mutant]) -> None:
    """A row for each mutant, by part, file and line."""
    order = [*PARTS, HAND]
    rows = sorted(mutants, key=lambda m: (order.index(m.part), m.file, m.line, m.operator, m.after))
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, FIELDS, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        table.writerows(asdict(m) for m in rows)


def figures(mutants: Sequence[Mutant]) -> str:
    """A Markdown table: by part, how many were planted and caught, and how many of the rest nobody could catch."""
    lines = ["| part | planted | caught | survived, equivalent | survived |", "|---|---|---|---|---|"]
    for part in (*PARTS, "drawn", HAND):
        mine = [m for m in mutants if m.part == part or (part == "drawn" and m.part != HAND)]
        if not mine:
            continue
        caught = sum(m.outcome == CAUGHT for m in mine)
        same = sum(m.outcome == SURVIVED and m.explanation.startswith("equivalent") for m in mine)
        share = f"{caught} ({caught / len(mine):.0%})"
        lines.append(f"| {part} | {len(mine)} | {share} | {same} | {len(mine) - caught - same} |")
    return "\n".join(lines)


def show(path: Path, mutants: Sequence[Mutant]) -> None:
    """The table of the page, between its marks, made anew."""
    begin, end = "<!-- figures -->\n", "\n<!-- end of figures -->"
    head, _, rest = path.read_text(encoding="utf-8").partition(begin)
    path.write_text(head + begin + figures(mutants) + end + rest.partition(end)[2], encoding="utf-8")


def main() -> None:
    """Draw, plant, try, write."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--sample", type=int, default=240, help="how many errors")
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--jobs", type=int, default=2, help="how many at a time")
    asked.add_argument("--limit", type=float, default=300.0, help="seconds for the tests of one file; longer counts as caught")
    asked.add_argument("--only", nargs="+", default=("*",), help="parts, or files such as 'logs/tlog.py'; the rest of the table stays")
    asked.add_argument("--survivors", action="store_true", help="only those that the table says have survived, and new ones")
    asked.add_argument("--resume", action="store_true", help="only those that the table does not have yet")
    asked.add_argument("--unchecked", action="store_true", help="the tests are known to pass without any error")
    asked.add_argument("--list", action="store_true", help="print the sample and plant nothing")
    asked.add_argument("--show", action="store_true", help="make the tables of the page anew and plant nothing")
    given = asked.parse_args()
    everything, before = [*draw(given.sample, given.seed), *by_hand()], {m.key: m for m in read(ROOT / TABLE)}
    drawn = [m for m in everything if m.part in given.only or any(fnmatch.fnmatch(m.file, p) for p in given.only)]
    if given.survivors:
        drawn = [m for m in drawn if m.key not in before or before[m.key].outcome == SURVIVED]
    if given.resume:
        drawn = [m for m in drawn if m.key not in before]
    if given.show:
        show(ROOT / PAGE, list(before.values()))
        return
    if given.list:
        print("\n".join(f"{m.file}:{m.line} {m.operator}\n    {m.before}\n    {m.after}" for m in drawn))
        return
    table = {m.key: replace(before[m.key], line=m.line) for m in everything if m.key in before}
    begun = time.perf_counter()
    for k, mutant in enumerate(campaign(drawn, given.jobs, given.limit, given.unchecked), start=1):
        known = before.get(mutant.key)
        kept = replace(mutant, explanation=known.explanation if known and mutant.outcome == SURVIVED else "")
        table[mutant.key] = kept
        print(f"{k}/{len(drawn)} {kept.outcome} {kept.file}:{kept.line} {kept.after}  [{kept.test}]", flush=True)
        write(ROOT / TABLE, table.values())
    found = read(ROOT / TABLE)
    show(ROOT / PAGE, found)
    print(f"{len(drawn)} in {(time.perf_counter() - begun) / 60:.0f} min\n\n{figures(found)}")


if __name__ == "__main__":
    main()
