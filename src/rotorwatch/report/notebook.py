"""A diagnosis in a notebook: a few lines of HTML without scripts, in the colours of the page around them."""

from __future__ import annotations

from html import escape

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.notebook import table
from rotorwatch.report import VERDICTS, frame, health, rotor_interval, rotor_loss, rotors_title, seconds, who


def page(result: Diagnosis) -> str:
    """Verdict, rotors and events."""
    grades = {rotor: (grade, trend) for rotor, _, grade, trend in health(result)}
    rotors = []
    for r in result.rotors:
        graded = grades.get(str(r.rotor), ("", ""))
        rotors.append((str(r.rotor), r.place, r.status, rotor_loss(r), rotor_interval(r), *graded))
    happened = [(seconds(e.onset_s), seconds(e.detected_s), who(e, result), e.reason) for e in result.events]
    return "".join(
        [
            f"<p><b>{escape(VERDICTS[result.verdict])}</b> {escape(result.headline)}<br>"
            f"<small>{escape(str(result.flight.get('name', '')))}, {escape(frame(result))}</small></p>",
            table(
                rotors_title(result), ("rotor", "where", "status", "loss", "95 % interval", "grade", "trend"), rotors
            ),
            table("Events", ("since", "announced", "what", "why"), happened),
            "".join(f"<p>&rarr; {escape(text)}</p>" for text in result.advice),
        ]
    )
