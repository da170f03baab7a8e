"""What fails beside the judging never ends it, and what grows has an end: disks, clocks, strangers on a link, pages that cannot be told."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega
from tests import soak
from tests.mavlink_vehicle import Autopilot, messages

from rotorwatch.live import endpoint, mavlink
from rotorwatch.live import link as links
from rotorwatch.live.clock import Clock, Restarted
from rotorwatch.live.link import Link
from rotorwatch.live.watch import Beside
from rotorwatch.live.watched import Watched
from rotorwatch.serve import live
from rotorwatch.serve.hub import Hub
from test_watch_links import Wire, _own_cache, events_of, flight, linked, of, relevant, sent_over  # noqa: F401


def test_a_reboot_after_a_short_stamp_is_told_in_plain_numbers():
    """What counts reboots goes into JSON, which has no numbers of NumPy."""
    clock = Clock()
    clock.take(np.float64(60e6), 0.0, False)
    clock.take(np.float64(60.1e6), 0.1, True)
    with pytest.raises(Restarted) as why:
        for k in range(10):
            clock.take(np.float64(1e6 + k), 0.2, False)
    assert why.value.reboot is True
    assert json.dumps(0 + why.value.reboot) == "1"


def test_a_page_is_told_numbers_of_numpy_too():
    hub = Hub(lambda: {})
    hub.publish("tick", {"count": np.int64(3), "row": np.arange(2)})
    assert '{"count": 3, "row": [0, 1]}' in hub._kept[-1][1]
    with pytest.raises(TypeError):
        hub.publish("tick", {"what": object()})


class Still:
    """A link of one vehicle that goes on for some polls; an error comes with the second one."""

    def __init__(self, polls=60, why=None):
        self.vehicles, self._left, self._why, self.polled = (Watched("v", lambda alert: None),), polls, why, 0

    def poll(self, wait_s):
        self.polled += 1
        if self._why is not None and self.polled == 2:
            raise self._why
        self._left -= 1
        time.sleep(wait_s)
        return self._left > 0

    def shown(self):
        return [(self.vehicles[0], "parameters")]

    def leave(self):
        pass


@pytest.mark.parametrize("broken", ["_tick", "_sample", "_tell"])
def test_an_error_while_showing_ends_no_watching(monkeypatch, broken, caplog):
    feed, source = live.Feed(), Still()
    guarded = live.Guarded("udp:1", lambda: source, feed)
    feed._sources = [guarded]

    def fails(*_):
        raise ZeroDivisionError("while showing")

    monkeypatch.setattr(feed, broken, fails)
    feed.start()
    feed.tell({"type": "notice", "vehicle": "v", "text": "a"})
    feed._thread.join(20.0)
    assert source.polled == 60 and not feed.trouble
    said = [line["text"] for line in feed._said if "while showing" in line["text"]]
    assert len(said) == 1, "it is said, once"
    assert "while showing" in caplog.text
    feed.stop()


def test_watching_that_ends_is_seen(monkeypatch, caplog):
    feed = live.Feed()
    feed._sources = [live.Guarded("udp:1", Still, feed)]
    monkeypatch.setattr(live, "watch", lambda *_: 1 / 0)
    feed.start()
    feed._thread.join(10.0)
    assert "Nothing is watched any more" in feed.trouble == feed._said[-1]["text"]
    feed.stop()


def test_a_link_that_fails_is_opened_again_and_its_flight_is_kept(monkeypatch):
    monkeypatch.setattr(live, "AGAIN_S", 0.05)
    feed, opened, over = live.Feed(), [], []
    monkeypatch.setattr(feed, "_sample", lambda source, all_is_over: over.append(all_is_over))

    def open_it():
        opened.append(Still(why=None if opened else ValueError("bug")))
        return opened[-1]

    guarded = live.Guarded("udp:1", open_it, feed)
    guarded.lists = True
    while guarded.poll(0.005):
        pass
    assert len(opened) == 2 and opened[1].polled == 60 and guarded.trouble == ""
    assert True in over, "the flight before it is over"


class Full:
    """A file on a disk that is full after so many bytes."""

    def __init__(self, room):
        self.room, self.closed = room, False

    def write(self, data):
        self.room -= len(data)
        if self.room < 0:
            raise OSError(28, "No space left on device")

    def flush(self):
        pass

    def close(self):
        self.closed = True


def test_a_full_disk_ends_the_recording_only(flight, tmp_path):  # noqa: F811
    link, wire, autopilot, alerts, data = linked(flight, record=tmp_path, seconds=45.0)
    link._file.close()
    link._file = full = Full(10_000)
    sent_over(link, wire, of(autopilot, data))
    link.leave()
    said = [a["text"] for a in alerts if a["type"] == "error"]
    assert said == ["nothing is recorded any more (No space left on device); judging goes on"] and full.closed
    assert events_of(alerts)[0]["rotors"] == [1]


def test_an_error_of_one_vehicle_is_not_the_others(flight):  # noqa: F811
    link, wire, autopilot, alerts, data = linked(flight, seconds=15.0)
    (heard,) = link._heard.values()
    heard.messages.take = lambda *_: 1 / 0
    wire.put(ardupilotmega.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(ardupilotmega.MAVLink(None, 9, 1)))
    sent_over(link, wire, of(autopilot, data))
    assert len(link.vehicles) == 2 and "ZeroDivisionError" in link.vehicles[0].trouble and not link.vehicles[1].trouble
    assert sum(a["type"] == "error" for a in alerts) == 1, "it is said once"


def test_strangers_fill_no_memory():
    alerts, wire = [], Wire()
    link = Link(wire, alerts.append, talks=False)
    for k in range(3000):
        pack = ardupilotmega.MAVLink(None, 1 + k % 250, 1 + k // 250)
        wire.put(ardupilotmega.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(pack), peer=k)
    link.poll(0.0)
    assert len(link.vehicles) == links.VEHICLES and len(link._parsers) <= links.PEERS
    assert sum("more than 64 vehicles" in a.get("text", "") for a in alerts) == 1


def test_parameters_without_end_are_given_up():
    heard, layout = (
        mavlink.Messages("ArduPilot", 2),
        next(x for x in mavlink.layouts().values() if x.name == "PARAM_VALUE"),
    )
    pack = ardupilotmega.MAVLink(None, 1, 1)
    for k in range(mavlink.MOST_PARAMETERS + 500):
        heard.add(
            layout, ardupilotmega.MAVLink_param_value_message(b"P%d" % k, 1.0, 9, 65535, k % 65536).pack(pack), 0.0
        )
    assert len(heard.parameters()) == mavlink.MOST_PARAMETERS


def test_only_what_speaks_mavlink_is_answered():
    opened = endpoint.Udp("udp:0", "127.0.0.1", 0, listens=True)
    port = opened._socket.getsockname()[1]
    link = Link(opened, lambda alert: None)
    heartbeat = ardupilotmega.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(ardupilotmega.MAVLink(None, 1, 1))
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as known,
    ):
        stranger.settimeout(0.3)
        known.settimeout(3.0)
        stranger.sendto(b"x", ("127.0.0.1", port))
        known.sendto(heartbeat, ("127.0.0.1", port))
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            link.poll(0.01)
        assert known.recv(2048)
        with pytest.raises(TimeoutError):
            stranger.recv(2048)
    for k in range(200):
        opened.heard(("127.0.0.1", 20000 + k))
    assert len(opened._peers) <= endpoint.ANSWERED
    link.leave()


def test_trouble_of_an_outlet_is_said_once_and_ends_nothing():
    class Broken:
        def take(self, alert):
            raise OSError(28, "No space left on device")

        step = leave = take

    said = []
    outlet = Beside(Broken(), said.append)
    outlet.take({})
    outlet.step([])
    outlet.leave()
    assert len(said) == 1 and said[0].startswith("broken: ")


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_watching_as_it_should_end(flight, tmp_path, number):  # noqa: F811
    """The record is whole, rates that were asked for are given back, the last word is said."""
    data, autopilot, over = messages(flight, seconds=6.0), Autopilot(relevant(flight.parameters)), threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:
        child = subprocess.Popen(
            [sys.executable, "-m", "rotorwatch.cli", "watch", f"tcp:127.0.0.1:{server.getsockname()[1]}", "--jsonl",
             "--record", str(tmp_path)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        side, _ = server.accept()

        def answers():
            while not over.is_set():
                try:
                    side.sendall(autopilot.answer(side.recv(4096)))
                except OSError:
                    return

        threading.Thread(target=answers, daemon=True).start()
        for _, message in data:
            side.sendall(autopilot.packed(message))
            time.sleep(0.0005)
        end = time.monotonic() + 20.0
        while time.monotonic() < end and len(asked_for(autopilot)) < 3:
            side.sendall(autopilot.packed(next(m for _, m in data if m.get_type() == "HEARTBEAT")))
            time.sleep(0.05)
        last = autopilot.packed(data[-1][1])
        side.sendall(last)
        time.sleep(0.3)
        before = len(autopilot.asked)
        child.send_signal(number)
        _, said = child.communicate(timeout=30.0)
        time.sleep(0.2)
        over.set()
        side.close()
    assert child.returncode == 3 and "Traceback" not in said, said
    (record,) = tmp_path.glob("*.tlog")
    assert last in record.read_bytes()[-4096:], "the last moment is recorded"
    back = {m.param1 for m in autopilot.asked[before:] if m.get_type() == "COMMAND_LONG" and m.command == 511}
    assert len(back) >= 2 and back <= asked_for(autopilot), "rates are given back"


def asked_for(autopilot):
    """Messages whose rates were set."""
    return {m.param1 for m in autopilot.asked if m.get_type() == "COMMAND_LONG" and m.command == 511}


def test_a_soak_of_some_minutes():
    told = soak.soak(vehicles=2, minutes=2.3, seed=4)
    assert told.alive and not told.said
    assert told.flights == 4 and told.entries == told.parts
