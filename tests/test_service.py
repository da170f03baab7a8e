"""`watch --service`: the unit that is written, what systemd reads in it, and that nothing of others is touched."""

import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import rotorwatch as rw
from rotorwatch.errors import ConfigError
from rotorwatch.live import service

URL = 'https://alerts.example/in?token=s3cr$t`"\\%h'
FAKE = """#!/bin/sh
echo "$@" >> "$FAKE_LOG"
case "$*" in
*--property=Version*) echo "Version=${FAKE_VERSION:-252.38-1~deb12u1}" ;;
*"show "*.service*)
  printf 'ActiveState=%s\\nSubState=running\\nUnitFileState=enabled\\nNRestarts=2\\n' "${FAKE_STATE:-active}"
  echo ActiveEnterTimestamp=today ;;
esac
case "$*" in *"${FAKE_FAILS:-nothing fails}"*) echo "Failed as it was told to." >&2; exit 1 ;; esac
"""
JOURNAL = """#!/bin/sh
echo "journal $@" >> "$FAKE_LOG"
printf '2026-01-01 pi rotorwatch[1]: rotor 3 lost 37 %%\\033[31m\\n'
"""
LINGER = '#!/bin/sh\necho "Linger=${FAKE_LINGER:-no}"\n'


def unquoted(line):
    """The words of a command line of systemd.service(5), "Quoting" and "Specifiers", written after the manual: words are separated by
    whitespace, quotes may stand around a word, C's escapes are read everywhere, %% is %."""
    words, at = [], 0
    simple = {"a": 7, "b": 8, "f": 12, "n": 10, "r": 13, "t": 9, "v": 11, "\\": 92, '"': 34, "'": 39, "s": 32}
    line = line.encode()
    while at < len(line):
        if chr(line[at]) in " \t\n\r":
            at += 1
            continue
        quote, word = (line[at : at + 1], bytearray()) if line[at : at + 1] in b"\"'" else (b"", bytearray())
        at += len(quote)
        while at < len(line):
            one = line[at : at + 1]
            if quote and one == quote:
                at += 1
                assert at == len(line) or chr(line[at]) in " \t\n\r", "a quote ends within a word"
                quote = b"closed"
                break
            if not quote and chr(line[at]) in " \t\n\r":
                break
            if one == b"\\":
                kind = chr(line[at + 1])
                if kind == "x":
                    word.append(int(line[at + 2 : at + 4], 16))
                    at += 4
                else:
                    word.append(simple[kind])
                    at += 2
                continue
            word += one
            at += 1
        assert quote in (b"", b"closed"), "a quote is left open"
        words.append(bytes(word))
    found = []
    for word in words:
        assert not re.search(rb"%(?!%)", word.replace(b"%%", b"")), "a specifier is left"
        found.append(word.replace(b"%%", b"%").decode())
    return found


def variables(text):
    """Name -> value, as systemd.exec(5) says of EnvironmentFile=: C's escapes are not read, only \\ before ", \\, ` and $ within quotes."""
    found = {}
    for line in text.splitlines():
        if line and not line.startswith(("#", ";")):
            name, _, value = line.partition("=")
            if value[:1] == '"':
                assert value[-1] == '"'
                value = re.sub(r'\\(["\\`$])', r"\1", value[1:-1])
            found[name] = value
    return found


def settings_of(text):
    """Section -> [(key, value)] of a unit."""
    found, section = {}, None
    for line in text.splitlines():
        if line.startswith("["):
            section = found.setdefault(line, [])
        elif line and not line.startswith("#"):
            section.append(tuple(line.split("=", 1)))
    return found


def value(text, key):
    (found,) = [v for rows in settings_of(text).values() for k, v in rows if k == key]
    return found


@pytest.fixture
def computer(tmp_path, monkeypatch):
    """A home and a systemd that takes down what it is told. Returns (home, what it was told)."""
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, text in (("systemctl", FAKE), ("journalctl", JOURNAL), ("loginctl", LINGER)):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    home = tmp_path / "home of 100% me"
    home.mkdir()
    log = tmp_path / "told"
    log.write_text("")
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("FAKE_LOG", str(log))
    for name in ("XDG_CONFIG_HOME", "SUDO_USER", "ROTORWATCH_WEBHOOK"):
        monkeypatch.delenv(name, raising=False)
    return home, lambda: log.read_text().splitlines()


