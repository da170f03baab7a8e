"""Alerts that go further than the screen: to a web address, to Prometheus, to ground stations."""

import json
import math
import socket
import threading
import time
import urllib.request
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from tests.conftest import hexa_event

from rotorwatch.commands import cli
from rotorwatch.engine.events.words import INFO
from rotorwatch.errors import ConfigError
from rotorwatch.live import endpoint, ground
from rotorwatch.live.channels import metrics, tell_ground, webhook
from rotorwatch.live.link import Link
from rotorwatch.live.watched import Watched


class Server:
    """An HTTP server in a thread that answers with `codes`, one after the other, then 200."""

    def __init__(self, codes=()):
        self.got, self.asked, waiting = [], 0, list(codes)
        server = self

        class Answer(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                server.asked += 1
                code = waiting.pop(0) if waiting else 200
                if code == 200:
                    server.got.append(json.loads(body))
                self.send_response(code)
                self.send_header("Location", "http://127.0.0.1:9/elsewhere")
                self.end_headers()

            def log_message(self, *_):
                pass

        self._server = HTTPServer(("127.0.0.1", 0), Answer)
        self.url = f"http://127.0.0.1:{self._server.server_port}/alerts"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def close(self):
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def served():
    made = []

    def make(*codes):
        made.append(Server(codes))
        return made[-1]

    yield make
    for server in made:
        server.close()


def until(true, most_s=20.0):
    began = time.monotonic()
    while not true() and time.monotonic() - began < most_s:
        time.sleep(0.005)
    assert true()


def test_what_fails_is_sent_again_and_nothing_is_lost_or_doubled(served):
    server, reported = served(500, 503, 429), []
    hook = webhook.Webhook(server.url, reported.append, pause_s=0.01)
    alerts = [{"type": "notice", "vehicle": "a", "text": str(k)} for k in range(20)]
    for alert in alerts:
        hook.take(alert)
    until(lambda: hook.sent == 20)
    hook.leave()
    assert server.got == alerts and server.asked == 23
    assert len(reported) == 2 and "does not accept alerts (500" in reported[0] and "accepts alerts again" in reported[1]


def test_what_is_refused_for_good_is_said_once_and_holds_nothing_up(served):
    server, reported = served(404, 301, 200), []
    hook = webhook.Webhook(server.url, reported.append)
    for k in range(3):
        hook.take({"number": k})
    until(lambda: hook.sent == 1)
    hook.leave()
    assert server.got == [{"number": 2}] and hook.refused == 2
    assert len(reported) == 1 and "refuses alerts (404" in reported[0]


def test_an_address_that_nobody_answers_costs_the_oldest_alerts_only(monkeypatch):
    monkeypatch.setattr(webhook, "MOST", 10)
    monkeypatch.setattr(webhook, "LAST_S", 0.1)
    reported = []
    hook = webhook.Webhook("http://127.0.0.1:9/", reported.append)
    for k in range(50):
        hook.take({"number": k})
    assert hook.dropped == 40
    hook.leave()
    assert "could not be sent" in reported[-1] and "10 alerts" in reported[-1]


@pytest.mark.parametrize("url", ["alerts.example", "ftp://example/", "http://"])
def test_what_is_no_address_is_said(url):
    with pytest.raises(ConfigError, match="begins with http:// or https://"):
        webhook.Webhook(url)


def flying(name="udp:14550/1", losses=(0.0, 0.0, 0.371, 0.0, 0.0, 0.0), events=()):
    """A vehicle that is being assessed, as far as outlets see one."""
    watched = Watched(name, lambda alert: None)
    loss = np.array(losses)
    watched.session = SimpleNamespace(
        losses=lambda: (loss, np.clip(loss - 0.05, 0, 1), loss + 0.05), flying=True, ticks=123, blind=lambda: "", now=40.0
    )  # fmt: skip
    watched.health.taken, watched.health.lost = 95, 5
    watched.changes.since_last(events)
    return watched


def source(*watched):
    return SimpleNamespace(shown=lambda: [(w, "") for w in watched], vehicles=watched)


def scraped(page):
    with urllib.request.urlopen(f"http://127.0.0.1:{page.port}/metrics") as answer:
        lines = answer.read().decode().splitlines()
    return dict(line.rsplit(" ", 1) for line in lines if not line.startswith("#"))


def test_a_scrape_says_what_is_known_of_each_vehicle():
    page = metrics.Metrics("0")
    try:
        assert scraped(page) == {}
        page.step([source(flying(events=[hexa_event()]), flying('odd"name\\\n', losses=(0.0,) * 4))])
        said = scraped(page)
    finally:
        page.leave()
    who = 'vehicle="udp:14550/1"'
    assert float(said[f'rotorwatch_rotor_loss{{rotor="3",{who}}}']) == pytest.approx(0.371)
    assert float(said[f'rotorwatch_rotor_loss_upper{{rotor="3",{who}}}']) == pytest.approx(0.421)
    assert said[f'rotorwatch_state{{state="FAULT",{who}}}'] == "1.0"
    assert said[f'rotorwatch_state{{state="OK",{who}}}'] == "0.0"
    assert said[f"rotorwatch_ticks_assessed_total{{{who}}}"] == "123.0"
    assert said[f"rotorwatch_messages_lost_total{{{who}}}"] == "5.0"
    assert float(said[f"rotorwatch_link_loss{{{who}}}"]) == pytest.approx(0.05)
    assert 0.0 <= float(said[f"rotorwatch_message_age_seconds{{{who}}}"]) < 60.0
    assert said[f'rotorwatch_events{{kind="loss_of_effectiveness",{who}}}'] == "1.0"
    assert 'rotorwatch_state{state="OK",vehicle="odd\\"name\\\\\\n"}' in said


def test_connections_that_ask_nothing_keep_no_thread(monkeypatch):
    monkeypatch.setattr(metrics, "CONNECTIONS", 4)
    before = threading.active_count()
    page = metrics.Metrics("0")
    try:
        idle = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(40)]
        assert scraped(page) == {}
        until = time.monotonic() + 5.0
        while (over := threading.active_count() - before > 6) and time.monotonic() < until:
            time.sleep(0.01)
        assert not over
    finally:
        page.leave()
    for sock in idle:
        sock.close()


