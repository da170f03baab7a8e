"""What fails beside the assessing never ends it, and what ends is seen; nothing that a link brings makes memory grow without bound."""

import errno
import json
import math
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from tests.link_faults import Wire, base
from tests.mavlink_vehicle import ARDUPILOT, QUAD, Autopilot, mavlink
from tests.soak import soak

from rotorwatch import logs
from rotorwatch.commands import cli
from rotorwatch.errors import LinkError, StoreError
from rotorwatch.fleet.store import Entry
from rotorwatch.live import endpoint, record, requests, watch
from rotorwatch.live.clock import Clock, Restarted
from rotorwatch.live.guard import Guard, as_json
from rotorwatch.live.link import VEHICLES, Link
from rotorwatch.live.mavlink import MOST_PARAMETERS
from rotorwatch.live.watched import Watched
from rotorwatch.serve import flights as flights_of
from rotorwatch.serve import hub, live

SAMPLE = cli.SAMPLES / "quadx_healthy_hover.bin.xz"
FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_after_a_short_stamp_a_reboot_is_a_plain_truth():
    """What counts reboots goes into JSON, which has no numbers of NumPy."""
    clock = Clock()
    clock.take(60e6, 0.0, False)
    clock.take(60.1e6, 0.1, True)
    with pytest.raises(Restarted) as why:
        for k in range(10):
            clock.take(1e6 + 0.1e6 * k, 0.2 + 0.1 * k, False)
    assert why.value.reboot is True


BUILDS_FOR_LONG = """
import os, signal, threading, time
from rotorwatch.live import session
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where whoever runs the tests ignores it
class Slow:
    @property
    def library(self):
        time.sleep(30.0)
session.ENGINE = Slow()
assert not session.building().done(wait=False)
threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
time.sleep(30.0)
"""


def test_code_that_is_being_built_keeps_nobody_from_ending_the_watch():
    """Ctrl-C stops it at once."""
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-c", BUILDS_FOR_LONG], capture_output=True, text=True, timeout=60.0)
    assert done.returncode == -signal.SIGINT and "KeyboardInterrupt" in done.stderr
    assert time.monotonic() - began < 20.0


def test_short_stamps_that_are_not_believed_do_not_pile_up():
    clock = Clock()
    clock.take(6000e6, 0.0, False)
    for k in range(1000):
        assert clock.take(1e6 + k, 0.2, True) is None
    assert len(clock._other) < 10 and clock.refused == 1000


def test_vehicles_of_one_link_are_assessed_and_listed_whatever_their_clocks_do(tmp_path):
    """The short version of `python -m tests.soak`."""
    found = soak(0.75, tmp_path, count=2, seed=3, flight_s=19.0)
    assert found.trouble == [] and found.reboots + found.jumps == found.flights - 2 >= 2
    assert found.stored == found.flights


def test_any_number_is_reported_as_json():
    reported = {"a": np.int64(3), "b": np.bool_(True), "c": [np.float32(0.5), math.nan, (np.inf, None)], "d": np.arange(2)}
    assert json.loads(as_json(reported)) == {"a": 3, "b": True, "c": [0.5, None, [None, None]], "d": [0, 1]}
    page = hub.Hub(dict)
    page.publish("tick", reported)
    assert "NaN" not in page._since(0)[0]


class Source:
    """Polled so many times, at some of which it fails. polled: how often; left: whether it was left."""

    def __init__(self, times, fails=None):
        self.vehicles, self._times, self._fails = (), times, fails or {}
        self.polled, self.left, self.trouble = 0, False, ""

    def poll(self, wait_s):
        self.polled += 1
        if self.polled in self._fails:
            raise self._fails[self.polled]
        return self.polled < self._times

    def shown(self):
        return []

    def leave(self):
        self.left = True


class Outlet:
    def take(self, alert):
        pass

    def step(self, sources):
        raise ValueError("counting is broken")

    def leave(self):
        raise ValueError("leaving is broken")


