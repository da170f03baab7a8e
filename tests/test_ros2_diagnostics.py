"""DiagnosticArray on /diagnostics: the messages are those of ROS 2 as rosbags has them, serialised, put into a bag and read back; with
ROS 2 itself where it is installed."""

import importlib.util
import json
import subprocess
import sys
import time
from types import ModuleType, SimpleNamespace

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from tests.conftest import hexa_event
from tests.test_watch_alerts import flying, source

from rotorwatch.commands import cli
from rotorwatch.live import snapshot
from rotorwatch.live.channels import ros2_diagnostics
from rotorwatch.live.watched import Watched

STORE = get_typestore(Stores.ROS2_JAZZY)
ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
SAMPLE = cli.SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz"


@pytest.fixture
def ros(monkeypatch):
    """The part of rclpy that a node needs, with messages of rosbags; holds what was published, as bytes."""
    made = SimpleNamespace(sent=[], args=None, shut=False)
    types = {name.rpartition("/")[2]: kind for name, kind in STORE.types.items() if name.startswith("diagnostic_msgs/msg/")}
    stamp, header = STORE.types["builtin_interfaces/msg/Time"], STORE.types["std_msgs/msg/Header"]

    def array(status):
        return types["DiagnosticArray"](header=header(stamp=stamp(0, 0), frame_id=""), status=status)

    def clock():
        now = time.time_ns()
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: stamp(now // 10**9, now % 10**9)))

    def publisher(kind, topic, depth):
        assert kind is array and topic == "/diagnostics"
        return SimpleNamespace(publish=lambda message: made.sent.append(bytes(STORE.serialize_cdr(message, ARRAY))))

    node = SimpleNamespace(create_publisher=publisher, get_clock=clock, destroy_node=lambda: None)
    rclpy, package, messages = ModuleType("rclpy"), ModuleType("diagnostic_msgs"), ModuleType("diagnostic_msgs.msg")
    rclpy.Context = lambda: SimpleNamespace(try_shutdown=lambda: setattr(made, "shut", True))
    rclpy.SignalHandlerOptions = SimpleNamespace(NO=0)
    rclpy.init = lambda args, context, signal_handler_options: setattr(made, "args", args)
    rclpy.create_node = lambda name, context: node
    messages.DiagnosticStatus, messages.KeyValue, messages.DiagnosticArray = types["DiagnosticStatus"], types["KeyValue"], array
    package.msg = messages
    for module in (rclpy, package, messages):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return made


def received(ros):
    return [STORE.deserialize_cdr(data, ARRAY) for data in ros.sent]


def published(ros, *vehicles):
    outlet = ros2_diagnostics.Diagnostics()
    outlet.step([source(*vehicles)])
    outlet.leave()
    (array,) = received(ros)
    return array


def levels(array):
    kind = STORE.types["diagnostic_msgs/msg/DiagnosticStatus"]
    names = {getattr(kind, name): name for name in ("OK", "WARN", "ERROR", "STALE")}
    return [names[status.level] for status in array.status]


def test_each_rotor_has_a_status_with_its_values(ros):
    array = published(ros, flying(events=[hexa_event()]))
    assert levels(array) == ["ERROR", "OK", "OK", "ERROR", "OK", "OK", "OK"]
    assert abs(array.header.stamp.sec - time.time()) < 60.0 and ros.shut
    third = array.status[3]
    values = {pair.key: pair.value for pair in third.values}
    assert third.name == "rotorwatch: udp:14550/1: rotor 3" and third.hardware_id == "udp:14550/1"
    assert values["loss"] == "0.3710" and values["event"] == "loss_of_effectiveness" and values["event_loss_upper"] == "0.4100"
    assert "rotor 3" in third.message and array.status[1].message == "no loss found"


@pytest.mark.parametrize(
    "events, wanted",
    [
        ([], ["OK"] * 7),
        ([hexa_event(alternatives=((5,),))], ["WARN", "OK", "OK", "WARN", "OK", "WARN", "OK"]),
        ([hexa_event(end_s=38.0)], ["OK"] * 7),
        (
            [hexa_event(kind="loss_of_control", rotors=(2,), extra={"cause": "rotor"}, loss=(), interval=())],
            ["ERROR", "STALE", "ERROR", "STALE", "STALE", "STALE", "STALE"],
        ),
    ],
)
def test_levels_follow_what_is_known(ros, events, wanted):
    assert levels(published(ros, flying(events=events))) == wanted


def test_what_is_not_assessed_is_stale(ros):
    unknown, silent = Watched("udp:14550/2", lambda alert: None), flying()
    silent.health.last_frame -= 60.0
    silent.session.flying = False
    array = published(ros, unknown, silent)
    assert levels(array) == ["STALE"] * 8 and array.status[0].message == "not known yet"
    ill = flying(events=[hexa_event()])
    ill.session.blind = lambda: "on the ground"  # what was found still holds; nothing is known of the others
    ros.sent.clear()
    assert levels(published(ros, ill)) == ["ERROR", "STALE", "STALE", "ERROR", "STALE", "STALE", "STALE"]


def test_states_come_once_a_second_and_at_once_with_an_event(ros):
    outlet = ros2_diagnostics.Diagnostics()
    for _ in range(3):
        outlet.step([source(flying())])
    assert len(ros.sent) == 1
    outlet.take({"type": "event"})
    outlet.step([source(flying())])
    assert len(ros.sent) == 2


def test_watch_is_a_node_whose_messages_fill_a_bag(ros, tmp_path, monkeypatch, run):
    arguments = ["watch", str(SAMPLE), "--speed", "max", "--ros2", "--quiet", "--ros-args", "-r", "__ns:=/one"]
    monkeypatch.setattr(sys, "argv", ["rotorwatch", *arguments])
    code, _, _ = run(*arguments)
    assert code == 1 and ros.args[-2:] == ["-r", "__ns:=/one"]
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/diagnostics", ARRAY, typestore=STORE)
        for k, data in enumerate(ros.sent):
            bag.write(connection, k, data)
    with AnyReader([tmp_path / "bag"], default_typestore=STORE) as bag:
        arrays = [bag.deserialize(data, c.msgtype) for c, _, data in bag.messages()]
    assert len(arrays[-1].status) == 7 and "ERROR" in {level for array in arrays for level in levels(array)[3:4]}


def test_without_ros_2_a_sentence_says_what_to_do(run):
    if importlib.util.find_spec("rclpy"):
        pytest.skip("ROS 2 is installed")
    code, _, err = run("watch", SAMPLE, "--ros2")
    assert code == 2 and "--ros2 needs ROS 2" in err and "Traceback" not in err


LISTENER = """
import json, rclpy, sys
from diagnostic_msgs.msg import DiagnosticArray
rclpy.init()
node = rclpy.create_node("listener")
def heard(array):
    print(json.dumps([[s.name, int.from_bytes(s.level, "little"), {v.key: v.value for v in s.values}] for s in array.status]), flush=True)
node.create_subscription(DiagnosticArray, "/diagnostics", heard, 10)
rclpy.spin(node)
"""


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs ROS 2 (rclpy, diagnostic_msgs)")
def test_a_listener_of_ros_2_hears_the_node():
    listener = subprocess.Popen([sys.executable, "-c", LISTENER], stdout=subprocess.PIPE, text=True)
    try:
        outlet, began = ros2_diagnostics.Diagnostics(), time.monotonic()
        while time.monotonic() - began < 5.0:
            outlet.step([source(flying(events=[hexa_event()]))])
            time.sleep(0.1)
        outlet.leave()
    finally:
        listener.terminate()
    heard = [json.loads(line) for line in listener.stdout]
    assert heard and [level for _, level, _ in heard[-1]] == [2, 0, 0, 2, 0, 0, 0]


def test_a_snapshot_is_what_the_statuses_are_made_of():
    known = snapshot.taken(flying(events=[hexa_event(alternatives=((4,),))]))
    assert known.assessed and known.faulty and known.state == "MAYBE" and len(ros2_diagnostics.statuses(known)) == 7