def test_a_page_that_cannot_be_opened_is_said():
    with pytest.raises(ConfigError, match="give a port, or HOST:PORT"):
        metrics.Metrics("everywhere")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        with pytest.raises(ConfigError, match="is another program using this port"):
            metrics.Metrics(str(taken.getsockname()[1]))


class Wire(endpoint.Endpoint):
    def __init__(self):
        super().__init__("udp:14550")
        self.open, self.sent, self._parse = True, [], mavlink.MAVLink(None)
        self.queue = []

    def receive(self, wait_s=0.0):
        queue, self.queue = self.queue, []
        return queue

    def send(self, data, peer=None):
        self.sent += self._parse.parse_buffer(data) or []


@pytest.fixture
def reported():
    """(ground, link, wire, the clock's time in a list): one vehicle of system 7 on a link, in flight."""
    now = [1000.0]
    wire = Wire()
    link = Link(wire, lambda alert: None, patience_s=math.inf)
    pack = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    wire.queue = [("a", mavlink.MAVLink_heartbeat_message(13, 3, 0x80, 0, 4, 3).pack(pack))]
    link.poll(0.0)
    (watched,) = link.vehicles
    watched.session = flying().session
    wire.sent.clear()
    return tell_ground.Ground(lambda: now[0]), link, wire, now


def alert(number=1, state="announced", **event):
    return {"type": "event", "vehicle": "udp:14550/7", "number": number, "state": state, "event": hexa_event(**event).to_dict()}


def texts(wire):
    return [(m.severity, m.text) for m in wire.sent if m.get_type() == "STATUSTEXT"]


