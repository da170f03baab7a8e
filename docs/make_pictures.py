"""Draw the pictures of the documentation: `python docs/make_pictures.py`. Needs Chromium.

docs/report.png is the top of the demo's HTML report, as a browser shows it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from rotorwatch.cli import SAMPLES
from rotorwatch.diagnose import diagnose

DOCS = Path(__file__).resolve().parent
FAULTY = "hexax_m3_mul0.80_square_wind.bin.xz"
WIDTH, HEIGHT = 1100, 1440  # CSS pixels: header, verdict, rotors and the loss plot
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
    print(f"wrote {DOCS / 'report.png'}")
    return 0


def shoot(browser: str, page: Path, picture: Path) -> None:
    """Write a PNG of the first WIDTH x HEIGHT pixels of a local page; CalledProcessError when the browser fails."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"]
    options += [f"--user-data-dir={page.parent / 'profile'}", f"--window-size={WIDTH},{HEIGHT}"]
    options += ["--virtual-time-budget=10000", f"--screenshot={picture}", page.as_uri()]
    subprocess.run([browser, *options], check=True, capture_output=True, timeout=120)


if __name__ == "__main__":
    sys.exit(main())
