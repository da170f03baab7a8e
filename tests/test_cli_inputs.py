"""What people type: pipes, addresses, odd names, places that cannot be written to, and libraries that are not there."""

import io
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from rotorwatch.base import files, incoming
from rotorwatch.commands import cli, tools
from rotorwatch.errors import BackendWarning, ConfigError
from rotorwatch_lab import tune
from test_cli import fake, run  # noqa: F401

SAMPLE = cli.SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"


def outside(*argv, **how):
    return subprocess.run([sys.executable, "-m", "rotorwatch.commands.cli", *map(str, argv)], capture_output=True, timeout=120, **how)


@pytest.fixture
def typed(monkeypatch):
    """What comes in at standard input, which has not been read yet."""

    def give(data: bytes):
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))

    monkeypatch.setattr(incoming, "_spool", {})
    return give


# Where logs come from


def test_a_log_from_standard_input_is_reported_by_its_content():
    done = outside("info", "-", "--json", input=SAMPLE.read_bytes())
    facts = json.loads(done.stdout)
    assert done.returncode == 0 and facts["name"] == "standard input" and facts["autopilot"] == "ArduPilot"


def test_trouble_with_standard_input_names_no_temporary_file():
    done = outside("diagnose", "-", input=b"hello")
    assert done.returncode == 2 and done.stderr.startswith(b"rotorwatch: standard input: not a flight log")
    assert outside("diagnose", "-", input=b"").stderr.startswith(b"rotorwatch: standard input: the file is empty")


def test_standard_input_is_read_once(fake, run, typed):  # noqa: F811
    typed(b"x")
    code, _, err = run("diagnose", "-", "-")
    assert code == 2 and "only once" in err


def test_what_never_ends_is_no_log(fake, run, typed, monkeypatch):  # noqa: F811
    monkeypatch.setattr(incoming, "MOST", 100)
    typed(bytes(1000))
    code, _, err = run("info", "-")
    assert code == 2 and "which no flight log does" in err
    code, _, err = run("info", "/dev/zero")
    assert code == 2 and "is a device" in err


@pytest.mark.parametrize("given", ["https://logs.px4.io/x.ulg", "http://a/b.bin", "s3://bucket/x.bin"])
def test_an_address_is_no_file(fake, run, given):  # noqa: F811
    for argv in (("info", given), ("diagnose", "fault.bin", "--baseline", given), ("diagnose", "fault.bin", "--report", given)):
        code, out, err = run(*argv)
        assert (code, out) == (2, "") and f"{given} is an address, not a file: download it first" in err


def test_names_with_spaces_accents_dashes_and_bytes_that_are_no_text(tmp_path, monkeypatch, run):  # noqa: F811
    monkeypatch.chdir(tmp_path)
    data = SAMPLE.read_bytes()
    for name in ("a b.xz", "żółć ü.xz", "-x.xz"):
        Path(name).write_bytes(data)
    for name in ("a b.xz", "żółć ü.xz", "./-x.xz"):
        assert run("info", name, "--json")[0] == 0
    done = outside("info", "-x.xz")
    assert done.returncode == 2 and b"write ./-x.xz" in done.stderr
    try:
        Path(bytes.decode(b"bad\xff.xz", errors="surrogateescape")).write_bytes(data)
    except OSError:
        return  # a file system that takes only text
    done = outside("diagnose", b"bad\xff.xz".decode(errors="surrogateescape"), "--report", "page.html")
    assert done.returncode == 1 and done.stderr == b"rotorwatch: report written to page.html\n"
    assert "bad\\udcff.xz" in Path("page.html").read_text()


def test_an_empty_name_is_not_this_folder(fake, run):  # noqa: F811
    code, _, err = run("diagnose", "")
    assert code == 2 and "empty file name" in err


