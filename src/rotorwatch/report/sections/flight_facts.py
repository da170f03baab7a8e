"""Facts of the flight: airframe, autopilot, duration, clock, logging rates."""

from __future__ import annotations

from rotorwatch import report
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import markup

name, title, order = "flight", "Flight", 20
views = ("page",)


def data(diagnosis: Diagnosis) -> Diagnosis:
    return diagnosis


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    facts = data.flight
    airborne = facts.get("airborne_s") or ()
    boot = f"{facts['boot_s']:.2f} s since boot" if facts.get("boot_s") else ""
    return markup.facts(
        {
            "airframe": report.frame(data),
            "autopilot": facts.get("autopilot"),
            "format": facts.get("format"),
            "duration": f"{float(facts.get('duration_s') or 0):.1f} s",
            "airborne": f"{float(airborne[0]):.1f} to {float(airborne[1]):.1f} s" if len(airborne) == 2 else None,
            "second 0 of the log": ", ".join(filter(None, (report.day(data), boot))),
            "logging": facts.get("profile"),
        }
    )
