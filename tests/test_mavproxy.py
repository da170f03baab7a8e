"""`module load rotorwatch` in MAVProxy: against a stand-in with its interface (1.8.75), and against MAVProxy where it is installed."""

import importlib.util
import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from tests.mavlink_vehicle import HEXA, Autopilot, messages

import rotorwatch as rw
from rotorwatch import logs
from rotorwatch.commands import cli
from rotorwatch.live import mavproxy, requests

SAMPLE = cli.SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"
SOURCE = str(Path(rw.__file__).parents[1])


class Console:
    """MAVProxy's console: what is written, and the fields above it."""

    def __init__(self):
        self.lines, self.fields = [], {}

    def writeln(self, text, fg="black", bg="white"):
        self.lines.append((text, fg))

    def set_status(self, name, text="", row=0, fg="black", bg="white"):
        self.fields[name] = text, fg


class Map:
    def __init__(self):
        self.objects = {}

    def icon(self, name):
        return name

    def add_object(self, one):
        self.objects[one.key] = one

    def remove_object(self, key):
        self.objects.pop(key, None)


class Master:
    """A link. wire: what the vehicle answers."""

    def __init__(self, number, answer=lambda data: b""):
        self.linknum, self.sysid_state, self.written = number, {}, []
        self._answer, self.answers = answer, []

    def write(self, data):
        self.written.append(bytes(data))
        self.answers.append(self._answer(bytes(data)))

    def post(self, m):
        """What mavutil.post_message keeps of a message, with its instances."""
        known = self.sysid_state.setdefault(m.get_srcSystem(), SimpleNamespace(messages={})).messages
        kind, part = m.get_type(), m._instance_field
        if part is None or getattr(m, part, None) is None:
            known[kind] = m
            return
        instances = getattr(known.get(kind), "_instances", None) or {}
        instances[getattr(m, part)] = m
        known[kind] = SimpleNamespace(_instances=instances)


class MPModule:
    """MAVProxy.modules.lib.mp_module.MPModule, as far as modules use it."""

    def __init__(self, mpstate, name, description=None, public=False, multi_instance=False, multi_vehicle=False):
        self.mpstate, self.name, self.description, self.multi_vehicle = mpstate, name, description, multi_vehicle
        self.needs_unloading = False
        if public:
            mpstate.public_modules[name] = self

    def unload(self):
        pass

    def module_matching(self, name):
        from fnmatch import fnmatch

        return [found for key, found in self.mpstate.public_modules.items() if fnmatch(key, name)]

    @property
    def console(self):
        return self.mpstate.console

    @property
    def settings(self):
        return self.mpstate.settings

    def add_command(self, name, callback, description, completions=None):
        self.mpstate.command_map[name] = callback, description

    def remove_command(self, name):
        del self.mpstate.command_map[name]


