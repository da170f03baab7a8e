"""Who else sends under a vehicle's id, by mistake or on purpose: the vehicle is assessed all the same, and what changes is said."""

import struct

import numpy as np
import pytest
from tests.link_faults import Wire, base, watched
from tests.mavlink_vehicle import ARDUPILOT, QUAD, Autopilot, mavlink
from tests.soak import stamped

from rotorwatch.flight import Signal
from rotorwatch.live.clock import Clock, Restarted
from rotorwatch.live.framing import seeds, sums
from rotorwatch.live.link import Link
from rotorwatch.live.outliers import Outliers
from rotorwatch.live.routes import Route, Routes

FAULTY = 4  # a quad hovers; rotor 2 loses a quarter of its thrust 22 s after it begins
NEEDED = (30, 27, 36)


def identity(frame):
    return int.from_bytes(frame[7:10], "little")


def forged(frame, change=lambda old: old, values=None):
    """A frame of the vehicle's, sent by somebody else: with a running number of his own, another stamp, and other outputs."""
    frame = stamped(frame, change)
    body = bytearray(frame[10:-2])
    for output, value in (values or {}).items():
        struct.pack_into("<H", body, 2 + 2 * output, value)
    head = frame[:4] + bytes(((frame[4] + 40) % 256,)) + frame[5:10]
    return head + bytes(body) + sums(head + bytes(body), seeds()[identity(frame)])


def beats(peer, every_s=1.0, begin=0.0, end=45.0):
    """Heartbeats of the vehicle's id, from elsewhere or from its own address."""
    other = Autopilot({})
    beat = mavlink.MAVLink_heartbeat_message(QUAD, ARDUPILOT, 0x80, 0, 4, 3)
    return [(at, peer, bytes(other.packed(beat))) for at in np.arange(begin, end, every_s).tolist()]


def flown(more=(), change=lambda at, frame: [("a", frame)], which=FAULTY, first="a"):
    """(alerts, link) of a flight of which each frame comes as change(at, frame) says, a list of (peer, frame), with more besides. first:
    who is heard first."""
    frames, parameters, kind = base(which)
    if first != "a":  # its parameters come when they are fetched
        vehicle = Autopilot(parameters)
        more = [*more, *((2.0 + 0.001 * k, "a", vehicle.packed(vehicle._value(k))) for k in range(len(parameters)))]
    own = [(at, peer, one) for at, frame in frames for peer, one in change(at, frame)]
    return watched(sorted([*own, *more], key=lambda one: one[0]), parameters, kind, first=first)


def losses(alerts):
    return [(a["state"], a["event"]["rotors"], a["at"]) for a in alerts if a.get("event", {}).get("kind") == "loss_of_effectiveness"]


def texts(alerts):
    return [a["text"] for a in alerts if "text" in a]


@pytest.fixture(scope="module")
def undisturbed():
    """When the loss is announced over a link without any trouble."""
    (state, rotors, at), *_ = losses(flown()[0])
    assert state == "announced" and rotors == [2]
    return at


def found_in_time(alerts, undisturbed):
    reported = losses(alerts)
    assert reported and all(rotors == [2] for _, rotors, _ in reported) and "withdrawn" not in {state for state, *_ in reported}, reported
    assert reported[0][0] == "announced" and reported[0][2] == pytest.approx(undisturbed, abs=0.2)


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("ahead_s, every_s", [(9.0, 1.0), (0.3, 1.0), (40.0, 5.0), (3.0, 60.0), (0.7, 5.0)])
def test_a_stamp_ahead_restarts_nothing(ahead_s, every_s, undisturbed):
    due = [20.0 if every_s == 60.0 else 2.0]

    def change(at, frame):
        if identity(frame) != 30 or at < due[0]:
            return [("a", frame)]
        due[0] = at + every_s
        return [("a", frame), ("a", forged(frame, lambda old: old + 1e6 * ahead_s))]

    alerts, link = flown((), change)
    (vehicle,) = link.vehicles
    found_in_time(alerts, undisturbed)
    assert vehicle.health.reboots == vehicle.health.jumps == 0


