"""The jobs of the processes with limits: read a log, evaluate it, draw it. A log gets a neutral name there, so that no sentence contains
its own; the last few diagnoses are kept, because questions about one log come one after the other."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rotorwatch import airframes
from rotorwatch.assistants import answers, quoted, signal_rows
from rotorwatch.assistants.folders import Allowed
from rotorwatch.base import discovery, optional
from rotorwatch.errors import ConfigError, LogError, VehicleError
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.vehicle import Vehicle

KEPT = 4  # diagnoses
LARGEST = 400_000  # bytes of a picture
LOADS = ("rotorwatch.diagnose", "rotorwatch.report.info", "rotorwatch.assistants.answers", "rotorwatch.report.figures")
_kept: OrderedDict[Any, Diagnosis] = OrderedDict()


@dataclass(frozen=True)
class Question:
    """A question. verb: one of VERBS; log, healthy, vehicle: readable files; more: the tool's other parameters."""

    verb: str
    log: Allowed | None = None
    healthy: tuple[Allowed, ...] = ()
    vehicle: Allowed | str | None = None
    more: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Failed:
    """A failure: one of our sentences and, for an error in a file, its reader's words, which may quote it."""

    sentence: str
    reader: str = ""


def answer(question: Question) -> dict[str, Any] | Failed | tuple[dict[str, Any], bytes]:
    """The answer, in the types of models.py; of a picture with its bytes."""
    try:
        return VERBS[question.verb](question, dict(question.more))
    except _Ours as why:
        return Failed(str(why))
    except (LogError, VehicleError, ConfigError) as why:
        blamed = getattr(why, BLAMED, "This vehicle" if question.log is None else "This log")
        sentence = re.sub(re.escape(tempfile.gettempdir() + os.sep) + r"[^/\\\s]+[/\\]", "", str(why))  # the link's folder
        reader = quoted.quoted(sentence, 300)["quoted_from_log"]
        return Failed(f"{blamed} cannot be used; what its reader says is quoted.", reader)


def planning_loads() -> tuple[str, ...]:
    """The modules that planning needs; it is a part of the laboratory."""
    entry = discovery.offered("rotorwatch.api").get("survive")
    return ("jax", "scipy.optimize", *([] if entry is None else [entry.module]))


def _planning() -> Any:
    """The module that answers survival questions. Raises ConfigError where it is not installed."""
    return discovery.first("rotorwatch.api", "What a vehicle survives", "survive")


def away() -> None:
    """Work in an empty folder, where no name of an airframe can be that of a file."""
    os.chdir(tempfile.mkdtemp())


BLAMED = "blamed"  # attribute of an exception: the file at fault, as the beginning of a sentence


@contextmanager
def _blaming(what: str) -> Iterator[None]:
    """Context in which errors are attributed to that file, unless already attributed."""
    try:
        yield
    except (LogError, VehicleError, ConfigError) as why:
        if not hasattr(why, BLAMED):
            setattr(why, BLAMED, what)
        raise


class _Ours(ConfigError):
    """A sentence without content of a file."""


def _ours(do: Callable[..., Any], *what: Any) -> Any:
    """do(*what), whose ConfigErrors contain nothing of a file."""
    try:
        return do(*what)
    except ConfigError as why:
        raise _Ours(str(why)) from None


