"""Logs that are sent here: taken within bounds of size and time, judged in processes of their own, and kept as flights."""

from __future__ import annotations

import asyncio
import functools
import hashlib
import json
import pickle
import shutil
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rotorwatch import limited
from rotorwatch.errors import ConfigError, RotorwatchError, StoreError, WorkerError
from rotorwatch.fleet.store import Entry
from rotorwatch.many.processes import Worker
from rotorwatch.serve import names
from rotorwatch.serve.flights import Flights

IDLE_S, MOST_S = 30.0, 900.0  # without a byte; for the whole of an upload
DRAIN_S = 10.0  # what is too large is read on for so long, that the answer is seen and not a broken connection
RECEIVING, WAITING = 8, 50  # uploads that are received at once; those that are here and wait for being judged
PATIENCE_S = 60.0  # for which an upload waits until it is received
AGAIN_S = 30.0  # between two attempts to judge or to keep a log for which something was lacking
LOADS = ("rotorwatch.fleet.judge", "rotorwatch.diagnose", "rotorwatch.report.html", "bokeh.embed")


class Refused(RotorwatchError):
    """An upload that is not taken. code: of the HTTP answer."""

    def __init__(self, code: int, why: str):
        super().__init__(why)
        self.code = code


class Lacking(RotorwatchError):
    """What a log needs to be judged and kept is not there now: room on a disk, a store, a process. It is none of the log's fault. code: of
    the HTTP answer."""

    def __init__(self, why: str, code: int = 507):
        super().__init__(why)
        self.code = code


@dataclass(frozen=True)
class Limits:
    """most: bytes of an upload; judge_s and memory_mb: for one log; jobs: logs judged at once."""

    most: int = 512 << 20
    judge_s: float = 120.0
    memory_mb: int = 4000
    jobs: int = 1


@dataclass(frozen=True)
class Log:
    """An upload that is complete. path: alone in a folder of its own; digest: SHA-256 of its bytes."""

    path: Path
    name: str
    digest: str
    size: int


def judge(what: tuple[Log, str]) -> Entry | str:
    """What a worker does with (log, path of the page): writes the page, returns the flight for the store, or why the log is refused. Raises
    Lacking."""
    from rotorwatch.diagnose import diagnose
    from rotorwatch.fleet.judge import of_flight
    from rotorwatch.logs import read
    from rotorwatch.report.html import write

    log, page = what
    try:
        flight = replace(read(log.path), name=log.name)
        found = diagnose(flight)
    except RotorwatchError as why:
        return str(why).replace(str(log.path), log.name).replace(log.path.name, log.name)
    try:
        write(found, page)
    except ConfigError as why:  # its place is the server's, and nobody else's business
        raise Lacking(f"its page cannot be written ({str(why).rpartition(': ')[2].rstrip('.')})") from None
    return of_flight(flight, log.digest, log.name, log.size, found=found)


@dataclass(frozen=True)
class _Limited:
    """A job within a time that the process looks after itself."""

    job: Callable[[Any], Any]
    timeout_s: float

    def __call__(self, what: Any) -> Any:
        try:
            with limited.within(self.timeout_s):
                return self.job(what)
        except limited.TooLong as why:
            raise WorkerError(str(why), "took too long") from None


