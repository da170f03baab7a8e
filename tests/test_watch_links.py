"""Links: what a vehicle sends over MAVLink is assessed as its recording is, and nothing that a link does to it ends the watch."""

import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega
from tests.mavlink_vehicle import ARDUPILOT, HEXA, QUAD, Autopilot, messages

from conftest import hexa_event
from rotorwatch import airframes, diagnose, logs
from rotorwatch.commands import cli
from rotorwatch.errors import LinkError
from rotorwatch.live import endpoint, mavlink, requests
from rotorwatch.live.clock import Clock, Restarted
from rotorwatch.live.framing import Sender
from rotorwatch.live.link import Link
from rotorwatch.live.watched import Watched
from rotorwatch.logs import mavlink_messages

SAMPLES = cli.SAMPLES
FLIGHTS = Path(__file__).resolve().parents[2] / "shared" / "flights"
SECONDS = 50.0


class Wire(endpoint.Endpoint):
    """An endpoint in memory. autopilots: answer what is sent."""

    def __init__(self, autopilots=()):
        super().__init__("udp:14550")
        self.open, self._queue, self._autopilots = True, [], autopilots
        self.sent = []

    def put(self, data, peer="a"):
        self._queue.append((peer, data))

    def receive(self, wait_s=0.0):
        queue, self._queue = self._queue, []
        return queue

    def send(self, data, peer=None):
        self.sent.append(data)
        for autopilot in self._autopilots:
            if answer := autopilot.answer(data):
                self.put(answer)


