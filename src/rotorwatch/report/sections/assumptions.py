"""Baseline and assumptions of the diagnosis."""

from __future__ import annotations

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.blocks import Block, Notes

name, title, order = "assumptions", "Assumptions", 340
views, post_order = ("page", "terminal", "post"), 30


def data(diagnosis: Diagnosis) -> Diagnosis:
    return diagnosis


def words(data: Diagnosis) -> list[Block]:
    return [Notes("baseline", [data.baseline], named=True), Notes("assumed", data.assumptions)]
