"""Alerts to a vehicle's ground stations, over its own link, in what they show by themselves: STATUSTEXT in plain words,
NAMED_VALUE_FLOAT of each rotor's loss, a HEARTBEAT with the state, SYS_STATUS with the health of the motor outputs, and EVENT.

These messages only inform; nothing here commands a vehicle. They come from an onboard computer of the vehicle's own system, as from a
companion computer, so that routers forward them and ground stations show them with the vehicle's other texts.
https://mavlink.io/en/messages/common.html
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from rotorwatch.live.channels import Option

if TYPE_CHECKING:
    from rotorwatch.live.link import Link
    from rotorwatch.live.snapshot import Snapshot
    from rotorwatch.live.watch import Source

OPTION = Option(
    "--tell-ground", "Send results to the vehicles' ground stations: texts, values, health, events (docs/watch.md).", sends=True
)  # fmt: skip
PAUSE_S = 2.0  # between two texts of one vehicle
A_MINUTE = 10  # texts of one vehicle in a minute
AT_ONCE = 2  # requests that are answered in a step of the loop: an answer is at most 6 frames, so that nobody can be flooded
SLOW_S, FAST_S = 5.0, 1.0  # between two values of a rotor, and two states, on serial ports and elsewhere
# Only while the vehicle itself is received: a ground station may take what a component sends for a sign of life of the vehicle.
FRESH_S = 1.0
MOTOR_OUTPUTS = 0x8000  # MAV_SYS_STATUS_SENSOR
STANDBY, ACTIVE, FAULTY, LOST = 3, 4, 5, 6  # MAV_STATE: standby, active, critical, emergency
STATES = {"OK": ACTIVE, "MAYBE": FAULTY, "FAULT": FAULTY, "LOST": LOST}
SENSORS = tuple(f"onboard_control_sensors_{part}" for part in ("present", "enabled", "health"))


def opened(value: bool, notify: Callable[[str], None]) -> Ground:
    """The teller."""
    return Ground()


class _Vehicle:
    """sent: event -> its gist as last sent; waiting: event -> the latest alert; texts: when they were sent; values, state: likewise."""

    def __init__(self):
        from rotorwatch.live.ground_events import Sent, Transfers

        self.sent: dict[int, tuple] = {}
        self.waiting: dict[int, dict] = {}
        self.texts: list[float] = []
        self.values = self.state = -math.inf
        self.events, self.files = Sent(), Transfers()


class Ground:
    """Informs the ground stations of all vehicles that are watched over links."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        """clock: s, of any origin."""
        self._clock = clock
        self._vehicles: dict[str, _Vehicle] = {}

    def take(self, alert: dict) -> None:
        """Queue an alert. Only the latest of each event is kept, so that fast changes are sent once."""
        vehicle = self._of(alert["vehicle"])
        if alert["type"] == "vehicle":  # a new flight restarts the numbers of events
            vehicle.sent, vehicle.waiting = {}, {}
        elif alert["type"] == "event":
            vehicle.waiting[alert["number"]] = alert
        elif alert["type"] == "notice" and "rotor" in alert:  # of its ESC; event numbers begin with 1
            vehicle.waiting[-alert["rotor"]] = alert

    def _of(self, name: str) -> _Vehicle:
        return self._vehicles.setdefault(name, _Vehicle())

    def step(self, sources: Sequence[Source]) -> None:
        """Send what is due, and answer what was asked."""
        from rotorwatch.live import ground, snapshot
        from rotorwatch.live.link import Link

        now = self._clock()
        for source in sources:
            if not isinstance(source, Link):
                continue
            every = SLOW_S if source.endpoint.slow else FAST_S
            for watched, waits_for in source.shown():
                vehicle, name = self._of(watched.name), watched.name
                if vehicle.waiting:
                    self._texts(source, name, vehicle, now)
                fresh = source.clock() - watched.health.last_frame < FRESH_S
                if fresh and now - vehicle.state >= every:
                    vehicle.state = now
                    for message in (*states(snapshot.taken(watched, waits_for), source.status(name)), vehicle.events.current()):
                        source.broadcast(name, message)
                if fresh and now - vehicle.values >= every and watched.session is not None and watched.session.flying:
                    known = watched.session.losses()
                    if known is not None:
                        vehicle.values = now
                        for number, loss in enumerate(known[0].tolist(), 1):
                            source.broadcast(name, ground.value(source.boot_ms(name), number, loss))
            for _ in range(min(len(source.asked), AT_ONCE)):
                self._answer(source, *source.asked.popleft())

    def leave(self) -> None:
        """Pending texts are dropped: the link is closing."""

    def _answer(self, link: Link, name: str, peer: Any, who: tuple[int, int], identity: int, asked: dict[str, Any]) -> None:
        from rotorwatch.live import ground_events as events

        if identity == events.COMMAND:
            answers = events.metadata(asked, *who, link.boot_ms(name))
        elif identity == events.FTP:
            answers = self._of(name).files.answers(asked["payload"], *who)
        else:
            answers = self._of(name).events.again(asked, *who)
        for message in answers:
            link.broadcast(name, message, peer)

    def _texts(self, link: Link, name: str, vehicle: _Vehicle, now: float) -> None:
        from rotorwatch.live.ground import gist, text, text_of, worth_sending

        vehicle.texts = [t for t in vehicle.texts if t > now - 60.0]
        for number, alert in list(vehicle.waiting.items()):
            if not worth_sending(vehicle.sent.get(number), alert):
                del vehicle.waiting[number]
        if not vehicle.waiting or len(vehicle.texts) >= A_MINUTE:
            return
        if vehicle.texts and now - vehicle.texts[-1] < PAUSE_S:
            return
        number, alert = min(vehicle.waiting.items(), key=lambda item: (text_of(item[1])[1], item[0]))
        del vehicle.waiting[number]
        vehicle.sent[number] = gist(alert)
        vehicle.texts.append(now)
        link.broadcast(name, text(alert))
        link.broadcast(name, vehicle.events.add(alert, text_of(alert)[1], link.boot_ms(name)))


def states(known: Snapshot, status: dict[str, Any] | None) -> list[Any]:
    """HEARTBEAT and SYS_STATUS of a vehicle. status: the fields of the autopilot's last SYS_STATUS.

    MAVSDK, and QGroundControl before it looked at component ids, take any component's SYS_STATUS for the vehicle's: so the autopilot's own
    is repeated, battery and sensors included, and only the motor outputs' bits differ. Without one, none is sent."""
    from rotorwatch.live.framing import outgoing

    beat = outgoing("HEARTBEAT", type=18, autopilot=8, system_status=STATES.get(known.state, STANDBY), mavlink_version=3)
    if status is None:
        return [beat]
    present, enabled, health = (status[name] for name in SENSORS)
    if known.faulty:
        present, enabled, health = present | MOTOR_OUTPUTS, enabled | MOTOR_OUTPUTS, health & ~MOTOR_OUTPUTS
    elif known.assessed and not enabled & MOTOR_OUTPUTS:  # else the autopilot says itself whether they are fine
        present, enabled, health = present | MOTOR_OUTPUTS, enabled | MOTOR_OUTPUTS, health | MOTOR_OUTPUTS
    return [beat, outgoing("SYS_STATUS", **{**status, **dict(zip(SENSORS, (present, enabled, health)))})]