def watch(*arguments, **environment):
    """The command line itself."""
    source = str(Path(rw.__file__).parents[1])
    return subprocess.run(
        [sys.executable, "-m", "rotorwatch", "watch", *arguments], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": source, **environment}, timeout=120,
    )  # fmt: skip


def files(home):
    return sorted(str(path.relative_to(home)) for path in home.rglob("*") if path.is_file())


UNIT, SECRETS = ".config/systemd/user/rotorwatch.service", ".config/rotorwatch/rotorwatch.env"


def test_from_install_to_remove(computer, tmp_path):
    home, told = computer
    record = tmp_path / 'my 50% "flights" $HOME'
    options = ["--record", str(record), "--tell-ground", "--patience", "90"]
    done = watch("udp:14550", "serial:/dev/nothing:57600", *options, "--webhook", URL, "--service", "install")
    assert (done.returncode, done.stdout) == (0, "")
    assert "loginctl enable-linger" in done.stderr and "/dev/nothing is not there" in done.stderr
    assert told() == [
        "--user --no-pager show --property=Version", "--user --no-pager daemon-reload",
        "--user --no-pager enable rotorwatch.service", "--user --no-pager restart rotorwatch.service",
    ]  # fmt: skip
    assert files(home) == [SECRETS, UNIT] and record.is_dir()
    unit = (home / UNIT).read_text()
    words = unquoted(value(unit, "ExecStart"))
    assert words[:4] == [f":{os.path.abspath(sys.executable)}", "-m", "rotorwatch", "watch"]
    assert words[4:6] == ["udp:14550", "serial:/dev/nothing:57600"]
    assert sorted(words[6:]) == sorted(["--record", str(record), "--tell-ground", "--patience", "90.0"])
    assert value(unit, "EnvironmentFile") == "-" + str(home / SECRETS).replace("%", "%%")
    # What only its owner may know is in the file that only its owner can read.
    assert "alerts.example" not in unit + done.stderr and "webhook" not in unit
    assert stat.S_IMODE((home / SECRETS).stat().st_mode) == 0o600
    assert variables((home / SECRETS).read_text()) == {"ROTORWATCH_WEBHOOK": URL}

    shown = watch("--service", "status")
    assert (
        shown.returncode == 0 and "rotor 3 lost 37 %\\x1b[31m" in shown.stdout and "restarted 2 times" in shown.stdout
    )
    assert watch("--service", "status", FAKE_STATE="failed").returncode == 1
    assert "journal --user-unit rotorwatch.service" in told()[-1]

    gone = watch("--service", "remove")
    assert gone.returncode == 0 and files(home) == []
    assert "--user --no-pager disable --now rotorwatch.service" in told()
    again = watch("--service", "remove")
    assert again.returncode == 0 and "no service rotorwatch" in again.stderr
    assert watch("--service", "status").returncode == 3


def test_a_second_install_changes_nothing(computer):
    home, _ = computer
    made = [watch("udp:14550", "--webhook", URL, "--service", "install")]
    before = {name: (home / name).read_bytes() for name in files(home)}
    made.append(watch("udp:14550", "--service", "install", ROTORWATCH_WEBHOOK=URL, FAKE_LINGER="yes"))
    assert [one.returncode for one in made] == [0, 0] and "enable-linger" not in made[1].stderr
    assert {name: (home / name).read_bytes() for name in files(home)} == before


def test_variables_of_the_user_are_kept(computer):
    home, _ = computer
    service.install(["udp:14550"], secrets={service.WEBHOOK: URL})
    with (home / SECRETS).open("a") as file:
        file.write("# mine\nHTTPS_PROXY=http://proxy.example\n")
    service.install(["udp:14551"])
    assert variables((home / SECRETS).read_text()) == {"HTTPS_PROXY": "http://proxy.example"}
    assert stat.S_IMODE((home / SECRETS).stat().st_mode) == 0o600 and "# mine" in (home / SECRETS).read_text()


