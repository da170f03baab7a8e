"""Alerts and states over MQTT: a real broker (mosquitto), and a second client that subscribes."""

import json
import shutil
import socket
import subprocess
import threading
import time

import paho.mqtt.client as paho
import pytest
from tests.conftest import hexa_event
from tests.test_watch_alerts import flying, source, until

from rotorwatch.commands import cli
from rotorwatch.errors import ConfigError
from rotorwatch.live.channels import mqtt

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")
broker_needed = pytest.mark.skipif(MOSQUITTO is None, reason="needs the broker mosquitto")


class Mosquitto:
    """A broker on a port of its own, and what a subscriber has from it: got, (topic, text, retained)."""

    def __init__(self, folder, *config):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self._config = folder / "mosquitto.conf"
        self._config.write_text("\n".join((f"listener {self.port} 127.0.0.1", "persistence false", *config)) + "\n")
        self._process, self.got, self._clients = None, [], []

    def start(self):
        self._process = subprocess.Popen([MOSQUITTO, "-c", self._config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

        def listens():
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self.port)) == 0

        until(listens)
        return self

    def subscribe(self, *credentials):
        ready = threading.Event()
        client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        if credentials:
            client.username_pw_set(*credentials)
        client.on_message = lambda c, d, m: self.got.append((m.topic, m.payload.decode(), m.retain))
        client.on_subscribe = lambda *_: ready.set()
        client.connect("127.0.0.1", self.port)
        client.loop_start()
        client.subscribe("#", qos=1)
        assert ready.wait(10.0)
        self._clients.append(client)
        return client

    def of(self, topic):
        return [json.loads(text) for name, text, _ in self.got if name == topic]

    def stop(self):
        self._process.terminate()
        self._process.wait(10.0)

    def close(self):
        for client in self._clients:
            client.loop_stop()
        if self._process is not None:
            self.stop()


@pytest.fixture
def broker(tmp_path):
    made = []

    def make(*config):
        made.append(Mosquitto(tmp_path, *(config or ("allow_anonymous true",))))
        return made[-1]

    yield make
    for one in made:
        one.close()


ALERT = {"type": "event", "vehicle": "udp:14550/1", "number": 1, "state": "announced", "event": hexa_event().to_dict()}


@broker_needed
def test_alerts_and_states_come_under_the_vehicles_topic_and_states_stay(broker):
    there = broker().start()
    there.subscribe()
    outlet = mqtt.Mqtt(f"mqtt://127.0.0.1:{there.port}/field/north")
    outlet.take(ALERT)
    outlet.step([source(flying(events=[hexa_event()]))])
    until(lambda: there.of("field/north/udp:14550-1/alert"))
    until(lambda: ("field/north/status", "online", False) in there.got)

    def stated():
        outlet.step([source(flying(events=[hexa_event()]))])
        time.sleep(0.05)
        return bool(there.of("field/north/udp:14550-1/state"))

    until(stated)
    outlet.leave()
    assert there.of("field/north/udp:14550-1/alert") == [ALERT]
    said = there.of("field/north/udp:14550-1/state")[0]
    assert said["state"] == "FAULT" and said["vehicle"] == "udp:14550/1" and said["messages_lost"] == 5
    assert [r["rotor"] for r in said["rotors"]] == [1, 2, 3, 4, 5, 6] and said["rotors"][2]["loss"] == pytest.approx(0.371)
    assert said["events"][0]["rotors"] == [3]
    there.subscribe()  # later: what the broker has kept
    until(lambda: len({topic for topic, _, retained in there.got if retained}) == 2)
    kept = {topic: text for topic, text, retained in there.got if retained}
    assert kept["field/north/status"] == "offline" and json.loads(kept["field/north/udp:14550-1/state"]) == said


@broker_needed
def test_alerts_wait_for_a_broker_that_is_not_there_yet(broker):
    there, reported = broker(), []
    outlet = mqtt.Mqtt(f"mqtt://127.0.0.1:{there.port}", reported.append)
    for number in range(20):
        outlet.take({**ALERT, "number": number})

    def said():
        outlet.step([])
        return bool(reported)

    until(said)
    assert "cannot be reached" in reported[0] and str(there.port) in reported[0]
    there.start()
    there.subscribe()
    until(lambda: len(there.of("rotorwatch/udp:14550-1/alert")) == 20)
    outlet.leave()
    assert [a["number"] for a in there.of("rotorwatch/udp:14550-1/alert")] == [*range(20)]
    assert len(reported) == 2 and "connected again" in reported[1]


