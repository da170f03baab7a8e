"""`rotorwatch watch` as a service of systemd, of this user or of the system: its unit, and the file of its secrets.

https://www.freedesktop.org/software/systemd/man/latest/systemd.service.html (Command lines), systemd.exec, systemd.syntax
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rotorwatch.base.files import folder, printable, replacing
from rotorwatch.errors import ConfigError

MARKER = "# Written by `rotorwatch watch --service install`; `--service remove` deletes this file."
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,99}")
PLAIN = re.compile(r"[A-Za-z0-9_@+=:,./-]+")  # needs no quotes in a unit
VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
LINES = 10
WEBHOOK = "ROTORWATCH_WEBHOOK"
ESCAPED, BEFORE = re.compile(r'(["\\`$])'), r"\\\1"  # within the quotes of a file of variables
WAIT_S = 60.0  # for an answer of systemctl
GROWING = 254  # systemd from which pauses between restarts can grow
PAUSE_S, LONGEST_S, STEPS = 5, 60, 5
# These need no namespace of mounts, which the service manager of a user cannot make on every kernel.
HARDENED = (
    "NoNewPrivileges=yes", "LockPersonality=yes", "RestrictRealtime=yes", "RestrictSUIDSGID=yes", "RestrictNamespaces=yes",
    "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK", "SystemCallArchitectures=native", "SystemCallFilter=@system-service",
)  # fmt: skip
HARDENED_SYSTEM = (
    "ProtectSystem=strict", "ProtectHome=read-only", "PrivateTmp=yes", "ProtectKernelTunables=yes", "ProtectKernelModules=yes",
    "ProtectKernelLogs=yes", "ProtectControlGroups=yes", "ProtectHostname=yes", "CapabilityBoundingSet=",
)  # fmt: skip


@dataclass(frozen=True)
class Service:
    """A service by its name. unit, secrets: its files. system: of the computer, not of this user."""

    name: str
    system: bool
    unit: Path
    secrets: Path


@dataclass(frozen=True)
class State:
    """How a service is. installed: its unit is there. running, enabled (starts by itself), state: as systemd says it; lines: the last
    of its log. trouble: what could not be found out, a sentence."""

    service: Service
    installed: bool
    running: bool = False
    enabled: bool = False
    state: str = ""
    lines: tuple[str, ...] = ()
    trouble: str = ""


def service(name: str = "rotorwatch", system: bool = False) -> Service:
    """The service of this name. Raises ConfigError for a name that no unit can have."""
    if not NAME.fullmatch(name):
        raise ConfigError(f"--name {printable(name)}: use letters, digits, - and _ only, as in rotorwatch-2.")
    if system:
        return Service(
            name, True, Path("/etc/systemd/system", f"{name}.service"), Path("/etc/rotorwatch", f"{name}.env")
        )
    home = Path(os.path.abspath(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"))
    return Service(name, False, home / "systemd" / "user" / f"{name}.service", home / "rotorwatch" / f"{name}.env")


def quoted(argument: str) -> str:
    """An argument as a command line of a unit needs it. Specifiers (%) are doubled; variables ($) must be off, by `:` before the program.
    Raises ConfigError for what no unit can hold."""
    if PLAIN.fullmatch(argument):
        return argument
    try:
        argument.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{printable(argument)} is no UTF-8 text, and no unit of systemd can hold it.") from None
    if "\0" in argument:
        raise ConfigError(f"{printable(argument)} has a zero byte, and no unit of systemd can hold it.")
    plain = argument.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return '"' + "".join(c if c.isprintable() else "".join(f"\\x{b:02x}" for b in c.encode()) for c in plain) + '"'


def command(arguments: Sequence[str]) -> str:
    """The value of ExecStart: this Python with rotorwatch, and these arguments."""
    program = [os.path.abspath(sys.executable)]
    if set(program[0]) & set("\"'\\") or not program[0].isprintable():  # systemd takes no program with such a name
        program.insert(0, "/usr/bin/env")
    program[0] = ":" + program[0]  # no variables are put in
    return " ".join(map(quoted, [*program, "-m", "rotorwatch", *arguments]))


def _line(text: str, path: Path) -> str:
    """A path that stands alone in a line, without quotes."""
    if not str(path).isprintable() or str(path) != str(path).strip():
        raise ConfigError(f"{printable(text)}: no unit of systemd can hold this name.")
    return str(path).replace("%", "%%")


def unit(
    arguments: Sequence[str], about: Service, version: int = 0, user: str = "", writes: Sequence[Path] = (), groups: Sequence[str] = ()
) -> str:  # fmt: skip
    """The unit that runs `rotorwatch` with these arguments. version: of systemd; user: who runs it, of a system's service; writes: folders
    that it writes into; groups: that it is in besides, for its serial ports."""
    pauses = [f"RestartSec={PAUSE_S}"]
    if version >= GROWING:
        pauses += [f"RestartSteps={STEPS}", f"RestartMaxDelaySec={LONGEST_S}"]
    network = ["Wants=network-online.target", "After=network-online.target"] if about.system else []
    own = []
    if about.system:
        own += [f"User={user}"] if user else []
        own += [f"SupplementaryGroups={' '.join(groups)}"] if groups else []
        own += [f"CacheDirectory={about.name}", f"Environment=ROTORWATCH_CACHE=/var/cache/{about.name}"]
    hardened = [*HARDENED, *(HARDENED_SYSTEM if about.system else ())]
    if about.system and writes:
        hardened.append("ReadWritePaths=" + " ".join(quoted(str(path)) for path in writes))
    lines = [
        MARKER,
        "[Unit]",
        "Description=rotorwatch: judges vehicles while they fly",
        *network,
        "StartLimitIntervalSec=0",  # it is tried again for as long as the computer runs
        "",
        "[Service]",
        "Type=exec",
        "WorkingDirectory=/",  # Python looks for modules there first
        f"ExecStart={command(arguments)}",
        f"EnvironmentFile=-{_line(about.name, about.secrets)}",
        *own,
        "Restart=on-failure",
        *pauses,
        "SuccessExitStatus=1 3",  # a fault was found; nothing could be judged
        "TimeoutStopSec=20",
        f"SyslogIdentifier={about.name}",
        "LogRateLimitIntervalSec=30",
        "LogRateLimitBurst=300",
        *hardened,
        "",
        "[Install]",
        f"WantedBy={'multi-user' if about.system else 'default'}.target",
    ]
    return "\n".join(lines) + "\n"


def environment(secrets: Mapping[str, str], before: str = "") -> str:
    """The file of variables. Lines of `before`, as it was, are kept, but for those that an install writes. Raises ConfigError."""
    lines = [MARKER]
    for name, value in secrets.items():
        if not VARIABLE.fullmatch(name) or not value.isprintable():
            raise ConfigError(
                f"{printable(name)}: its value has a control character, which no file of variables can hold."
            )
        lines.append(f'{name}="{ESCAPED.sub(BEFORE, value)}"')
    ours = {MARKER, WEBHOOK, *secrets}
    lines += [line for line in before.splitlines() if line.split("=", 1)[0].strip() not in ours and line != MARKER]
    return "\n".join(lines) + "\n"


def install(
    arguments: Sequence[str], name: str = "rotorwatch", system: bool = False, secrets: Mapping[str, str] | None = None,
    writes: Sequence[str | os.PathLike] = (),
) -> Service:  # fmt: skip
    """Write the unit, start it now and whenever the user logs in or the computer starts. What was installed under this name is replaced.

    arguments: of `rotorwatch watch`, with absolute paths. name: of the service. system: of the computer (needs root), not of this user.
    secrets: variable -> value, for a file that only its owner can read. writes: folders that it writes into.
    Raises ConfigError; then all is as it was.
    """
    about = service(name, system)
    _allowed(about)
    version = _version(about)
    folders = [folder(Path(path).absolute(), "--record") for path in writes]
    text = planned(arguments, about, version, folders)
    before = {path: _ours(path) for path in (about.secrets, about.unit)}
    if system:
        _hand_over(folders, _user())
    variables = environment(secrets or {}, (before[about.secrets] or b"").decode(errors="replace"))
    try:
        _write(about.secrets, variables, private=True)
        _write(about.unit, text)
        for step in (("daemon-reload",), ("enable", about.unit.name), ("restart", about.unit.name)):
            _asked(about, *step)
    except BaseException:
        _restore(about, before)
        raise
    return about


def planned(arguments: Sequence[str], about: Service, version: int = 0, folders: Sequence[Path] = ()) -> str:
    """The unit that `install` writes. arguments: of `rotorwatch watch`; about: the service; version: of systemd; folders: that it
    writes into."""
    user = _user() if about.system else ""
    return unit(["watch", *arguments], about, version, user, folders, _groups(arguments) if about.system else ())


def remove(name: str = "rotorwatch", system: bool = False) -> bool:
    """Stop a service and delete what `install` wrote; whether there was anything. name, system: as given to `install`. Raises
    ConfigError."""
    about = service(name, system)
    there = [path for path in (about.unit, about.secrets) if _ours(path) is not None]
    _version(about)
    if not there:
        return False
    _allowed(about)
    if about.unit in there:
        _asked(about, "disable", "--now", about.unit.name)
    for path in there:
        try:
            path.unlink(missing_ok=True)
        except OSError as why:
            raise ConfigError(f"{path} cannot be deleted ({why.strerror or why}).") from None
    _asked(about, "daemon-reload")
    _systemctl(about, "reset-failed", about.unit.name)  # it says no where nothing had failed
    return True


def status(name: str = "rotorwatch", system: bool = False) -> State:
    """How a service is, and its last lines. name, system: as given to `install`. Raises ConfigError where there is no systemd."""
    about = service(name, system)
    installed = _ours(about.unit) is not None
    _version(about)
    wanted = "ActiveState,SubState,UnitFileState,NRestarts,ActiveEnterTimestamp"
    answer = _asked(about, "show", about.unit.name, f"--property={wanted}")
    found: dict[str, str] = dict(line.split("=", 1) for line in answer.splitlines() if "=" in line)
    active, since = found.get("ActiveState", ""), found.get("ActiveEnterTimestamp", "")
    restarts = found.get("NRestarts", "0")
    state = f"{active} ({found.get('SubState', '')})" + (f" since {since}" if active == "active" and since else "")
    state += f", restarted {restarts} times" if restarts.isdigit() and int(restarts) else ""
    lines, trouble = _lines(about) if installed else ((), "")
    return State(about, installed, active == "active", found.get("UnitFileState") == "enabled", state, lines, trouble)


def lingers() -> bool:
    """Whether this user's services run while nobody is logged in."""
    program = shutil.which("loginctl")
    if program is None:
        return False
    answer = _run([program, "show-user", str(os.getuid()), "--property=Linger"])
    return answer is not None and answer.returncode == 0 and "Linger=yes" in answer.stdout


