"""What ground stations show by themselves: health bits, the component's state, and MAVLink events with their definitions. The receivers are
pymavlink, libevents' own parser (in pyulog), and MAVSDK."""

import importlib.util
import json
import lzma
import math
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from pymavlink import mavftp
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pyulog.libevents_parse.parser import Parser
from tests.conftest import hexa_event
from tests.test_watch_alerts import Wire, alert, flying

from rotorwatch.flight import kinds
from rotorwatch.live import endpoint, framing, ground_events
from rotorwatch.live.channels import tell_ground
from rotorwatch.live.link import Link

BIT = mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
SOUND = mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO | mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
NOBODY = {"rotors": (), "loss": (), "interval": ()}
EVENT, SEQUENCE, ERROR = "UNKNOWN_410", "UNKNOWN_411", "UNKNOWN_413"  # the dialect lacks them


def beat():
    return mavlink.MAVLink_heartbeat_message(13, 12, 0x80, 0, 4, 3)


def status(present=SOUND):
    return mavlink.MAVLink_sys_status_message(present, present, present, 100, 15800, 2000, 77, 0, 0, 0, 0, 0, 0)


def assessed(link, *events):
    """The vehicle on a link, being assessed, with these events; nothing of it is evaluated."""
    (vehicle,) = link._vehicles.values()
    vehicle.step, vehicle._begun = (lambda now: None), {}
    vehicle.watched.session = flying().session
    vehicle.watched.changes.since_last(events)
    return vehicle.watched


class Station:
    """A vehicle, system 7, on a link, and what a ground station hears of it."""

    def __init__(self):
        self.now, self.wire = [1000.0], Wire()
        self.link = Link(self.wire, lambda alert: None, patience_s=math.inf)
        self.outlet = tell_ground.Ground(lambda: self.now[0])
        self._pack = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
        self._ask = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self.vehicle(beat())

    def _put(self, pack, message):
        self.wire.queue.append(("a", message if isinstance(message, bytes) else message.pack(pack)))
        pack.seq = (pack.seq + 1) % 256
        self.link.poll(0.0)

    def vehicle(self, message):
        self._put(self._pack, message)

    def fly(self, *events):
        assessed(self.link, *events)

    def ask(self, message):
        """The answers to a message of a ground station."""
        self.outlet.step([self.link])  # what is due
        self._put(self._ask, message)
        self.wire.sent.clear()
        self.outlet.step([self.link])
        return self.wire.sent

    def hear(self, *kinds, wait_s=30.0):
        self.wire.sent.clear()
        self.now[0] += wait_s
        self.outlet.step([self.link])
        known = [m for m in self.wire.sent if not m.get_type().startswith("UNKNOWN")]
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in known} <= {(7, 191)}
        return [m for m in self.wire.sent if m.get_type() in kinds]


def bits(message):
    return tuple(
        bool(getattr(message, f"onboard_control_sensors_{part}") & BIT) for part in ("present", "enabled", "health")
    )  # fmt: skip


def test_the_motor_outputs_are_healthy_until_a_rotor_is_at_fault_and_all_else_is_the_autopilots():
    station = Station()
    station.fly()
    assert not station.hear("SYS_STATUS"), "without the autopilot's own, a receiver that does not tell components apart would lose it"
    station.vehicle(status())
    (said,) = station.hear("SYS_STATUS")
    assert bits(said) == (True, True, True) and said.voltage_battery == 15800 and said.battery_remaining == 77
    assert said.onboard_control_sensors_health & SOUND == SOUND
    station.fly(hexa_event())
    (said,) = station.hear("SYS_STATUS")
    assert bits(said) == (True, True, False) and said.onboard_control_sensors_health == SOUND
    station.fly(hexa_event(alternatives=((4,),)))  # which one is not known, but one is
    assert bits(station.hear("SYS_STATUS")[0]) == (True, True, False)
    station.fly(hexa_event(end_s=40.0))
    assert bits(station.hear("SYS_STATUS")[0]) == (True, True, True)
    station.fly(hexa_event(kind="loss_of_control", **NOBODY, extra={"cause": "knock"}))
    assert bits(station.hear("SYS_STATUS")[0]) == (False, False, False), "out of control nothing is known of the motors"