def test_what_fails_beside_the_assessing_ends_nothing_and_is_said_once(monkeypatch):
    monkeypatch.setattr(watch, "STEP_S", 0.0)
    monkeypatch.setattr(watch, "SHOW_S", 0.0)

    def show(sources):
        raise FULL

    said, reported, source = [], [], Source(50)
    beside = Guard(said.append)
    watch.watch([watch.Guarded("one", source, reported.append)], show, outlets=[Outlet(), Outlet()], guard=beside)
    assert source.polled == 50 and source.left and reported == []
    assert len(said) == 2 and "counting is broken" in said[0] and "No space left" in said[1]
    assert set(beside.failed) == {"outlet", "the picture"}


def test_a_source_that_fails_is_tried_again_and_one_that_ends_leaves_the_others(monkeypatch):
    monkeypatch.setattr(watch, "FIRST_S", 0.001)
    reported = []
    failing, ending, good = (Source(9, {3: ValueError("bug"), 4: ValueError("bug")}), Source(9, {2: LinkError("gone.")}), Source(60))
    guarded = [watch.Guarded(name, one, reported.append) for name, one in zip("abc", (failing, ending, good))]
    watch.watch(guarded)
    assert failing.polled == 9 and ending.polled == 2 and good.polled == 60
    assert [(t["vehicle"], t["text"][:4]) for t in reported] in ([("b", "gone"), ("a", "an i")], [("a", "an i"), ("b", "gone")])
    assert failing.left and ending.left and good.left


def test_a_loop_that_dies_is_seen_and_begins_again(monkeypatch, capsys):
    calls, feed = [], live.Feed()
    loop = live.loop.watch

    def dies(*given, **more):
        calls.append(1)
        if len(calls) == 1:
            raise MemoryError("once")
        loop(*given, **more)

    monkeypatch.setattr(live.loop, "watch", dies)
    monkeypatch.setattr(live.loop, "FIRST_S", 0.001)
    source = Source(5)
    feed._sources = [live.Guarded("serial:x:1", source, feed)]
    feed.start()
    feed._thread.join(10)
    feed.stop()
    assert len(calls) == 2 and source.polled == 5 and "MemoryError" in feed.failed
    assert "MemoryError" in capsys.readouterr().err and "MemoryError" in feed.state()["said"][-1]["text"]


def test_a_vehicle_that_cannot_be_shown_hides_no_other_and_is_assessed_on(monkeypatch):
    feed, source = live.Feed(), Source(5)
    source.vehicles = [Watched(name, feed.notify) for name in "ab"]
    source.shown = lambda: [(watched, "parameters") for watched in source.vehicles]
    guarded = live.Guarded("udp:1", source, feed)
    feed._sources = [guarded]
    line = live.view.line
    monkeypatch.setattr(live.view, "line", lambda watched, waits: line(watched, waits) if watched.name == "b" else 1 / 0)
    assert guarded.poll(0.0)
    feed._show()
    feed._show()
    assert [v["name"] for v in feed.state()["vehicles"]] == ["b"]
    (said,) = feed.state()["said"]
    assert "what is shown of a" in said["text"] and "ZeroDivisionError" in said["text"]


def test_a_flight_is_kept_whatever_fails_around_the_store(tmp_path, monkeypatch):
    class Gone:
        times = 0

        def keep(self, entry):
            self.times += 1
            if self.times < 3:
                raise (StoreError("gone."), ValueError("bug"))[self.times - 1]
            return {"hash": entry.hash}

    def fails(row):
        kept.append(row["hash"])
        raise TypeError("nobody can be informed")

    def mute(text):
        raise BrokenPipeError

    monkeypatch.setattr(flights_of, "AGAIN_S", 0.001)
    kept = []
    keeper = flights_of.StoreWriter(Gone(), fails, mute, tmp_path)
    for digit in "01":
        keeper.keep(Entry(digit * 64, "", "udp:1/1", 0))
    until = time.monotonic() + 10.0
    while len(kept) < 2 and time.monotonic() < until:
        time.sleep(0.005)
    keeper.stop()
    assert kept == ["0" * 64, "1" * 64]


