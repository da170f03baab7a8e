"""Many logs in one call: which ones, in what order they are shown, and what is left when the call is ended."""

import json
import lzma
import re
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

import rotorwatch
from rotorwatch import gathering
from rotorwatch.commands import several
from rotorwatch.errors import ConfigError, LogError
from rotorwatch.report import overview
from test_cli import fake, run  # noqa: F401

SAMPLES = Path(rotorwatch.__file__).parent / "samples"
DATAFLASH = lzma.decompress((SAMPLES / "quadx_healthy_hover.bin.xz").read_bytes())[:5000]


@pytest.fixture
def folder(tmp_path):
    """Two logs, one of them compressed, one more in a folder below, and what is no log."""
    for name in ("a.bin", "deep/down/c.bin", "deep/not-named-as-one"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(DATAFLASH)
    (tmp_path / "b.bin.xz").write_bytes(lzma.compress(DATAFLASH))
    (tmp_path / "notes.txt").write_text("nothing to see")
    (tmp_path / "truth.csv").write_text("rotor,loss\n1,0.2\n")
    (tmp_path / "empty.bin").write_bytes(b"")
    (tmp_path / ".hidden.bin").write_bytes(DATAFLASH)
    return tmp_path


def names(found, folder):
    return [str(Path(log).relative_to(folder)) for log in found]


# Which logs


def test_a_folder_stands_for_the_logs_in_it(folder):
    found = gathering.Gathered([folder])
    assert names(found, folder) == ["a.bin", "b.bin.xz", "deep/down/c.bin", "deep/not-named-as-one", "empty.bin"]
    assert found.others == 2


def test_logs_of_a_folder_are_looked_for_once(folder, monkeypatch):
    """What the command has found is assessed as it is: packed logs take as long to be recognised as to be read."""
    looked = []
    real = gathering.Gathered._of
    monkeypatch.setattr(gathering.Gathered, "_of", lambda self, source: looked.append(source) or real(self, source))
    found = gathering.Found(gathering.Gathered([folder]))
    assert {a.path for a in rotorwatch.diagnose_many(found, jobs=1)} == {str(path) for path in found} and looked == [folder]


def test_a_log_in_a_folder_that_cannot_be_read_is_an_error_and_not_left_out(folder):
    """A name that only logs have says that it is one, and was worth keeping; what is wrong is said by whoever reads it."""
    for name in ("broken.ulg", "broken.TLOG", "broken.bin.xz"):
        (folder / name).write_bytes(b"\0" * 64)
    broken = {"broken.ulg", "broken.TLOG", "broken.bin.xz", "empty.bin"}
    answers = {Path(a.path).name: a for a in rotorwatch.diagnose_many([folder / "*.*"], jobs=1) if a.path}
    assert {name for name, a in answers.items() if a.exit_code == 2 and name in str(a.error)} >= broken
    (folder / "only").mkdir()
    (folder / "only" / "broken.ulg").write_bytes(b"\0" * 64)
    (answer,) = rotorwatch.diagnose_many([folder / "only"], jobs=1)
    assert answer.exit_code == 2 and "not a flight log" in str(answer.error)


def test_patterns_and_names_and_each_log_once(folder, monkeypatch):
    monkeypatch.chdir(folder)
    found = gathering.Gathered(["a.bin", "missing.bin", "**/*.bin", folder / "a.bin", "notes.txt"])
    # What is named is taken as it is: whoever reads it says what is wrong.
    assert list(map(str, found)) == ["a.bin", "missing.bin", "deep/down/c.bin", "empty.bin", "notes.txt"] and found.others == 0
    for given, says in (("*.nothing", "fits no flight log"), ("deep/none", None)):
        if says:
            with pytest.raises(ConfigError, match=says):
                list(gathering.Gathered([given]))
    (folder / "bare").mkdir()
    with pytest.raises(ConfigError, match="bare holds no flight log"):
        list(gathering.Gathered([folder / "bare"]))


def test_a_folder_of_tables_is_one_log(tmp_path):
    (tmp_path / "x" / "log_vehicle_status_0.csv").parent.mkdir()
    (tmp_path / "x" / "log_actuator_outputs_0.csv").write_text("timestamp,output[0]\n1,1\n")
    assert list(gathering.Gathered([tmp_path])) == [tmp_path / "x"] and not gathering.is_several(tmp_path / "x")


def test_logs_behind_addresses(folder):
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    for name in ("a.bin", "deep/c.ulg.xz", "deep/notes.txt"):
        memory.pipe_file(f"/flights/{name}", DATAFLASH)
    try:
        found = gathering.Gathered(["memory://flights/", "memory://flights/*.bin", (folder / "a.bin").as_uri()])
        assert list(found) == ["memory:///flights/a.bin", "memory:///flights/deep/c.ulg.xz", (folder / "a.bin").as_uri()]
        assert found.others == 1
        with gathering.fetched("memory://flights/a.bin") as here:
            assert here.name == "a.bin" and here.read_bytes() == DATAFLASH
        assert not here.exists()
        with gathering.fetched((folder / "a.bin").as_uri()) as here:
            assert here == folder / "a.bin"
        with pytest.raises(LogError, match=r"memory://flights/none\.bin: nothing is there"):
            with gathering.fetched("memory://flights/none.bin"):
                pass
    finally:
        memory.rm("/flights", recursive=True)


def test_logs_on_a_web_server(folder):
    pytest.importorskip("aiohttp")

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        here = f"http://127.0.0.1:{server.server_port}"
        found = gathering.Gathered([f"{here}/", f"{here}/a.bin"])
        assert list(found) == [f"{here}/{n}" for n in ("a.bin", "b.bin.xz", "deep/down/c.bin", "empty.bin", "truth.csv")]
        with gathering.fetched(f"{here}/b.bin.xz") as copy:
            assert copy.name == "b.bin.xz" and copy.read_bytes() == (folder / "b.bin.xz").read_bytes()
        with pytest.raises(LogError, match=r"none\.bin: nothing is there"):
            with gathering.fetched(f"{here}/none.bin"):
                pass
        server.shutdown()


def test_without_fsspec_one_sentence(fake, run, monkeypatch):  # noqa: F811
    monkeypatch.setitem(sys.modules, "fsspec", None)
    code, out, err = run("diagnose", "s3://bucket/x.bin")
    assert (code, out) == (2, "") and "s3://bucket/x.bin needs fsspec, which is not installed" in err


@pytest.fixture
def plain_pages(monkeypatch):
    """Reports without plots, which take seconds."""
    from rotorwatch.report import html

    monkeypatch.setattr(html, "page", lambda found: f"<!doctype html>{found.verdict}")


# What is shown


def test_the_table_has_the_worst_first_with_full_paths(fake, run, monkeypatch):  # noqa: F811
    """It stays a table in a pipe; the folder that all are in is said once, and in a wide one why as well."""
    logs = [f"{name}.bin" for name in ("healthy", "ambiguous", "crashed", "fault", "broken", "inconclusive")]
    code, out, err = run("diagnose", *logs)
    assert code == 2
    order = [tuple(line.split()[:2]) for line in out.splitlines() if ".bin" in line]
    assert order == [
        (n.replace("broken", "error"), f"{n}.bin") for n in ("broken", "crashed", "fault", "ambiguous", "inconclusive", "healthy")
    ]
    assert f"all in {fake}/" in "".join(out.split("\n")[1:3])
    assert out.startswith("6 logs: 1 error, 1 crashed, 1 fault, 1 ambiguous, 1 inconclusive, 1 healthy")
    assert max(map(len, out.splitlines())) <= 80 and out.split().count("what") == 1 and "why" not in out.split()
    # Answers were reported as they came.
    assert [line.split()[0] for line in err.splitlines()] == ["healthy", "ambiguous", "crashed,", "fault", "rotorwatch:", "inconclusive"]
    assert run("diagnose", "-q", *logs)[2] == "rotorwatch: broken.bin: not a flight log.\n"


def test_the_first_answer_is_there_before_the_last_log_is_read(fake, run, monkeypatch):  # noqa: F811
    seen = []
    real = rotorwatch.logs.read

    def read(path, progress=None):
        seen.append(len(Path("out.jsonl").read_text().splitlines()))
        return real(path, progress)

    monkeypatch.setattr(rotorwatch.logs, "read", read)
    run("diagnose", "fault.bin", "healthy.bin", "ambiguous.bin", "--jsonl", "-o", "out.jsonl")
    assert seen == [0, 1, 2]


def test_json_lines_hold_path_code_and_the_answer(fake, run):  # noqa: F811
    code, out, _ = run("diagnose", "fault.bin", "broken.bin", "bug.bin", "--jsonl")
    lines = [json.loads(line) for line in out.splitlines()]
    assert code == 2 and [line["exit_code"] for line in lines] == [1, 2, 2]
    assert [line["path"] for line in lines] == [str(fake / n) for n in ("fault.bin", "broken.bin", "bug.bin")]
    assert lines[0]["verdict"] == "fault" and lines[0]["size"] == 1 and len(lines[0]["sha256"]) == 64
    assert lines[1]["error"] == "broken.bin: not a flight log." and "report it" in lines[2]["error"]
    assert lines[2]["sha256"] is None  # not known to be the log's fault: --resume tries it again
    whole = json.loads(run("diagnose", "fault.bin", "--json")[1])
    assert set(lines[0]) == {"path", "exit_code", "size", "sha256", "settings", *whole}


def test_resume_does_nothing_twice(fake, run, monkeypatch):  # noqa: F811
    logs = ("fault.bin", "healthy.bin", "ambiguous.bin", "broken.bin", "bug.bin")
    run("diagnose", *logs, "--jsonl", "-o", "whole.jsonl")
    whole = Path("whole.jsonl").read_text().splitlines()
    Path("part.jsonl").write_text("\n".join(whole[:3]) + "\n" + whole[3][:50])  # killed while it wrote
    Path("healthy.bin").write_bytes(b"another")
    read = []
    real = rotorwatch.logs.read
    monkeypatch.setattr(rotorwatch.logs, "read", lambda path, progress=None: read.append(path.name) or real(path, progress))
    code, _, _ = run("diagnose", *logs, "--jsonl", "-o", "part.jsonl", "--resume")
    assert code == 2 and read == ["healthy.bin", "broken.bin", "bug.bin"]
    lines = [json.loads(line) for line in Path("part.jsonl").read_text().splitlines()]
    assert [Path(line["path"]).name for line in lines] == [*logs[:3], "healthy.bin", "broken.bin", "bug.bin"]
    read.clear()
    assert run("diagnose", "fault.bin", "healthy.bin", "--jsonl", "-o", "part.jsonl", "--resume")[0] == 1 and read == []
    # The same lines as undisturbed, but for the times that it took.
    last = {line["path"]: line for line in lines}
    for text in whole:
        one = json.loads(text)
        if "healthy" not in one["path"] and "error" not in one:
            assert {**one, "timing": 0} == {**last[one["path"]], "timing": 0}


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (("--jsonl", "-o", "there.jsonl"), "there.jsonl exists already: continue it with --resume"),
        (("--jsonl", "-o", "there.jsonl", "--resume"), "line 1 is not a diagnosis of rotorwatch"),
        (("--jsonl", "-o", "other.jsonl", "--resume"), "made by another version"),
        (("--jsonl", "--json"), "give one"),
        (("-o", "x.jsonl"), "belong to --jsonl"),
        (("--resume", "--jsonl"), "belong to --jsonl"),
        (("--jobs", "2", "--scheduler", "tcp://a:1"), "not both"),
        (("--html", "healthy.bin"), "is a file, not a folder"),
    ],
)
def test_what_does_not_fit_is_reported_before_the_work(fake, run, argv, says):  # noqa: F811
    Path("there.jsonl").write_text("hello\n")
    line = {"path": "/x", "exit_code": 0, "size": 1, "sha256": "0", "settings": "of another"}
    Path("other.jsonl").write_text(json.dumps(line) + "\n")
    code, out, err = run("diagnose", "fault.bin", "healthy.bin", *argv)
    assert (code, out) == (2, "") and says in err and err.count("\n") == 1


