"""How long the served page takes: until something is painted, until the first vehicle is drawn, and until an uploaded log is answered.

    python benchmarks/serve.py [LOG ...] [--watch FLIGHT]

Starts a server of its own, and a headless Chromium with an empty cache for each measurement of the page (extra `test`). The answer to an
upload is timed from the first byte that is sent to the last of the answer, when the flight is in the store; each log is sent once to a
fresh store, after a small one of the same kind has been assessed, as a server does that has been in use.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SAMPLES = Path(__file__).parents[1] / "src" / "rotorwatch" / "samples"
PAINTED = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
DRAWN = "new Promise(done => (function look() { document.querySelector('g.rotor') ? done(performance.now()) : setTimeout(look, 5) })())"
TIMES = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--watch", type=Path, default=SAMPLES / "hexax_m3_mul0.80_square_wind.bin.xz")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "rotorwatch.commands.cli",
            "serve",
            "--port",
            "0",
            "--store",
            f"{folder}/fleet.db",
            str(options.watch),
        ]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert server.stdout is not None
        try:
            address = server.stdout.readline().strip()
            time.sleep(15.0)  # the vehicle is in the air
            paint(address)
            for sample in sorted(SAMPLES.glob("*.xz")):
                send(address, sample)
            for log in options.logs:
                before = cpu(server.pid)
                duration, answer = send(address, log)
                print(
                    f"{log.name}, {log.stat().st_size / 1e6:.0f} MB, {answer['duration_s']:.0f} s of flight: answered in {duration:.1f} s, "
                    f"{cpu(server.pid) - before:.1f} s of it computing (load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores)"
                )
        finally:
            server.terminate()
            server.wait()


def paint(address: str) -> None:
    """Of a page that was never open before."""
    from playwright.sync_api import sync_playwright

    browser_at = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    found = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_at, args=["--no-sandbox", "--disable-gpu"])
        for _ in range(TIMES):
            context = browser.new_context()
            page = context.new_page()
            page.goto(address)
            drawn = page.evaluate(DRAWN)
            found.append((page.evaluate(PAINTED), drawn))
            context.close()
        browser.close()
    for name, times in zip(("first paint", "first vehicle drawn"), zip(*found)):
        print(f"{name}: median {statistics.median(times):.0f} ms, longest {max(times):.0f} ms of {TIMES}")


def send(address: str, log: Path) -> tuple[float, dict]:
    """Seconds until a log was answered, and the answer."""
    connection = http.client.HTTPConnection(address.split("/")[2])
    with log.open("rb") as file:
        began = time.perf_counter()
        headers = {"X-Rotorwatch-Name": log.name, "Content-Length": str(os.path.getsize(log))}
        connection.request("POST", "/api/flights", file, headers)
        answer = connection.getresponse()
        text = answer.read()
    duration = time.perf_counter() - began
    if answer.status not in (200, 201):
        raise SystemExit(text.decode())
    return duration, json.loads(text)


def cpu(server: int) -> float:
    """Seconds that the server and its processes have computed (Linux)."""
    family, total = {server}, 0.0
    for stat in sorted(Path("/proc").glob("[0-9]*/stat"), key=lambda p: int(p.parent.name)):
        try:
            fields = stat.read_text().rpartition(") ")[2].split()
        except OSError:
            continue
        if int(stat.parent.name) in family or int(fields[1]) in family:
            family.add(int(stat.parent.name))
            total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


if __name__ == "__main__":
    main()
