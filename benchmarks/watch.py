"""How long from a datagram to a published estimate: vehicles over UDP in real time, watched by one process.

    python benchmarks/watch.py FLIGHT.bin --vehicles 20 --seconds 60

The vehicles run in a process of their own, each with SERVO_OUTPUT_RAW, ATTITUDE and RAW_IMU at 50 Hz. Latency: from the sending of the
datagram that completes a tick to the estimate of that tick, whatever it waited for in between.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import socket
import time

import numpy as np


def fly(path: str, port: int, vehicles: int, seconds: float, ready, sent) -> None:
    """Send all vehicles' messages in real time, from a flight's middle on."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    from rotorwatch import logs

    flight = logs.read(path)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(("127.0.0.1", port))
    packs = [mavlink.MAVLink(None, srcSystem=k + 1, srcComponent=1) for k in range(vehicles)]
    wanted = sorted(
        (n, v) for n, v in flight.parameters.items() if n.startswith(("FRAME", "MOT_", "SERVO")) and len(n) <= 16
    )

    def send(k, message):
        sock.send(message.pack(packs[k]))
        packs[k].seq = (packs[k].seq + 1) % 256

    for k in range(vehicles):
        send(k, mavlink.MAVLink_heartbeat_message(2, 3, 0x80, 0, 4, 3))
        for i, (name, value) in enumerate(wanted):
            send(k, mavlink.MAVLink_param_value_message(name.encode(), float(value), 9, len(wanted), i))
        time.sleep(0.05)
    motors, gyro, accel = flight["motors"], flight["gyro"], flight["accel"]
    packed = []  # beforehand: packing takes more than all the rest
    for step in range(int(seconds * 50)):
        t = motors.time[0] + step / 50.0
        at = [min(np.searchsorted(s.time, t), len(s) - 1) for s in (motors, gyro, accel)]
        pwm = [round(v) for v in motors.values[at[0]]]
        rate, push = gyro.values[at[1]], accel.values[at[2]]
        us = int((t + 30.0) * 1e6)
        imu = [int(v) for v in (*np.round(push / 9.80665 * 1e3), *np.round(rate * 1e3), 0, 0, 0)]
        said = [
            mavlink.MAVLink_servo_output_raw_message(us, 0, *(pwm + [0] * 8)[:8]),
            mavlink.MAVLink_attitude_message(us // 1000, 0.0, 0.0, 0.0, *map(float, rate)),
            mavlink.MAVLink_raw_imu_message(us, *imu),
        ]
        if step % 50 == 0:
            said.append(mavlink.MAVLink_heartbeat_message(2, 3, 0x80, 0, 4, 3))
        for k in range(vehicles):
            frames = []
            for message in said:
                frames.append(message.pack(packs[k]))
                packs[k].seq = (packs[k].seq + 1) % 256
            packed.append(frames)
    ready.set()
    began = time.monotonic()
    # Each vehicle was switched on at another time: their ticks do not end together.
    due = [(step / 50.0 + 0.1 * k / vehicles) for step in range(int(seconds * 50)) for k in range(vehicles)]
    for number in np.argsort(due, kind="stable").tolist():
        frames, wait = packed[number], began + due[number] - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        sent[number] = time.monotonic()
        for frame in frames:
            sock.send(frame)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight")
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0)
    given = parser.parse_args()
    from rotorwatch import airframes
    from rotorwatch.default import program
    from rotorwatch.live import endpoint, link

    program.steps(0.05, airframes.named("ardupilot-quad-x").effectiveness())  # built beforehand

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    watched = link.Link(endpoint.open_endpoint(f"udpin:127.0.0.1:{port}"), lambda alert: None, talks=False)
    ready = multiprocessing.Event()
    sent = multiprocessing.Array("d", int(given.seconds * 50) * given.vehicles, lock=False)
    process = multiprocessing.Process(
        target=fly, args=(given.flight, port, given.vehicles, given.seconds, ready, sent), daemon=True
    )
    process.start()
    late, stepped = [], link.Watched.advance

    def timed(self, complete=None):
        if not stepped(self, complete):
            return False
        now, number = time.monotonic(), int(self.name.rsplit("/")[-1]) - 1
        table, _ = self.session._judge.now
        # The vehicle's clock counts from its first message; a tick is complete with the first motion after it.
        step = int(np.ceil(table.time[-1] * 50 - 1e-6))
        if 0 <= step * given.vehicles + number < len(sent):
            late.append(now - sent[step * given.vehicles + number])
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
        raise SystemExit("nothing was judged: let the vehicles fly for longer")
    print(f"{given.vehicles} vehicles, {wall:.0f} s: {len(late)} pieces judged, {busy / wall:.0%} of one core")
    p50, p99, most = np.quantile(np.array(late[share:]) * 1e3, [0.5, 0.99, 1.0])
    print(f"from datagram to estimate: median {p50:.1f} ms, 99 % {p99:.1f} ms, longest {most:.1f} ms")
    behind = [wall - w.session.now for w in watched.vehicles if w.session is not None]
    print(f"vehicles heard: {len(watched.vehicles)}; behind at the end: {max(behind, default=np.nan):.2f} s at most")
    lost = sum(w.health.lost for w in watched.vehicles)
    print(f"messages lost: {lost}")


if __name__ == "__main__":
    main()