def introduced(link, wire, autopilot, parameters):
    wire.queue.append(("a", autopilot.packed(mavlink.MAVLink_heartbeat_message(QUAD, ARDUPILOT, 0x80, 0, 4, 3))))
    wire.queue += [("a", autopilot.packed(autopilot._value(k))) for k in range(len(parameters))]
    link.poll(0.0)


def test_after_an_error_of_its_own_a_vehicle_is_watched_anew(monkeypatch):
    frames, parameters, _kind = base(0)
    now, alerts, wire, autopilot = [0.0], [], Wire(), Autopilot(parameters)
    link = Link(wire, alerts.append, talks=False, clock=lambda: now[0])
    introduced(link, wire, autopilot, parameters)
    (watched,) = link.vehicles
    first = watched.session
    for at, frame in frames[:1500]:
        now[0] = 1.0 + at
        wire.queue.append(("a", frame))
        if 6.0 < at < 6.1 and watched.session is first:
            monkeypatch.setattr(first, "add", lambda *given: 1 / 0)
        link.poll(0.0)
    texts = [a["text"] for a in alerts if "text" in a]
    assert sum("ZeroDivisionError" in t for t in texts) == 1 and texts[-1] == "watching restarts after an error"
    assert watched.trouble == "" and watched.session is not first and watched.session.now > 2.0


def test_a_full_disk_ends_the_recording_and_not_the_assessing(tmp_path, monkeypatch):
    frames, parameters, _kind = base(0)
    alerts, wire, autopilot = [], Wire(), Autopilot(parameters)
    link = Link(wire, alerts.append, talks=False, record=tmp_path)
    write, room = os.write, [20_000]

    def fills(file, data):
        if file <= 2 or (file == link._record._file and room[0] >= len(data)):
            room[0] -= len(data) if file > 2 else 0
            return write(file, data)
        if room[0] > 0 and file == link._record._file:
            part, room[0] = room[0], 0
            return write(file, bytes(data)[:part])
        raise FULL

    monkeypatch.setattr(record.os, "write", fills)
    monkeypatch.setattr(record, "FLUSH_S", 0.0)
    introduced(link, wire, autopilot, parameters)
    for k in range(0, 1500, 10):
        wire.queue += [("a", frame) for _, frame in frames[k : k + 10]]
        link.poll(0.0)
    (watched,) = link.vehicles
    assert watched.session.now > 5.0 and watched.trouble == ""
    (said,) = [a for a in alerts if a["type"] == "error"]
    assert "recording to" in said["text"] and "No space left" in said["text"] and link.trouble == said["text"]
    link.leave()
    (path,) = tmp_path.iterdir()
    assert path.stat().st_size == 20_000 and len(logs.read(path)["motors"]) > 10


def param(name: bytes, index: int, count: int):
    return mavlink.MAVLink_param_value_message(name, 1.0, 9, count, index)


