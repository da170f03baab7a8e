"""The state of each rotor as diagnostic_msgs/DiagnosticArray on /diagnostics, which rqt_robot_monitor, Foxglove and diagnostic_aggregator
show: https://docs.ros.org/en/jazzy/p/diagnostic_msgs/

`rotorwatch watch --ros2` is a node, by hand or in a launch file: what follows --ros-args is ROS's.
"""

from __future__ import annotations

import importlib
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from rotorwatch.errors import ConfigError
from rotorwatch.live.channels import Option

if TYPE_CHECKING:
    from rotorwatch.live.snapshot import Snapshot
    from rotorwatch.live.watch import Source

OPTION = Option("--ros2", "Publish the state of each rotor as DiagnosticArray on /diagnostics, as a ROS 2 node.")
EVERY_S = 1.0
OK, WARN, ERROR, STALE = "OK", "WARN", "ERROR", "STALE"


def opened(value: bool, notify: Callable[[str], None]) -> Diagnostics:
    """The node. Raises ConfigError without ROS 2."""
    return Diagnostics()


class Status(NamedTuple):
    """A DiagnosticStatus. level: OK, WARN, ERROR or STALE."""

    name: str
    level: str
    message: str
    values: Mapping[str, str]


def statuses(known: Snapshot) -> list[Status]:
    """The vehicle's status, and one of each rotor. ERROR: a rotor at fault, or a loss of control; WARN: one of several candidates, or an
    event that no rotor causes; STALE: not assessed."""
    from rotorwatch.live import view

    lost = known.state == "LOST"
    level = ERROR if lost or known.state == "FAULT" else WARN if known.state == "MAYBE" else OK if known.state == "OK" else STALE
    words = [view.words(event) for event in known.lasting]
    message = "; ".join(words) or known.blind or known.state.lower()
    counts = {"messages": known.taken, "messages_lost": known.lost, "ticks_assessed": known.ticks}
    values = {"state": known.state, "blind": known.blind, "events": len(known.events), **counts}
    found = [Status(f"rotorwatch: {known.name}", level, message, {name: str(value) for name, value in values.items()})]
    return found + [_rotor(known, number, *sizes) for number, sizes in enumerate(known.rotors, 1)]


def _rotor(known: Snapshot, number: int, loss: float, lower: float, upper: float) -> Status:
    from rotorwatch.live import view

    values = {"rotor": str(number), "loss": f"{loss:.4f}", "loss_lower": f"{lower:.4f}", "loss_upper": f"{upper:.4f}"}
    suspected = [event for event in known.lasting if number in event.suspects]
    level, message = (OK, "no loss found") if known.assessed else (STALE, known.blind or "not assessed")
    for event in sorted(suspected, key=lambda event: not event.alternatives):
        level, message = WARN if event.alternatives else ERROR, view.words(event)
        low, high = event.interval[event.rotors.index(number)] if number in event.rotors and event.interval else (math.nan, math.nan)
        about = {"event": event.kind, "onset_s": f"{event.onset_s:.2f}", "probability": f"{event.probability:.4f}"}
        values |= about | {"event_loss_lower": f"{low:.4f}", "event_loss_upper": f"{high:.4f}"}
    return Status(f"rotorwatch: {known.name}: rotor {number}", level, message, values)


class Diagnostics:
    """The node `rotorwatch`."""

    def __init__(self):
        """Raises ConfigError without ROS 2: it comes with a distribution of ROS, not with pip."""
        try:
            rclpy, messages = (importlib.import_module(name) for name in ("rclpy", "diagnostic_msgs.msg"))
        except ImportError as why:
            raise ConfigError(f"--ros2 needs ROS 2 ({why}): source /opt/ros/DISTRIBUTION/setup.bash, then run rotorwatch again.") from why
        self._messages, self._context = messages, rclpy.Context()
        rclpy.init(args=sys.argv, context=self._context, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._node = rclpy.create_node("rotorwatch", context=self._context)
        self._publisher = self._node.create_publisher(messages.DiagnosticArray, "/diagnostics", 10)
        self._sent = -math.inf

    def take(self, alert: dict) -> None:
        """Alerts are published with the state they lead to, at once."""
        if alert["type"] == "event":
            self._sent = -math.inf

    def step(self, sources: Sequence[Source]) -> None:
        """Publish the states of all vehicles, when due."""
        from rotorwatch.live import snapshot

        now = time.monotonic()
        pairs = [pair for source in sources for pair in source.shown()] if now - self._sent >= EVERY_S else []
        if pairs:
            self._sent = now
            self._publisher.publish(self._message([snapshot.taken(*pair) for pair in pairs]))

    def _message(self, vehicles: Sequence[Snapshot]) -> Any:
        """The DiagnosticArray of these vehicles."""
        kind, pair = self._messages.DiagnosticStatus, self._messages.KeyValue
        status = [
            kind(
                level=getattr(kind, one.level), name=one.name, message=one.message, hardware_id=known.name,
                values=[pair(key=key, value=value) for key, value in one.values.items()],
            )
            for known in vehicles
            for one in statuses(known)
        ]  # fmt: skip
        array = self._messages.DiagnosticArray(status=status)
        array.header.stamp = self._node.get_clock().now().to_msg()
        return array

    def leave(self) -> None:
        self._node.destroy_node()
        self._context.try_shutdown()
