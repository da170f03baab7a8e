"""Times without an assessment, and why."""

from __future__ import annotations

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.blocks import Block, Notes

name, title, order = "blind", "Times that could not be assessed", 350
views = ("page", "terminal")


def data(diagnosis: Diagnosis) -> list[str] | None:
    blind = diagnosis.trace.blind if diagnosis.trace is not None else ()
    return [f"{start:.1f} to {end:.1f} s: {why}" for start, end, why in blind] or None


def words(data: list[str]) -> list[Block]:
    return [Notes("blind", data)]