def test_a_fault_is_reported_in_plain_words_and_again_only_when_it_has_changed_much(reported):
    outlet, link, wire, now = reported

    def step(*alerts, wait=30.0):
        for one in alerts:
            outlet.take(one)
        wire.sent.clear()
        now[0] += wait
        outlet.step([link])
        return texts(wire)

    assert step(alert()) == [(ground.WARNING, "rotorwatch: rotor 3 lost 37 % (33-41)")]
    assert step() == []
    assert step(alert(state="changed", loss=(0.41,))) == []
    assert step(alert(state="changed", loss=(0.48,))) == [(ground.WARNING, "rotorwatch: rotor 3 lost 48 % (33-41)")]
    assert step(alert(state="changed", loss=(0.40,))) == []
    assert step(alert(state="changed", alternatives=((4,),))) == [(ground.WARNING, "rotorwatch: rotor 3 lost 37 % (33-41) or 4")]
    assert step(alert(state="changed", end_s=40.0)) == [(INFO, "rotorwatch: rotor 3 lost 37 % (33-41) is over")]
    assert step(alert(state="withdrawn")) == [(INFO, "rotorwatch: rotor 3 lost 37 % (33-41) withdrawn")]
    assert step(alert(number=2), alert(number=2, state="withdrawn")) == []  # gone before it was said


@pytest.mark.parametrize(
    "event, state, severity, words",
    [
        ({"rotors": (2,), "cause": "rotor"}, "announced", ground.CRITICAL, "LOSS OF CONTROL, rotor 2"),
        ({"rotors": (2,), "alternatives": ((3,),), "cause": "unknown"}, "announced", ground.CRITICAL, "LOSS OF CONTROL, rotor 2 or 3"),
        ({"cause": "disarmed"}, "announced", ground.CRITICAL, "LOSS OF CONTROL, motors stopped"),
        ({"cause": "unknown"}, "changed", ground.CRITICAL, "LOSS OF CONTROL"),
        ({"cause": "knock", "end_s": 33.0, "impact_s": 33.0}, "final", ground.CRITICAL, "LOSS OF CONTROL, collision"),
        ({"cause": "knock", "end_s": 33.0, "impact_s": None}, "changed", INFO, "LOSS OF CONTROL, collision is over"),
        ({"rotors": (2,), "cause": "rotor"}, "withdrawn", INFO, "LOSS OF CONTROL, rotor 2 withdrawn"),
        ({"kind": "motor_order", "rotors": (1, 2)}, "announced", ground.CRITICAL, "rotors 1+2 wrong motor order"),
    ],
)  # fmt: skip
def test_a_loss_of_control_is_critical_and_its_cause_is_reported(event, state, severity, words):
    reported = {k: v for k, v in event.items() if k not in ("cause", "impact_s")}
    extra = {k: v for k, v in event.items() if k in ("cause", "impact_s")}
    reported = {"kind": "loss_of_control", "rotors": (), "loss": (), "interval": (), **reported, "extra": extra}
    said = alert(state=state, **reported)
    assert ground.text_of(said) == (f"rotorwatch: {words}", severity)


def test_a_cause_that_is_known_later_is_reported_again(reported):
    outlet, link, wire, now = reported
    for rotors, cause in (((), "unknown"), ((2,), "rotor"), ((2,), "rotor")):
        outlet.take(alert(kind="loss_of_control", rotors=rotors, loss=(), interval=(), extra={"cause": cause}))
        now[0] += 30.0
        outlet.step([link])
    assert [text for _, text in texts(wire)] == ["rotorwatch: LOSS OF CONTROL", "rotorwatch: LOSS OF CONTROL, rotor 2"]