def test_nothing_is_said_of_motors_that_are_not_assessed_and_nothing_against_the_autopilot():
    station = Station()
    station.vehicle(status())
    assert bits(station.hear("SYS_STATUS")[0]) == (False, False, False)
    station.fly()
    ill = mavlink.MAVLink_sys_status_message(BIT, BIT, 0, 100, 15800, 2000, 77, 0, 0, 0, 0, 0, 0)
    station.vehicle(ill)
    assert bits(station.hear("SYS_STATUS")[0]) == (True, True, False)


def test_the_components_state_follows_the_vehicle():
    station = Station()

    def state():
        (said,) = station.hear("HEARTBEAT")
        assert (said.type, said.autopilot) == (mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID)
        return said.system_status

    assert state() == mavlink.MAV_STATE_STANDBY
    station.fly()
    assert state() == mavlink.MAV_STATE_ACTIVE
    station.fly(hexa_event())
    assert state() == mavlink.MAV_STATE_CRITICAL
    station.fly(hexa_event(kind="loss_of_control", extra={"cause": "rotor"}))
    assert state() == mavlink.MAV_STATE_EMERGENCY
    assert not station.hear("HEARTBEAT", wait_s=0.5)


def test_a_vehicle_that_is_not_received_shows_no_sign_of_life():
    station = Station()
    station.fly()
    station.vehicle(status())
    (vehicle,) = station.link.vehicles
    vehicle.health.last_frame -= 2.0
    assert not station.hear("HEARTBEAT", "SYS_STATUS", "NAMED_VALUE_FLOAT", SEQUENCE)
    station.vehicle(beat())
    assert station.hear("HEARTBEAT") and station.hear("NAMED_VALUE_FLOAT")


def unpacked(message):
    """(sequence, log levels, event by libevents' parser) of an EVENT."""
    body = bytes(message.data)
    body = body[10 : 10 + body[1]] if body[0] == 0xFD else body
    number, _, sequence, _, _, levels = struct.unpack("<IIHBBB", body[:13])
    parser = Parser()
    parser.load_definitions(json.loads(json.dumps(ground_events.definitions())))
    return sequence, levels, parser.parse(number, body[13:].ljust(40, b"\0"))


@pytest.mark.parametrize(
    "event, level, message",
    [
        ({}, 4, "loss of effectiveness of rotor 3, 37 % (announced)"),
        ({"alternatives": ((4,), (5, 6))}, 4, "loss of effectiveness of rotor 3 or 4+5+6, 37 % (announced)"),
        ({"rotors": (3, 16), "loss": (0.1, 1.0), "interval": ((0.0, 0.2), (0.9, 1.0))}, 2, "rotor 3+16, 100 % (announced)"),
        ({"kind": "loss_of_control", **NOBODY, "extra": {"cause": "knock"}}, 2, "loss of control (announced)"),
    ],
)  # fmt: skip
def test_an_event_carries_rotor_size_and_severity(event, level, message):
    station = Station()
    station.fly()
    station.outlet.take(alert(**event))
    (said,) = station.hear(EVENT)
    _, levels, parsed = unpacked(said)
    assert levels & 15 == levels >> 4 <= level and message in parsed.message()
    assert parsed.namespace() == "rotorwatch" and parsed.group() == "default"
    if event.get("rotors") == ():
        assert parsed.name() == "vehicle" and parsed.argument_display_value(2) == parsed.description().removeprefix("Cause: ")


@pytest.mark.parametrize("turns, message", [(False, "ESC of rotor 5: motor stopped"), (True, "ESC of rotor 5: motor turns again")])
def test_an_esc_that_reports_a_stopped_motor_is_an_event(turns, message):
    station = Station()
    station.fly()
    text = "the ESC of rotor 5 reports " + ("that the motor turns again" if turns else "a stopped motor") + " at 3.0 s"
    station.outlet.take({"type": "notice", "vehicle": "udp:14550/7", "rotor": 5, "text": text})
    (said,) = station.hear(EVENT)
    assert unpacked(said)[2].message() == message