@pytest.mark.parametrize("which", [UNIT, SECRETS])
@pytest.mark.parametrize("text", ["[Unit]\n", "", service.MARKER + " not\n"])
def test_files_of_others_are_left_alone(computer, which, text):
    home, told = computer
    (home / which).parent.mkdir(parents=True)
    (home / which).write_text(text)
    for act in (lambda: service.install(["udp:14550"]), service.remove):
        with pytest.raises(ConfigError, match="was not written by rotorwatch"):
            act()
    assert files(home) == [which] and (home / which).read_text() == text
    assert not any("enable" in line or "disable" in line for line in told())


@pytest.mark.parametrize("step", ["daemon-reload", "enable", "restart"])
@pytest.mark.parametrize("first", [True, False])
def test_what_fails_leaves_all_as_it_was(computer, monkeypatch, step, first):
    home, _ = computer
    if not first:
        service.install(["udp:14550"])
    before = {name: (home / name).read_bytes() for name in files(home)}
    monkeypatch.setenv("FAKE_FAILS", step)
    with pytest.raises(ConfigError, match=rf"systemctl {step}.* has failed \(Failed as it was told to\)"):
        service.install(["udp:14551"], secrets={service.WEBHOOK: URL})
    assert {name: (home / name).read_bytes() for name in files(home)} == before


def test_a_folder_that_cannot_be_written_is_found_before(computer):
    home, _ = computer
    (home / "file").write_text("")
    with pytest.raises(ConfigError, match="--record"):
        service.install(["udp:14550"], writes=[home / "file"])
    assert files(home) == ["file"]


def test_without_systemd_one_sentence(computer, monkeypatch, tmp_path):
    home, _ = computer
    empty = tmp_path / "empty"
    empty.mkdir()
    for what in (["install", "udp:1"], ["status"], ["remove"]):
        done = watch("--service", *what, PATH=str(empty))
        assert (done.returncode, done.stdout) == (2, "") and files(home) == []
        assert done.stderr.startswith("rotorwatch: There is no systemd") and done.stderr.count("\n") == 1
    done = watch("--service", "install", "udp:1", FAKE_FAILS="--property=Version")
    assert done.returncode == 2 and "does not run or cannot be reached" in done.stderr and files(home) == []
    assert watch("--service", "install", "udp:1", "--dry-run", PATH=str(empty)).returncode == 0 and files(home) == []


@pytest.mark.parametrize(
    "arguments, words",
    [
        ([], "Missing argument"),
        (["flight.bin"], "watches links, not logs"),
        (["udp:0"], "no endpoint"),
        (["serial:57600"], "name the device"),
        (["udp:1", "--webhook", "ftp://x"], "--webhook"),
        (["udp:1", "--metrics", "x"], "--metrics"),
        (["udp:1", "--listen-only", "--tell-ground"], "leave out one"),
        (["udp:1", "--vehicle", "nothing.toml"], "nothing.toml"),
        (["udp:1", "--name", "a/b"], "--name"),
        (["udp:1", "--name", "-x"], "--name"),
    ],
)
def test_what_could_not_run_is_not_installed(computer, arguments, words):
    home, told = computer
    done = watch(*arguments, "--service", "install")
    assert done.returncode == 2 and words in done.stderr and "Traceback" not in done.stderr
    assert files(home) == [] and told() == []


@pytest.mark.parametrize(
    "arguments", [["--system"], ["--name", "x"], ["--dry-run"], ["--service", "remove", "--dry-run"]]
)
def test_options_of_a_service_without_one(computer, arguments):
    done = watch("udp:1", *arguments)
    assert done.returncode == 2 and "go with --service" in done.stderr


def test_a_service_of_the_system(computer, monkeypatch, tmp_path):
    """As root with sudo. Its folders are moved below the test's own."""
    _, told = computer
    made = service.service

    def moved(name="rotorwatch", system=False):
        known = made(name, system)
        assert known.unit == Path(f"/etc/systemd/system/{name}.service") and known.secrets == Path(
            f"/etc/rotorwatch/{name}.env"
        )
        return service.Service(name, system, tmp_path / "etc" / "unit.service", tmp_path / "etc" / "secrets.env")

    monkeypatch.setattr(service, "service", moved)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(ConfigError, match="needs root"):
        service.install(["udp:14550"], system=True)
    assert not (tmp_path / "etc").exists()
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setenv("SUDO_USER", "pi")
    given = []
    monkeypatch.setattr(shutil, "chown", lambda path, user: given.append((path, user)))
    about = service.install(["udp:14550"], system=True, writes=[tmp_path / "record here"])
    text = about.unit.read_text()
    assert not [line for line in told() if "--user" in line]
    assert value(text, "WantedBy") == "multi-user.target" and value(text, "User") == "pi"
    assert unquoted(value(text, "ReadWritePaths")) == [str(tmp_path / "record here")]
    assert {"ProtectSystem", "PrivateTmp", "NoNewPrivileges"} <= {k for k, _ in settings_of(text)["[Service]"]}
    assert given in ([], [(tmp_path / "record here", "pi")])  # only root's folders are given away
    assert service.status(system=True).running
    monkeypatch.setattr(service, "service", made)
    with pytest.raises(ConfigError, match="With sudo this would be a service of root"):
        service.install(["udp:14550"])


