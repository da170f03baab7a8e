"""What `rotorwatch watch` costs a companion computer: one vehicle in real time, the command as a service runs it.

    python benchmarks/companion.py FLIGHT.bin --seconds 60
    python benchmarks/companion.py FLIGHT.bin --python "qemu-aarch64-static -L ROOT ROOT/usr/bin/python3.11"

The vehicle sends SERVO_OUTPUT_RAW, ATTITUDE and RAW_IMU at 50 Hz over UDP, from this process. --python: what runs the command; with an
emulator for another processor its time is the emulator's, not that of such a processor. Counted is the processor's time of the command,
all its threads, between the first fifth and the end (Linux only), and before: from its start to the first tick that it could assess.
"""

from __future__ import annotations

import argparse
import os
import shlex
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from watch import free_port, packed

TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


def used_s(pid: int) -> float:
    """Processor's time of a process, all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S


def memory_mb(pid: int) -> float:
    """What it holds."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--python", default=shlex.quote(sys.executable))
    options = parser.parse_args()
    frames, greeting = packed(options.flight, 1, options.seconds)
    port = free_port()
    command = [*shlex.split(options.python), "-m", "rotorwatch", "watch", f"udpin:127.0.0.1:{port}", "--listen-only", "--jsonl"]
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen([*command, "--patience", "600"], stdout=said)
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        # Its port is there before the rest is loaded; the greeting waits in it.
        began = time.monotonic()
        while not any(f":{port:04X} " in line for line in Path("/proc/net/udp").read_text().splitlines()):
            if process.poll() is not None or time.monotonic() - began > 120.0:
                raise SystemExit("the command has ended, or does not open its port")
            time.sleep(0.05)
        opened, first = time.monotonic() - began, (0.0, 0.0)
        for frame in greeting[0]:
            sock.sendto(frame, ("127.0.0.1", port))
            time.sleep(0.002)
        started, share = time.monotonic(), 0.0
        for step, messages in enumerate(frames):
            if (wait := started + step / 50.0 - time.monotonic()) > 0.0:
                time.sleep(wait)
            for frame in messages:
                sock.sendto(frame, ("127.0.0.1", port))
            if step == len(frames) // 5:
                first = time.monotonic(), used_s(process.pid)
        share = (used_s(process.pid) - first[1]) / (time.monotonic() - first[0])
        held, spent = memory_mb(process.pid), first[1]
        process.terminate()
        code = process.wait(120.0)
        said.seek(0)
        lines = said.read().splitlines()
    print(f"port open after {opened:.1f} s; {spent:.1f} s of processor time until {options.seconds / 5:.0f} s into the flight")
    print(f"one vehicle at 50 Hz: {share:.1%} of one core, {held:.0f} MB; exit code {code}")
    for line in lines:
        print(line[:200])


if __name__ == "__main__":
    main()
