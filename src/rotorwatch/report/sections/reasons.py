"""Reasons of the events, in a post; other views show each with its event."""

from __future__ import annotations

from rotorwatch.answer.wording import seconds
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.blocks import Block, Bullets

name, title, order = "reasons", "Evidence", 51
views, post_order = ("post",), 40


def data(diagnosis: Diagnosis) -> list[str]:
    return [f"{seconds(e.onset_s)}: {e.reason}" for e in diagnosis.events if e.reason]


def words(data: list[str]) -> list[Block]:
    return [Bullets(data)]