def _allowed(about: Service) -> None:
    if about.system and os.geteuid() != 0:
        raise ConfigError(
            f"--system writes to {about.unit.parent}, which needs root: run it with sudo, or leave out --system."
        )
    if not about.system and os.geteuid() == 0 and os.environ.get("SUDO_USER"):
        raise ConfigError(
            "With sudo this would be a service of root: leave out sudo, or give --system for one of the computer."
        )


def _run(words: Sequence[str]) -> subprocess.CompletedProcess | None:
    """What a program answers; None where it does not."""
    try:
        return subprocess.run(
            words, capture_output=True, text=True, errors="replace", timeout=WAIT_S, stdin=subprocess.DEVNULL
        )
    except (OSError, subprocess.TimeoutExpired):
        return None


def _systemctl(about: Service, *words: str) -> tuple[bool, str]:
    """(whether it did it, what it says)."""
    program = shutil.which("systemctl")
    if program is None or sys.platform != "linux":
        raise ConfigError(
            "There is no systemd on this computer (no systemctl), which --service needs: start it in another way."
        )
    done = _run([program, *(() if about.system else ("--user",)), "--no-pager", *words])
    if done is None:
        return False, "systemctl does not answer"
    said = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[0]
    return done.returncode == 0, done.stdout if done.returncode == 0 else printable(said)


