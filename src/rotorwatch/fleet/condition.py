"""Whether an aircraft may fly: what its rotors show over all flights, and what its flights were judged by themselves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rotorwatch.answer.wording import listed

FAULT, SUSPECT, UNKNOWN, HEALTHY = STATES = ("fault", "suspect", "not judged", "healthy")  # the most urgent first
URGENT = {"damaged": 0, "worn": 1, "suspect": 2}  # states of a rotor that is not well
BAD = ("crashed", "fault")


def of(verdicts: Sequence[str], fell: Sequence[bool], rotors: Iterable[str]) -> str:
    """One of STATES. verdicts, fell: of the flights since the last service, in order, and whether control was lost in them; rotors: the
    states of its rotors. A verdict that decides nothing clears no fault; a rotor or a last flight that was not judged is not healthy."""
    rotors = list(rotors)
    bad = [verdict in BAD or lost for verdict, lost in zip(verdicts, fell, strict=True)]
    decided = [k for k, verdict in enumerate(verdicts) if bad[k] or verdict != "inconclusive"]
    if any(URGENT.get(r, 2) < 2 for r in rotors) or (decided and bad[decided[-1]]):
        return FAULT
    if any(r in URGENT for r in rotors) or any(bad) or (decided and verdicts[decided[-1]] == "ambiguous"):
        return SUSPECT
    judged = verdicts and decided and decided[-1] == len(verdicts) - 1
    return HEALTHY if judged and rotors and not {"unknown", "serviced"} & set(rotors) else UNKNOWN


def flights(verdicts: Sequence[str], fell: Sequence[bool]) -> str:
    """How many flights were bad, as a sentence; empty where none was."""
    crashed, fault = (sum(verdict == one for verdict in verdicts) for one in BAD)
    lost = sum(gone and verdict not in BAD for verdict, gone in zip(verdicts, fell, strict=True))
    counts = ((crashed, "crashed"), (fault, "had a fault"), (lost, "lost control"))
    said = [f"{count} {what}" for count, what in counts if count]
    return f"Of {len(verdicts)} flight{'s' * (len(verdicts) > 1)} {listed(said)}." if said else ""


def by_urgency(aircraft: Iterable[Mapping]) -> list[Mapping]:
    """Aircraft as `Store.aircraft` gives them, those first that need attention: by their states, then by the rotors' evidence."""

    def urgency(a: Mapping) -> tuple:
        standing = a["standing"] or {}
        worst = min((URGENT.get(r["status"], len(URGENT)) for r in standing.get("rotors", ())), default=len(URGENT))
        return STATES.index(a["state"]), worst, -float(standing.get("worst") or 0.0), a["name"]

    return sorted(aircraft, key=urgency)


def state(standing: Mapping | None, verdicts: Mapping[str, int]) -> str:
    """The state of an aircraft by its standing; of one that was not worked out, by its rotors or verdicts alone. verdicts: how many."""
    known = (standing or {}).get("state")
    if known in STATES:
        return known
    rotors = [r["status"] for r in (standing or {}).get("rotors", ())]
    bad = any(verdicts.get(verdict) for verdict in BAD)
    return of(["fault" if bad else "inconclusive"], [False], rotors)
