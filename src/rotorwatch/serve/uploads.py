"""Uploaded logs: received within limits of size and time, assessed in separate processes, and stored as flights."""

from __future__ import annotations

import asyncio
import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rotorwatch.base.many.limited import TooMuch, Workers
from rotorwatch.errors import ConfigError, LogError, RotorwatchError, VehicleError
from rotorwatch.fleet.store import Entry
from rotorwatch.serve import names
from rotorwatch.serve.flights import Flights, wrong

IDLE_S, MOST_S = 30.0, 900.0  # without a byte; for the whole of an upload
DRAIN_S = 10.0  # for reading on a too large upload, so that the client sees the answer and not a broken connection
RECEIVING, WAITING = 8, 50  # uploads received at once; logs on disk waiting to be assessed
PATIENCE_S = 60.0  # longest wait of a further upload for its turn, with its bytes unread
AGAIN_S, LONGEST_S = 30.0, 3600.0  # pauses between attempts to assess a log, doubled each time
LOADS = ("rotorwatch.fleet.flight_result", "rotorwatch.diagnose", "rotorwatch.report.html", "bokeh.embed")


class Refused(RotorwatchError):
    """A refused upload. code: of the HTTP answer."""

    def __init__(self, code: int, why: str):
        super().__init__(why)
        self.code = code


class Later(Refused):
    """A received upload that cannot be assessed or stored now. The log stays, and is retried."""


@dataclass(frozen=True)
class Limits:
    """most: bytes of an upload; assess_s and memory_mb: for one log; jobs: logs assessed at once."""

    most: int = 512 << 20
    assess_s: float = 120.0
    memory_mb: int = 4000
    jobs: int = 1


@dataclass(frozen=True)
class Log:
    """A complete upload. path: alone in a folder of its own; digest: SHA-256 of its bytes."""

    path: Path
    name: str
    digest: str
    size: int


def assess(what: tuple[Log, str]) -> Entry | str:
    """A worker's job on (log, path of the page): writes the page, returns the flight for the store, or why the log holds none. Raises
    errors that are not due to the log."""
    from rotorwatch.diagnose import diagnose
    from rotorwatch.fleet.flight_result import of_flight
    from rotorwatch.logs import read
    from rotorwatch.report.html import write

    log, page = what
    try:
        flight = replace(read(log.path), name=log.name)
        diagnosis = diagnose(flight)
        entry = of_flight(flight, log.digest, log.name, log.size, found=diagnosis)
    except (LogError, VehicleError) as why:
        return str(why).replace(str(log.path), log.name).replace(log.path.name, log.name)
    try:
        write(diagnosis, page)
    except ConfigError as why:
        raise OSError(str(why)) from None
    return entry


