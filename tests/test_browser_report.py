"""The report in a real browser: it draws, zooms, prints no error and asks the network for nothing."""

import json
import re
import subprocess

import pytest

from conftest import hexa_diagnosis

# Runs after the page's own scripts and leaves what it saw in an attribute of <html>, which the browser prints.
PROBE = """
<script>
(function probe(tries) {
  if (document.documentElement.dataset.plots === undefined && tries) return setTimeout(probe, 50, tries - 1);
  const canvases = [];
  (function walk(node) {
    if (node.tagName === "CANVAS") canvases.push(node);
    if (node.shadowRoot) walk(node.shadowRoot);
    for (const child of node.children) walk(child);
  })(document.documentElement);
  const inked = (c) => {
    const pixels = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    let n = 0;
    for (let i = 3; i < pixels.length; i += 4) n += pixels[i] > 0;
    return n / (pixels.length / 4);
  };
  const figures = Bokeh.documents.flatMap((d) => d.roots());
  figures[0].x_range.setv({ start: 30, end: 34 });
  const before = figures.map((f) => f.renderers.filter((r) => r.visible).length);
  document.querySelector('.chips button[data-rotor="rotor 3"]').click();
  const after = figures.map((f) => f.renderers.filter((r) => r.visible).length);
  document.documentElement.dataset.probe = JSON.stringify({
    names: figures.map((f) => f.name),
    inked: canvases.filter((c) => c.width && c.height).map(inked),
    ranges: figures.map((f) => [f.x_range.start, f.x_range.end]),
    hidden: before.map((n, i) => n - after[i]),
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
    requests: performance.getEntriesByType("resource").map((e) => e.name),
  });
})(200);
</script>
"""


ANGLES = ["roll", "pitch", "yaw"]
FOLDED = ["altitude", "ground_speed", "voltage", "current", "vibration", "modes"]
SHOWN = ["loss", "lane", "command", "evidence", *(f"angle_{a}" for a in ANGLES), *ANGLES, "thrust"]
NAMES = SHOWN + FOLDED


@pytest.fixture(scope="module")
def visit(chromium, tmp_path_factory):
    """visit(width, extra) -> (what the probe saw, console lines) of the report at that width, with extra HTML in it."""
    folder = tmp_path_factory.mktemp("browser")
    report = folder / "report.html"
    hexa_diagnosis().to_html(report)
    text = report.read_text()

    def run(width, extra=""):
        report.write_text(text.replace("</body>", extra + PROBE + "</body>"))
        command = [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        command += ["--no-first-run", "--disable-background-networking", "--disable-component-update"]
        command += [f"--user-data-dir={folder / 'profile'}", f"--window-size={width},900"]
        command += ["--enable-logging=stderr", "--virtual-time-budget=20000", "--dump-dom", report.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        seen = re.search(r'<html[^>]* data-probe="([^"]*)"', done.stdout)
        assert seen, f"the page's scripts did not finish: {done.stderr[-2000:]}"
        console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
        return json.loads(seen.group(1).replace("&quot;", '"')), console

    return run


def complaints(console):
    """Console lines that are not plain information."""
    return [line for line in console if re.search(r"error|warn|exception|refused|violat", line, re.IGNORECASE)]


@pytest.fixture(scope="module")
def desktop(visit):
    return visit(1200)


def test_all_plots_are_drawn(desktop):
    seen, _ = desktop
    assert seen["names"] == NAMES
    assert len(seen["inked"]) >= len(SHOWN)
    assert sum(share > 0.01 for share in seen["inked"]) >= len(SHOWN), seen["inked"]


def test_zooming_one_plot_zooms_all(desktop):
    assert desktop[0]["ranges"] == [[30, 34]] * len(NAMES)


def test_switching_a_rotor_off_hides_its_lines(desktop):
    seen, _ = desktop
    assert dict(zip(seen["names"], seen["hidden"], strict=True)) == {
        "loss": 2,  # line and band
        "command": 1,
        **dict.fromkeys(set(NAMES) - {"loss", "command"}, 0),
    }


def test_console_has_no_error(desktop):
    assert complaints(desktop[1]) == []


def test_nothing_is_fetched(desktop, visit):
    """The page forbids itself every request, and the browser complains of any attempt: here of none, there of one."""
    assert desktop[0]["requests"] == []
    _, console = visit(1200, '<img src="http://rotorwatch.invalid/x.png" alt="">')
    assert len(complaints(console)) == 1 and "rotorwatch.invalid" in complaints(console)[0]


def test_a_phone_needs_no_sideways_scrolling(visit):
    seen, _ = visit(500)  # the narrowest window a headless Chromium makes
    assert seen["overflow"] <= 0
    assert sum(share > 0.01 for share in seen["inked"]) >= 7
