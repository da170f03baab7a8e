"""Dispatch of a question to a process with limits, with one sentence where there is no answer."""

from __future__ import annotations

import difflib
import threading
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any

from rotorwatch import airframes
from rotorwatch.assistants import answers, work
from rotorwatch.assistants.fleet_access import Fleet
from rotorwatch.assistants.folders import Folders
from rotorwatch.assistants.quoted import quoted
from rotorwatch.assistants.work import Question
from rotorwatch.base.many.limited import TooMuch, Workers
from rotorwatch.errors import ConfigError

WAITING, PATIENCE_S = 8, 300.0  # queued questions, and their longest wait
MOST_HEALTHY, MOST_LISTED = 20, 50


class Desk:
    """Answers as plain data. folders: readable ones; store: address of the fleet's store or ""; assess_s [s], memory_mb [MB], most [bytes
    of a log]: limits of one question; jobs: questions at once."""

    def __init__(self, folders: Sequence[Any], store: str, most: int, assess_s: float, memory_mb: int, jobs: int = 1):
        self.folders, self.fleet = Folders(folders, most), Fleet(store)
        self._assessing = Workers(work.answer, assess_s, memory_mb, work.LOADS, work.away)
        self._planning = Workers(work.answer, assess_s, memory_mb, work.planning_loads(), work.away)
        self._turn, self._places = threading.Semaphore(jobs), threading.Semaphore(jobs + WAITING)

    def stop(self) -> None:
        """End all processes."""
        self._assessing.stop()
        self._planning.stop()

    def ask(self, verb: str, log: str | None = None, baseline: Sequence[str] = (), vehicle: str | None = None, **more: Any) -> Any:
        """The process's answer (`work.answer`). log, baseline, vehicle: as the user names them. Raises ConfigError, WorkerError."""
        if len(baseline) > MOST_HEALTHY:
            raise ConfigError(f"baseline: give at most {MOST_HEALTHY} flights.")
        named = None if log is None else self.folders.log(log)
        craft: Any = None
        if vehicle is not None:
            craft = self._airframe(vehicle) if verb == "survive" else self.folders.vehicle(vehicle)
        others = tuple(self.folders.log(one) for one in baseline)
        question = Question(verb, named, others, craft, tuple(sorted(more.items())))
        return self._answered(self._planning if verb == "survive" else self._assessing, question)

    def _airframe(self, given: str) -> Any:
        """The name of an airframe, or a vehicle file. Raises ConfigError."""
        names = (*airframes.names(), *airframes.papers())
        if given in names:
            return given
        if given.lower().endswith(".toml"):
            return self.folders.vehicle(given)
        near = difflib.get_close_matches(given[:60].lower(), names, 4, 0.4) or ["ardupilot-quad-x", "px4-quad-x"]
        raise ConfigError(f"vehicle: give the name of an airframe, such as {', '.join(near)}, or a vehicle file (.toml).")

    def _answered(self, workers: Workers, question: Question) -> Any:
        if not self._places.acquire(blocking=False):
            raise ConfigError("Too many requests at once; try again when the others are answered.")
        try:
            if not self._turn.acquire(timeout=PATIENCE_S):
                raise ConfigError("Earlier requests take too long; try again later.")
            try:
                return workers.call(question)
            except TooMuch as why:
                text = str(why)
                raise ConfigError(text[:1].upper() + text[1:]) from None
            except MemoryError:
                raise ConfigError("Not enough memory to answer this.") from None
            finally:
                self._turn.release()
        finally:
            self._places.release()

    def list_logs(self, search: str, limit: int) -> dict[str, Any]:
        """`Logs` of models.py."""
        logs = self.folders.list(search)
        several = len(self.folders.roots) > 1
        rows = []
        for name, root, path, about in logs[: min(limit, MOST_LISTED)]:
            listed = path if several else path.relative_to(root)
            when = datetime.fromtimestamp(about.st_mtime, timezone.utc)
            rows.append({"id": name, "path": quoted(listed), "bytes": about.st_size, "changed_utc": f"{when:%Y-%m-%dT%H:%MZ}"})
        left = len(logs) - len(rows)
        note = f"{left} more logs; search for words of their paths, or raise the limit." if left else None
        return {"total": len(logs), "logs": rows, "note": note}

    def stored(self, flight: str) -> dict[str, Any]:
        """`Diagnosis` of models.py, of a flight in the store."""
        return answers.diagnosis(*self.fleet.flight(flight))

    def stored_event(self, flight: str, number: int | None) -> dict[str, Any]:
        """`Event` of models.py, of a flight in the store. Raises ConfigError."""
        event = answers.event(*self.fleet.flight(flight), number)
        if isinstance(event, str):
            raise ConfigError(event)
        return event
