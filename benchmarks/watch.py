"""How long from a datagram to a published estimate: vehicles over UDP in real time, watched by one process.

    python benchmarks/watch.py FLIGHT.bin --vehicles 20 --seconds 60
    python benchmarks/watch.py FLIGHT.bin --starts 5

The vehicles run in a process of their own, each with SERVO_OUTPUT_RAW, ATTITUDE and RAW_IMU at 50 Hz. Latency: from the sending of the
datagram that completes a tick to the estimate of that tick, whatever it waited for in between.

--starts: how long the command takes from its start to the first tick of a vehicle that is in the air and whose parameters come at once,
so many times. That tick learns the noise: what is assessed follows after the blind time, which is physics and no machinery.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import multiprocessing
import socket
import statistics
import subprocess
import sys
import time

import numpy as np


def packed(path: str, vehicles: int, seconds: float) -> tuple[list[list[bytes]], list[list[bytes]]]:
    """(the frames that are sent together, vehicle after vehicle, 50 times a second; heartbeat and parameters of each vehicle)."""
    from rotorwatch import logs

    mavlink = importlib.import_module("pymavlink.dialects.v20.ardupilotmega")  # its types alone would take a minute to check

    flight = logs.read(path)
    packs = [mavlink.MAVLink(None, srcSystem=k + 1, srcComponent=1) for k in range(vehicles)]
    wanted = sorted((n, v) for n, v in flight.parameters.items() if n.startswith(("FRAME", "MOT_", "SERVO")) and len(n) <= 16)

    def frame(k, message):
        made = message.pack(packs[k])
        packs[k].seq = (packs[k].seq + 1) % 256
        return made

    beat = mavlink.MAVLink_heartbeat_message(2, 3, 0x80, 0, 4, 3)
    known = [mavlink.MAVLink_param_value_message(name.encode(), float(value), 9, len(wanted), i) for i, (name, value) in enumerate(wanted)]
    greetings = [[frame(k, message) for message in (beat, *known)] for k in range(vehicles)]
    motors, gyro, accel = flight["motors"], flight["gyro"], flight["accel"]
    frames = []  # beforehand: packing takes more than all the rest
    for step in range(int(seconds * 50)):
        t = motors.time[0] + step / 50.0
        at = [min(np.searchsorted(s.time, t), len(s) - 1) for s in (motors, gyro, accel)]
        pwm = [round(v) for v in motors.values[at[0]]]
        rate, push = gyro.values[at[1]], accel.values[at[2]]
        us = int((t + 30.0) * 1e6)
        imu = [int(v) for v in (*np.round(push / 9.80665 * 1e3), *np.round(rate * 1e3), 0, 0, 0)]
        samples = [
            mavlink.MAVLink_servo_output_raw_message(us, 0, *(pwm + [0] * 8)[:8]),
            mavlink.MAVLink_attitude_message(us // 1000, 0.0, 0.0, 0.0, *map(float, rate)),
            mavlink.MAVLink_raw_imu_message(us, *imu),
            *([beat] if step % 50 == 0 else ()),
        ]
        frames += [[frame(k, message) for message in samples] for k in range(vehicles)]
    return frames, greetings


def fly(path: str, port: int, vehicles: int, seconds: float, ready, sent) -> None:
    """Send all vehicles' messages in real time."""
    frames, greetings = packed(path, vehicles, seconds)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(("127.0.0.1", port))
    for greeting in greetings:
        for frame in greeting:
            sock.send(frame)
        time.sleep(0.05)
    ready.set()
    began = time.monotonic()
    # Each vehicle was switched on at another time: their ticks do not end together.
    due = [(step / 50.0 + 0.1 * k / vehicles) for step in range(int(seconds * 50)) for k in range(vehicles)]
    for number in np.argsort(due, kind="stable").tolist():
        wait = began + due[number] - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        sent[number] = time.monotonic()
        for frame in frames[number]:
            sock.send(frame)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