@pytest.mark.parametrize("up_s", [100.0, 3000.0])
@pytest.mark.parametrize("to_s, reboot", [(1.0, True), (9000.0, False)])
def test_a_clock_that_begins_anew_is_followed_within_a_second(up_s, to_s, reboot):
    """Also when it has run for so long that the outputs' 32 bits, read by the old clock, do not fit either one."""
    clock = Clock()
    for k in range(100):
        clock.take((up_s + 0.02 * k) * 1e6, 0.02 * k, bool(k % 2))
    with pytest.raises(Restarted) as why:
        for k in range(1000):
            now = 5.0 + 0.01 * k
            clock.take((to_s + 0.01 * k) * 1e6 % (2.0**32 if k % 3 == 0 else 2.0**63), now, k % 3 == 0)
    assert why.value.reboot is reboot and now < 5.5


def test_a_link_that_delays_less_from_now_on_is_followed_without_a_restart():
    """Two seconds of what a radio held back are dropped."""
    clock = Clock()
    for k in range(200):
        assert clock.take((30.0 + 0.02 * k) * 1e6, 2.0 + 0.02 * k, False) is not None
    came = [clock.take((36.0 + 0.02 * k) * 1e6, 6.0 + 0.02 * k, False) for k in range(50)]
    assert came[-1] == pytest.approx(6.98) and 5 < came.count(None) < 20


def test_messages_that_were_held_back_and_come_at_once_are_all_believed():
    clock = Clock()
    for k in range(300):
        at = 0.02 * k
        assert clock.take((30.0 + at) * 1e6, 4.0 if 2.0 < at < 4.0 else at, False) is not None


def test_heartbeats_from_elsewhere_win_nothing(undisturbed):
    """Neither who is heard first, nor who is heard while the vehicle is silent for some seconds."""
    alerts, link = flown(beats("b", 0.5), first="b")
    found_in_time(alerts, undisturbed)
    assert sum("it is now received through a instead of b" in text for text in texts(alerts)) == 1
    alerts, link = flown(beats("b"), lambda at, frame: [] if 14.0 < at < 18.0 else [("a", frame)])
    found_in_time(alerts, undisturbed)
    assert not any("from now on" in text for text in texts(alerts)) and link.vehicles[0].health.others > 20


def test_an_attitude_without_outputs_wins_nothing(undisturbed):
    more = [(at, "b", frame) for at, frame in base(FAULTY)[0] if identity(frame) in (0, 30)]
    found_in_time(flown(more, first="b")[0], undisturbed)


def test_a_path_that_keeps_only_the_heartbeats_does_not_hide_that_the_other_is_gone():
    alerts, _link = flown(beats("b"), lambda at, frame: [("a", frame)] if at < 15.0 or at > 34.0 else [])
    (gone,) = [a for a in alerts if "no motor outputs and angular rates that can be used have arrived" in a.get("text", "")]
    assert gone["missing"] == ["outputs", "rates"] and gone["at"] < 25.0
    (again,) = [a for a in alerts if "arriving now" in a.get("text", "")]
    assert 34.0 < again["at"] < 35.0


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("fades", ["a", "b"])
def test_of_two_paths_of_one_vehicle_either_may_fade_and_nothing_is_taken_twice(fades, undisturbed):
    frames, late = base(FAULTY)[0], 0.3  # the second path is the slower one, and numbers its frames itself

    def change(at, frame):
        return [("a", frame)] if not (fades == "a" and at > 17.0) else []

    more = []
    for at, frame in frames:
        if at > 5.0 and not (fades == "b" and at > 17.0):
            renumbered = frame[:4] + bytes(((frame[4] + 77) % 256,)) + frame[5:-2]
            more.append((at + late, "b", renumbered + sums(renumbered, seeds()[identity(frame)])))
    alerts, link = flown(more, change)
    (vehicle,) = link.vehicles
    found_in_time(alerts, undisturbed + (late if fades == "a" else 0.0))
    assert vehicle.health.reboots == vehicle.health.jumps == 0 and vehicle.health.taken < 1.02 * len(frames)
    assert sum("it is now received through b" in text for text in texts(alerts)) == (fades == "a")


def test_a_vehicle_that_was_silent_is_not_said_to_lack_what_then_comes():
    polls = [(at, "c", b"\0") for at in np.arange(12.0, 24.0, 0.1).tolist()]
    alerts, _ = flown(polls, lambda at, frame: [] if 12.0 < at < 24.0 else [("a", frame)])
    assert [t for t in texts(alerts) if "nothing has been received" in t] and not [t for t in texts(alerts) if "outputs" in t]


