"""Frames out of the bytes of a link, and what the less usual messages say of a signal."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from rotorwatch.live import esc_notices, framing, senders
from rotorwatch.live.clock import Restarted
from rotorwatch.live.mavlink import Messages, layouts
from rotorwatch.logs import mavlink_messages, tlog


def packed(count, rng, second=True, signed=False):
    """Frames of random values, as pymavlink writes them."""
    pack = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    if signed:
        pack.signing.secret_key, pack.signing.sign_outgoing, pack.signing.link_id = b"x" * 32, True, 1
    out = []
    for k in range(count):
        message = mavlink.MAVLink_attitude_message(1000 + k, *rng.normal(size=6).tolist())
        out.append(bytes(message.pack(pack, force_mavlink1=not second)))
        pack.seq = (pack.seq + 1) % 256
    return out


@pytest.mark.parametrize("second, signed", [(True, False), (False, False), (True, True)])
def test_frames_come_out_of_pieces_of_any_length(second, signed):
    rng = np.random.default_rng(1)
    wanted, found, parser = packed(200, rng, second, signed), [], framing.Frames()
    data, at = b"".join(wanted), 0
    while at < len(data):
        size = int(rng.integers(1, 90))
        found += parser.take(data[at : at + size])
        at += size
    assert found == wanted and parser.damaged == 0


def test_no_sound_frame_is_lost_to_damage_before_it():
    """Bytes that look like the head of a long frame, frames cut off and frames with a wrong byte: all others are found."""
    rng = np.random.default_rng(2)
    parser, wanted, found = framing.Frames(), packed(300, rng), []
    for k, frame in enumerate(wanted):
        found += parser.take(frame)
        kind = k % 4
        if kind == 0:
            found += parser.take(bytes((0xFD, 255, 0, 0)) + rng.bytes(3))
        elif kind == 1:
            found += parser.take(frame[: int(rng.integers(1, len(frame) - 1))])
        elif kind == 2:
            wrong = bytearray(frame)
            wrong[int(rng.integers(1, len(frame)))] ^= 1 << int(rng.integers(8))
            found += parser.take(bytes(wrong))
    found += parser.take(bytes(600))
    assert found == wanted and 100 < parser.damaged


@pytest.mark.parametrize(
    "stride", [b"\xfe", b"\xfd", b"\xfe\x6e", b"\xfe\x00", b"\xfd\xff\x00\x00\x00", b"\xfd\xff\x00\x01\x00\x01\x01\x1e\x00\x00"]
)
def test_work_grows_with_the_bytes_whatever_they_are(stride, monkeypatch):
    """A frame may seem to begin at every byte, at every second, at every fifth: not every one of them is summed up to its end."""
    summed, sums = [], framing.sums
    parser, wanted = framing.Frames(), packed(1, np.random.default_rng(6))
    data = stride * (200_000 // len(stride))
    parser.take(data[:1400])
    monkeypatch.setattr(framing, "sums", lambda frame, extra: (summed.append(len(frame) + framing.ATTEMPT), sums(frame, extra))[1])
    for at in range(0, len(data), 1400):
        parser.take(data[at : at + 1400])
    assert sum(summed) < (framing.VAIN + 1) * len(data) + framing.SAVED
    assert parser.take(bytes(600) + wanted[0]) == wanted, "what comes after is found"


def test_the_sums_are_those_of_pymavlink():
    rng = np.random.default_rng(3)
    for _ in range(200):
        body, extra = b"\xfd" + rng.bytes(int(rng.integers(1, 270))), int(rng.integers(256))
        crc = mavlink.x25crc(body[1:] + bytes([extra])).crc
        assert framing.sums(body, extra) == crc.to_bytes(2, "little")


def test_whole_frames_of_unknown_messages_are_passed_over():
    parser, (frame, other) = framing.Frames(), packed(2, np.random.default_rng(4))
    strange = bytes((0xFD, 9, 0, 0, 0, 1, 1, 0xEE, 0xEE, 0xEE)) + bytes(11)
    assert parser.take(frame + strange + other) == [frame, other]
    assert (parser.unknown, parser.damaged) == (1, 0)


class Link:
    """Messages of one vehicle, put in as they would arrive: at the times of their stamps."""

    def __init__(self, autopilot="ArduPilot"):
        self.messages, self._pack, self._now = Messages(autopilot, 2), mavlink.MAVLink(None, srcSystem=1), 0.0
        self._by_name = {layout.name: layout for layout in layouts().values()}

    def put(self, message):
        stamp = getattr(message, "time_usec", 1e3 * getattr(message, "time_boot_ms", 0))
        self._now = max(self._now, 1e-6 * stamp)
        try:
            self.messages.add(self._by_name[message.get_type()], bytes(message.pack(self._pack)), self._now)
        except Restarted:
            raise AssertionError("no clock began anew here") from None

    def take(self, outputs=(1, 2, 3, 4), aloft=False):
        return self.messages.take(tlog.Outputs(outputs), aloft)[0]


def servo(us, values, port=0):
    return mavlink.MAVLink_servo_output_raw_message(us, port, *(list(values) + [0] * 16)[:16])


def attitude(ms):
    return mavlink.MAVLink_attitude_message(ms, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)


def test_outputs_of_both_banks():
    """Outputs 9 to 16 are in the message's extension, 17 to 32 in the one of port 1; a rotor never takes another bank's values."""
    link = Link()
    link.put(attitude(1000))
    for k in range(5):
        link.put(servo(1_000_000 + 20_000 * k, range(1001, 1017)))
        link.put(servo(1_000_000 + 20_000 * k, range(1101, 1117), port=1))
    first, second = link.messages, tlog.readings(tlog.Outputs((17, 18, 19, 32)))["motors"][0].make(link.messages)
    assert second is not None and second.values[0].tolist() == [1101.0, 1102.0, 1103.0, 1116.0]
    assert link.take((9, 10, 11, 16))["motors"].values[0].tolist() == [1009.0, 1010.0, 1011.0, 1016.0]
    link.put(servo(2_000_000, range(1001, 1017)))
    assert tlog.readings(tlog.Outputs((9, 17)))["motors"][0].make(first) is None and any("both banks" in n for n in first.notes)
    mapped = {f"SERVO{16 + k}_FUNCTION": 32.0 + k for k in range(1, 5)}
    assert tlog.rotor_outputs(first, mapped).numbers == (17, 18, 19, 20)


def test_the_faster_message_tells_of_the_outputs():
    link = Link("PX4")
    link.put(attitude(1000))
    for k in range(300):
        us = 1_000_000 + 20_000 * k
        link.put(mavlink.MAVLink_actuator_output_status_message(us, 4, [1500.0 + k % 7] * 4 + [0.0] * 28))
        if not k % 25:
            link.put(servo(us, [1400] * 4))
    taken = link.take()["motors"]
    assert taken.source == "ACTUATOR_OUTPUT_STATUS" and len(taken) == 300 and taken.valid.all()
    link.put(mavlink.MAVLink_actuator_output_status_message(8_000_000, 3, [1500.0] * 4 + [0.0] * 28))
    assert link.take()["motors"].valid.tolist() == [[True, True, True, False]]


def test_a_battery_by_its_cells_where_nothing_else_tells():
    link = Link()
    link.put(attitude(1000))
    cells = [4000, 4100, 3900] + [65535] * 7
    link.put(mavlink.MAVLink_battery_status_message(0, 0, 0, 2000, cells, 1234, -1, -1, 50))
    link.put(mavlink.MAVLink_battery_status_message(1, 0, 0, 2000, [1000] * 10, 1234, -1, -1, 50))
    assert link.take()["battery"].values.tolist() == [[12.0, 12.34]]


def test_a_source_that_says_nothing_usable_gives_way():
    """HIGHRES_IMU without numbers in it: rates come from the attitude, at once."""
    link, nothing = Link("PX4"), float("nan")
    for k in range(50):
        link.put(mavlink.MAVLink_highres_imu_message(1_000_000 + 20_000 * k, *[nothing] * 13, 63))
        link.put(attitude(1000 + 20 * k))
    assert link.take()["gyro"].source == "ATTITUDE"


def test_a_tick_waits_for_all_it_is_made_of_but_not_for_long():
    link = Link()
    imu = mavlink.MAVLink_raw_imu_message
    for k in range(10):
        link.put(attitude(1000 + 20 * k))
        link.put(servo(1_000_000 + 20_000 * k, [1500] * 4))
        link.put(imu(1_000_000 + 20_000 * k, 0, 0, -1000, 0, 0, 0, 0, 0, 0))
    link.take()
    link.put(attitude(1200))
    link.put(servo(1_200_000, [1500] * 4))
    assert not link.messages.reached(0.199)
    link.put(imu(1_200_000, 0, 0, -1000, 0, 0, 0, 0, 0, 0))
    assert link.messages.reached(0.199) and not link.messages.reached(0.3)
    link.take()
    link.put(attitude(1450))
    assert link.messages.reached(0.3)


def numbered(senders, numbers, what="several"):
    """After how many of the frames with these running numbers there seemed to be several senders."""
    seen = 0
    for number in numbers:
        senders.count(int(number) % 256)
        seen += getattr(senders, what)
    return seen


@pytest.mark.parametrize("offset", [60, 128, 200])
@pytest.mark.parametrize("batch", [1, 4])
def test_two_senders_of_one_id_are_seen_and_their_end_too(offset, batch):
    several = senders.Senders()
    both = [n for k in range(0, 1000, batch) for start in (k, k + offset) for n in range(start, start + batch)]
    assert numbered(several, both) > 0.8 * len(both) and several.several
    assert numbered(several, range(1000, 1600)) < 250 and not several.several


@pytest.mark.parametrize("offset", [60, 128, 200])
def test_a_second_sender_is_suspected_at_once(offset):
    """Nothing is announced of what two send together, from the first moments on."""
    one = senders.Senders()
    assert numbered(one, range(500), "suspected") == 0
    both = [n for k in range(500, 570) for n in (k, k + offset)]
    assert numbered(one, both, "suspected") > len(both) - 40
    assert not one.several, "this takes longer"
    numbered(one, range(570, 900))
    assert not one.suspected


def test_what_a_bad_link_does_to_one_sender_is_not_taken_for_two():
    rng = np.random.default_rng(6)
    order = np.argsort(np.arange(20_000) + rng.uniform(0, 9, 20_000) * (rng.random(20_000) < 0.2))
    kept = order[rng.random(order.size) > 0.3]
    for start in rng.integers(0, 20_000, 40):  # cuts of up to 3 s
        kept = kept[(kept < start) | (kept > start + rng.integers(450))]
    odd = rng.random(kept.size) < 0.1
    assert numbered(senders.Senders(), np.where(odd, rng.integers(0, 256, kept.size), kept)) == 0
    assert numbered(senders.Senders(), kept, "suspected") < 0.01 * kept.size


def test_a_rotor_that_stands_is_said_by_its_esc():
    """ArduPilot's telemetry over a link: speeds are known, a rotor that stands in the air is said once, and that it turns again."""
    link, seen, said = Link(), esc_notices.Rotors(), []

    def fly(seconds, rpm, flying=True):
        for _ in range(int(seconds * 10)):
            link.now_ms = getattr(link, "now_ms", 1000) + 100
            link.put(attitude(link.now_ms))
            link.put(servo(link.now_ms * 1000, [1500] * 4))
            link.put(mavlink.MAVLink_esc_telemetry_1_to_4_message([30] * 4, [1600] * 4, [500] * 4, [0] * 4, rpm, [1] * 4))
            taken = link.take()
            said.extend(seen.examine(taken.get("esc"), taken.get("motors"), flying))

    fly(2.0, [0] * 4, flying=False)
    fly(10.0, [5000, 5100, 5200, 5300])
    assert said == [] and seen.words() == "ESC 5000 5100 5200 5300 rpm"
    fly(3.0, [5000, 5100, 0, 5300])
    assert [(rotor, "stopped" in text) for rotor, text in said] == [(3, True)]
    fly(4.0, [5000, 5100, 5200, 5300])
    assert [(rotor, "turns again" in text) for rotor, text in said[1:]] == [(3, True)]
    said.clear()
    fly(3.0, [0] * 4)  # all of them: the motors were switched off, or the telemetry is gone
    assert said == []


