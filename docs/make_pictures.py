"""Draw the pictures of the documentation: `python docs/make_pictures.py`. Needs Chromium.

docs/report.png is the top of the demo's HTML report, as a browser shows it; docs/serve.png the page of `rotorwatch serve` in the middle of
the same flight, with both samples in its list (extra `test`, for Playwright).
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from rotorwatch.commands.cli import SAMPLES
from rotorwatch.diagnose import diagnose

DOCS = Path(__file__).resolve().parent
FAULTY = "hexax_m3_mul0.80_square_wind.bin.xz"
WIDTH, HEIGHT = 1100, 1110  # CSS pixels: header, verdict, what to do next, rotors
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def main() -> int:
    """Write the pictures; 0 when all went well."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print("make_pictures: no Chromium found; install it (apt-get install chromium).", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "report.html"
        diagnose(SAMPLES / FAULTY).to_html(page)
        shoot(browser, page, DOCS / "report.png")
        serve(browser, Path(folder), DOCS / "serve.png")
    print(f"wrote {DOCS / 'report.png'} and {DOCS / 'serve.png'}")
    return 0


def shoot(browser: str, page: Path, picture: Path) -> None:
    """Write a PNG of the first WIDTH x HEIGHT pixels of a local page; CalledProcessError when the browser fails."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"]
    options += [f"--user-data-dir={page.parent / 'profile'}", f"--window-size={WIDTH},{HEIGHT}"]
    options += ["--virtual-time-budget=10000", f"--screenshot={picture}", page.as_uri()]
    subprocess.run([browser, *options], check=True, capture_output=True, timeout=120)


def serve(browser: str, folder: Path, picture: Path) -> None:
    """Write a PNG of the served page while the faulty sample is replayed."""
    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-m", "rotorwatch.commands.cli", "serve", "--port", "0", "--store", str(folder / "fleet.db"), "-q"]
    server = subprocess.Popen([*command, "--speed", "6", str(SAMPLES / FAULTY)], stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    try:
        with sync_playwright() as playwright:
            window = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox", "--disable-gpu"])
            page = window.new_page(viewport={"width": WIDTH, "height": 1610})
            page.goto(server.stdout.readline().strip())
            page.set_input_files("#choose", sorted(SAMPLES.glob("*.bin.xz")))
            page.locator("#list tbody tr").nth(1).wait_for(timeout=120_000)
            page.reload()
            page.wait_for_selector("article[data-state=FAULT]", timeout=120_000)
            page.wait_for_timeout(5000)
            page.screenshot(path=picture)
            window.close()
    finally:
        server.terminate()
        server.wait()


if __name__ == "__main__":
    sys.exit(main())
