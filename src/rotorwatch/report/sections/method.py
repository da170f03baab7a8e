"""Estimates of a published method itself, with its own interval or bound; absent with the default method."""

from __future__ import annotations

from typing import Any

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import colours, markup, method_plots
from rotorwatch.report.axes import flight_range
from rotorwatch.report.figures import assessed

name, title, order = "method", "Estimates of the method", 110
views = ("page",)


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    return None if diagnosis.own is None else assessed(diagnosis)


def plot(data: Diagnosis) -> dict[str, Any]:
    """own_loss [%], and own_x_0 .., own_e_0 ..: the method's states and innovations."""
    own = data.own
    assert own is not None and data.trace is not None
    looks = colours.looks(data, data.trace.loss.shape[1])
    tints = {own.theta_names[k]: looks[rotor] for rotor, k in own.rotors.items()}
    drawn = method_plots.drawn(own, flight_range(data), tints, method_plots.limits([own]))
    return {f"own_{key}": figure for key, figure in drawn.items()}


def page(data: Diagnosis, divs: dict[str, str]) -> str:
    assert data.own is not None
    method, (loss, *rest) = markup.text(data.own.method), [markup.plot(*item) for item in divs.items()]
    return (
        f"<h2>{method}: own estimates</h2><p>{markup.text(data.own.whose)} Nothing is held, clipped or decided; the losses above "
        f"are those of the decision stage common to all methods.</p>{loss}"
        f"<details><summary>States and innovations of {method}</summary>{''.join(rest)}</details>"
    )