SENT = (
    ("HEARTBEAT", {"type": 18, "autopilot": 8, "system_status": 4, "mavlink_version": 3}),
    ("PARAM_REQUEST_LIST", {"target_system": 7, "target_component": 1}),
    ("PARAM_REQUEST_READ", {"target_system": 7, "target_component": 1, "param_id": b"MOT_SPIN_MIN", "param_index": -1}),
    ("COMMAND_LONG", {"target_system": 7, "target_component": 1, "command": 511, "param1": 36.0, "param2": 20000.0}),
    ("REQUEST_DATA_STREAM", {"target_system": 7, "req_stream_id": 3, "req_message_rate": 50, "start_stop": 1}),
    ("STATUSTEXT", {"severity": 2, "text": b"rotorwatch: rotor 3 lost 37 % (33-41)"}),
    ("NAMED_VALUE_FLOAT", {"time_boot_ms": 70_000, "name": b"rw_loss3", "value": 0.37}),
    ("GPS_STATUS", {"satellites_visible": 2, "satellite_prn": [*range(20)]}),
)


@pytest.mark.parametrize("first_version", [False, True])
@pytest.mark.parametrize("name, values", SENT)
def test_what_is_sent_is_what_pymavlink_reads_and_writes(name, values, first_version):
    sender, parser = framing.Sender(254, 191), mavlink.MAVLink(None)
    pack = mavlink.MAVLink(None, srcSystem=254, srcComponent=191)
    for _ in range(300):  # more than running numbers there are
        frame = sender.frame(framing.outgoing(name, **values), first_version)
        (message,) = parser.parse_buffer(frame)
        assert message.get_type() == name and message.get_seq() == pack.seq
        for field, value in values.items():
            wanted = value.decode() if isinstance(value, bytes) else pytest.approx(value)
            assert getattr(message, field) == wanted
        assert frame == message.pack(pack, force_mavlink1=first_version)
        pack.seq = (pack.seq + 1) % 256


def test_a_field_that_a_message_does_not_have_is_refused():
    with pytest.raises(TypeError, match="HEARTBEAT has no field kind"):
        framing.outgoing("HEARTBEAT", kind=2)


def test_the_table_of_messages_is_that_of_pymavlink():
    """tools/mavlink_messages.py writes it; after pymavlink has new messages: again."""
    tool = Path(__file__).parents[1] / "tools" / "mavlink_messages.py"
    said = subprocess.run(
        [sys.executable, "-c", f"import runpy; print(runpy.run_path({str(tool)!r})['text'](), end='')"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    table = json.loads((Path(mavlink_messages.__file__).with_suffix(".json")).read_text("utf-8"))
    theirs = json.loads(said)
    # A later pymavlink may know more, and may extend messages at their ends; ids, seeds and what is there do not change.
    for name, (number, seed, form, fields) in table.items():
        assert theirs[name][:2] == [number, seed] and theirs[name][2].startswith(form), name
        assert theirs[name][3][: len(fields)] == fields, name