def test_parameters_and_heartbeats_without_end_take_no_memory_without_end():
    now, alerts, wire = [0.0], [], Wire()
    link = Link(wire, alerts.append, talks=False, clock=lambda: now[0])
    own = Autopilot({"FRAME_CLASS": 1.0})
    introduced(link, wire, own, {"FRAME_CLASS": 1.0})
    frame = bytearray(own.packed(param(b"P000000", 0, 60000)))
    from rotorwatch.live.framing import sums

    for k in range(30_000):
        body = bytes(frame[:10]) + struct.pack("<fHH16sB", 1.0, 60000, k % 60000, b"P%06d" % k, 9)
        body = body[:1] + bytes((25,)) + body[2:4] + bytes((k % 256,)) + body[5:]
        wire.queue.append(("a", body + sums(body, 220)))
    link.poll(0.0)
    heard = link._vehicles[1, 1]
    assert len(heard.messages._parameters) <= MOST_PARAMETERS
    for k in range(10_000):
        pack = mavlink.MAVLink(None, srcSystem=2 + k % 250, srcComponent=1 + k // 250)
        wire.queue.append(("b", mavlink.MAVLink_heartbeat_message(QUAD, ARDUPILOT, 0x80, 0, 4, 3).pack(pack)))
        now[0] += 0.001
    link.poll(0.0)
    assert len(link.vehicles) <= VEHICLES and len(alerts) < 2 * VEHICLES
    assert "more than 100 vehicles" in next(a["text"] for a in alerts if a["type"] == "error")
    # One that comes when the others have fallen silent has their room.
    now[0] += 10.0
    pack = mavlink.MAVLink(None, srcSystem=255, srcComponent=77)
    wire.queue.append(("c", mavlink.MAVLink_heartbeat_message(QUAD, ARDUPILOT, 0x80, 0, 4, 3).pack(pack)))
    link.poll(0.0)
    assert any(v.name.endswith("/255.77") for v in link.vehicles) and len(link.vehicles) <= VEHICLES


def test_those_that_send_only_heartbeats_give_way_to_one_that_sends_more():
    """They never fall silent, and the real one is heard after them; what it sent before is not needed."""
    now, alerts, wire = [0.0], [], Wire()
    link = Link(wire, alerts.append, talks=False, clock=lambda: now[0])
    beat = mavlink.MAVLink_heartbeat_message(QUAD, ARDUPILOT, 0x80, 0, 4, 3)
    packs = {k: mavlink.MAVLink(None, srcSystem=k, srcComponent=1) for k in range(1, VEHICLES + 50)}
    real = VEHICLES + 60
    packs[real] = mavlink.MAVLink(None, srcSystem=real, srcComponent=1)
    for _ in range(5):
        for k, pack in packs.items():
            wire.queue.append(("c" if k == real else "b", beat.pack(pack)))
            pack.seq = (pack.seq + 1) % 256
            if k == real:
                wire.queue.append(("c", mavlink.MAVLink_attitude_message(int(now[0] * 1e3), 0, 0, 0, 0, 0, 0).pack(pack)))
                pack.seq = (pack.seq + 1) % 256
        now[0] += 1.0
        link.poll(0.0)
    assert any(v.name.endswith(f"/{real}") and v.health.taken > 5 for v in link.vehicles)
    assert len(link.vehicles) == VEHICLES and len(alerts) < 2 * VEHICLES


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_only_what_speaks_mavlink_is_answered_and_few_of_these(monkeypatch):
    monkeypatch.setattr(endpoint, "ANSWERED", 4)
    port = free_port()
    link = Link(endpoint.open_endpoint(f"udpin:127.0.0.1:{port}"), lambda alert: None, patience_s=math.inf)
    socks = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(8)]
    ground = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mavlink.MAVLink(None, srcSystem=255))
    try:
        for sock in socks:
            sock.bind(("127.0.0.1", 0))
            sock.setblocking(False)
            sock.sendto(b"\xfd" if sock is socks[0] else ground, ("127.0.0.1", port))
        link.poll(0.1)
        link._beat = -math.inf
        link.poll(0.0)
        heard = []
        for sock in socks:
            try:
                heard.append(bool(sock.recv(2048)))
            except BlockingIOError:
                heard.append(False)
        assert heard == [False, False, False, False, True, True, True, True]
    finally:
        link.leave()
        for sock in socks:
            sock.close()


class Vehicle(threading.Thread):
    """A vehicle on the loopback that is on the ground: heartbeats, parameters, and answers to what is asked."""

    def __init__(self, port):
        super().__init__(daemon=True)
        self.autopilot, self.stop = Autopilot({"FRAME_CLASS": 1.0, "MOT_SPIN_MIN": 0.15}), threading.Event()
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.connect(("127.0.0.1", port))
        self._sock.settimeout(0.05)

    def run(self):
        beat = mavlink.MAVLink_heartbeat_message(QUAD, ARDUPILOT, 0x80, 0, 4, 3)
        while not self.stop.is_set():
            try:
                self.last = self.autopilot.packed(beat)
                self._sock.send(self.last)
                self._sock.send(self.autopilot.answer(self._sock.recv(2048)) or b"\0")
            except OSError:
                time.sleep(0.02)
        self._sock.close()

    def intervals(self):
        return [int(m.param1) for m in self.autopilot.asked if m.get_type() == "COMMAND_LONG" and m.command == 511]