def test_pauses_grow_where_systemd_can_do_that(computer):
    about = service.service()
    old, new = (service.planned(["udp:14550"], about, version) for version in (253, 254))
    assert "RestartSteps" not in old and value(new, "RestartSteps") == "5" and value(new, "RestartMaxDelaySec") == "60"
    assert value(old, "Restart") == "on-failure" and value(old, "SuccessExitStatus") == "1 3"
    assert value(old, "WantedBy") == "default.target"


def test_it_is_reached_as_an_attribute():
    assert rw.service is service


@settings(max_examples=300, deadline=None)
@given(st.lists(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])), min_size=1))
@example(
    [
        ";",
        "",
        " ",
        "%",
        "%%h",
        "$HOME",
        "${X}",
        "\\",
        "a\\ b",
        "'",
        '"',
        "\n",
        "\t",
        "\x7f",
        "é",
        "\u2028",
        "-",
        ":",
        "\\x41",
        "#",
    ]
)
def test_systemd_reads_the_words_that_were_meant(words):
    line = service.command(words)
    assert "\n" not in line and "\r" not in line and len(line.splitlines()) == 1
    assert unquoted(line)[3:] == words
    # Before it takes quotes away, systemd looks for ; which would begin another command.
    assert ";" not in line.split(" ")


@settings(max_examples=200, deadline=None)
@given(st.text(st.characters(exclude_categories=["C", "Zl", "Zp"]).filter(str.isprintable)))
def test_systemd_reads_the_secrets_that_were_meant(text):
    assert variables(service.environment({"ROTORWATCH_WEBHOOK": text})) == {"ROTORWATCH_WEBHOOK": text}


@pytest.mark.parametrize("word", ["a\0b", "\udc80"])
def test_what_no_unit_can_hold(word):
    with pytest.raises(ConfigError, match="no unit of systemd can hold it"):
        service.quoted(word)
    with pytest.raises(ConfigError, match="control character"):
        service.environment({"ROTORWATCH_WEBHOOK": "https://x\n.example"})


@pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed here: it checks the unit"
)
@pytest.mark.parametrize("system", [True, False])
@pytest.mark.parametrize("quotes", ["'dir'", "", '"'])
def test_systemd_itself_understands_the_unit(tmp_path, monkeypatch, system, quotes):
    """Names of settings are known to it, and it finds the program behind an odd name."""
    odd = tmp_path / f"a 100%h $HOME {quotes} é"
    odd.mkdir()
    program = odd / "python 3"
    program.symlink_to(os.path.realpath(sys.executable))
    monkeypatch.setattr(sys, "executable", str(program))
    about = service.Service("rotorwatch", system, tmp_path / "rotorwatch.service", odd / "x.env")
    arguments = ["udp:14550", "--record", str(odd), ";", "$X", "%%"]
    about.unit.write_text(service.planned(arguments, about, 0, [odd]))
    scope = [] if system else ["--user"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "SYSTEMD_LOG_LEVEL": "notice"}
    command = ["systemd-analyze", *scope, "--man=no", "--recursive-errors=no", "verify", str(about.unit)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    # It would have said so:
    about.unit.write_text(about.unit.read_text().replace("PrivateTmp", "PrivatTmp").replace("NoNewP", "NoNeP"))
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert "Unknown key" in done.stderr
    if quotes:  # then it looks for env, not for Python
        assert about.unit.read_text().count('ExecStart=:/usr/bin/env "') == 1
        return
    about.unit.write_text(about.unit.read_text().replace("python 3", "python 4"))
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode != 0 and "not executable" in done.stderr