def _asked(about: Service, *words: str) -> str:
    done, said = _systemctl(about, *words)
    if not done:
        raise ConfigError(f"systemctl {' '.join(words)} has failed ({said.rstrip('.')}).")
    return said


def _version(about: Service) -> int:
    """Of the systemd that runs. Raises ConfigError where none does."""
    done, said = _systemctl(about, "show", "--property=Version")
    if not done:
        whose = "of the system" if about.system else "of this user"
        raise ConfigError(
            f"The systemd {whose}, which --service needs, does not run or cannot be reached ({said.rstrip('.')})."
        )
    number = re.search(r"Version=(\d+)", said)
    return int(number[1]) if number else 0


def version(about: Service) -> int:
    """Of the systemd that runs; 0 where none does."""
    try:
        return _version(about)
    except ConfigError:
        return 0


def _ours(path: Path) -> bytes | None:
    """What `install` wrote there; None where there is nothing. Raises ConfigError for a file of somebody else."""
    try:
        text = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except PermissionError:
        raise ConfigError(f"{path} cannot be read without root: run it with sudo.") from None
    except OSError as why:
        raise ConfigError(f"{path} cannot be read ({why.strerror or why}).") from None
    if text.split(b"\n", 1)[0].decode(errors="replace") != MARKER:
        raise ConfigError(
            f"{path} was not written by rotorwatch and is left alone: choose another --name, or move it away."
        )
    return text