class Slow(BaseHTTPRequestHandler):
    """Takes alerts, each after a while, so that some wait."""

    def do_POST(self):
        time.sleep(0.2)
        self.server.taken.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(200)
        self.end_headers()

    def log_message(self, *given):
        pass


@pytest.fixture
def slow():
    server = ThreadingHTTPServer(("127.0.0.1", 0), Slow)
    server.taken = []
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_asked_to_end_it_gives_back_what_it_has_asked_for_and_keeps_the_record(tmp_path, slow, number):
    port = free_port()
    vehicle = Vehicle(port)
    program = (
        "import sys, signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from rotorwatch.commands import cli; cli.main(sys.argv[1:])"
    )
    arguments = ["watch", f"udpin:127.0.0.1:{port}", "--jsonl", "--record", str(tmp_path)]
    arguments += ["--webhook", f"http://127.0.0.1:{slow.server_port}"]
    child = subprocess.Popen([sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    vehicle.start()
    try:
        until = time.monotonic() + 30.0
        while not vehicle.intervals() and child.poll() is None and time.monotonic() < until:
            time.sleep(0.02)
        time.sleep(0.3)
        last, asked = vehicle.last, len(vehicle.intervals())
        child.send_signal(number)
        assert child.wait(20.0) == 3  # nothing could be assessed
        until = time.monotonic() + 5.0
        while vehicle.intervals()[0] not in vehicle.intervals()[asked:] and time.monotonic() < until:
            time.sleep(0.02)
    finally:
        child.kill()
        vehicle.stop.set()
        vehicle.join(2.0)
        reported = [json.loads(line) for line in child.communicate()[0].splitlines()]
    assert reported and slow.taken == reported
    given_back = vehicle.intervals()[asked:]
    assert asked and set(given_back) >= {vehicle.intervals()[0]}
    (path,) = tmp_path.iterdir()
    recorded = path.read_bytes()
    assert last in recorded and recorded[8] == 0xFD, "what came within the last second is in the record"


def test_one_endpoint_without_a_vehicle_does_not_end_the_others(capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(["watch", f"udpin:127.0.0.1:{free_port()}", str(SAMPLE), "--patience", "0", "--speed", "max", "--jsonl"])
    out, err = capsys.readouterr()
    assert '"frame": "ardupilot-quad-x"' in out and '"type": "error"' in out
    assert left.value.code == 2 and "no heartbeat of a multirotor" in err


def test_a_flight_that_the_store_did_not_take_is_kept_by_the_next_server(tmp_path, monkeypatch):
    monkeypatch.setattr(flights_of, "AGAIN_S", 0.001)
    reported, said = [], []
    flights = flights_of.Flights(str(tmp_path / "fleet.db"))
    entry = Entry("a" * 64, "", "udp:1/1", 0, diagnosis={"verdict": "healthy", "losses": [0.1]})
    with monkeypatch.context() as gone:
        gone.setattr(flights, "keep", lambda entry: 1 / 0)
        keeper = flights.store_writer(reported.append, said.append)
        keeper.keep(entry)
        keeper.stop()
    assert reported == [] and "not in the list yet" in said[0]
    (flights.folder("heard") / "torn.json").write_text('{"hash": "b')
    keeper = flights.store_writer(reported.append, said.append)
    keeper.stop()
    assert [row["hash"] for row in reported] == [entry.hash] and flights.diagnosis(entry.hash) == entry.diagnosis
    assert [path.name for path in flights.folder("heard").iterdir()] == ["torn.json"]
    flights.close()


def test_parameters_are_kept_of_a_thousand_vehicles_and_not_of_more(tmp_path, monkeypatch):
    monkeypatch.setattr(requests, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(requests, "CACHED_VEHICLES", 10)
    for k in range(25):
        requests.store(f"ArduPilot-{k}", {"A": float(k)})
        os.utime(tmp_path / "parameters" / f"ArduPilot-{k}.json", (k, k))
    assert len(list((tmp_path / "parameters").iterdir())) <= 10
    assert requests.cached("ArduPilot-24") == {"A": 24.0} and requests.cached("ArduPilot-0") == {}
