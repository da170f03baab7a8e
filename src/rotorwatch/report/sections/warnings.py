"""Warnings of the diagnosis."""

from __future__ import annotations

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.blocks import Block, Notes, Text

name, title, order = "warnings", "Warnings", 330
views, post_order = ("page", "terminal", "post"), 20
ROUTINE = ("ignored", "was dropped", "were dropped", "was scaled", "taken as full output", "it is not used")


def data(diagnosis: Diagnosis) -> tuple[str, ...] | None:
    return diagnosis.warnings or None


def words(data: tuple[str, ...]) -> list[Block]:
    return [Notes("warning", data)]


def summary(data: tuple[str, ...]) -> list[Block]:
    """All but routine ones, which most logs have: dropped single values, and how the firmware scales what it writes."""
    return [Text(sentence, "! ") for sentence in data if not any(part in sentence for part in ROUTINE)]
