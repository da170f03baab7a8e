"""Logs that come as streams: what never ends, stalls or unfolds without end is given up, and nothing of it stays behind."""

from __future__ import annotations

import gzip
import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from rotorwatch import gathering
from rotorwatch.base import incoming
from rotorwatch.commands import cli
from rotorwatch.errors import LogError
from rotorwatch.logs import container

SAMPLE = cli.SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"


# The command; nohup has SIGHUP ignored for all that it starts, the test's own processes too.
COMMAND = "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL); from rotorwatch.commands.cli import main; main()"


class Drips(io.RawIOBase):
    """A stream that gives one byte after so many seconds, again and again."""

    def __init__(self, every_s: float):
        super().__init__()
        self.every_s = every_s

    def read(self, size=-1):
        time.sleep(self.every_s)
        return b"x"


def test_a_stream_is_kept_whole(tmp_path):
    data = os.urandom(3_000_000)
    for waits in (False, True):
        incoming.keep(io.BytesIO(data), tmp_path / "kept", "a pipe", waits)
        assert (tmp_path / "kept").read_bytes() == data


@pytest.mark.parametrize(("every_s", "stalls_s", "most_s", "said"), [(5.0, 0.1, 60.0, "nothing came"), (0.01, 1.0, 0.2, "not whole")])
def test_a_stream_that_does_not_come_is_given_up(tmp_path, monkeypatch, every_s, stalls_s, most_s, said):
    monkeypatch.setattr(incoming, "STALLS_S", stalls_s)
    monkeypatch.setattr(incoming, "MOST_S", most_s)
    began = time.monotonic()
    with pytest.raises(LogError, match=said):
        incoming.keep(Drips(every_s), tmp_path / "kept", "http://x")
    assert time.monotonic() - began < 2.0


def test_what_goes_wrong_while_reading_is_raised(tmp_path):
    class Broken(io.RawIOBase):
        def read(self, size=-1):
            raise ConnectionResetError("gone")

    with pytest.raises(ConnectionResetError):
        incoming.keep(Broken(), tmp_path / "kept", "http://x")


@contextmanager
def served(endless: bool) -> Iterator[str]:
    """The address of a log whose body never ends, or stops without an end."""
    over = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.end_headers()
            try:
                self.wfile.write(bytes(1 << 20))
                while not over.wait(0.0 if endless else 0.1):
                    if endless:
                        self.wfile.write(bytes(1 << 20))
            except OSError:
                pass

        def do_HEAD(self):
            self.send_response(200)
            self.end_headers()

        def log_message(self, *args):  # type: ignore[override]
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/flight.bin"
    finally:
        over.set()
        server.shutdown()


def test_a_body_without_end_is_given_up_and_nothing_stays(monkeypatch):
    monkeypatch.setattr(incoming, "MOST", 5 << 20)
    with served(endless=True) as address, pytest.raises(LogError, match="which no flight log does"):
        with gathering.fetched(address):
            pass
    assert not list(incoming.spool().rglob("flight.bin"))


def test_one_limit_holds_for_plain_and_packed_files(tmp_path, monkeypatch):
    plain, packed = tmp_path / "a.bin", tmp_path / "b.bin.gz"
    with plain.open("wb") as file:
        file.truncate(incoming.MOST + 1)  # takes no room
    packed.write_bytes(gzip.compress(bytes(8 << 20)))
    with pytest.raises(LogError, match="no flight log"):
        container.open_log(plain)
    assert len(container.open_log(packed)[0]) == 8 << 20
    monkeypatch.setattr(container, "SLACK", 1 << 20)
    with pytest.raises(LogError, match="no flight log"):
        container.open_log(packed)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("several", [False, True])
def test_a_command_that_is_ended_leaves_nothing_behind(tmp_path, number, several):
    with served(endless=False) as address:
        logs = [address, address + "?2", address + "?3"] if several else [address]
        child = subprocess.Popen(
            [sys.executable, "-c", COMMAND, "diagnose", *logs],
            env={**os.environ, "TMPDIR": str(tmp_path)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        until = time.monotonic() + 60.0
        while not list(tmp_path.glob("**/flight.bin")) and time.monotonic() < until:
            time.sleep(0.05)
        assert list(tmp_path.glob("**/flight.bin"))
        child.send_signal(number)
        _, said = child.communicate(timeout=30.0)
    assert child.returncode == 128 + number
    assert said.decode().strip().endswith("interrupted") and "Traceback" not in said.decode()
    assert not list(tmp_path.iterdir())
