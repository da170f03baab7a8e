"""Alerts and the state of each vehicle, for an MQTT broker: https://docs.oasis-open.org/mqtt/mqtt/v5.0/mqtt-v5.0.html

paho's thread connects, sends and connects again, so that a slow or unreachable broker never delays the evaluation.
"""

from __future__ import annotations

import re
import threading
import time
import urllib.parse
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from rotorwatch.base.files import public
from rotorwatch.base.optional import library
from rotorwatch.errors import ConfigError
from rotorwatch.live.channels import Option
from rotorwatch.live.guard import as_json

if TYPE_CHECKING:
    from rotorwatch.live.snapshot import Snapshot
    from rotorwatch.live.watch import Source

ADDRESS = "mqtt[s]://[USER:PASSWORD@]HOST[:PORT][/TOPIC]"
OPTION = Option("--mqtt", "Publish alerts and states to this MQTT broker (docs/watch.md).", "URL", "ROTORWATCH_MQTT")
PREFIX, PORTS = "rotorwatch", {"mqtt": 1883, "mqtts": 8883}
MOST = 1000  # waiting alerts; beyond, new ones are dropped
EVERY_S, LAST_S = 1.0, 5.0  # between two states; at the end, for unsent alerts
LONGEST_S, ALIVE_S = 60, 30  # between attempts to connect; after which the broker takes a silent client for gone


def opened(value: str, notify: Callable[[str], None]) -> Mqtt:
    """The publisher. Raises ConfigError."""
    return Mqtt(value, notify)


def level(name: str) -> str:
    """A name as one level of a topic: without the characters that separate levels, or stand for any."""
    return re.sub(r"[/+#\0]", "-", name) or "-"


class Broker:
    """A broker, by its address `ADDRESS`. name: for display. notify: called by `step` with a sentence when the connection fails, and when
    it is there again. Topics are below TOPIC, by default `rotorwatch`; TOPIC/status is online, or offline, also by the broker itself."""

    def __init__(self, url: str, notify: Callable[[str], None] = lambda text: None):
        """Raises ConfigError for an invalid address, or where paho-mqtt is missing."""
        try:
            where = urllib.parse.urlsplit(url)
            port, host = where.port or PORTS.get(where.scheme, 0), where.hostname or ""
        except ValueError:
            port = host = where = None
        if not (port and host and where):
            raise ConfigError(f"--mqtt {public(url)}: give {ADDRESS}.")
        paho = library("paho.mqtt.client", "--mqtt")
        self.name, self._notify = f"{where.scheme}://{host}:{port}", notify
        self._prefix = urllib.parse.unquote(where.path).strip("/") or PREFIX
        self._notices: deque[str] = deque(maxlen=100)
        self._failing = False
        self._known = threading.Event()  # whether there is a connection, or none
        self._alerts = False
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        if where.username:
            self._client.username_pw_set(*(urllib.parse.unquote(part or "") for part in (where.username, where.password)))
        if where.scheme == "mqtts":
            self._client.tls_set()
        self._client.on_connect, self._client.on_connect_fail, self._client.on_disconnect = self._connected, self._failed, self._gone
        self._client.will_set(f"{self._prefix}/status", "offline", 1, True)
        self._client.max_queued_messages_set(MOST)
        self._client.reconnect_delay_set(1, LONGEST_S)
        self._client.connect_async(host, port, ALIVE_S)
        self._client.loop_start()

    def _connected(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self._trouble(f"refuses the connection ({reason})")
            return
        client.publish(f"{self._prefix}/status", "online", 1, True)
        if self._failing:
            self._failing = False
            self._notices.append(f"{self.name} is connected again")
        self._known.set()

    def _failed(self, client: Any, data: Any) -> None:
        self._trouble("cannot be reached")

    def _gone(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        if reason.is_failure:
            self._trouble(f"is not connected ({reason})")

    def _trouble(self, what: str) -> None:
        if not self._failing:
            self._failing = True
            self._notices.append(f"{self.name} {what}; alerts are queued")
        self._known.set()

    def publish(self, topic: str, value: dict[str, Any], lasting: bool = False) -> None:
        """Publish JSON below the prefix, without blocking. lasting: it is a state, kept by the broker and not repeated; else an alert, sent
        until the broker has it."""
        self._alerts |= not lasting
        self._client.publish(f"{self._prefix}/{topic}", as_json(value), qos=0 if lasting else 1, retain=lasting)

    def step(self) -> None:
        """Report changes of the connection; called by the loop, so that one thread does all reporting."""
        while self._notices:
            self._notify(self._notices.popleft())

    def leave(self) -> None:
        """Send waiting alerts, for up to LAST_S, and disconnect."""
        self._known.wait(LAST_S)
        sent = False
        if self._client.is_connected():
            last = self._client.publish(f"{self._prefix}/status", "offline", 1, True)
            with suppress(ValueError, RuntimeError):  # it was lost meanwhile
                last.wait_for_publish(LAST_S)  # in order: then all before it are there
                sent = last.is_published()
        self._client.disconnect()
        self._client.loop_stop()
        if self._alerts and not sent:
            self._notices.append(f"{self.name}: the last alerts could not be sent before shutdown")
        self.step()


class Mqtt:
    """TOPIC/VEHICLE/alert: each alert; TOPIC/VEHICLE/state: the state of a vehicle once a second, kept by the broker."""

    def __init__(self, url: str, notify: Callable[[str], None] = lambda text: None):
        """Raises ConfigError."""
        self._broker = Broker(url, notify)
        self._stated = 0.0

    def take(self, alert: dict) -> None:
        """Queue an alert without blocking."""
        self._broker.publish(f"{level(alert['vehicle'])}/alert", alert)

    def step(self, sources: Sequence[Source]) -> None:
        """Publish the states, when due."""
        from rotorwatch.live import snapshot

        now = time.monotonic()
        if now - self._stated >= EVERY_S:
            self._stated = now
            for known in (snapshot.taken(*pair) for source in sources for pair in source.shown()):
                self._broker.publish(f"{level(known.name)}/state", state(known), lasting=True)
        self._broker.step()

    def leave(self) -> None:
        self._broker.leave()


def state(known: Snapshot) -> dict[str, Any]:
    """The state of a vehicle, as published."""
    rotors = [{"rotor": k, "loss": loss, "lower": low, "upper": high} for k, (loss, low, high) in enumerate(known.rotors, 1)]
    events = [event.to_dict() for event in known.events]
    counts = {"ticks_assessed": known.ticks, "messages": known.taken, "messages_lost": known.lost}
    return {"vehicle": known.name, "state": known.state, "blind": known.blind, "rotors": rotors, "events": events, **counts}