def _write(path: Path, text: str | bytes, private: bool = False) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as why:
        raise ConfigError(f"{path.parent} cannot be made ({why.strerror or why}).") from None
    with replacing(path, private) as part:
        part.write_bytes(text if isinstance(text, bytes) else text.encode())


def _restore(about: Service, before: Mapping[Path, bytes | None]) -> None:
    """All as it was: after an installation that has failed."""
    if before[about.unit] is None:
        with suppress(ConfigError):
            _systemctl(about, "disable", "--now", about.unit.name)
    for path, text in before.items():
        with suppress(OSError, ConfigError):
            if text is None:
                path.unlink(missing_ok=True)
            else:
                _write(path, text, path == about.secrets)
    with suppress(ConfigError):
        _systemctl(about, "daemon-reload")
        if before[about.unit] is not None:
            _systemctl(about, "restart", about.unit.name)


def _user() -> str:
    """Who runs a service of the system: who has called sudo."""
    return os.environ.get("SUDO_USER", "") if os.environ.get("SUDO_USER") != "root" else ""


def _hand_over(folders: Sequence[Path], user: str) -> None:
    """Folders that root has just made, for the one who will write into them."""
    for path in folders:
        if user and path.stat().st_uid == 0 and not any(path.iterdir()):
            with suppress(OSError, LookupError):
                shutil.chown(path, user)


def _groups(arguments: Sequence[str]) -> list[str]:
    """Groups that own the serial ports among the endpoints."""
    import grp

    found = set()
    for device in devices(arguments):
        with suppress(OSError, KeyError):
            found.add(
                grp.getgrgid(os.stat(device).st_gid).gr_name
                if os.path.exists(device)
                else grp.getgrnam("dialout").gr_name
            )
    return sorted(found - {"root"})


def devices(arguments: Sequence[str]) -> list[str]:
    """Serial ports among the arguments of `watch`."""
    return [text.partition(":")[2].rpartition(":")[0] for text in arguments if text.lower().startswith("serial:")]


def _lines(about: Service) -> tuple[tuple[str, ...], str]:
    """(the last lines of its log, why there are none)."""
    program = shutil.which("journalctl")
    which = "-u" if about.system else "--user-unit"
    done = (
        None
        if program is None
        else _run([program, which, about.unit.name, "-n", str(LINES), "-o", "short-iso", "--no-pager", "-q"])
    )
    if done is None or done.returncode:
        return (), "the log cannot be read (journalctl)"
    return tuple(printable(line) for line in done.stdout.splitlines()), ""