class Uploads:
    """Where logs go. told: called with each flight that is new, once it is kept; trouble: with a sentence about a log whose sender has gone
    or has been told to wait."""

    def __init__(
        self,
        flights: Flights,
        limits: Limits,
        told: Callable[[dict[str, Any]], None],
        trouble: Callable[[str], None] = lambda text: None,
    ):
        """Raises ConfigError where the folder for uploads cannot be written to."""
        self.limits, self._flights, self._told, self._trouble = limits, flights, told, trouble
        self._incoming = flights.folder("incoming")
        self._run, self._lock = _own(self._incoming)
        self._receiving, self._room = asyncio.Semaphore(RECEIVING), asyncio.Semaphore(WAITING)
        self._again: set[asyncio.Task[None]] = set()
        self._judging: dict[str, asyncio.Task[tuple[dict[str, Any], bool]]] = {}
        self._turn = asyncio.Semaphore(limits.jobs)
        self._idle: list[Worker] = []
        self._all: list[Worker] = []

    def start(self) -> None:
        """Make a worker ready, and judge what was complete when an earlier server was killed."""
        self._idle.append(self._worker())
        for log in _left(self._incoming, self._run):
            self._later(log, 0.0)

    def stop(self) -> None:
        """End what is at work; what was not judged is there for the next start."""
        for worker in self._all:
            worker.stop()

    async def take(
        self, given_name: str, length: int | None, body: AsyncIterator[bytes]
    ) -> tuple[dict[str, Any], bool]:
        """(the flight of an upload, whether it is new). given_name: percent-encoded. length: as announced. Raises Refused."""
        name, most = names.shown(given_name), self.limits.most
        if length is not None and length > most:
            await _drain(body)
            raise Refused(413, _too_large(name, most))
        try:
            await asyncio.wait_for(self._room.acquire(), PATIENCE_S)
        except asyncio.TimeoutError:
            await _drain(body)
            raise Refused(503, "Too many logs have been sent at once; try again in a minute.") from None
        try:
            async with self._receiving:
                log = await self._receive(name, body)
            try:
                return await asyncio.shield(self._begin(log))
            except Lacking as why:
                self._later(log, AGAIN_S)
                said = f"{name}: {why}. The log is kept, and is judged as soon as that is mended."
                raise Refused(why.code, said) from None
        finally:
            self._room.release()

    async def _receive(self, name: str, body: AsyncIterator[bytes]) -> Log:
        """The whole of a body in a file."""
        try:
            folder = Path(tempfile.mkdtemp(dir=self._run))
            path, size, digest = folder / names.on_disk(name), 0, hashlib.sha256()
            try:
                end = time.monotonic() + MOST_S
                with path.open("wb") as file:
                    while piece := await asyncio.wait_for(
                        anext(body, b""), min(IDLE_S, max(end - time.monotonic(), 0.0))
                    ):
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
            raise Refused(
                408, f"{name}: the upload was too slow and was given up; try again on a better connection."
            ) from None
        except OSError as why:
            raise Refused(
                507, f"{name}: the upload cannot be kept ({why.strerror or why}); make room on the server's disk."
            ) from None
        return Log(path, name, digest.hexdigest(), size)

    def _begin(self, log: Log) -> asyncio.Task[tuple[dict[str, Any], bool]]:
        """Judge it, once for all who have sent it: (the flight, whether it is new). Raises Refused for what is no flight, and Lacking."""
        task = self._judging.get(log.digest)
        if task is not None:
            shutil.rmtree(log.path.parent, ignore_errors=True)
            return task
        task = self._judging[log.digest] = asyncio.create_task(self._judge(log))
        task.add_done_callback(lambda done: (self._judging.pop(log.digest, None), done.cancelled() or done.exception()))
        return task

    def _later(self, log: Log, after_s: float) -> None:
        """Judge it after so long, and again until it is kept or refused, as nobody waits for it."""

        async def again() -> None:
            wait_s = after_s
            while log.path.exists():
                await asyncio.sleep(wait_s)
                try:
                    await asyncio.shield(self._begin(log))
                except Lacking as why:
                    self._trouble(f"The flight of {log.name} is not in the list yet: {why}.")
                except Refused as why:
                    self._trouble(str(why))
                wait_s = AGAIN_S

        task = asyncio.create_task(again())
        self._again.add(task)
        task.add_done_callback(self._again.discard)

    async def _judge(self, log: Log) -> tuple[dict[str, Any], bool]:
        """As `_begin`. The log goes when the store has its flight, or when it is refused, and for no other reason."""
        try:
            row = await asyncio.to_thread(self._flights.row, log.digest)
            new = row is None
            if row is None:
                async with self._turn:
                    found = await asyncio.to_thread(self._answer, log)
                    if isinstance(found, str):
                        raise Refused(422, found)
                    row = await asyncio.to_thread(self._flights.keep, found)
        except Refused:
            shutil.rmtree(log.path.parent, ignore_errors=True)
            raise
        except StoreError as why:
            raise Lacking("the fleet's store does not take it now", 503) from why
        except OSError as why:
            raise Lacking(f"it cannot be kept ({why.strerror})") from why
        shutil.rmtree(log.path.parent, ignore_errors=True)
        if new:
            self._told(row)
        return row, new

    def _answer(self, log: Log) -> Entry | str:
        """What a worker says of it. Raises Lacking, and Refused for what it could not bear."""
        worker = self._idle.pop() if self._idle else self._worker()
        try:
            return worker.ask((log, str(self._flights.page(log.digest))))
        except Lacking:
            raise
        except Exception as why:
            if not worker.ready or not (worker.alive or isinstance(why, WorkerError)):  # or the server stops
                raise Lacking(f"the process that judges logs does not run ({why})", 503) from None
            raise Refused(422, f"{log.name}: {self._sentence(why)}") from None
        finally:
            if worker.alive:
                self._idle.append(worker)
            else:
                self._all.remove(worker)

    def _sentence(self, why: Exception) -> str:
        how = why.how if isinstance(why, WorkerError) else ""
        if how.startswith(("took too long", "hung")):
            return f"judging it took longer than {self.limits.judge_s:g} s and was given up; try `rotorwatch diagnose`."
        if isinstance(why, MemoryError) or how.startswith("died"):
            return f"judging it needed more than {self.limits.memory_mb} MB of memory and was given up; try `rotorwatch diagnose`."
        return f"an error in rotorwatch itself ({type(why).__name__}: {why}); please report it."

    def _worker(self) -> Worker:
        prepare = functools.partial(limited.cap_memory, self.limits.memory_mb, LOADS)
        work = pickle.dumps((_Limited(judge, self.limits.judge_s), prepare))
        worker = Worker(work, self.limits.judge_s + limited.GRACE_S)
        self._all.append(worker)
        return worker


