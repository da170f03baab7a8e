"""A PostgreSQL server of the tests' own: started on a socket in a temporary folder, gone with it. Reaches nothing outside.

PostgreSQL refuses to run as root; then it runs as the user `postgres` or `nobody`, whichever there is.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import pytest


def _user() -> dict:
    """Arguments of subprocess that give up root's rights."""
    if os.name != "posix" or os.geteuid() != 0:
        return {}
    import pwd

    for name in ("postgres", "nobody"):
        try:
            found = pwd.getpwnam(name)
        except KeyError:
            continue
        return {"user": found.pw_uid, "group": found.pw_gid, "extra_groups": []}
    pytest.skip("PostgreSQL cannot run as root, and there is no user postgres or nobody")


def _program(name: str) -> str:
    found = shutil.which(name)
    if not found:  # Debian keeps them out of the path
        kept = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
        found = str(kept[-1]) if kept else None
    if not found:
        pytest.skip(f"PostgreSQL is not installed here ({name} is missing)")
    return found


class Server:
    """A server in a folder of its own; `url(name)` makes a database."""

    def __init__(self) -> None:
        self.initdb, self.postgres, self.who = _program("initdb"), _program("postgres"), _user()
        self.folder = Path(tempfile.mkdtemp(prefix="rw-pg-", dir="/tmp"))  # a socket's path must be short
        self.process: subprocess.Popen | None = None
        if self.who:
            os.chown(self.folder, self.who["user"], self.who["group"])
        subprocess.run(
            [self.initdb, "-D", self.folder / "data", "-U", "rw", "-A", "trust", "-E", "UTF8", "--no-locale", "--no-sync"],
            check=True, capture_output=True, cwd=self.folder, **self.who,
        )  # fmt: skip
        self.count = 0
        self.start()

    def start(self) -> None:
        """Start it and wait until it answers."""
        log = open(self.folder / "log", "ab")
        self.process = subprocess.Popen(
            [self.postgres, "-D", self.folder / "data", "-k", self.folder, "-h", "", "-F"],
            stdout=log, stderr=log, cwd=self.folder, **self.who,
        )  # fmt: skip
        for _ in range(300):
            try:
                self._connect().close()
                return
            except Exception:
                if self.process.poll() is not None:
                    raise RuntimeError((self.folder / "log").read_text()[-2000:]) from None
                time.sleep(0.1)
        raise RuntimeError("PostgreSQL did not start")

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """Stop it: SIGINT at once but in order, SIGQUIT as in a crash."""
        if self.process is not None:
            self.process.send_signal(how)
            self.process.wait(30)
            self.process = None

    def _connect(self):
        import psycopg

        return psycopg.connect(host=str(self.folder), user="rw", dbname="postgres", autocommit=True)

    def url(self) -> str:
        """A new, empty database."""
        self.count += 1
        with self._connect() as connection:
            connection.execute(f"CREATE DATABASE d{self.count}".encode())
        return f"postgresql://rw@/d{self.count}?host={self.folder}"

    def close(self) -> None:
        """Stop it and remove its folder."""
        self.stop()
        shutil.rmtree(self.folder, ignore_errors=True)
