"""Fitness of an aircraft to fly, by its rotors over all flights and by the verdicts of its flights."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rotorwatch.answer.wording import listed

FAULT, SUSPECT, UNKNOWN, HEALTHY = STATES = ("fault", "suspect", "not assessed", "healthy")  # the most urgent first
URGENT = {"damaged": 0, "worn": 1, "suspect": 2}  # states of a rotor with a fault
BAD = ("crashed", "fault")


def of(verdicts: Sequence[str], fell: Sequence[bool], rotors: Iterable[str]) -> str:
    """The state, from STATES. verdicts, fell: of the flights since the last service, in order, and whether control was lost in them;
    rotors: the states of its rotors. An undecided verdict clears no fault; a rotor or a last flight that was not assessed is not
    healthy."""
    rotors = list(rotors)
    bad = [verdict in BAD or lost for verdict, lost in zip(verdicts, fell, strict=True)]
    decided = [k for k, verdict in enumerate(verdicts) if bad[k] or verdict != "inconclusive"]
    if any(URGENT.get(r, 2) < 2 for r in rotors) or (decided and bad[decided[-1]]):
        return FAULT
    if any(r in URGENT for r in rotors) or any(bad) or (decided and verdicts[decided[-1]] == "ambiguous"):
        return SUSPECT
    last_assessed = verdicts and decided and decided[-1] == len(verdicts) - 1
    return HEALTHY if last_assessed and rotors and not {"unknown", "serviced"} & set(rotors) else UNKNOWN


def flights(verdicts: Sequence[str], fell: Sequence[bool]) -> str:
    """The number of bad flights, as a sentence; empty where there were none."""
    crashed, fault = (sum(verdict == bad for verdict in verdicts) for bad in BAD)
    lost = sum(gone and verdict not in BAD for verdict, gone in zip(verdicts, fell, strict=True))
    counts = ((crashed, "crashed"), (fault, "had a fault"), (lost, "lost control"))
    counted = [f"{count} {what}" for count, what in counts if count]
    return f"Of {len(verdicts)} flight{'s' * (len(verdicts) > 1)} {listed(counted)}." if counted else ""


def by_urgency(aircraft: Iterable[Mapping]) -> list[Mapping]:
    """Aircraft as from `Store.aircraft`, the most urgent first: by their states, then by the rotors' evidence."""

    def urgency(a: Mapping) -> tuple:
        standing = a["standing"] or {}
        worst = min((URGENT.get(r["status"], len(URGENT)) for r in standing.get("rotors", ())), default=len(URGENT))
        return STATES.index(a["state"]), worst, -float(standing.get("worst") or 0.0), a["name"]

    return sorted(aircraft, key=urgency)


def state(standing: Mapping | None, verdicts: Mapping[str, int]) -> str:
    """The state of an aircraft by its standing; without one, by its rotors or verdicts alone. verdicts: their numbers."""
    stored = (standing or {}).get("state")
    if stored in STATES:
        return stored
    rotors = [r["status"] for r in (standing or {}).get("rotors", ())]
    bad = any(verdicts.get(verdict) for verdict in BAD)
    return of(["fault" if bad else "inconclusive"], [False], rotors)