def _too_large(name: str, most: int) -> str:
    return f"{name}: this is more than the {most / 2**20:g} MB that are taken here; start the server with a larger --max-upload."


async def _drain(body: AsyncIterator[bytes]) -> None:
    """Read on for a while without keeping anything."""

    async def rest() -> None:
        async for _ in body:
            pass

    with suppress(asyncio.TimeoutError):  # not the built-in one in Python 3.10
        await asyncio.wait_for(rest(), DRAIN_S)


def _own(incoming: Path) -> tuple[Path, Any]:
    """A folder for the uploads of this run, and the lock that says that it is in use."""
    try:
        run = Path(tempfile.mkdtemp(dir=incoming, prefix="run-"))
        lock = (run / "lock").open("wb")
    except OSError as why:
        raise ConfigError(f"--store: cannot write into {incoming} ({why.strerror or why}).") from None
    _locked(lock)
    return run, lock


def _locked(file: Any) -> bool:
    """Whether the lock could be had; where the system has none, it could not."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (ImportError, OSError):
        return False
    return True


def _left(incoming: Path, own: Path) -> list[Log]:
    """What servers that were killed had received and not judged, moved to the folder of this run; the rest of theirs is removed."""
    found = []
    for run in incoming.glob("run-*"):
        if run == own:
            continue
        with suppress(OSError), (run / "lock").open("ab") as lock:
            if not _locked(lock):
                continue
            for note in run.glob("*/complete.json"):
                with suppress(ValueError, KeyError, TypeError):  # not written to its end: the log was not complete
                    about = json.loads(note.read_text())
                    folder = own / note.parent.name
                    log = Log(folder / Path(about["file"]).name, about["name"], about["digest"], int(about["size"]))
                    note.parent.rename(folder)
                    found.append(log)
            shutil.rmtree(run, ignore_errors=True)  # not reached when one of them could not be moved
    return found