def test_names_that_are_no_text_are_gone_on_with_too(fake, run, monkeypatch):  # noqa: F811
    name = b"fault-\xff.bin".decode(errors="surrogateescape")
    Path(name).write_bytes(b"x")
    argv = ("diagnose", name, "healthy.bin", "--jsonl", "-o", "out.jsonl")
    run(*argv)
    monkeypatch.setattr(rotorwatch.logs, "read", None)
    assert run(*argv, "--resume")[0] == 1 and len(Path("out.jsonl").read_text().splitlines()) == 2


def test_nothing_is_shown_where_nothing_was_answered(fake, run, monkeypatch):  # noqa: F811
    from rotorwatch.base.many import cluster

    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "ANSWER_S", 0.2)
    code, out, err = run("diagnose", "fault.bin", "healthy.bin", "--scheduler", "tcp://127.0.0.1:1")
    assert (code, out) == (2, "") and err.startswith("rotorwatch: No Dask scheduler answers") and err.count("\n") == 1


def test_what_was_answered_stays_when_the_call_is_interrupted(fake, run, monkeypatch, plain_pages):  # noqa: F811
    real = rotorwatch.logs.read

    def read(path, progress=None):
        if "ambiguous" in str(path):
            raise KeyboardInterrupt
        return real(path, progress)

    monkeypatch.setattr(rotorwatch.logs, "read", read)
    logs = ("healthy.bin", "fault.bin", "ambiguous.bin", "inconclusive.bin")
    code, out, err = run("diagnose", *logs, "--html", "pages")
    assert code == 130 and out.startswith("2 logs: 1 fault, 1 healthy") and err.endswith("rotorwatch: interrupted\n")
    assert "fault.bin" in Path("pages/index.html").read_text()
    code, _, _ = run("diagnose", *logs, "--jsonl", "-o", "out.jsonl")
    assert code == 130 and len(Path("out.jsonl").read_text().splitlines()) == 2


