"""Which rotor of a multirotor lost effectiveness, how much, since when and how sure that is: from flight logs.

    import rotorwatch as rw
    flight = rw.read("flight.bin")
    diagnosis = rw.diagnose(flight)
    print(diagnosis.verdict, diagnosis.reason)
    diagnosis.to_html("report.html")

Everything is loaded on first use, so that importing the package costs nothing: ``rw.read``, ``rw.diagnose``, ``rw.calibrate`` and so on
are the commands of the command line, ``rw.Flight``, ``rw.Vehicle`` and ``rw.Diagnosis`` its data, ``rw.airframes`` and so on the
submodules. Installed packages add names by entry points `rotorwatch.api`: ``rw.simulate``, ``rw.estimators``, ``rw.reproduce`` and others
come from `rotorwatch_lab`.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Functions that live in a module of the same name: rotorwatch/diagnose.py holds diagnose.
_VERBS = {"calibrate": "calibrate", "diagnose": "diagnose", "diagnose_many": "diagnose_many", "info": "report.info"}
# Other names: where each one lives.
_HOMES = {
    "read": "logs",
    "airborne": "engine.motion.air_spans",
    "serve": "serve.server",
    "mcp": "assistants.mcp_server",
    "new": "templates",
    "Flight": "flight",
    "Message": "flight",
    "Signal": "flight",
    "Rotor": "flight.vehicle",
    "ThrustCurve": "flight.vehicle",
    "Vehicle": "flight.vehicle",
    "Diagnosis": "flight.diagnosis",
    "Event": "flight.diagnosis",
    "RotorState": "flight.diagnosis",
    "Trace": "flight.diagnosis",
    "ConfigError": "errors",
    "LogError": "errors",
    "RotorwatchError": "errors",
    "VehicleError": "errors",
}
# Modules by a shorter name.
_SHORT = {"checks": "base.checks", "many": "base.many", "sections": "report.sections"}

__all__ = ["__version__", "read", *_VERBS, *(n for n in _HOMES if n != "read")]

if TYPE_CHECKING:
    from rotorwatch.assistants.mcp_server import mcp as mcp
    from rotorwatch.calibrate import calibrate as calibrate
    from rotorwatch.diagnose import diagnose as diagnose
    from rotorwatch.diagnose_many import diagnose_many as diagnose_many
    from rotorwatch.engine.motion.air_spans import airborne as airborne
    from rotorwatch.errors import ConfigError as ConfigError
    from rotorwatch.errors import LogError as LogError
    from rotorwatch.errors import RotorwatchError as RotorwatchError
    from rotorwatch.errors import VehicleError as VehicleError
    from rotorwatch.flight import Flight as Flight
    from rotorwatch.flight import Message as Message
    from rotorwatch.flight import Signal as Signal
    from rotorwatch.flight.diagnosis import Diagnosis as Diagnosis
    from rotorwatch.flight.diagnosis import Event as Event
    from rotorwatch.flight.diagnosis import RotorState as RotorState
    from rotorwatch.flight.diagnosis import Trace as Trace
    from rotorwatch.flight.vehicle import Rotor as Rotor
    from rotorwatch.flight.vehicle import ThrustCurve as ThrustCurve
    from rotorwatch.flight.vehicle import Vehicle as Vehicle
    from rotorwatch.logs import read as read
    from rotorwatch.report.info import info as info
    from rotorwatch.serve.server import serve as serve
    from rotorwatch.templates import new as new

    # Types of the entry points `rotorwatch.api` of our own wheel: nothing is imported at run time.
    from rotorwatch_lab.compiling.run import run as run
    from rotorwatch_lab.estimate import estimate as estimate
    from rotorwatch_lab.experiments.evaluate import evaluate as evaluate
    from rotorwatch_lab.experiments.inject import inject as inject
    from rotorwatch_lab.experiments.studies.compare import compare as compare
    from rotorwatch_lab.experiments.studies.reproduction import reproduce as reproduce
    from rotorwatch_lab.export_c import export_c as export_c
    from rotorwatch_lab.planning.ask import ask as ask
    from rotorwatch_lab.planning.survive import survive as survive
    from rotorwatch_lab.published.observability import observability as observability
    from rotorwatch_lab.simulation import simulate as simulate
    from rotorwatch_lab.simulation.any_system import simulate_system as simulate_system
    from rotorwatch_lab.tune import tune as tune


class _Verb(ModuleType):
    """A module that can be called: ``rw.inject(flight, ...)`` is its main function, ``rw.inject.campaign`` another."""

    @property
    def __wrapped__(self):
        return getattr(self, self.__name__.rpartition(".")[2])

    def __call__(self, *args, **kwargs):
        try:
            return self.__wrapped__(*args, **kwargs)
        except ModuleNotFoundError as why:
            from rotorwatch.errors import ConfigError, lacking

            if said := lacking(why):
                raise ConfigError(said) from why
            raise


def _callable(module: ModuleType) -> None:
    """Make a module a verb, of which `help` shows its functions alone, the arguments first and not its imports."""
    own = [n for n, f in vars(module).items() if not n.startswith("_") and getattr(f, "__module__", "") == module.__name__]
    module.__dict__.setdefault("__all__", [n for n in own if not isinstance(getattr(module, n), type)])
    module.__class__ = _Verb


class _Package(ModuleType):
    """The import system sets each loaded submodule as an attribute here; verbs become callable at that moment."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _VERBS and type(value) is ModuleType:
            _callable(value)
        super().__setattr__(name, value)


def __getattr__(name: str) -> Any:
    from importlib import import_module
    from importlib.util import find_spec

    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    if name in _VERBS:
        setattr(sys.modules[__name__], name, import_module(f"{__name__}.{_VERBS[name]}"))
        return sys.modules[__name__].__dict__[name]
    if name == "init":  # what MAVProxy calls: `module load rotorwatch`
        return import_module(f"{__name__}.live.mavproxy").init
    if name in _SHORT:
        return import_module(f"{__name__}.{_SHORT[name]}")
    if name.startswith("_"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if find_spec(f"{__name__}.{name}") is not None:
        return import_module(f"{__name__}.{name}")
    return _offered(name)


def _offered(name: str) -> Any:
    """What an installed package offers under that name; a module that holds a function of its own name becomes callable."""
    from rotorwatch.base import discovery

    found = discovery.api(name)
    if type(found) is ModuleType and hasattr(found, found.__name__.rpartition(".")[2]):
        _callable(found)
    return found


def __dir__() -> list[str]:
    from pkgutil import iter_modules

    from rotorwatch.base import discovery

    own = (module.name for module in iter_modules(__path__) if not module.name.startswith("_"))
    loaded = (n for n in globals() if n.startswith("__"))
    return sorted({*loaded, *__all__, *_SHORT, *own, *discovery.offered("rotorwatch.api")})


sys.modules[__name__].__class__ = _Package