def test_who_is_contradicted_by_the_motion_gives_way_to_another_that_sends_too():
    """Somebody has the vehicle's clock and its attitude, and outputs that stand still."""
    numbers = iter(range(10**6))

    def change(at, frame):
        if identity(frame) not in (0, *NEEDED):
            return []
        frame = forged(frame, values=dict.fromkeys(range(1, 5), 1500)) if identity(frame) == 36 else frame
        frame = frame[:4] + bytes((next(numbers) % 256,)) + frame[5:-2]
        return [("a", frame + sums(frame, seeds()[identity(frame)]))]

    alerts, link = flown([(at, "b", frame) for at, frame in base(0)[0]], change, which=0)
    assert not [a for a in alerts if a["type"] == "event"]
    (other,) = [a for a in alerts if "it is now received through b" in a.get("text", "")]
    assert "its data are inconsistent" in other["text"] and other["at"] < 40.0 and link.vehicles[0].session.doubt == ""


def garbage(begin=0.0, end=45.0, seed=0):
    """What a vehicle sends, with any values and stamps of another time."""
    rng, out = np.random.default_rng(seed), []
    for at, frame in base(FAULTY)[0]:
        if begin < at < end and identity(frame) in (0, *NEEDED):
            body = frame[10:-2] if identity(frame) == 0 else rng.bytes(len(frame) - 12)
            out.append((at, "b", frame[:10] + body + sums(frame[:10] + body, seeds()[identity(frame)])))
            if identity(frame) != 0:
                out[-1] = (at, "b", stamped(out[-1][2], lambda old, at=at: 1e6 * (500.0 + at)))
    return out


def test_garbage_under_the_id_does_not_take_over_while_the_vehicle_sends(undisturbed):
    found_in_time(flown(garbage())[0], undisturbed)
    alerts, _link = flown(garbage(), lambda at, frame: [] if 10.0 < at < 12.0 else [("a", frame)])
    found_in_time(alerts, undisturbed)


def test_after_garbage_has_taken_over_the_vehicle_is_followed_again():
    """It was silent from 8 to 11.5 s; who came in meanwhile sends nothing that can be used."""
    alerts, _link = flown(garbage(), lambda at, frame: [] if 8.0 < at < 11.5 else [("a", frame)])
    reported = losses(alerts)
    assert reported and all(rotors == [2] for _, rotors, _ in reported) and reported[-1][0] != "withdrawn" and reported[0][2] < 28.0
    assert [text for text in texts(alerts) if "received through a instead of" in text]


class Asked(Wire):
    """A vehicle at "a" that sends heartbeats alone until rates are requested there; and somebody at "b" who only sends heartbeats."""

    def __init__(self):
        super().__init__()
        self.vehicle, self.streams, self.restored = Autopilot({"FRAME_CLASS": 1.0, "MOT_SPIN_MIN": 0.15}), False, 0

    def send(self, data, peer=None):
        if peer == "a":
            self.queue.append((peer, self.vehicle.answer(data)))
            self.streams = any(m.get_type() == "COMMAND_LONG" and m.command == 511 for m in self.vehicle.asked)


def test_each_address_is_asked_in_turn_while_none_sends_what_assessing_needs():
    now, alerts, wire = [0.0], [], Asked()
    link = Link(wire, lambda alert: alerts.append({**alert, "at": now[0]}), clock=lambda: now[0])
    beat, other = mavlink.MAVLink_heartbeat_message(QUAD, ARDUPILOT, 0x80, 0, 4, 3), Autopilot({})
    for k in range(400):
        now[0] = 0.05 * k
        if k % 20 == 0:
            wire.queue += [("b", other.packed(beat)), ("a", wire.vehicle.packed(beat))]
        if wire.streams:
            ms = 30_000 + 50 * k
            turns = mavlink.MAVLink_attitude_message(ms, 0, 0, 0, 0, 0, 0)
            outputs = mavlink.MAVLink_servo_output_raw_message(1000 * ms, 0, *[1000] * 4, *[0] * 12)
            wire.queue += [("a", wire.vehicle.packed(one)) for one in (turns, outputs)]
        link.poll(0.0)
    (vehicle,) = link.vehicles
    assert vehicle.session is not None and vehicle.session.vehicle is not None and vehicle.session.now > 5.0
    assert max(a["at"] for a in alerts if "text" in a) < 12.0, "nothing more is said"
    before = len(wire.vehicle.asked)
    link.leave()
    assert any(m.get_type() == "COMMAND_LONG" for m in wire.vehicle.asked[before:]), "its rates are given back"


