"""The moment of a loss of control, or of a desync, in one picture."""

from __future__ import annotations

from typing import Any

from rotorwatch import report
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import colours, markup, upset

name, title, order = "moment", "The moment in one picture", 10
views = ("page",)


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    return diagnosis if diagnosis.picture else None


def plot(data: Diagnosis) -> dict[str, Any]:
    """moment_strip and those of `upset.NAMES` that are logged."""
    return upset.plots(data)


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    if not divs:
        return ""
    looks, places = colours.looks(data), report.places(data)
    keys = " &ensp; ".join(
        f'<span class="nowrap">{markup.line(*looks[r.rotor])}{markup.text(report.rotors([r.rotor], places))}</span>' for r in data.rotors
    )
    return (
        f'<section class="moment" id="moment"><h2>{title}</h2><p>Attitude and rates: blue as it flew, dashed the '
        "setpoint. Commands: of each rotor, in percent of full thrust; a thick line is the rotor that is named above.</p>"
        + "".join(markup.plot(*item) for item in divs.items())
        + f'<p class="note">{keys}</p></section>'
    )