# The command as it is; a thread waits until what makes the ticks has been loaded, and then for the first of them.
FIRST_TICK = """
import os, sys, threading, time

def look():
    while not hasattr(watched := sys.modules.get("rotorwatch.live.watched"), "Watched"):
        time.sleep(0.002)
    advance = watched.Watched.advance

    def first(self, complete=None):
        if advance(self, complete):
            print(time.monotonic(), flush=True)
            os._exit(0)
        return False

    watched.Watched.advance = first

threading.Thread(target=look, daemon=True).start()
from rotorwatch.commands.cli import main
main(["watch", sys.argv[1], "--listen-only", "--jsonl", "--seconds", "20"])
"""


def starts(path: str, times: int) -> None:
    """How long the command takes to the first tick."""
    durations = []
    for _ in range(times):
        port = free_port()
        ready, go = multiprocessing.Event(), multiprocessing.Event()
        process = multiprocessing.Process(target=stream, args=(path, port, ready, go), daemon=True)
        process.start()
        ready.wait()
        began = time.monotonic()
        go.set()
        command = [sys.executable, "-c", FIRST_TICK, f"udpin:127.0.0.1:{port}"]
        lines = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
        process.kill()
        durations.append(float(lines[-1]) - began)
    print(f"from the start to the first tick: median {statistics.median(durations):.2f} s, longest {max(durations):.2f} s of {times}")


def stream(path: str, port: int, ready, go) -> None:
    """One vehicle in the air that sends a heartbeat and its parameters ten times a second."""
    frames, greeting = packed(path, 1, 30.0)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    ready.set()
    go.wait()
    began = time.monotonic()
    for step, messages in enumerate(frames):
        time.sleep(max(0.0, began + step / 50.0 - time.monotonic()))
        for frame in [*(greeting[0] if step % 5 == 0 else ()), *messages]:
            sock.sendto(frame, ("127.0.0.1", port))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight")
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--starts", type=int, default=0)
    options = parser.parse_args()
    if options.starts:
        starts(options.flight, options.starts)
        return
    from rotorwatch import airframes
    from rotorwatch.engine.bindings import program
    from rotorwatch.live import endpoint, link

    program.steps(0.05, airframes.named("ardupilot-quad-x").effectiveness())  # built beforehand

    port = free_port()
    watched = link.Link(endpoint.open_endpoint(f"udpin:127.0.0.1:{port}"), lambda alert: None, talks=False)
    ready = multiprocessing.Event()
    sent = multiprocessing.Array("d", int(options.seconds * 50) * options.vehicles, lock=False)
    process = multiprocessing.Process(target=fly, args=(options.flight, port, options.vehicles, options.seconds, ready, sent), daemon=True)
    process.start()
    late, stepped = [], link.Watched.advance

    def timed(self, complete=None):
        if not stepped(self, complete):
            return False
        now, number = time.monotonic(), int(self.name.rsplit("/")[-1]) - 1
        table, _ = self.session._assess.now
        # The vehicle's clock counts from its first message; a tick is complete with the first motion after it.
        step = int(np.ceil(table.time[-1] * 50 - 1e-6))
        if 0 <= step * options.vehicles + number < len(sent):
            late.append(now - sent[step * options.vehicles + number])
        return True

    link.Watched.advance = timed
    gc.collect()
    gc.freeze()  # as `watch` does
    while not ready.is_set():
        watched.poll(0.005)
    first, busy = time.monotonic(), time.process_time()
    while process.is_alive():
        watched.poll(0.005)
    wall, busy = time.monotonic() - first, time.process_time() - busy
    share = len(late) // 5
    if not late:
        raise SystemExit("nothing was assessed: let the vehicles fly for longer")
    print(f"{options.vehicles} vehicles, {wall:.0f} s: {len(late)} pieces assessed, {busy / wall:.0%} of one core")
    p50, p99, most = np.quantile(np.array(late[share:]) * 1e3, [0.5, 0.99, 1.0])
    print(f"from datagram to estimate: median {p50:.1f} ms, 99 % {p99:.1f} ms, longest {most:.1f} ms")
    behind = [wall - w.session.now for w in watched.vehicles if w.session is not None]
    print(f"vehicles heard: {len(watched.vehicles)}; behind at the end: {max(behind, default=np.nan):.2f} s at most")
    lost = sum(w.health.lost for w in watched.vehicles)
    print(f"messages lost: {lost}")


if __name__ == "__main__":
    main()