class Uploads:
    """Uploaded logs. on_stored: called with each new flight, once it is stored; trouble: with a sentence when a log has to wait.

    A log stays in a folder of its own until it is in the store or was refused; any other failure is retried."""

    def __init__(
        self,
        flights: Flights,
        limits: Limits,
        on_stored: Callable[[dict[str, Any]], None],
        trouble: Callable[[str], None] = lambda text: None,
    ):
        """Raises ConfigError where the folder for uploads cannot be written to."""
        self.limits, self._flights, self._on_stored, self._trouble = limits, flights, on_stored, trouble
        self._incoming = flights.folder("incoming")
        self._run, self._lock = _own(self._incoming)
        self._receiving, self._stopping = 0, False
        self._logs: dict[str, Log] = {}  # by digest: received, and neither in the store nor refused
        self._assessing: dict[str, asyncio.Task[tuple[dict[str, Any], bool]]] = {}
        self._freed = asyncio.Condition()
        self._turn = asyncio.Semaphore(limits.jobs)
        self._workers = Workers(assess, limits.assess_s, limits.memory_mb, LOADS)

    def start(self) -> None:
        """Prepare a worker, and assess complete logs left by an earlier server."""
        self._workers.start()
        for log in _left(self._incoming, self._run):
            self._begin(log)

    def stop(self) -> None:
        """End the workers; unprocessed logs stay for the next start."""
        self._stopping = True
        self._workers.stop()
        self._lock.close()

    def waiting(self, digest: str) -> bool:
        """True if a log was received and neither stored nor refused yet."""
        return digest in self._logs

    async def take(self, encoded_name: str, length: int | None, body: AsyncIterator[bytes]) -> tuple[dict, bool]:
        """(the flight of an upload, whether it is new). encoded_name: percent-encoded. length: as announced. The flight has the name of
        this upload; `known_as` is that in the store, where the same bytes came before by another name. Raises Refused."""
        name, most = names.shown(encoded_name), self.limits.most
        if length is not None and length > most:
            await _drain(body)
            raise Refused(413, _too_large(name, most))
        try:
            async with self._place():
                log = await self._receive(name, body)
                task = self._begin(log)
                first = self._logs[log.digest].name
        except asyncio.TimeoutError:
            await _drain(body)
            raise Refused(503, "Too many logs at once; try again in a minute.") from None
        try:
            row, new = await asyncio.shield(task)
        except Refused as why:
            raise type(why)(why.code, str(why).replace(first, name)) from why
        return row | {"name": name} | ({"known_as": row["name"]} if row["name"] != name else {}), new

    @asynccontextmanager
    async def _place(self) -> AsyncIterator[None]:
        """A slot for receiving an upload. Raises TimeoutError when none is free in time."""
        async with self._freed:
            free = self._freed.wait_for(lambda: self._receiving < RECEIVING and len(self._logs) < WAITING)
            await asyncio.wait_for(free, PATIENCE_S)
            self._receiving += 1
        try:
            yield
        finally:
            self._receiving -= 1
            async with self._freed:
                self._freed.notify()

    async def _receive(self, name: str, body: AsyncIterator[bytes]) -> Log:
        """Write the whole body to a file."""
        try:
            folder = Path(tempfile.mkdtemp(dir=self._run))
            path, size, digest = folder / names.on_disk(name), 0, hashlib.sha256()
            try:
                end = time.monotonic() + MOST_S
                with path.open("wb") as file:
                    while piece := await asyncio.wait_for(anext(body, b""), min(IDLE_S, max(end - time.monotonic(), 0.0))):
                        size += len(piece)
                        if size > self.limits.most:
                            await _drain(body)
                            raise Refused(413, _too_large(name, self.limits.most))
                        file.write(piece)
                        digest.update(piece)
                if not size:
                    raise Refused(400, f"{name}: the file is empty; copy the log from the vehicle again.")
                about = {"name": name, "file": path.name, "digest": digest.hexdigest(), "size": size}
                (folder / "complete.json").write_text(json.dumps(about))
            except BaseException:
                shutil.rmtree(folder, ignore_errors=True)
                raise
        except asyncio.TimeoutError:
            text = f"{name}: the upload was too slow and was aborted; try again on a better connection."
            raise Refused(408, text) from None
        except OSError as why:
            text = f"{name}: the upload cannot be stored ({why.strerror or why}); free space on the server's disk."
            raise Refused(507, text) from None
        return Log(path, name, digest.hexdigest(), size)

    def _begin(self, log: Log, waited_s: float = 0.0) -> asyncio.Task[tuple[dict[str, Any], bool]]:
        """Assess it, once for all who sent it. waited_s: since the attempt before this one."""
        known = self._logs.setdefault(log.digest, log)
        if known.path != log.path:
            shutil.rmtree(log.path.parent, ignore_errors=True)
        task = self._assessing.get(log.digest)
        if task is None:
            task = self._assessing[log.digest] = asyncio.create_task(self._assess(known, waited_s))
            task.add_done_callback(lambda t: (self._assessing.pop(log.digest, None), t.cancelled() or t.exception()))
        return task

    async def _assess(self, log: Log, waited_s: float) -> tuple[dict[str, Any], bool]:
        """(the flight, stored before on_stored is called; whether it is new). Raises Refused for a log without a flight, Later."""
        new = False
        try:
            row = await asyncio.to_thread(self._attempt, log, self._flights.row, log.digest)
            if row is None:
                async with self._turn:
                    row, new = await asyncio.to_thread(self._attempt, log, self._into_store, log), True
        except Later as why:
            pause_s = min(max(2.0 * waited_s, AGAIN_S), LONGEST_S)
            asyncio.get_running_loop().call_later(pause_s, self._again, log, pause_s)
            self._trouble(str(why))
            raise
        except Refused:
            await self._finish(log)
            raise
        await self._finish(log)
        if new:
            self._on_stored(row)
        return row, new

    def _again(self, log: Log, waited_s: float) -> None:
        if log.digest in self._logs and not self._stopping:
            self._begin(log, waited_s)

    async def _finish(self, log: Log) -> None:
        """Remove a log that is stored or refused."""
        del self._logs[log.digest]
        shutil.rmtree(log.path.parent, ignore_errors=True)
        async with self._freed:
            self._freed.notify()

    def _attempt(self, log: Log, do: Callable[..., Any], *what: Any) -> Any:
        """do(*what). Raises Refused unchanged, and any other error, which is not due to the log, as Later."""
        try:
            return do(*what)
        except Refused:
            raise
        except Exception as why:
            code, text = (503, "The server is stopping.") if self._stopping else wrong(why)
            raise Later(code, f"{log.name}: the log is kept and diagnosed later. {text}") from why

    def _into_store(self, log: Log) -> dict[str, Any]:
        """The flight, assessed and put into the store."""
        entry = self._answer(log)
        if isinstance(entry, str):
            raise Refused(422, entry)
        return self._flights.keep(entry)

    def _answer(self, log: Log) -> Entry | str:
        """A worker's result."""
        try:
            return self._workers.call((log, str(self._flights.page(log.digest))))
        except TooMuch as why:
            raise Refused(422, f"{log.name}: {why}") from None