@pytest.fixture(autouse=True)
def _stand_in(tmp_path, monkeypatch):
    names = ("MAVProxy", "MAVProxy.modules", "MAVProxy.modules.lib", "MAVProxy.modules.mavproxy_map")
    for name in names:
        package = ModuleType(name)
        package.__path__ = []
        monkeypatch.setitem(sys.modules, name, package)
    base = ModuleType("MAVProxy.modules.lib.mp_module")
    base.MPModule = MPModule
    slip = ModuleType("MAVProxy.modules.mavproxy_map.mp_slipmap")
    slip.SlipIcon = lambda key, latlon, img, layer=1, rotation=0, label=None, colour=None: SimpleNamespace(
        key=key, latlon=latlon, img=img, layer=layer, label=label, colour=colour
    )
    monkeypatch.setitem(sys.modules, base.__name__, base)
    monkeypatch.setitem(sys.modules, slip.__name__, slip)
    sys.modules["MAVProxy.modules.lib"].mp_module = base
    sys.modules["MAVProxy.modules.mavproxy_map"].mp_slipmap = slip
    monkeypatch.setattr(requests, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(requests, "MISSING_S", 0.02)
    monkeypatch.setattr(requests, "LIST_S", 0.1)


@pytest.fixture(scope="module")
def flight():
    return logs.read(SAMPLE).until(60.0)


def state(*masters):
    return SimpleNamespace(
        console=Console(), public_modules={}, command_map={}, mav_master=list(masters), settings=SimpleNamespace(streamrate=4)
    )


def turns(module, until, seconds=20.0):
    """MAVProxy's loop, until something holds."""
    ends = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < ends, module.mpstate.console.lines
        module.idle_task()
        time.sleep(0.002)


def parsed(data):
    """Messages as MAVProxy hands them on, with the bytes they came in."""
    return mavlink.MAVLink(None).parse_buffer(bytes(data)) or []


def positions(flight, boot_s=30.0):
    """It flies north, 1e-5 degrees in half a second."""
    for k in range(int(flight.duration * 2)):
        ms = int((k * 0.5 + boot_s) * 1e3)
        at = round((47.0 + 1e-5 * k) * 1e7), round(8.0 * 1e7)
        yield k * 0.5, mavlink.MAVLink_global_position_int_message(ms, *at, 0, 0, 0, 0, 0, 0)


def packets(flight, pilot):
    timed = sorted([*messages(flight, kind=HEXA), *positions(flight)], key=lambda pair: pair[0])
    return [(time_s, pilot.packed(message)) for time_s, message in timed]


def parameters(flight):
    return {n: v for n, v in flight.parameters.items() if n.startswith(("FRAME", "MOT_", "SERVO")) and len(n) <= 16}


def hand(module, master, data):
    for m in parsed(data):
        master.post(m)
        module.mavlink_packet(m)


def fly(flight, *maps, more=()):
    """(module, state, master) after a flight in which rotor 3 fails at about 47 s. The module talks to the vehicle."""
    pilot = Autopilot(parameters(flight))
    master = Master(0, pilot.answer)
    mpstate = state(master, *more)
    for number, one in enumerate(maps):
        mpstate.public_modules[f"map{number}"] = SimpleNamespace(map=one)
    module = rw.init(mpstate)
    sent = packets(flight, pilot)

    def answer():
        while master.answers:
            hand(module, master, master.answers.pop(0))

    for _, data in sent[:200]:
        hand(module, master, data)

    def known():
        answer()
        return any("ardupilot-hexa-x, 6 rotors" in line for line, _ in mpstate.console.lines)

    turns(module, known)
    for k, (_, data) in enumerate(sent[200:]):
        hand(module, master, data)
        if k % 50 == 0:
            module.idle_task()
            answer()
            time.sleep(0.002)

    def assessed():
        answer()
        rates = [m for m in pilot.asked if m.get_type() == "COMMAND_LONG" and m.command == 511]
        acknowledged = len(rates) > 1 or not pilot.asked  # the second rate is requested after the answer to the first
        return acknowledged and any("rotor 3 lost" in line for line, _ in mpstate.console.lines)

    turns(module, assessed)
    return module, mpstate, master


def test_events_come_to_the_console_and_the_map(flight):
    early, late = Map(), Map()
    module, mpstate, master = fly(flight, early)
    try:
        ((line, colour), *_) = [pair for pair in mpstate.console.lines if "rotor 3 lost" in pair[0]]
        assert colour == "orange" and line.startswith("rotorwatch: rotor 3 lost") and "(vehicle 1, announced, 47." in line
        turns(module, lambda: mpstate.console.fields.get("rotorwatch 1", ("",))[0].startswith("RW 1: FAULT rotor 3"))
        assert mpstate.console.fields["rotorwatch 1"][1] == "red"
        # At the place where it began, not where the vehicle is now.
        ((key, marker),) = early.objects.items()
        onset = float(line.split("announced, ")[1].split(" s)")[0])
        assert marker.latlon == pytest.approx((47.0 + 1e-5 * 2 * onset, 8.0), abs=3e-5)
        assert marker.label.startswith("rotor 3 lost") and marker.img == "flag.png" and marker.colour == (255, 165, 0)
        # A map that is opened later shows it as well.
        mpstate.public_modules["map9"] = SimpleNamespace(map=late)
        turns(module, lambda: late.objects)
        assert late.objects[key].label == marker.label
        mpstate.command_map["rotorwatch"][0](["status"])
        assert "vehicle 1: FAULT rotor 3" in mpstate.console.lines[-1][0]
        mpstate.command_map["rotorwatch"][0](["clear"])
        assert not early.objects and not late.objects
        asked = {m.get_type() for data in master.written for m in parsed(data)}
        assert asked == {"PARAM_REQUEST_LIST", "COMMAND_LONG"}  # no heartbeat: MAVProxy has its own
        before = len(master.written)
    finally:
        module.unload()
    assert "rotorwatch" not in mpstate.command_map and not module._watcher._thread.is_alive()
    assert len(master.written) > before  # rates as they were
    assert any("final" in line for line, _ in mpstate.console.lines)


def test_nothing_is_sent_when_it_only_listens(flight):
    pilot, master = Autopilot(parameters(flight)), Master(0)
    mpstate = state(master)
    module = rw.init(mpstate, listen_only=True)
    for _, data in packets(flight.until(5.0), pilot):
        hand(module, master, data)
    hand(module, master, b"".join(pilot.packed(pilot._value(k)) for k in range(len(pilot._values))))
    turns(module, lambda: module._watcher.states)
    module.unload()
    assert master.written == [] and not any("streamrate" in line for line, _ in mpstate.console.lines)


def test_no_exception_reaches_mavproxy_and_its_loop_never_waits(flight, monkeypatch):
    """A console, a map and a master that fail, messages that are none, and assessing that fails or hangs."""

    class Broken:
        def __getattr__(self, name):
            raise RuntimeError("broken")

    pilot, master = Autopilot(parameters(flight)), Master(0)
    mpstate = state(master)
    module = rw.init(mpstate)
    from rotorwatch.live.link import Link

    monkeypatch.setattr(Link, "poll", lambda self, wait_s: time.sleep(0.5) or 1 / 0)
    longest = 0.0
    sent = packets(flight.until(20.0), pilot)
    for k, (_, data) in enumerate(sent):
        if k == 300:
            mpstate.console = Broken()
            mpstate.public_modules["map"] = SimpleNamespace(map=Broken())
            module._watcher.news.append(mavproxy.News("x", 2, "key", "x", (1.0, 2.0)))
            module._handed.sent.append((0, b"x"))
            master.write = None
        if k % 100 == 0:
            module.mavlink_packet(SimpleNamespace(get_type=lambda: "ATTITUDE"))
            module.mavlink_packet(None)
        (m,) = parsed(data)
        began = time.perf_counter()
        module.mavlink_packet(m)
        module.idle_task()
        longest = max(longest, time.perf_counter() - began)
    assert longest < 0.2  # nothing of the half second, on a busy computer either
    mpstate.console = Console()
    turns(module, lambda: any("ZeroDivisionError" in line for line, _ in mpstate.console.lines))
    began = time.monotonic()
    module.unload()
    assert time.monotonic() - began < 5.0  # MAVProxy waits so long


def test_a_thread_that_has_ended_begins_again(flight, monkeypatch):
    monkeypatch.setattr(mavproxy, "AGAIN_S", 0.05)
    from rotorwatch.live import watch

    failing = [True]
    made = watch.Guarded.poll
    monkeypatch.setattr(watch.Guarded, "poll", lambda self, wait_s: 1 / 0 if failing else made(self, wait_s))
    mpstate = state(Master(0))
    module = rw.init(mpstate)
    turns(module, lambda: any("an internal error of rotorwatch" in line for line, _ in mpstate.console.lines))
    failing.clear()
    pilot = Autopilot(parameters(flight))
    (beat,) = [data for _, data in packets(flight.until(1.0), pilot) if parsed(data)[0].get_type() == "HEARTBEAT"][:1]
    hand(module, mpstate.mav_master[0], beat)

    def known():
        hand(module, mpstate.mav_master[0], beat)
        return module._watcher.states

    turns(module, known)
    module.unload()


def test_a_vehicle_file_that_is_none_is_said(tmp_path):
    mpstate = state(Master(0))
    module = rw.init(mpstate, vehicle=str(tmp_path / "none.toml"))
    turns(module, lambda: any("none.toml" in line for line, _ in mpstate.console.lines))
    module.unload()


def test_two_links_to_one_vehicle_are_reported_apart(flight):
    """Each link numbers its frames for itself: as one they would look like two vehicles."""
    other = Master(1)
    pilot = Autopilot(parameters(flight))
    masters = Master(0), other
    mpstate = state(*masters)
    module = rw.init(mpstate, listen_only=True)
    second = Autopilot(parameters(flight))
    for _ in range(77):
        second.packed(mavlink.MAVLink_system_time_message(0, 0))
    seen = []
    put = module._handed.put
    module._handed.put = lambda link, frame: (seen.append(link), put(link, frame))
    for (_, one), (_, two) in zip(packets(flight.until(8.0), pilot), packets(flight.until(8.0), second)):
        hand(module, masters[0], one)
        hand(module, masters[1], two)
    assert seen == [0, 1] * (len(seen) // 2)
    turns(module, lambda: any("second address" in line for line, _ in mpstate.console.lines))
    module.unload()
    assert not any("two vehicles" in line for line, _ in mpstate.console.lines)


def test_a_replayed_log_gets_no_requests():
    kind = type("mavlogfile", (Master,), {})
    mpstate = state(kind(0))
    module = rw.init(mpstate)
    assert not module._watcher._talks and mpstate.console.lines == []
    module.unload()


def test_frames_that_nobody_takes_have_an_end():
    handed = mavproxy.Handed()
    for k in range(mavproxy.FRAMES + 5):
        handed.put(0, k.to_bytes(4, "little"))
    assert len(handed._frames) == mavproxy.FRAMES and len(handed.receive()) == 500
    for _ in range(mavproxy.SENT + 5):
        handed.send(b"x", 0)
    assert len(handed.sent) == mavproxy.SENT


def test_places_by_the_vehicles_own_clock():
    places = mavproxy.Places()
    assert places.find(1, 0) is None
    for k in range(10):
        places.add(1, k * 100, 47.0 + k, 8.0)
    places.add(1, 5000, 0.0, 0.0)  # no position yet
    assert places.find(1, 480) == (52.0, 8.0) and places.find(1, 10**6) == (52.0, 8.0) and places.find(2, 0) is None
    places.add(1, 10, 1.0, 2.0)  # rebooted
    assert places.find(1, 480) == (1.0, 2.0)


def test_a_marker_goes_when_its_event_is_withdrawn():
    shown = Map()
    panel = mavproxy.Shown(Console, lambda: [shown])
    panel.marker(mavproxy.News("a", 2, "k", "rotor 3", (1.0, 2.0)))
    panel.marker(mavproxy.News("b", 2, "k", "rotor 2", (5.0, 6.0)))  # the same event stays where it began
    assert shown.objects["k"].label == "rotor 2" and shown.objects["k"].latlon == (1.0, 2.0)
    panel.marker(mavproxy.News("c", 5, "k", "rotor 2", gone=True))
    assert not shown.objects
    for k in range(mavproxy.MARKERS + 3):
        panel.marker(mavproxy.News("a", 2, f"k{k}", "x", (1.0, 2.0)))
    assert len(shown.objects) == mavproxy.MARKERS


LOAD = """
import sys
from types import ModuleType
from importlib import reload

class MPModule:
    def __init__(self, mpstate, name, *args, **kwargs):
        self.mpstate, self.name = mpstate, name

for name in ("MAVProxy", "MAVProxy.modules", "MAVProxy.modules.lib"):
    sys.modules[name] = ModuleType(name)
    sys.modules[name].__path__ = []
sys.modules["MAVProxy.modules.lib.mp_module"] = sys.modules["MAVProxy.modules.lib"].mp_module = ModuleType("mp_module")
sys.modules["MAVProxy.modules.lib.mp_module"].MPModule = MPModule
MPModule.add_command = MPModule.remove_command = lambda *args: None
MPModule.unload = lambda self: None
MPModule.console = type("Console", (), {"writeln": lambda self, text, fg="": None})()
MPModule.settings = None
MPModule.module_matching = lambda self, name: []

class State:
    mav_master = []

# As MAVProxy.load_module does it, twice as for `module reload`.
for _ in range(2):
    m = __import__("rotorwatch")
    reload(m)
    module = m.init(State())
    assert isinstance(module, MPModule) and module.name == "rotorwatch"
    slow = {"numpy", "jax", "rich", "pandas"} & set(sys.modules) if not _ else ()
    module.unload()
print("loaded")
"""


def test_mavproxy_finds_it_by_its_name():
    done = subprocess.run(
        [sys.executable, "-c", LOAD], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": SOURCE}, timeout=120
    )
    assert done.stdout == "loaded\n", done.stderr


@pytest.mark.skipif(importlib.util.find_spec("MAVProxy") is None, reason="MAVProxy is not installed here: `pip install MAVProxy`")
def test_in_mavproxy_itself(tmp_path):
    script = shutil.which("mavproxy.py", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    assert script is not None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, script, f"--master=udpin:127.0.0.1:{port}", "--default-modules=link,param", "--force-connected"]
    process = subprocess.Popen(
        [*command, "--cmd=module load rotorwatch", f"--logfile={tmp_path / 'm.tlog'}"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, env={**os.environ, "PYTHONPATH": SOURCE, "HOME": str(tmp_path)}, cwd=tmp_path,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    said = ""
    for line in process.stdout:
        said += line
        if "Waiting for heartbeat" in line:
            break
    time.sleep(2.0)
    for command in ("rotorwatch status", "module reload rotorwatch", "module unload rotorwatch", "exit"):
        process.stdin.write(f"{command}\n")
        process.stdin.flush()
        time.sleep(2.0)
    said += process.communicate(timeout=60)[0]
    assert "Loaded module rotorwatch" in said and "no vehicle is known yet" in said
    assert "Reloaded module rotorwatch" in said and "Unloaded module rotorwatch" in said and "Traceback" not in said
    drawn = subprocess.run([sys.executable, "-c", MARKER], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": SOURCE})
    assert drawn.stdout == "drawn\n", drawn.stderr


# The marker as MAVProxy's map draws it, without its window.
MARKER = """
import importlib.machinery
import sys
from unittest.mock import MagicMock
wx = sys.modules["wx"] = MagicMock()  # the window's library
wx.__spec__ = importlib.machinery.ModuleSpec("wx", None)
import numpy as np
from MAVProxy.modules.mavproxy_map import mp_tile
from rotorwatch.live import mavproxy

class Map:
    def icon(self, name):
        return mp_tile.mp_icon(name)
    def add_object(self, one):
        image = np.zeros((200, 400, 3), np.uint8)
        one.draw(image, lambda place: (100, 100), None)
        assert image.any()
        print("drawn")

mavproxy.Shown(None, lambda: [Map()]).marker(mavproxy.News("a", 2, "k", "rotor 3 lost 37 %", (47.0, 8.0)))
"""
