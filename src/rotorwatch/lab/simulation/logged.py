"""What the simulated autopilots log (logged.toml): signals, their rates, and the definitions of messages."""

from __future__ import annotations

from pathlib import Path

from rotorwatch.base import files

LOGGED, _ = files.toml(Path(__file__).with_suffix(".toml"), "table of messages")
