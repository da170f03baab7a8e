"""`rotorwatch mcp` over standard input and output: ten questions, bounded answers, and inputs that mean harm."""

from __future__ import annotations

import lzma
import os
import signal
import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mcp")

from mcp_client import COMMAND, CURRENT, ENVIRONMENT, PREVIOUS, Session, command
from mcp_texts import ORDERS, WORD, quoted, tokens, unmarked
from rotorwatch import diagnose, logs
from rotorwatch.commands.cli import SAMPLES
from rotorwatch.flight import Message
from rotorwatch_lab.simulation.write_dataflash import write_dataflash

CRASH = Path(__file__).resolve().parents[2] / "shared" / "flights" / "crash"
HEXA, HOVER, FPV = ("hexax_m3_mul0.80_square_wind.bin.xz", "quadx_healthy_hover.bin.xz", "fpv_motor_3_stops.bbl.xz")
MOST_TOKENS = 1500

# Inputs that mean harm.

TEXTS = [f"{WORD} {order}" for order in ORDERS]
NAMES = [f"{WORD} {order}".replace("/", "|").replace("\0", "")[:90] + ".bin" for order in ORDERS]
OUTSIDE = [
    "/etc/passwd", "/etc/shadow", "/proc/self/environ", "/proc/self/mem", "/proc/1/root/etc/passwd", "/dev/zero", "/dev/stdin",
    "/root/.ssh/id_rsa", "//etc/passwd", "/./etc/../etc/passwd", "../secret.bin", "../../../../../../etc/passwd", "a/../../secret.bin",
    "./../secret.bin", "..", ".", "/", "//", "~", "~/.ssh/id_rsa", "~root/secret.bin", "$HOME/secret.bin", "%2e%2e/secret.bin",
    "..%2fsecret.bin", "..\\secret.bin", "C:\\Windows\\win.ini", "\\\\server\\share\\a.bin", "file:///etc/passwd",
    "http://127.0.0.1/a.bin", "https://example.org/flight.bin", "s3://bucket/flight.bin", "ftp://example.org/a.bin", "link.bin",
    "linked/secret.bin", "loop.bin", "dangling.bin", ".hidden.bin", ".git/config.bin", "sub/.hidden.bin", "pipe.bin", "socket.bin",
    "folder.bin", "sub", "sub/", "empty.bin", "huge.bin", "huge.csv.xz", "notes.txt", "key.pem", "log.bin/../../secret.bin", "none.bin",
    "none.bin#2", "#2", "#", "*.bin", "?", "[a].bin", "-", "--help", "-rf", "0" * 12, "f" * 12, "log.bin\0.toml", "\0", "a" * 1025,
    "b" * 300 + ".bin", "/" * 900, "../" * 300 + "etc/passwd", "CON.bin", "nul", "aux.bin", " ", "\t", "\n", "log.bin\n", "|id.bin",
    ";reboot.bin", "`id`.bin", "$(id).bin", "<log.bin",
]  # fmt: skip
WRONG: list[tuple[str, dict]] = [
    ("diagnose", {}), ("diagnose", {"log": None}), ("diagnose", {"log": 1}), ("diagnose", {"log": ["a"]}), ("diagnose", {"log": {}}),
    ("diagnose", {"log": ""}), ("diagnose", {"log": True}), ("diagnose", {"logs": "log.bin"}),
    ("diagnose", {"log": "log.bin", "shell": "id"}), ("diagnose", {"log": "log.bin", "vehicle": "/etc/passwd"}),
    ("diagnose", {"log": "log.bin", "vehicle": "log.bin"}), ("diagnose", {"log": "log.bin", "vehicle": 7}),
    ("diagnose", {"log": "log.bin", "vehicle": "evil.toml"}), ("diagnose", {"log": "log.bin", "vehicle": "huge.toml"}),
    ("diagnose", {"log": "log.bin", "estimator": "os.system"}), ("diagnose", {"log": "broken.bin"}), ("diagnose", {"log": "text.bin"}),
    ("diagnose", {"log": "bomb.bin.xz"}), ("diagnose", {"log": "evil.csv"}), ("compare_with_healthy", {"log": "log.bin"}),
    ("compare_with_healthy", {"log": "log.bin", "baseline": []}), ("compare_with_healthy", {"log": "log.bin", "baseline": "log.bin"}),
    ("compare_with_healthy", {"log": "log.bin", "baseline": ["/etc/passwd"]}),
    ("compare_with_healthy", {"log": "log.bin", "baseline": ["log.bin"] * 21}),
    ("compare_with_healthy", {"log": "log.bin", "baseline": [None]}), ("event", {"log": "log.bin", "number": -1}),
    ("event", {"log": "log.bin", "number": 10**30}), ("event", {"log": "log.bin", "number": 0.5}),
    ("event", {"log": "log.bin", "number": "one"}), ("event", {"log": "log.bin", "number": [0]}), ("event", {"number": 0}),
    ("get_series", {"log": "log.bin", "what": "__class__"}), ("get_series", {"log": "log.bin", "what": ""}),
    ("get_series", {"log": "log.bin", "most": 401}), ("get_series", {"log": "log.bin", "most": 0}),
    ("get_series", {"log": "log.bin", "most": 10**12}), ("get_series", {"log": "log.bin", "most": -5}),
    ("get_series", {"log": "log.bin", "most": 1e300}), ("get_series", {"log": "log.bin", "rotor": 0}),
    ("get_series", {"log": "log.bin", "rotor": 65}), ("get_series", {"log": "log.bin", "start_s": -1.0}),
    ("get_series", {"log": "log.bin", "end_s": 1e300}), ("get_series", {"log": "log.bin", "start_s": "now"}),
    ("get_series", {"log": "log.bin", "start_s": "nan"}), ("get_series", {"log": "log.bin", "end_s": "inf"}),
    ("picture", {"log": "log.bin", "what": "../../etc/passwd"}), ("picture", {"log": "log.bin", "what": None}),
    ("picture", {"log": "log.bin", "path": "/tmp/x.png"}), ("picture", {"log": "log.bin", "width": 10**6}),
    ("info", {"log": "/proc/kcore"}), ("info", {}), ("what_to_log", {"log": []}), ("survive", {}),
    ("survive", {"vehicle": "/etc/passwd"}), ("survive", {"vehicle": "../x.toml"}), ("survive", {"vehicle": "evil"}),
    ("survive", {"vehicle": "ardupilot-quad-x", "loss": [2.0]}), ("survive", {"vehicle": "ardupilot-quad-x", "loss": []}),
    ("survive", {"vehicle": "ardupilot-quad-x", "loss": [0.1] * 50}), ("survive", {"vehicle": "ardupilot-quad-x", "mass_kg": -1}),
    ("survive", {"vehicle": "ardupilot-quad-x", "mass_kg": "inf"}), ("survive", {"vehicle": "ardupilot-quad-x", "thrust_to_weight": 0}),
    ("survive", {"vehicle": "ardupilot-quad-x", "arm_m": 1e9}), ("list_logs", {"limit": 0}), ("list_logs", {"limit": 10**9}),
    ("list_logs", {"search": "x" * 201}), ("list_logs", {"folder": "/etc"}), ("fleet", {"limit": -1}), ("fleet", {"search": 5}),
    ("fleet", {}), ("fleet_flights", {"offset": -1}), ("fleet_flights", {"limit": 31}), ("fleet_flights", {"search": "' OR 1=1 --"}),
    ("fleet_flights", {"sort": "hash; DROP TABLE flights"}), ("fleet_flights", {"verdict": "crashed"}),
    ("fleet_flights", {"since": "' OR 1=1 --"}), ("fleet_flights", {"min_loss": 2}), ("fleet_flights", {"min_duration": "nan"}),
    ("fleet_flights", {"aircraft": ""}), ("fleet_flight", {"flight": "../../x"}), ("fleet_flight", {"flight": "abc"}),
    ("fleet_flight", {"flight": "0' OR '1'='1"}), ("fleet_flight", {"flight": "a" * 65}),
    ("fleet_event", {"flight": "abcdef", "number": -3}), ("fleet_event", {}), ("delete_everything", {}), ("", {}), ("__init__", {}),
    ("diagnose; rm -rf /", {"log": "log.bin"}), ("tools/call", {}), (f"{WORD} tool", {"x": 1}),
]  # fmt: skip
ADDRESSES = [
    "file:///etc/passwd", "rotorwatch://glossary/../limits", "rotorwatch://glossary/%2e%2e%2fsecret", "rotorwatch://secret",
    "rotorwatch://limits//etc/passwd", f"rotorwatch://glossary/{WORD}", "http://127.0.0.1/", "rotorwatch://",
    "rotorwatch://glossary/" + "x" * 5000, "rotorwatch://limits/__class__",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """An allowed folder full of traps, next to a secret."""
    top = tmp_path_factory.mktemp("mcp")
    (top / "secret.bin").write_bytes(b"secret")
    here = top / "logs"
    (here / "sub").mkdir(parents=True)
    for name in ("folder.bin", ".git"):
        (here / name).mkdir()
    for name in (".hidden.bin", ".git/config.bin", "sub/.hidden.bin", "notes.txt", "key.pem"):
        (here / name).write_bytes(b"secret")
    (here / "link.bin").symlink_to(top / "secret.bin")
    (here / "linked").symlink_to(top)
    (here / "loop.bin").symlink_to(here / "loop.bin")
    (here / "dangling.bin").symlink_to(here / "nothing.bin")
    os.mkfifo(here / "pipe.bin")
    with socket.socket(socket.AF_UNIX) as sock:
        before = os.getcwd()
        os.chdir(here)  # a socket's path is short
        try:
            sock.bind("socket.bin")
        finally:
            os.chdir(before)
    (here / "empty.bin").touch()
    for name in ("huge.bin", "huge.csv.xz", "huge.toml"):
        with (here / name).open("wb") as file:
            file.truncate(600 << 20)
    flight = logs.read(SAMPLES / HOVER)
    evil = [Message(float(k), "text", f"thrust error {text}") for k, text in enumerate(TEXTS, 1)]
    reported = sorted([*flight.messages, *evil], key=lambda m: m.time)
    hostile = replace(flight, messages=tuple(reported), name="x")
    object.__setattr__(hostile, "firmware", f"ArduCopter V4.5.7 {TEXTS[0]}")
    write_dataflash(hostile, here / "log.bin")
    for k, name in enumerate(NAMES):
        os.link(here / "log.bin", here / f"{k:02d} {name}")
    (here / "broken.bin").write_bytes((here / "log.bin").read_bytes()[:3000])
    (here / "text.bin").write_text(TEXTS[0])
    (here / "bomb.bin.xz").write_bytes(lzma.compress(bytes(40 << 20), preset=0))
    (here / "evil.csv").write_text(f'time_s,"{TEXTS[0]}",motor_1\n0,1,2\n')
    (here / "evil.toml").write_text(f'name = "{TEXTS[0]}"\n"{TEXTS[1]}" = 1\n')
    return here


@pytest.fixture(scope="module")
def session(folder):
    words = [SAMPLES, *([CRASH] if CRASH.exists() else []), folder]
    session = Session(command(*words), CURRENT)
    yield session
    session.close()


def test_there_are_hostile_inputs_enough():
    assert len(TEXTS) + len(NAMES) + len(OUTSIDE) + len(WRONG) + len(ADDRESSES) >= 200
    assert len(set(OUTSIDE)) == len(OUTSIDE)


# Ten questions, one call each.

QUESTIONS = [
    ("which rotor of the hexa lost thrust?", SAMPLES / HEXA, "fault", (3,), None),
    ("is this hover healthy?", SAMPLES / HOVER, "healthy", (), None),
    ("why did my FPV quad fall?", SAMPLES / FPV, "fault", (3,), None),
    ("it fell: which rotor?", CRASH / "quad-off-1.bin.xz", "fault", (2,), None),
    ("it came down spinning: why?", CRASH / "quad-half-1.bin.xz", "fault", (1,), None),
    ("it turned over at take-off: why?", CRASH / "take-off-swapped-1.bin.xz", "fault", (1, 2), "motor_order"),
    ("was it a rotor?", CRASH / "disarmed-1.bin.xz", None, (), "disarmed"),
    ("and this one?", CRASH / "gyro-1.bin.xz", None, (), "controller"),
    ("which rotors are weak?", CRASH / "hexa-opposite-2.bin.xz", "ambiguous", (3, 4), None),
    ("did the gust break something?", CRASH / "gust-1.bin.xz", "healthy", (), None),
]


HELD_AGAINST_JSON = {HEXA, FPV, "quad-off-1.bin.xz", "hexa-opposite-2.bin.xz"}  # with --thorough all


@pytest.mark.parametrize(("question", "log", "verdict", "rotors", "cause"), QUESTIONS, ids=[q[0] for q in QUESTIONS])
def test_a_question_is_answered_in_one_call(session, request, question, log, verdict, rotors, cause):
    if not log.exists():
        pytest.skip("no shared flights beside the checkout")
    answer = session.call("diagnose", log=log.name)
    assert not answer.failed and tokens(answer.text) < MOST_TOKENS, tokens(answer.text)
    assert verdict in (None, answer["verdict"])
    if rotors:
        main = next(e for e in answer["events"] if e["number"] == answer["main_event"])
        explanations = [tuple(main["rotors"]), *map(tuple, main.get("alternatives", ()))]
        assert rotors in explanations and (verdict == "ambiguous" or len(explanations) == 1)
    if cause:
        assert any(cause in (e.get("cause"), e["kind"]) for e in answer["events"])
        assert cause == "motor_order" or not any(e["kind"] == "loss_of_effectiveness" for e in answer["events"])
    if log.name in HELD_AGAINST_JSON or request.config.getoption("thorough"):
        has_the_figures_of_json(answer, log)


def has_the_figures_of_json(answer, log):
    """All that the answer says stands so in what `rotorwatch diagnose --json` prints."""
    truth = diagnose(log)
    d = truth.to_dict()
    assert answer["exit_code"] == truth.exit_code
    for name in ("verdict", "headline", "reason"):
        assert answer[name].replace("log.bin.xz", log.name) == d[name]
    assert answer.data.get("main_event") == d["main_event"]
    for line in answer.data.get("events", ()):
        whole = d["events"][line["number"]]
        assert all(whole[name] == value for name, value in line.items() if name != "number")
    for mine, theirs in zip(answer["rotors"], d["rotors"], strict=True):
        assert all(theirs[name] == value for name, value in mine.items())


def test_every_answer_is_short_by_default(session):
    for tool, arguments in [
        ("list_logs", {}), ("info", {"log": HEXA}), ("what_to_log", {"log": HEXA}), ("event", {"log": HEXA}), ("get_series", {"log": HEXA}),
        ("get_series", {"log": HEXA, "what": "residual"}), ("get_series", {"log": HEXA, "what": "evidence"}),
        ("get_series", {"log": FPV, "what": "moment_rates"}), ("picture", {"log": HEXA}),
    ]:  # fmt: skip
        answer = session.call(tool, **arguments)
        assert not answer.failed, (tool, answer.text)
        assert tokens(answer.text) < MOST_TOKENS, (tool, arguments, tokens(answer.text))


def test_a_series_is_bounded_and_keeps_what_matters(session):
    whole = session.call("get_series", log=HEXA, what="loss", rotor=3, most=400)
    assert whole["columns"] == ["time_s", "loss", "lower", "upper"] and 200 < len(whole["rows"]) <= 400 < whole["samples"]
    part = session.call("get_series", log=HEXA, what="command", start_s=47.0, end_s=49.0, most=20)
    assert len(part["rows"]) <= 20 and all(46.9 < row[0] < 49.1 for row in part["rows"]) and len(part["columns"]) == 7
    last = [row[1] for row in whole["rows"] if row[0] > 50.0]
    assert min(last) > 0.25
    assert session.call("get_series", log=HEXA, what="moment_speed").failed


def test_a_picture_is_a_small_png(session):
    answer = session.call("picture", log=FPV)
    (image,) = [part for part in answer.content if part.type == "image"]
    assert image.mime_type == "image/png" and image.data.startswith("iVBOR") and answer["bytes"] < 400_000
    assert "gives nothing at 14.00 s" in answer["shows"]


def test_an_event_has_its_evidence(session):
    answer = session.call("event", log=FPV)
    assert answer["event"]["kind"] == "desync" and answer["details"]["times"] == [14.0, 19.0] and answer["of"] == 2
    assert session.call("event", log=FPV, number=9).failed


def test_what_a_log_lacks(session):
    answer = session.call("what_to_log", log=HEXA)
    assert answer["ready"] and all(gap["setting"] and gap["why"] for gap in answer["missing"])


def test_resources(session):
    assert "| ambiguous |" in session.read("rotorwatch://glossary")
    assert session.read("rotorwatch://glossary/onset") == "onset: when an event began"
    heads = session.read("rotorwatch://limits").splitlines()
    assert "Knocks" in heads and session.read("rotorwatch://limits/Knocks")


def test_tools_say_that_they_only_read_and_what_they_answer(session):
    tools = session.do(session.client.list_tools()).tools
    assert len(tools) == 13
    for tool in tools:
        assert tool.annotations.read_only_hint and tool.output_schema["type"] == "object" and tool.description
    said = sum(len(str((t.name, t.description, t.input_schema))) for t in tools)
    assert said / 3 < 4000, said


# Hostile inputs.


def refused(answer) -> str:
    """The sentence of a refusal: one line, in which nothing of the caller's or of a file stands."""
    assert answer.failed and set(answer.data) <= {"error", "quoted_from_log"}
    text = answer["error"]
    assert text.isprintable() and text.endswith(".") and len(text) < 400 and "Traceback" not in text
    assert WORD not in text and "secret" not in text and str(Path.home()) not in text and "/tmp" not in text
    assert all(len(said) <= 300 and said.isprintable() and "/tmp" not in said for said in quoted(answer.data))
    return text


@pytest.mark.parametrize("path", OUTSIDE, ids=range(len(OUTSIDE)))
def test_no_other_file_is_read(session, path):
    tool = ("diagnose", "info", "what_to_log", "event", "get_series", "picture")[OUTSIDE.index(path) % 6]
    assert "own error" not in refused(session.call(tool, log=path))


@pytest.mark.parametrize(("tool", "arguments"), WRONG, ids=range(len(WRONG)))
def test_wrong_calls_are_refused_in_a_sentence(session, tool, arguments):
    assert "internal error of rotorwatch" not in refused(session.call(tool, **arguments))


@pytest.mark.parametrize("uri", ADDRESSES, ids=range(len(ADDRESSES)))
def test_no_other_resource_is_read(session, uri):
    with pytest.raises(Exception) as why:
        session.read(uri)
    assert "root:" not in str(why.value) and "Traceback" not in str(why.value)


def test_texts_of_a_log_come_back_marked_as_data(session):
    asked = [session.call(tool, log="log.bin") for tool in ("diagnose", "info", "what_to_log", "get_series", "picture")]
    asked += [session.call("compare_with_healthy", log="log.bin", baseline=[f"00 {NAMES[0]}"])]
    for answer in asked:
        assert not [text for text in unmarked(answer.data) if WORD in text]
        assert all(text.isprintable() and len(text) <= 300 for text in quoted(answer.data))
        assert tokens(answer.text) < MOST_TOKENS
    assert any(WORD in text for text in quoted(asked[1]["messages"])) and asked[0]["firmware"]["quoted_from_log"]


def test_names_of_files_come_back_marked_as_data(session, folder):
    answer = session.call("list_logs", search=WORD, limit=50)
    assert answer["total"] == len(NAMES)
    assert not [text for text in unmarked(answer.data) if WORD in text]
    assert all(text.isprintable() for text in quoted(answer.data))
    one = answer["logs"][7]
    found = session.call("what_to_log", log=one["id"])  # whatever the name is, the id is plain
    assert not found.failed and one["id"].isalnum() and WORD in found["log"]["quoted_from_log"]
    assert len({row["id"] for row in answer["logs"]}) == len(NAMES)
    assert session.call("list_logs", search="secret")["total"] == session.call("list_logs", search=".hidden")["total"] == 0


def test_nothing_was_written(session, folder):
    assert not {p.name for p in folder.iterdir()} & {"x.png", "built"} and (folder.parent / "secret.bin").read_bytes() == b"secret"


# The command.


def test_the_version_before_is_spoken_too():
    session = Session(command(SAMPLES, "--max-size", "0.4"), PREVIOUS)
    try:
        assert session.call("list_logs")["total"] == 3
        assert "more than the 0.4 MB" in session.call("info", log=HEXA)["error"]
        assert "rotorwatch" in session.client.instructions
    finally:
        session.close()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "Name the folders"),
        (["/nowhere/at/all"], "no such folder"),
        ([str(SAMPLES / HEXA)], "is not a folder"),
        ([str(SAMPLES), "--http"], "a token is required"),
        ([str(SAMPLES), "--http", "--token", "short"], "at least 16"),
        ([str(SAMPLES), "--http", "--token", "x" * 20, "--host", "0.0.0.0"], "loopback"),
        ([str(SAMPLES), "--max-size", "0"], "max_size"),
    ],
)
def test_what_cannot_be_served_is_said_in_a_sentence(run, words, said):
    code, out, err = run("mcp", *words)
    assert code == 2 and out == "" and said in err and err.count("\n") == 1, err


def test_without_the_extra_it_says_what_to_install(tmp_path):
    (tmp_path / "mcp.py").write_text("raise ImportError('not here')\n")
    environment = ENVIRONMENT | {"PYTHONPATH": f"{tmp_path}:{ENVIRONMENT['PYTHONPATH']}"}
    done = subprocess.run([*COMMAND, str(SAMPLES)], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "pip install mcp" in done.stderr and done.stderr.count("\n") == 1


def test_it_ends_when_it_is_reported_to():
    server = subprocess.Popen(
        [*COMMAND, str(SAMPLES)], env=ENVIRONMENT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert server.stdin and server.stdout
    server.stdin.write(b'{"jsonrpc":"2.0","id":1,"method":"nothing"}\n')
    server.stdin.flush()
    assert b"error" in server.stdout.readline()
    server.terminate()  # while it waits for a line
    assert server.wait(20) == 128 + signal.SIGTERM
    for stream in (server.stdin, server.stdout, server.stderr):
        stream.close()