@broker_needed
def test_a_broker_says_itself_that_a_killed_watch_is_gone(broker):
    there = broker().start()
    there.subscribe()
    outlet = mqtt.Mqtt(f"mqtt://127.0.0.1:{there.port}")
    until(lambda: ("rotorwatch/status", "online", False) in there.got)
    outlet._broker._client._sock.shutdown(socket.SHUT_RDWR)
    until(lambda: ("rotorwatch/status", "offline", False) in there.got)
    outlet.leave()


@broker_needed
def test_a_password_opens_a_broker_and_a_wrong_one_is_said(broker, tmp_path):
    users = tmp_path / "users"
    users.touch(0o600)
    tool = shutil.which("mosquitto_passwd")
    if tool is None:
        pytest.skip("mosquitto_passwd is not installed")
    subprocess.run([tool, "-b", str(users), "me", "a:b/c"], check=True, capture_output=True)
    there = broker("allow_anonymous false", f"password_file {users}", "user root").start()
    there.subscribe("me", "a:b/c")
    right = mqtt.Mqtt(f"mqtt://me:a%3Ab%2Fc@127.0.0.1:{there.port}")
    right.take(ALERT)
    until(lambda: there.of("rotorwatch/udp:14550-1/alert"))
    right.leave()
    reported = []
    wrong = mqtt.Mqtt(f"mqtt://me:secret@127.0.0.1:{there.port}", reported.append)
    wrong.take(ALERT)

    def said():
        wrong.step([])
        return bool(reported)

    until(said)
    wrong.leave()
    assert "refuses the connection" in reported[0] and "secret" not in "".join(reported)
    assert "last alerts could not be sent" in reported[-1]


@pytest.mark.parametrize("url", ["broker", "http://broker", "mqtt://", "mqtt://host:port", "mqtt://[::1"])
def test_what_is_no_address_is_said(url):
    with pytest.raises(ConfigError, match=r"--mqtt .*: give mqtt"):
        mqtt.Mqtt(url)


@broker_needed
def test_watch_publishes_a_replayed_flight(broker):
    there = broker().start()
    there.subscribe()
    sample = cli.SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"
    with pytest.raises(SystemExit) as left:
        cli.main(["watch", str(sample), "--speed", "max", "--mqtt", f"mqtt://127.0.0.1:{there.port}", "--quiet", "--jsonl"])
    assert left.value.code == 1
    alerts = there.of(f"rotorwatch/{sample.name}/alert")
    assert [a["event"]["rotors"] for a in alerts if a["type"] == "event"][-1] == [3]
    assert "offline" in [text for topic, text, _ in there.got if topic == "rotorwatch/status"]


@broker_needed
def test_a_fleet_publishes_new_flights_and_the_aircraft_that_changed(broker, tmp_path, run):
    pytest.importorskip("sqlalchemy")
    there = broker().start()
    there.subscribe()
    sample = cli.SAMPLES / "quadx_healthy_hover.bin.xz"
    address, store = f"mqtt://127.0.0.1:{there.port}/site", tmp_path / "fleet.db"
    broken = tmp_path / "broken.bin"
    broken.write_bytes(b"\xa3\x95\x80" + bytes(200))
    for more in ((), (broken,)):
        run("fleet", "add", sample, *more, "--aircraft", "north/1", "--mqtt", address, "--store", store)
    flights = there.of("site/fleet/flight")
    assert [(f["state"], f["aircraft"], f["verdict"]) for f in flights] == [("added", "north/1", "healthy"), ("failed", "", "")]
    said = there.of("site/fleet/north-1/state")
    assert len(said) == 2 and said[0] == said[1] and said[0]["flights"] == 1 and len(said[0]["rotors"]) == 4
    assert [text for topic, text, _ in there.got if topic == "site/status"] == ["online", "offline"] * 2