@pytest.fixture(scope="module")
def flight():
    path = FLIGHTS / "ardupilot-sitl" / "fullrate_excerpt_quadx_m1_mul0.90_hover.bin.xz"
    other = FLIGHTS / "ardupilot-sitl" / "quadx_m1_mul0.90_hover.bin.xz"
    if not other.exists():
        pytest.skip(f"the shared flight {path.name} is not here")
    return logs.read(other).until(SECONDS)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(requests, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(requests, "MISSING_S", 0.02)  # a link in memory answers at once
    monkeypatch.setattr(requests, "LIST_S", 0.1)


def relevant(parameters):
    keep = ("FRAME", "MOT_", "SERVO")
    return {name: value for name, value in parameters.items() if name.startswith(keep) and len(name) <= 16}


def settle(link, autopilot=None, polls=400):
    """Poll until the parameters are there."""
    for _ in range(polls):
        link.poll(0.0)
        if link.vehicles and link.vehicles[0].session is not None:
            return
        time.sleep(0.005)
    raise AssertionError("the parameters never came")


def sent_over(link, wire, data, mangled=list, step_s=0.04, timed=False):
    """All messages of [(time, message, autopilot)], in pieces of some ms of flight; mangled: what the link makes of a piece; timed: by the
    link's clock it takes as long as in flight."""
    piece, due, began, start = [], -np.inf, link.clock(), data[0][0]
    for at, message, autopilot in data:
        if timed:
            link.clock = lambda at=at: began + max(at - start, 0.0)
        piece.append(autopilot.packed(message))
        if at >= due:
            for frame in mangled(piece):
                wire.put(frame)
            link.poll(0.0)
            piece, due = [], at + step_s
    link.poll(0.0)


def of(autopilot, data):
    return [(at, message, autopilot) for at, message in data]


def linked(flight, record=None, lose=0.0, second=True, **options):
    alerts = []
    autopilot = Autopilot(relevant(flight.parameters), lose=lose, second=second)
    wire = Wire([autopilot])
    link = Link(wire, alerts.append, record=record)
    data = messages(flight, **options)
    wire.put(autopilot.packed(beat(data)))
    settle(link)
    return link, wire, autopilot, alerts, data


def beat(data):
    return next(m for _, m in data if m.get_type() == "HEARTBEAT")


def events_of(alerts):
    said = {a["number"]: a for a in alerts if a["type"] == "event"}
    return [a["event"] for a in said.values() if a["state"] != "withdrawn"]


@pytest.mark.parametrize(
    ("step", "lost", "twice", "new"),
    [(0, 0, 1, False), (1, 0, 0, True), (9, 8, 0, True), (100, 99, 0, True), (127, 126, 0, True), (128, 127, 0, True),
     (129, 0, 1, True), (250, 0, 1, True)],
)  # fmt: skip
def test_running_numbers_tell_what_was_lost_and_what_came_late(flight, step, lost, twice, new):
    """Up to half of the numbers ahead are frames that were lost; more are frames that come late."""
    link, *_ = linked(flight, seconds=1.0)
    (one,) = link._vehicles.values()
    one.routes.followed.sequence = 250
    health = one.watched.health
    before = health.lost, health.twice
    assert one.counted((250 + step) % 256) is new
    assert (health.lost - before[0], health.twice - before[1]) == (lost, twice)


@pytest.mark.parametrize("second", [True, False])
def test_a_vehicle_is_assessed_over_a_link_as_its_recording_is(flight, tmp_path, second):
    seconds = SECONDS if second else 15.0
    link, wire, autopilot, alerts, data = linked(flight, record=tmp_path, second=second, seconds=seconds)
    sent_over(link, wire, of(autopilot, data))
    (watched,) = link.vehicles
    session = watched.session
    assert watched.trouble == "" and session is not None and watched.health.lost == watched.health.twice == 0
    link.leave()
    kinds = {m.get_type() for m in autopilot.asked}
    assert kinds <= {"PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "COMMAND_LONG", "REQUEST_DATA_STREAM"}
    assert {m.command for m in autopilot.asked if m.get_type() == "COMMAND_LONG"} <= {510, 511, 512}
    if not second:
        assert session.now > 10.0
        return
    (loss,) = events_of(alerts)
    assert session.assessed and loss["rotors"] == [1] and 0.1 < loss["loss"][0] < 0.3
    (recording,) = tmp_path.glob("*.tlog")
    (afterwards,) = diagnose(logs.read(recording)).to_dict()["events"]
    assert (afterwards["kind"], afterwards["rotors"]) == (loss["kind"], loss["rotors"])
    assert afterwards["detected_s"] == pytest.approx(loss["detected_s"], abs=0.06)
    assert afterwards["onset_s"] == pytest.approx(loss["onset_s"], abs=0.06)
    assert afterwards["loss"] == pytest.approx(loss["loss"], abs=0.03)


def test_what_a_bad_link_does_is_survived_and_counted(flight):
    """A twentieth lost, some twice, some late, garbage between: the same rotor is found, and all of it is reported."""
    rng = np.random.default_rng(3)

    def mangled(piece):
        piece = [f for f in piece for _ in range(rng.choice([0, 1, 2], p=[0.05, 0.93, 0.02]))]
        if len(piece) > 1 and rng.random() < 0.2:
            k = rng.integers(len(piece) - 1)
            piece[k], piece[k + 1] = piece[k + 1], piece[k]
        return [*piece, rng.bytes(40)] if rng.random() < 0.05 else piece

    link, wire, autopilot, alerts, data = linked(flight, lose=0.3)
    sent_over(link, wire, of(autopilot, data), mangled)
    (watched,) = link.vehicles
    link.leave()
    assert 0.02 < watched.health.loss < 0.12 and watched.health.twice >= 50 and link.damaged > 10
    (loss,) = events_of(alerts)
    assert loss["rotors"] == [1]


def test_a_reboot_in_flight_and_silence_are_reported_and_survived(flight):
    link, wire, autopilot, alerts, data = linked(flight, seconds=20.0)
    sent_over(link, wire, of(autopilot, data))
    link.vehicles[0].health.last_frame -= 10.0
    link.poll(0.0)
    sent_over(link, wire, of(autopilot, messages(flight, boot_s=1.0, seconds=20.0)), timed=True)
    now = link.vehicles[0].session.now
    link.leave()
    texts = [a["text"] for a in alerts if a["type"] == "notice"]
    assert any("nothing has been received" in t for t in texts) and any("received again" in t for t in texts)
    assert any("rebooted" in t for t in texts)
    assert link.vehicles[0].health.reboots == 1 and 15.0 < now < 21.0


def test_vehicles_of_one_link_are_reported_apart(flight):
    parameters, data = relevant(flight.parameters), messages(flight, seconds=12.0)
    autopilots = [Autopilot(parameters, system=k) for k in (1, 7)]
    wire = Wire(autopilots)
    link = Link(wire, lambda alert: None)
    for autopilot in autopilots:
        wire.put(autopilot.packed(beat(data)))
    settle(link)
    sent_over(link, wire, [(at, m, autopilot) for at, m in data for autopilot in autopilots])
    assert [v.name for v in link.vehicles] == ["udp:14550/1", "udp:14550/7"]
    assert all(v.session is not None and v.session.now > 10.0 for v in link.vehicles)
    link.leave()


@pytest.mark.parametrize("intervals", [True, False])
def test_rates_are_asked_for_and_given_back(intervals):
    autopilot = Autopilot({"A": 1.0}, intervals=intervals)
    rates, now = requests.Rates(1, 1, "ArduPilot", slow=True), 0.0
    sender, parser = Sender(254, 191), ardupilotmega.MAVLink(None)

    def send(message):
        for answer in parser.parse_buffer(autopilot.answer(sender.frame(message))) or []:
            if answer.get_type() == "COMMAND_ACK":
                rates.answered(answer.command, answer.result)
            elif answer.get_type() == "MESSAGE_INTERVAL":
                rates.interval(answer.message_id, answer.interval_us)

    while not rates.done and now < 60.0:
        rates.step(now, send, {"SYS_STATUS": 2.0, "ATTITUDE": 4.0})
        now += 0.1
    asked = {int(m.param1): m.param2 for m in autopilot.asked if m.get_type() == "COMMAND_LONG" and m.command == 511}
    assert rates.done and asked.get(36) == pytest.approx(50000.0)
    before = len(autopilot.asked)
    rates.restore(send)
    back = autopilot.asked[before:]
    if intervals:
        assert 1 not in asked and {int(m.param1): m.param2 for m in back} == dict.fromkeys(asked, 250000.0)
    else:
        assert {(m.req_stream_id, m.req_message_rate, m.start_stop) for m in back} >= {(10, 4, 1), (3, 1, 0)}


def test_parameters_come_however_many_are_lost():
    values = {f"P{k}": float(k) for k in range(300)}
    autopilot, parameters = Autopilot(values, lose=0.5, seed=1), requests.Parameters(1, 1)
    sender, parser, now = Sender(254, 191), ardupilotmega.MAVLink(None), 0.0

    def send(message):
        for answer in parser.parse_buffer(autopilot.answer(sender.frame(message))) or []:
            parameters.received(answer.param_index, answer.param_count, now)

    while not (parameters.complete or parameters.given_up) and now < 200.0:
        parameters.step(now, send)
        now += 0.1
    assert parameters.complete
    nobody = requests.Parameters(1, 1)
    for k in range(2000):
        nobody.step(0.1 * k, lambda message: None)
    assert nobody.given_up


def test_kept_parameters_are_used_at_once():
    requests.store("ArduPilot-77-1", {"FRAME_CLASS": 1.0})
    assert requests.cached("ArduPilot-77-1") == {"FRAME_CLASS": 1.0} and requests.cached("other") == {}
    who = requests.Identity(1, 1)
    who.received(77, bytes(18), 0x04050700, "ArduPilot")
    assert who.key == "ArduPilot-4d-04050700"


class Late(Autopilot):
    """One that says who it is, but sends its parameters only when asked to."""

    sends = False

    def _value(self, k):
        return super()._value(k) if self.sends else ardupilotmega.MAVLink_heartbeat_message(QUAD, ARDUPILOT, 0x80, 0, 4, 3)


KEY = "ArduPilot-4d-04050700"
QUAD_PLUS = {"FRAME_CLASS": 1.0, "FRAME_TYPE": 0.0} | {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 5)}
SAMPLE = {QUAD: "quadx_healthy_hover.bin.xz", HEXA: "hexax_m3_mul0.80_square_wind.bin.xz"}


def introduced(parameters, data, autopilot=Autopilot):
    """A link on which a vehicle has been met and may be watched: (link, wire, autopilot, alerts)."""
    alerts, autopilot = [], autopilot(parameters)
    wire = Wire([autopilot])
    link = Link(wire, alerts.append)
    wire.put(autopilot.packed(beat(data)))
    for _ in range(50):
        link.poll(0.0)
        time.sleep(0.002)
    return link, wire, autopilot, alerts


@pytest.mark.parametrize("kind", [HEXA, QUAD])
def test_parameters_kept_of_another_vehicle_give_way_to_its_own(kind):
    """Simulated vehicles all have one id. A quad's parameters do not fit a hexa; those of a quad + fit a quad X until its own have come."""
    flight = logs.read(SAMPLES / SAMPLE[kind]).until(25.0)
    own, data = relevant(flight.parameters), messages(flight, kind=kind)
    requests.store(KEY, QUAD_PLUS)
    link, wire, autopilot, alerts = introduced(own, data, Late)
    (watched,) = link.vehicles
    assert (watched.session is None) == (kind == HEXA)
    half = len(data) // 2
    sent_over(link, wire, of(autopilot, data[:half]))
    assert kind == HEXA or (watched.session.flying and watched.session.vehicle.name == "ardupilot-quad-plus")
    autopilot.sends = True
    for _ in range(200):
        link.poll(0.0)
        time.sleep(0.002)
    sent_over(link, wire, of(autopilot, data[half:]))
    assert [a["text"] for a in alerts if a["type"] == "error"] == [] and watched.trouble == ""
    assert watched.session.vehicle.name == airframes.identify(flight).name and requests.cached(KEY) == own
    (said,) = [a["text"] for a in alerts if "stored" in a.get("text", "")]
    assert "do not match this vehicle" in said or "another vehicle" in said
    link.leave()


def test_parameters_kept_of_a_vehicle_are_used_until_its_own_have_come_and_nothing_is_said_of_it():
    flight = logs.read(SAMPLES / SAMPLE[QUAD]).until(15.0)
    own, data = relevant(flight.parameters), messages(flight)
    requests.store(KEY, own | {"MOT_SPIN_ARM": 0.11})  # changed since, which changes nothing here
    link, wire, autopilot, alerts = introduced(own, data, Late)
    (watched,) = link.vehicles
    sent_over(link, wire, of(autopilot, data[: len(data) // 2]))
    session = watched.session
    autopilot.sends = True
    for _ in range(200):
        link.poll(0.0)
        time.sleep(0.002)
    assert requests.cached(KEY) == own
    assert session.flying and watched.session is session and not any("kept" in a.get("text", "") for a in alerts)
    link.leave()


def test_what_was_reported_of_another_vehicle_is_taken_back():
    alerts = []
    watched = Watched("udp:14550/1", alerts.append)
    for change in watched.changes.since_last((hexa_event(),)):
        watched._alert(change)
    watched.withdraw()
    assert [alert["state"] for alert in alerts] == ["announced", "withdrawn"] and watched.events == ()


def test_of_a_vehicle_that_contradicts_itself_is_not_spoken_as_of_a_log():
    flight = logs.read(SAMPLES / SAMPLE[HEXA]).until(6.0)
    data = messages(flight, kind=HEXA)
    link, wire, autopilot, alerts = introduced(QUAD_PLUS, data)
    sent_over(link, wire, of(autopilot, data))
    (text,) = [a["text"] for a in alerts if a["type"] == "error"]
    assert "udp:14550/1 commands 6 rotors but the frame" in text and "log" not in text
    link.leave()


def test_the_clock_is_the_vehicles_and_one_wrong_stamp_is_no_reboot():
    clock = Clock()
    assert clock.take(5e6, 0.0, False) == 0.0 and clock.take(5.1e6, 0.0, False) == pytest.approx(0.1)
    assert clock.take(9e12, 0.0, False) is None and clock.take(5.08e6, 0.0, False) == pytest.approx(0.08)
    assert clock.take(np.nan, 0.0, False) is None and clock.now == pytest.approx(0.1)
    assert clock.take(5.2e6 - 2**32, 0.0, True) is None or clock.now == pytest.approx(0.2)
    with pytest.raises(Restarted) as why:
        for k in range(10):
            clock.take(1e5 + 0.1e6 * k, 0.1 * k, False)
    assert why.value.reboot


def test_random_datagrams_are_ignored_and_counted():
    rng, wire = np.random.default_rng(0), Wire()
    link = Link(wire, lambda alert: None, talks=False)
    for k in range(300):
        data = bytearray(rng.bytes(int(rng.integers(1, 300))))
        data[0] = (0xFD, 0xFE, data[0])[k % 3]
        wire.put(bytes(data), peer=k % 5)
        link.poll(0.0)
    assert link.damaged > 100 and link.vehicles == () and wire.sent == []


def test_wild_values_in_sound_frames_end_nothing(flight):
    """Any bits in the payloads of any message that is read, among those of a flight: reported at most, and assessed on."""
    rng = np.random.default_rng(5)
    link, wire, autopilot, _alerts, data = linked(flight, seconds=14.0)
    seeds = {name: message.seed for name, message in mavlink_messages.by_name().items()}
    known = [(k, v) for k, v in mavlink.layouts().items() if v.name in seeds and v.name not in ("HEARTBEAT", "PARAM_VALUE")]

    def mangled(piece):
        identity, layout = known[rng.integers(len(known))]
        head = bytes((layout.kind.itemsize, 0, 0, rng.integers(256), 1, 1)) + identity.to_bytes(3, "little")
        body = head + rng.bytes(layout.kind.itemsize)
        check = ardupilotmega.x25crc(body + bytes([seeds[layout.name]])).crc
        return [*piece, b"\xfd" + body + check.to_bytes(2, "little")]

    sent_over(link, wire, of(autopilot, data), mangled)
    (watched,) = link.vehicles
    assert watched.trouble == "" and watched.session is not None and watched.session.now > 5.0
    link.leave()


@pytest.mark.parametrize(
    "name, says",
    [
        ("udp:99999", "not an endpoint"),
        ("tcp:127.0.0.1:1", "cannot be reached"),
        ("serial:/dev/no-such-port:57600", "no such device"),
        ("serial:/dev/ttyUSB0", "name the device and its speed"),
        ("serial:/dev/null:57600", "cannot be opened as a serial port"),
        ("udp:no-such-host.invalid:14550", "cannot be opened"),
    ],
)
def test_an_endpoint_that_cannot_be_opened_is_said_in_a_sentence(name, says):
    assert endpoint.is_endpoint(name)
    with pytest.raises(LinkError, match=says):
        endpoint.open_endpoint(name)


def test_a_port_in_use_and_a_silent_link_are_said(capsys):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match="is another program using this port"):
            endpoint.open_endpoint(f"udpin:127.0.0.1:{port}")
    with pytest.raises(SystemExit) as left:
        cli.main(["watch", f"udpin:127.0.0.1:{port}", "--patience", "0.2", "--jsonl"])
    assert left.value.code == 2 and "no heartbeat of a multirotor" in capsys.readouterr().err


def test_an_endpoint_is_open_before_what_takes_long_is_loaded():
    """What a vehicle sends while Python still loads is waiting in the socket then."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        program = (
            "import sys\nfrom rotorwatch.commands import cli\n"
            f"try: cli.main(['watch', 'udpin:127.0.0.1:{port}'])\n"
            "except SystemExit: print(sorted({'numpy'} & sys.modules.keys()))"
        )
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "is another program using this port" in done.stderr
    assert done.stdout.strip() == "[]"


def test_a_serial_port_of_the_wrong_speed_is_said():
    """What is read at the wrong speed is bytes without a frame."""
    pty = pytest.importorskip("pty")
    other, own = pty.openpty()
    name = f"serial:{os.ttyname(own)}:57600"
    link = Link(endpoint.open_endpoint(name), lambda alert: None, patience_s=0.2)
    rng = np.random.default_rng(0)
    with pytest.raises(LinkError, match="are not MAVLink; is the baud rate right"):
        for _ in range(1000):
            os.write(other, rng.bytes(100))
            link.poll(0.0)
            time.sleep(0.002)
    link.leave()
    os.close(other)
    os.close(own)


def test_a_plane_is_refused_in_words():
    alerts, wire = [], Wire()
    link = Link(wire, alerts.append, talks=False)
    pack = ardupilotmega.MAVLink(None, srcSystem=3, srcComponent=1)
    wire.put(ardupilotmega.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3).pack(pack))
    link.poll(0.0)
    (said,) = alerts
    assert "fixed-wing aircraft" in said["text"] and link.vehicles == ()


def test_over_udp(flight):
    """A vehicle in a thread, on the loopback, forty times as fast as it flew."""
    data, parameters = messages(flight, seconds=20.0), relevant(flight.parameters)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    autopilot, known, stop = Autopilot(parameters), threading.Event(), threading.Event()

    def fly():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.connect(("127.0.0.1", port))
            sock.settimeout(0.02)
            while not known.is_set() and not stop.is_set():
                sock.send(autopilot.packed(beat(data)))
                try:
                    answer = autopilot.answer(sock.recv(2048))
                except OSError:
                    continue
                for k in range(0, len(answer), 1000):
                    sock.send(answer[k : k + 1000])
            for k, (_, message) in enumerate(data):
                sock.send(autopilot.packed(message))
                if k % 10 == 0:
                    time.sleep(0.001)
                if stop.is_set():
                    return

    link = Link(endpoint.open_endpoint(f"udpin:127.0.0.1:{port}"), lambda alert: None)
    thread = threading.Thread(target=fly, daemon=True)
    thread.start()
    began = time.monotonic()
    while time.monotonic() - began < 30.0:
        link.poll(0.005)
        if link.vehicles and link.vehicles[0].session is not None:
            known.set()
            if link.vehicles[0].session.now > 18.0:
                break
    stop.set()
    thread.join()
    (watched,) = link.vehicles
    assert watched.trouble == "" and watched.session is not None and watched.session.now > 18.0
    link.leave()