def test_requests_are_answered_a_few_at_a_time():
    station = Station()
    whom = {"target_system": 7, "target_component": 191}
    pack = framing.Sender(255, 190)
    for _ in range(1000):
        station.wire.queue.append(("a", pack.frame(framing.outgoing("REQUEST_EVENT", **whom))))
    station.link.poll(0.0)
    assert len(station.link.asked) == 100
    assert len(station.hear(ERROR, wait_s=0.0)) == tell_ground.AT_ONCE


def test_every_kind_of_event_has_a_definition_that_the_schema_allows():
    component = ground_events.definitions()["components"]["191"]
    names = {entry["name"] for entry in component["enums"]["kind_t"]["entries"].values()}
    assert names == set(kinds.table())
    for enum in component["enums"].values():
        assert all(entry["description"] and entry["name"].isidentifier() for entry in enum["entries"].values())
    for event in component["event_groups"]["default"]["events"].values():
        assert 0 < len(event["message"]) <= 120
        widths = {"uint8_t": 1, "kind_t": 1, "state_t": 1, "cause_t": 1, "turns_t": 1, "rotors_t": 2}
        assert sum(widths[a["type"]] for a in event["arguments"]) <= 40


def test_lost_events_are_sent_again():
    station = Station()
    station.fly()
    assert bytes(station.hear(SEQUENCE)[0].data)[10:13] == b"\0\0\1"  # nothing yet: forget an earlier run
    for number in (1, 2, 3):
        station.outlet.take(alert(number=number))
        (said,) = station.hear(EVENT)
    assert unpacked(said)[0] == 3
    whom = {"target_system": 7, "target_component": 191}
    request = framing.outgoing("REQUEST_EVENT", first_sequence=2, last_sequence=4, **whom)
    again = station.ask(framing.Sender(255, 190).frame(request))
    assert [unpacked(m)[0] for m in again if m.get_type() == EVENT] == [2, 3]
    (lost,) = [m for m in again if m.get_type() == ERROR]
    assert struct.unpack("<HHBB", bytes(lost.data)[10:16]) == (4, 1, 255, 190)


def test_what_another_component_with_this_id_may_be_meant_by_gets_no_answer():
    station = Station()
    for command, first in ((512, 148), (400, 1)):
        assert not station.ask(mavlink.MAVLink_command_long_message(7, 191, command, 0, first, 0, 0, 0, 0, 0, 0))
    for operation in (mavftp.OP_OpenFileRO, mavftp.OP_ReadFile, mavftp.OP_TerminateSession, mavftp.OP_ResetSessions):
        other = bytes(mavftp.FTP_OP(1, 0, operation, 7, 0, 0, 0, b"/a.json").pack())
        assert not station.ask(mavlink.MAVLink_file_transfer_protocol_message(0, 7, 191, other.ljust(251, b"\0")))
    there = mavlink.MAVLink_command_long_message(7, 1, 512, 0, 397, 0, 0, 0, 0, 0, 0)
    assert not station.ask(there), "asked of the autopilot"


def test_the_definitions_are_read_over_mavlink_ftp_piece_by_piece_and_at_once():
    station = Station()
    answers = station.ask(mavlink.MAVLink_command_long_message(7, 191, 512, 0, 397, 0, 0, 0, 0, 0, 0))
    assert [m.result for m in answers if m.get_type() == "COMMAND_ACK"] == [mavlink.MAV_RESULT_ACCEPTED]
    said = bytes(next(m for m in answers if m.get_type() == "UNKNOWN_397").data)
    assert b"mftp://[;comp=191]/general.json" in said
    number = 0

    def do(op, session=0, size=0, offset=0, data=b""):
        nonlocal number
        number += 1
        payload = bytes(mavftp.FTP_OP(number, session, op, size or len(data), 0, 0, offset, bytearray(data)).pack())
        got = station.ask(mavlink.MAVLink_file_transfer_protocol_message(0, 7, 191, payload.ljust(251, b"\0")))
        return [(*struct.unpack_from("<HBBBBBxI", bytes(m.payload)), bytes(m.payload[12:])) for m in got if hasattr(m, "payload")]

    for path in ("/general.json", "/events.json.xz"):
        ((_, session, op, _, asked, _, _, data),) = do(mavftp.OP_OpenFileRO, 5, data=path.encode())
        assert session == 5 and (op, asked) == (mavftp.OP_Ack, mavftp.OP_OpenFileRO)
        length = struct.unpack_from("<I", data)[0]
        pieces = []
        while sum(map(len, pieces)) < length:
            ((_, _, _, size, _, _, _, data),) = do(mavftp.OP_ReadFile, session, 100, sum(map(len, pieces)))
            pieces.append(data[:size])
        burst = do(mavftp.OP_BurstReadFile, session, 239)
        whole = b"".join(piece[-1][: piece[3]] for piece in burst)
        assert whole == b"".join(pieces) and [bool(p[5]) for p in burst] == [False] * (len(burst) - 1) + [True]
        ((_, _, op, size, _, _, _, data),) = do(mavftp.OP_ReadFile, session, 100, length)
        assert (op, data[:size]) == (mavftp.OP_Nack, bytes([mavftp.FtpError.EndOfFile.value]))
        assert do(mavftp.OP_TerminateSession, session)[0][2] == mavftp.OP_Ack
    assert json.loads(lzma.decompress(whole)) == ground_events.definitions()