def test_pages_and_the_index_that_links_them(fake, run, plain_pages):  # noqa: F811
    (fake / "sub").mkdir()
    (fake / "sub" / "fault.bin").write_bytes(b"y")
    argv = ("fault.bin", "sub/fault.bin", "healthy.bin", "broken.bin", "--html", "pages")
    code, _, err = run("diagnose", *argv)
    pages = sorted(path.name for path in Path("pages").iterdir())
    assert code == 2 and "pages written to pages/index.html" in err
    assert [re.sub(r"-[0-9a-f]{8}", "-*", name) for name in pages] == ["fault-*.html", "fault-*.html", "healthy-*.html", "index.html"]
    index = Path("pages/index.html").read_text()
    assert all(f'href="{name}"' in index for name in pages[:3])
    assert index.index("broken.bin") < index.index("sub/fault.bin") < index.index("healthy.bin")
    assert "://" not in index and 'type="search"' in index
    before = {name: Path("pages", name).stat().st_ino for name in pages}
    run("diagnose", "fault.bin", "--html", "pages")
    assert [name for name in pages if Path("pages", name).stat().st_ino != before[name]] != pages  # same log, same name


def test_the_python_function_takes_what_comes(fake):  # noqa: F811
    def endless():
        yield from ("fault.bin", "broken.bin")
        raise AssertionError("more was taken than was asked for")

    answers = rotorwatch.diagnose_many(endless(), jobs=1)
    first, second = next(answers), next(answers)
    assert (first.exit_code, first.diagnosis.verdict, first.page, first.sha256) == (1, "fault", None, None)
    assert first.path == str(fake / "fault.bin") and first.diagnosis.trace is None
    assert (second.exit_code, second.diagnosis) == (2, None) and isinstance(second.error, LogError)
    assert second.to_dict() == {"schema": 3, "flight": {"name": "broken.bin"}, "error": "broken.bin: not a flight log."}
    answers.close()