def _too_large(name: str, most: int) -> str:
    return f"{name}: larger than the limit of {most / 2**20:g} MB; start the server with a larger --max-upload."


async def _drain(body: AsyncIterator[bytes]) -> None:
    """Read and discard for a while."""

    async def rest() -> None:
        async for _ in body:
            pass

    with suppress(asyncio.TimeoutError):  # not the built-in one in Python 3.10
        await asyncio.wait_for(rest(), DRAIN_S)


def _own(incoming: Path) -> tuple[Path, Any]:
    """A folder for the uploads of this run, and the lock that marks it as in use."""
    run = Path(tempfile.mkdtemp(dir=incoming, prefix="run-"))
    lock = (run / "lock").open("wb")
    _locked(lock)
    return run, lock


def _locked(file: Any) -> bool:
    """True if the lock was acquired; False where the system has none."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (ImportError, OSError):
        return False
    return True


def _left(incoming: Path, own: Path) -> list[Log]:
    """Logs that earlier servers had received and not assessed, moved to the folder of this run; the rest of theirs is removed."""
    logs = []
    for run in incoming.glob("run-*"):
        if run == own:
            continue
        with suppress(OSError), (run / "lock").open("ab") as lock:
            if not _locked(lock):
                continue
            for note in run.glob("*/complete.json"):
                with suppress(ValueError, KeyError, TypeError):  # half-written: an incomplete upload
                    about = json.loads(note.read_text())
                    folder = own / note.parent.name
                    path = folder / Path(about["file"]).name
                    log = Log(path, str(about["name"]), str(about["digest"]), int(about["size"]))
                    note.parent.rename(folder)  # on failure, all stays for the next start
                    logs.append(log)
            shutil.rmtree(run, ignore_errors=True)
    return logs