def test_mavlink_1_is_not_sent_what_it_cannot_carry():
    station = Station()
    station.link._first_version = True
    station.fly()
    station.outlet.take(alert())
    assert station.hear("STATUSTEXT") and not station.hear(EVENT, SEQUENCE)


class Router(threading.Thread):
    """A vehicle of PX4, system 7, and a router: what one peer sends, all others get."""

    def __init__(self):
        super().__init__(daemon=True)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.05)
        self.port, self.ends = self.socket.getsockname()[1], False

    def run(self):
        peers, pack, reported = set(), mavlink.MAVLink(None, srcSystem=7, srcComponent=1), 0.0
        with self.socket:
            while not self.ends:
                if time.monotonic() - reported > 0.2:
                    reported = time.monotonic()
                    for message in (beat(), status()):
                        data = message.pack(pack)
                        pack.seq = (pack.seq + 1) % 256
                        for peer in peers:
                            self.socket.sendto(data, peer)
                try:
                    data, sender = self.socket.recvfrom(2048)
                except OSError:
                    continue
                peers.add(sender)
                for peer in peers - {sender}:
                    self.socket.sendto(data, peer)


@pytest.mark.skipif(importlib.util.find_spec("mavsdk") is None, reason="mavsdk has no wheel for this platform")
def test_mavsdk_shows_events_health_and_state(tmp_path):
    router = Router()
    router.start()
    link = Link(endpoint.open_endpoint(f"udpout:127.0.0.1:{router.port}"), lambda alert: None)
    outlet = tell_ground.Ground()
    environment = {**os.environ, "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    script = Path(__file__).with_name("mavsdk_station.py")
    station = subprocess.Popen([sys.executable, script, str(router.port)], env=environment, stdout=subprocess.PIPE, text=True)
    lines = []
    reader = threading.Thread(target=lambda: lines.extend(iter(station.stdout.readline, "")), daemon=True)
    reader.start()
    try:
        began, sent = time.monotonic(), False
        while time.monotonic() - began < 40.0:
            link.poll(0.01)
            if link.vehicles:
                watched = assessed(link, hexa_event())
                outlet.step([link])
                if not sent and any('"metadata"' in line for line in lines):
                    sent = True
                    outlet.take({**alert(), "vehicle": watched.name})
            if any('"event"' in line for line in lines):
                break
    finally:
        station.kill()
        station.wait()
        reader.join(5.0)
        router.ends = True
        router.join(2.0)
        link.leave()
    reported = [json.loads(line) for line in lines if line.startswith("{")]
    (event,) = [t for t in reported if "event" in t]
    assert event == {
        "event": "rotor", "namespace": "rotorwatch", "level": 4, "compid": 191,
        "message": "loss of effectiveness of rotor 3, 37 % (announced)",
    }  # fmt: skip
    by = {(t["name"], t["compid"]): t for t in reported if "name" in t}
    assert by["HEARTBEAT", 191]["system_status"] == mavlink.MAV_STATE_CRITICAL
    assert not by["SYS_STATUS", 191]["onboard_control_sensors_health"] & BIT
    assert by["STATUSTEXT", 191]["text"] == "rotorwatch: rotor 3 lost 37 % (33-41)"
    assert {round(t["volts"], 1) for t in reported if "volts" in t} == {15.8}, "the battery that it shows is still the autopilot's"
