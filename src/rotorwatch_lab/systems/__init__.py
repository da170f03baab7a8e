"""Plants: one file each, found by discovery; `rotorwatch.systems.RateDynamics` finds the class in its file."""

from __future__ import annotations


def __getattr__(name: str):
    from rotorwatch.base import discovery

    return discovery.member(__name__, name)