@contextmanager
def _here(file: Allowed, name: str) -> Iterator[Path]:
    """The file under a neutral name: a link in a folder of its own, or a copy where there are no links."""
    folder = Path(tempfile.mkdtemp())
    place = folder / f"{name}{file.ending}"
    try:
        try:
            place.symlink_to(file.path)
        except (OSError, NotImplementedError):
            shutil.copyfile(file.path, place)
        yield place if file.part is None else place.with_name(f"{place.name}#{file.part}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _read(file: Allowed | None, name: str) -> Flight:
    assert file is not None
    from rotorwatch import logs

    with _here(file, name) as path:
        return logs.read(path)


def _vehicle(file: Allowed | str | None) -> Vehicle | None:
    """The vehicle of a file, without its name and notes, which are foreign texts."""
    if not isinstance(file, Allowed):
        return None
    from rotorwatch.flight import vehicle_file

    with _here(file, "vehicle") as path:
        return replace(vehicle_file.read(path), name="vehicle-file", assumptions=(), source="vehicle file")


def _assessed(question: Question) -> Diagnosis:
    """The diagnosis, by `rotorwatch diagnose`."""
    key = question.log, question.healthy, question.vehicle
    if key in _kept:
        _kept.move_to_end(key)
        return _kept[key]
    from rotorwatch.diagnose import diagnose

    def assess() -> Diagnosis:
        healthy = []
        for k, file in enumerate(question.healthy, 1):
            with _blaming(f"Healthy flight {k} (of `baseline`)"):
                healthy.append(_read(file, f"healthy-{k}"))
        with _blaming("This vehicle"):
            vehicle = _vehicle(question.vehicle)
        with _blaming("This log"):
            flight = _read(question.log, "log")
            airframes.of(flight, vehicle)
        with _blaming("The baseline" if healthy else "This log"):
            return diagnose(flight, vehicle=vehicle, baseline=healthy)

    try:
        diagnosis = assess()
    except MemoryError:  # kept diagnoses use memory, too
        if not _kept:
            raise
        _kept.clear()
        diagnosis = assess()
    _kept[key] = diagnosis
    while len(_kept) > KEPT:
        _kept.popitem(last=False)
    return diagnosis


def _diagnose(question: Question, more: dict) -> dict[str, Any]:
    return answers.diagnosis(_assessed(question), _name(question))


def _compare(question: Question, more: dict) -> dict[str, Any]:
    return answers.compared(_assessed(question), _name(question), [file.name for file in question.healthy])


def _event(question: Question, more: dict) -> dict[str, Any]:
    event = answers.event(_assessed(question), _name(question), more["number"])
    if isinstance(event, str):
        raise _Ours(event)
    return event


def _series(question: Question, more: dict) -> dict[str, Any]:
    diagnosis = _assessed(question)
    wanted = [more[name] for name in ("what", "rotor", "start_s", "end_s", "most")]
    return {"log": quoted.quoted(_name(question))} | _ours(signal_rows.sampled, diagnosis, *wanted)


def _picture(question: Question, more: dict) -> tuple[dict[str, Any], bytes]:
    from rotorwatch.report import still

    diagnosis = _assessed(question)
    kind = _ours(still.shows, diagnosis, more["what"])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        drawn = _ours(still.figure, diagnosis, kind, path)
        data = path.read_bytes()
    if len(data) > LARGEST:
        raise _Ours("The picture is too large to send; `rotorwatch diagnose --report` writes it as a page.")
    width, height = (round(side) for side in drawn.get_size_inches() * drawn.dpi)
    size = {"width": width, "height": height, "bytes": len(data)}
    return {"log": quoted.quoted(_name(question)), "shows": answers.caption(diagnosis, kind)} | size, data


def _facts(question: Question) -> dict[str, Any]:
    from rotorwatch.report.info import info

    return info(_read(question.log, "log"))


def _log(question: Question, more: dict) -> dict[str, Any]:
    return answers.log(_facts(question), _name(question))


def _what_to_log(question: Question, more: dict) -> dict[str, Any]:
    return answers.what_to_log(_facts(question), _name(question))


def _survive(question: Question, more: dict) -> dict[str, Any]:
    file = question.vehicle
    name = file.name if isinstance(file, Allowed) else str(file)
    subject = _vehicle(file) or name
    for library in ("jax", "scipy"):
        _ours(optional.library, library, "What a vehicle survives")
    planning = _planning()
    return answers.survival(planning.survive(subject, **more), name, planning.VERDICTS)


def _name(question: Question) -> str:
    return "" if question.log is None else question.log.name


VERBS: dict[str, Callable[[Question, dict], Any]] = {
    "diagnose": _diagnose,
    "compare": _compare,
    "event": _event,
    "series": _series,
    "picture": _picture,
    "info": _log,
    "what_to_log": _what_to_log,
    "survive": _survive,
}
