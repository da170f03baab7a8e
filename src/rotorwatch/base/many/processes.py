"""Work for processes of this computer: each takes the next item when it has finished one.

They are spawned, not forked, because a fork inherits locks of numerical libraries; they do one thing at a time, in one thread, because
there are as many of them as processors; and they end with the process that started them, however that ends.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import connection, get_context, parent_process
from typing import Any

from rotorwatch.base import incoming
from rotorwatch.base.many.done import Done, Task, attempt, packed, portable
from rotorwatch.errors import FirstUse, WorkerError

START_S, EXIT_S = 120.0, 10.0
"""For a process to load what it needs, and to end after its pipe."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC")
"""Variables that say how many threads numerical libraries use; the last one is XLA's."""
READY = b"ready"


def run(function: Callable, tasks: Iterator[Task], jobs: int, tries: int) -> Iterator[Done]:
    """`spread.run`, with one item at a time in each process."""
    work = pickle.dumps((function, None))
    again: deque[Task] = deque()
    team: list[Worker] = []
    never_started = 0
    try:
        while True:
            while len(team) < jobs and (task := again.popleft() if again else next(tasks, None)) is not None:
                team.append(Worker(work, None, task))
            if not team:
                return
            finished: list[Done] = []
            for worker in _ready(team):
                received, task = worker.receive(), worker.task
                if received == READY:
                    never_started = 0
                    worker.begin()
                    continue
                if received is None:  # dead or hanging
                    team.remove(worker)
                    how = worker.ended()
                    if not worker.ready:
                        never_started += 1
                        if never_started > 1:
                            raise WorkerError(
                                f"A process that is to do the work {how} while starting: is there enough memory? In a script of your own, "
                                'start the work below `if __name__ == "__main__":`.'
                            )
                        again.append(task)
                    elif task.tries + 1 < tries:
                        again.append(replace(task, tries=task.tries + 1))
                    else:
                        error = WorkerError(f"the process {how} {tries} times (too little memory?)", how)
                        finished.append(Done(task.index, None, error))
                    continue
                value, error = _unpacked(received)
                if error is not None and not worker.ready:  # the function itself cannot be loaded there
                    raise error
                finished.append(Done(task.index, value, error))
                following = again.popleft() if again else next(tasks, None)
                if following is None:
                    team.remove(worker)
                    worker.dismiss()
                else:
                    worker.task = following
                    worker.begin()
            yield from finished  # after every worker has a task
    finally:
        for worker in team:
            worker.stop()


def _ready(team: list[Worker]) -> list[Worker]:
    """Workers that have sent a message, have died, or are beyond their limit; waits for one."""
    deadline = min(worker.deadline for worker in team)
    left_s = None if deadline == float("inf") else max(0.0, deadline - time.monotonic())
    ready = connection.wait([w.pipe for w in team], left_s)
    now = time.monotonic()
    return [w for w in team if w.pipe in ready or now > w.deadline]


def _unpacked(received: bytes) -> tuple[Any, Exception | None]:
    try:
        return pickle.loads(received)
    except Exception as why:
        return None, RuntimeError(f"A result cannot be unpacked ({type(why).__name__}: {why}).")


NOTHING = Task(0, None)


class Worker:
    """A process, this end of its pipe, and its current task."""

    def __init__(self, work: bytes, limit_s: float | None, task: Task = NOTHING):
        """work: (function, prepare), packed. limit_s: for one item."""
        context, reports = get_context("spawn"), _warns(FirstUse)
        place = str(incoming.spool())  # a killed process cleans up nothing
        self.task, self.limit_s, self.ready, self.hung = task, limit_s, False, False
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, work, place, reports), daemon=True)
        with _one_thread():
            self.process.start()
        theirs.close()
        self.deadline = time.monotonic() + START_S

    def call(self, item: Any) -> Any:
        """function(item). Raises what the function raises; WorkerError when the process dies or hangs; it has ended then."""
        self.task = Task(0, item)
        value, error = None, None
        if not self.ready:
            received = self._answer("while starting")
            if received != READY:
                self.stop()
                error = _unpacked(received)[1]
        if error is None:
            self.begin()
            value, error = _unpacked(self._answer())
        return Done(0, value, error).result()

    def _answer(self, when: str = "") -> bytes:
        _ready([self])
        received = self.receive()
        if received is None:
            how = self.ended()
            raise WorkerError(f"the process {how} {when}".rstrip(), how)
        return received

    @property
    def alive(self) -> bool:
        return self.process.is_alive()

    def begin(self) -> None:
        """Send the task and start its time limit."""
        self.ready = True
        self.deadline = float("inf") if self.limit_s is None else time.monotonic() + self.limit_s
        with suppress(OSError):  # dead, as the next poll will show
            self.pipe.send_bytes(pickle.dumps(self.task.item))

    def receive(self) -> bytes | None:
        """Its next message; None when it has died or is beyond its limit."""
        self.hung = not self.pipe.poll()
        try:
            return None if self.hung else self.pipe.recv_bytes()
        except (EOFError, OSError):
            return None

    def ended(self) -> str:
        """The way it ended without a message: "died (exit code ..)" or "hung for .. s and more"."""
        if not self.hung:
            self.process.join(EXIT_S)  # the pipe is closed, the exit code not yet known
        self.stop()
        limit_s = self.limit_s or 0.0 if self.ready else START_S
        return f"hung for {limit_s:g} s and more" if self.hung else f"died (exit code {self.process.exitcode})"

    def kill(self) -> None:
        """End it now, from any thread. A thread that waits in `call` finds it dead and closes the pipe, which no second thread may close:
        the number of its descriptor can by then be another file's."""
        self.process.kill()

    def stop(self) -> None:
        """End it now, from the thread that uses it."""
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def dismiss(self) -> None:
        """Let the process exit."""
        self.pipe.close()
        self.process.join()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started inside compute in one thread, unless the user's environment sets another number."""
    ours = [name for name in ONE_THREAD if name not in os.environ]
    os.environ.update(dict.fromkeys(ours, "1"))
    try:
        yield
    finally:
        for name in ours:
            os.environ.pop(name, None)


def _warns(kind: type[Warning]) -> bool:
    """True if warnings of a kind are shown by this process."""
    of_all = (action for action, text, of, module, _ in warnings.filters if not (text or module) and issubclass(kind, of))
    return next(of_all, "default") != "ignore"


def _serve(pipe: Any, work: bytes, place: str, reported: bool) -> None:
    """Main loop of a process: sends READY, then items in, packed results out, until the pipe closes. place: for its temporary files.
    reported:
    whether it reports native code that it builds to the user."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    tempfile.tempdir = place
    if not os.environ.get("ROTORWATCH_DEBUG"):
        warnings.simplefilter("ignore")  # of numerical libraries; each process would repeat them
        if reported:  # in one process only
            warnings.filterwarnings("once", category=FirstUse)
            warnings.showwarning = lambda message, *where, **more: print(f"rotorwatch: {message}", file=sys.stderr)
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_follow, args=(parent.sentinel,), daemon=True).start()
    try:
        function, prepare = pickle.loads(work)
        if prepare is not None:
            prepare()
    except Exception as why:
        pipe.send_bytes(packed(None, portable(why)))
        return

    def do(item: bytes) -> Any:
        return function(pickle.loads(item))

    with suppress(EOFError, OSError):
        pipe.send_bytes(READY)
        while True:
            pipe.send_bytes(packed(*attempt(do, pipe.recv_bytes())))


def _follow(sentinel: Any) -> None:
    """End at once when the process that started this one has ended."""
    connection.wait([sentinel])
    os._exit(1)