# Where answers go


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (("diagnose", "fault.bin", "--report", "-"), "standard output carries the answer"),
        (("diagnose", "fault.bin", "--report", "/dev/null"), "no ordinary file"),
        (("diagnose", "fault.bin", "--report", "/proc/x.html"), "cannot write into /proc"),
        (("diagnose", "fault.bin", "--report", "healthy.bin/x.html"), "healthy.bin is a file, not a folder"),
        (("calibrate", "healthy.bin", "-o", "no/v.toml"), "there is no folder no"),
        (("calibrate", "healthy.bin", "-o", "."), ". is a folder; give a file name"),
        (("tune", "healthy.bin", "-o", "no/t.toml"), "there is no folder no"),
        (("observability", "--vehicle", "ardupilot-quad-x", "--figure", "no/f.svg"), "there is no folder no"),
        (("observability", "--vehicle", "ardupilot-quad-x", "--figure", "f.xyz"), "ends in .svg, .png or .pdf"),
        (("reproduce", "all", "--figures", "healthy.bin"), "healthy.bin is a file, not a folder"),
        (("export-c", "--estimator", "ekf", "-o", "healthy.bin"), "healthy.bin is a file, not a folder"),
    ],
)
def test_a_place_that_cannot_be_written_to_is_noticed_before_the_work(fake, run, monkeypatch, argv, words):  # noqa: F811
    def work(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setattr(sys.modules["rotorwatch.logs"], "read", work)
    monkeypatch.setattr("rotorwatch_lab.published.observability.observability", work)
    before = sorted(fake.iterdir())
    code, out, err = run(*argv)
    assert (code, out) == (2, "") and words in err and err.count("\n") == 1
    assert sorted(fake.iterdir()) == before


@pytest.mark.parametrize(
    "argv", [("observability", "--vehicle", "ardupilot-quad-x", "--figure", "f.svg"), ("reproduce", "aesmf", "--figures", "d")]
)
def test_a_missing_library_is_noticed_before_the_work(fake, run, monkeypatch, argv):  # noqa: F811
    def work(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setattr("rotorwatch_lab.published.observability.observability", work)
    monkeypatch.setattr("rotorwatch_lab.experiments.studies.reproduction.reproduce", work)
    code, out, err = run(*argv)
    assert (code, out) == (2, "") and "needs matplotlib, which is not installed: pip install matplotlib." in err


def test_a_study_says_first_what_it_needs(fake, run, monkeypatch):  # noqa: F811
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    code, _, err = run("reproduce", "axkf")
    assert code == 2 and "The study axkf needs cvxpy, which is not installed: pip install cvxpy." in err


def test_the_benchmark_of_steps_says_which_extras_it_needs():
    text = "import sys, runpy; sys.modules['jax'] = None; sys.path.insert(0, 'benchmarks'); runpy.run_path('benchmarks/run.py')"
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", text], cwd=root, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert "the extras `benchmark` and `research`" in done.stderr


def test_no_hint_names_a_package_that_is_not_published():
    root = Path(cli.__file__).parents[1]
    assert [p for p in root.rglob("*.py") if "rotorwatch[" in p.read_text(encoding="utf-8")] == []


def test_a_file_is_there_whole_or_not_at_all(tmp_path):
    target = tmp_path / "t.toml"
    target.write_text("old")
    with pytest.raises(KeyboardInterrupt), files.replacing(target) as unfinished:
        unfinished.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old" and list(tmp_path.iterdir()) == [target]
    with files.replacing(target) as unfinished:
        unfinished.write_text("new")
    assert target.read_text() == "new" and list(tmp_path.iterdir()) == [target]
    with pytest.raises(ConfigError, match="cannot be written"), files.replacing(tmp_path / "no" / "t.toml"):
        pass


FULL = "rotorwatch: Reading or writing failed: No space left on device.\n"


@pytest.mark.thorough(keep=5)
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize(
    "words, where, code, err",
    [
        (("info", SAMPLE), ">/dev/full", 2, FULL),  # the command returns
        (("--version",), ">/dev/full", 2, FULL),  # it leaves by itself
        (("survive", "--help"), ">/dev/full", 2, FULL),
        (("no-such-command",), "2>/dev/full", 2, ""),
        (("info", "no-such.bin"), "2>/dev/full", 2, ""),
        (("info", SAMPLE), ">/dev/full 2>&1", 2, ""),
        (("info", SAMPLE), ">&-", 0, ""),  # nobody wants the answer: the exit code is one, too
        (("--version",), ">&-", 0, ""),
        (("info", "no-such.bin"), "2>&-", 2, ""),
        (("info", "no-such.bin"), "<&- >&- 2>&-", 2, ""),
    ],
)
def test_an_answer_that_cannot_be_written_is_an_error_and_no_verdict(words, where, code, err):
    """A shell opens and closes the streams, as users have it. The output is buffered: what waits is tried again when Python ends."""
    command = [sys.executable, "-m", "rotorwatch.commands.cli", *map(str, words)]
    done = subprocess.run(["sh", "-c", f'"$@" {where}', "sh", *command], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (code, "", err)


# Other words


def test_a_tuning_that_is_no_text_is_no_tuning(tmp_path):
    path = tmp_path / "t.toml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="is not a tuning file"):
        tune.read(path, "ekf")


def test_quiet_means_quiet(fake, run, monkeypatch):  # noqa: F811
    def read(path, progress=None):
        warnings.warn("no compiler", BackendWarning, stacklevel=1)
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["rotorwatch.logs"], "read", read)
    assert "no compiler" in run("diagnose", "fault.bin")[2]
    assert "no compiler" not in run("diagnose", "fault.bin", "-q")[2]


@pytest.mark.parametrize("term", ["dumb", "unknown"])
def test_no_bar_where_nothing_can_move(monkeypatch, term):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert tools.live()
    monkeypatch.setenv("TERM", term)
    assert not tools.live()
    with tools.progress(False) as tell:
        assert tell is None


@pytest.mark.parametrize("text", ["nan", "0", "1", "-1", "1e9", "", "0.2;0.3"])
def test_losses_that_no_vehicle_flies_with(text):
    with pytest.raises(ConfigError, match="--loss"):
        tools.shares("--loss", text)


def test_a_table_of_truth_is_read_before_anything_is_simulated(tmp_path, monkeypatch):
    from click.testing import CliRunner

    from rotorwatch_lab.experiments.studies import compare_flights

    monkeypatch.setattr(compare_flights, "simulated", lambda *_: 1 / 0)
    path = tmp_path / "truth.csv"
    for text, words in (
        (b"\xff\xfe", "is no table"),
        (b"a,b\n1,2\n", "needs the columns"),
        (b"path,faulty_rotors,thrust_loss,start_s\nother.bin,1,0.1,2\n", "names none of the logs"),
    ):
        path.write_bytes(text)
        done = CliRunner().invoke(cli.cli, ["compare", str(SAMPLE), "--truth", str(path)])
        assert isinstance(done.exception, ConfigError) and words in str(done.exception)
    done = CliRunner().invoke(cli.cli, ["compare", "--estimators", "crystal"])
    assert isinstance(done.exception, ConfigError) and "no estimator called 'crystal'" in str(done.exception)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_in_a_folder_is_passed_over_and_one_without_a_writer_is_said(tmp_path, run, monkeypatch):  # noqa: F811
    """To open such a pipe waits for ever."""
    from rotorwatch.gathering import Gathered
    from rotorwatch.logs import LogError, fingerprint, read

    monkeypatch.setattr(tools, "WRITER_S", 0.1)
    pipe = tmp_path / "a.bin"
    os.mkfifo(pipe)
    (tmp_path / "log.bin").write_bytes(b"no log")
    (tmp_path / "other.txt").write_bytes(b"no log")
    found = Gathered([tmp_path])
    assert [path.name for path in found] == ["log.bin"] and found.others == 2
    for command in ("diagnose", "info"):
        code, out, err = run(command, pipe)
        assert code == 2 and not out and "a pipe without a writer" in err and len(err.strip().splitlines()) == 1
    for ask in (read, fingerprint):
        with pytest.raises(LogError, match="a pipe"):
            ask(pipe)