# Rows


def a_row(verdict="fault", loss=0.2, path="/a.bin"):
    return overview.Row(verdict, path, "quad", "", "what", loss)


def test_rows_are_counted_and_the_worst_are_kept(monkeypatch):
    monkeypatch.setattr(overview, "MOST", 3)
    rows = overview.Rows()
    for k in range(20):
        rows.add(a_row("healthy" if k % 2 else "fault", 0.01 * k, f"/{k}"))
    assert [row.path for row in rows.worst()] == ["/18", "/16", "/14"]
    assert rows.title() == "20 logs: 10 fault, 10 healthy (the 3 worst are listed)"


@pytest.mark.parametrize(
    ("facts", "main", "says"),
    [
        ({"utc_start": "2026-11-21T07:40:36.500Z", "boot_s": 3.0}, 0, "2026-11-21 07:41:07 UTC"),
        ({"utc_start": "2026-11-21T07:40:36Z"}, None, "2026-11-21 07:40:36 UTC"),
        ({"boot_s": 3.0}, 0, "34.20 s since boot"),
        ({}, 0, "31.20 s"),
        ({"boot_s": 3.0}, None, ""),
    ],
)
def test_when_is_utc_or_the_logs_own_clock(facts, main, says):
    assert overview.when({"flight": facts, "main_event": main, "events": [{"onset_s": 31.2}]}) == says


def test_settings_change_with_what_answers_depend_on(tmp_path):
    (tmp_path / "v.toml").write_text("a")
    one = several.settings("default", 0.2, tmp_path / "v.toml")
    assert one == several.settings("default", 0.2, tmp_path / "v.toml") != several.settings("ekf", 0.2, tmp_path / "v.toml")
    assert one != several.settings("default", 0.3, tmp_path / "v.toml")
    (tmp_path / "v.toml").write_text("b")
    assert one != several.settings("default", 0.2, tmp_path / "v.toml")