def thinned(hz):
    """Outputs so often a second; all else as it is."""
    latest = [-np.inf]

    def keep(at, frame):
        if identity(frame) != 36:
            return True
        if at - latest[0] < 1.0 / hz - 0.001:
            return False
        latest[0] = at
        return True

    return keep


@pytest.mark.thorough(keep=2)
@pytest.mark.parametrize("hz, after_s", [(25.0, 0.008), (25.0, 0.036), (4.0, 0.1)])
@pytest.mark.parametrize("values", [{3: 2000}, {3: 1000}, {3: 0}, {1: 1600, 3: 1700}, dict.fromkeys(range(1, 5), 2000)])
def test_outputs_of_one_moment_that_their_neighbours_contradict_accuse_no_rotor(hz, after_s, values):
    """One every two seconds, of a vehicle without a fault."""
    due, keep = [12.0], thinned(hz)

    def change(at, frame):
        if not keep(at, frame):
            return []
        if identity(frame) != 36 or at < due[0]:
            return [("a", frame)]
        due[0] = at + 2.0
        return [("a", frame), ("a", forged(frame, lambda old: old + 1e6 * after_s, values))]

    alerts, link = flown((), change, which=0)
    assert not [a for a in alerts if a["type"] == "event"]
    assert link.vehicles[0].session.assessed


def test_outputs_that_jump_and_stay_pass_with_the_next_sample():
    def outputs(times, values):
        return Signal(np.array(times), np.array(values)[:, None] * np.ones(4), ("r1", "r2", "r3", "r4"), "us")

    outliers = Outliers()
    assert len(outliers.take(outputs([0.0, 0.04], [1500, 1505]))) == 2
    assert outliers.take(outputs([0.08], [1900])) is None
    assert outliers.take(outputs([0.12], [1890])).time.tolist() == [0.08, 0.12]
    extra = outliers.take(outputs([0.14, 0.16, 0.2], [1200, 1880, 1890]))
    assert extra.time.tolist() == [0.16, 0.2] and outliers.left_out == 1
    assert len(outliers.take(outputs([0.24, 0.28, 0.32], [1300, 1890, 1890]))) == 3, "in the autopilot's own rhythm a peak is true"
    assert len(outliers.take(outputs([0.9], [1100]))) == 1, "after a pause nothing contradicts it"


def test_a_slow_link_that_loses_some_samples_in_a_row_is_not_left_for_heartbeats():
    routes, last = Routes(Route("a", None, 0.0), 0.0), -1.0
    routes.add(Route("b", None, 0.0), 0.0)
    for k in range(200):
        now = 0.5 * k
        routes.find("b").hear(0, now)
        routes.usable["rates"] = now
        if k % 4 == 0 and k % 40 not in (8, 12):  # outputs come every 2 s, and two in a row are lost
            routes.usable["outputs"] = now
        assert routes.better(now, not routes.used(now)) is None and (now < 10.0 or routes.next(now) is None)
        last = now
    assert routes.next(last + 9.0) is None, "nobody is heard any more"
    routes.find("b").hear(0, last + 9.0)
    assert routes.next(last + 9.0) is routes.find("b")


def test_what_a_link_loses_is_said_while_it_does_and_at_the_end():
    rng = np.random.default_rng(0)
    alerts, _ = flown((), lambda at, frame: [] if 8.0 < at < 25.0 and rng.random() < 0.4 else [("a", frame)])
    (bad,) = [a for a in alerts if "of the messages of the last 10 s were lost" in a.get("text", "")]
    (good,) = [a for a in alerts if "loses few messages again" in a.get("text", "")]
    assert 10.0 < bad["at"] < 21.0 and 25.0 < good["at"] < 41.0
    assert "messages received; " in texts(alerts)[-1] and "% lost" in texts(alerts)[-1]
    assert "messages received; " in texts(flown()[0])[-1] and "lost" not in texts(flown()[0])[-1]