def test_texts_are_few_and_the_worst_comes_first(reported):
    outlet, link, wire, now = reported
    outlet.take(alert(number=1, kind="contact", rotors=(), loss=(), interval=(), end_s=31.2))
    outlet.take(alert(number=2))
    outlet.step([link])
    outlet.step([link])
    assert texts(wire) == [(ground.WARNING, "rotorwatch: rotor 3 lost 37 % (33-41)")]
    now[0] += tell_ground.PAUSE_S
    outlet.step([link])
    assert texts(wire)[1:] == [(ground.NOTICE, "rotorwatch: contact or collision")]
    wire.sent.clear()
    for k in range(600):  # a minute of an event that never rests
        outlet.take(alert(number=2, state="changed", loss=(0.2 if k % 2 else 0.8,)))
        now[0] += 0.1
        outlet.step([link])
    assert len(texts(wire)) <= tell_ground.A_MINUTE


def test_values_of_each_rotor_come_once_a_second_and_nothing_is_a_command(reported):
    outlet, link, wire, now = reported
    outlet.take(alert())
    for _ in range(100):
        now[0] += 0.1
        outlet.step([link])
    values = [m for m in wire.sent if m.get_type() == "NAMED_VALUE_FLOAT"]
    assert 9 * 6 <= len(values) <= 11 * 6 and {m.name for m in values} == {f"rw_loss{k}" for k in range(1, 7)}
    assert next(m.value for m in values if m.name == "rw_loss3") == pytest.approx(0.371)
    events = {"UNKNOWN_410", "UNKNOWN_411"}  # of this dialect: EVENT, CURRENT_EVENT_SEQUENCE
    assert {m.get_type() for m in wire.sent} == {"HEARTBEAT", "NAMED_VALUE_FLOAT", "STATUSTEXT", *events}
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in wire.sent if m.get_type() not in events} == {(7, 191)}


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("kind", ["loss_of_effectiveness", "output_override", "motor_order"])
def test_words_fit_one_message(count, kind):
    event = hexa_event(
        kind=kind, rotors=tuple(range(10, 10 + count)), loss=(1.0,) * count, interval=((0.99, 1.0),) * count,
        alternatives=((11, 12), (7, 8, 9)),
    )  # fmt: skip
    for state in ("announced", "withdrawn"):
        said, _ = ground.text_of({"type": "event", "state": state, "event": event.to_dict()})
        assert said.isascii() and len(said) <= 50 and "10" in said


def test_a_second_client_sees_the_text(reported):
    """Over UDP: a vehicle and a ground station on one port; the station hears what the watcher tells."""
    outlet, _, _, _ = reported
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    link = Link(endpoint.open_endpoint(f"udpin:127.0.0.1:{port}"), lambda alert: None)
    vehicle, station = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    with vehicle, station:
        for sock, message, who in (
            (vehicle, mavlink.MAVLink_heartbeat_message(13, 3, 0x80, 0, 4, 3), 7),
            (station, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), 255),
        ):
            sock.sendto(message.pack(mavlink.MAVLink(None, srcSystem=who, srcComponent=1)), ("127.0.0.1", port))
        station.settimeout(0.02)
        seen, parse = [], mavlink.MAVLink(None)

        def heard():
            link.poll(0.005)
            if link.vehicles and not seen:
                name = link.vehicles[0].name
                outlet.take({**alert(), "vehicle": name})
                outlet.step([link])
            try:
                seen.extend(m for m in parse.parse_buffer(station.recv(2048)) or [] if m.get_type() == "STATUSTEXT")
            except OSError:
                pass
            return bool(seen)

        until(heard)
    link.leave()
    assert seen[0].text == "rotorwatch: rotor 3 lost 37 % (33-41)" and seen[0].get_srcSystem() == 7


@pytest.mark.parametrize(
    "options, says",
    [
        (["--tell-ground", "--listen-only"], "leave out one of them"),
        (["--webhook", "nowhere"], "begins with http"),
        (["--metrics", "x"], "give a port"),
    ],
)
def test_options_that_cannot_be_are_said_in_a_sentence(options, says, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(["watch", "udp:14550", *options])
    said = capsys.readouterr().err
    assert left.value.code == 2 and says in said and "Traceback" not in said
