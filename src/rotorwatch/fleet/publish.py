"""A fleet on an MQTT broker: each new flight, and the state of every aircraft."""

from __future__ import annotations

from collections.abc import Callable

from rotorwatch.fleet.add import Outcome
from rotorwatch.fleet.store import Store
from rotorwatch.live.channels.mqtt import Broker, level


class Publisher:
    """TOPIC/fleet/flight: each log that is added, or cannot be diagnosed; TOPIC/fleet/AIRCRAFT/state: every aircraft whose state has
    changed, kept by the broker."""

    def __init__(self, url: str, notify: Callable[[str], None] = lambda text: None):
        """url, notify: as of `mqtt.Broker`. Raises ConfigError."""
        self._broker = Broker(url, notify)
        self._said: dict[str, dict] = {}

    def outcome(self, outcome: Outcome) -> None:
        """Publish what became of a log."""
        if outcome.state in ("added", "failed"):
            about = {"aircraft": outcome.aircraft, "verdict": outcome.verdict, "text": outcome.text}
            self._broker.publish("fleet/flight", {"log": str(outcome.path), "state": outcome.state, **about})
        self._broker.step()

    def aircraft(self, store: Store) -> None:
        """Publish the aircraft that have changed."""
        for one in store.aircraft():
            standing = one["standing"] or {}
            said = {name: one[name] for name in ("name", "state", "flights", "last", "verdicts")}
            said |= {"headline": standing.get("headline"), "rotors": standing.get("rotors", [])}
            if self._said.get(one["key"]) != said:
                self._said[one["key"]] = said
                self._broker.publish(f"fleet/{level(one['name'])}/state", said, lasting=True)
        self._broker.step()

    def leave(self) -> None:
        """Send what waits, and disconnect."""
        self._broker.leave()
