"""Is the simulator kinder than the world? Statistics of the diagnosis' normalised innovations, simulated flights against logged ones.

    python benchmarks/residuals.py FOLDER [FOLDER ...] [--plan plans/open.toml] [--flights 90]

FOLDER holds logs (.ulg, .bin, or these with .xz) and truth.csv with the columns path, kind and onset_s: of healthy flights all assessed
ticks count, of others those more than LEAD s before the onset. Simulated are the healthy flights among the first of the plan.

z = innovation / its standard deviation as the estimator has it, (T, 4): roll, pitch, yaw, thrust. Of each flight and axis: the standard
deviation of z; excess kurtosis; share beyond 4; correlation of neighbouring ticks; power in bands of a Welch spectrum (Hann, SEGMENT ticks)
as a share of all; its slope, d log10 S / d log10 f, from 0.5 Hz on; correlation between axes. Then medians and 90 % quantiles over flights;
the simulator is called kinder where the upper quantile of logged flights is FURTHER times its own: of a standard deviation, kurtosis or
share, else of an absolute correlation or slope.
"""

from __future__ import annotations

import argparse
import csv
import lzma
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rotorwatch import logs
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch.toolkit import ASSESS, estimated, prepare
from rotorwatch_lab import campaign
from rotorwatch_lab.campaign import batch, open_score
from rotorwatch_lab.experiments import tools

AXES = ("roll", "pitch", "yaw", "thrust")
SEGMENT, LEAD, LEAST = 128, 2.0, 200
BANDS = ((0.0, 0.4), (0.4, 1.5), (1.5, 4.0), (4.0, 100.0))
SIZES, SIGNED = ("standard deviation", "excess kurtosis", "share beyond 4"), ("correlation of neighbours", "slope")
FURTHER = 1.25


def innovations(flight: Flight, until: float = np.inf) -> tuple[np.ndarray, float] | None:
    """(z (T, 4) of assessed ticks before `until` [s], seconds of a tick), or None where the flight is not assessed."""
    ready = prepare(flight)
    if ready.table is None:
        return None
    out, table = estimated(ready).out, ready.table
    z = np.asarray(out.innovation) / np.sqrt(np.asarray(out.innovation_var))
    keep = (table.mode == ASSESS) & table.valid.all(axis=1) & (table.time < until)
    if table.contact is not None:
        keep &= ~table.contact
    return (z[keep], table.dt) if keep.sum() >= LEAST else None


def spectrum(z: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """(f [Hz], S) of z (T,): mean periodogram of half overlapping segments, without the mean frequency 0."""
    starts = range(0, len(z) - SEGMENT + 1, SEGMENT // 2)
    window = np.hanning(SEGMENT)
    parts = [np.abs(np.fft.rfft(window * (z[k : k + SEGMENT] - z[k : k + SEGMENT].mean()))) ** 2 for k in starts]
    return np.fft.rfftfreq(SEGMENT, dt)[1:], np.mean(parts, axis=0)[1:]


def measures(z: np.ndarray, dt: float) -> dict[str, float]:
    """{"axis: what": value} of one flight."""
    found = {}
    for k, axis in enumerate(AXES):
        x = z[:, k]
        off = x - x.mean()
        variance = max(off @ off / len(off), 1e-12)
        f, S = spectrum(x, dt)
        high = f > 0.5
        own = {
            "standard deviation": np.sqrt(np.mean(x * x)),
            "excess kurtosis": np.mean(off**4) / variance**2 - 3.0,
            "share beyond 4": np.mean(np.abs(x) > 4.0),
            "correlation of neighbours": np.mean(off[1:] * off[:-1]) / variance,
            "slope": np.polyfit(np.log10(f[high]), np.log10(np.maximum(S[high], 1e-12)), 1)[0],
        }
        for low, top in BANDS:
            own[f"power {low:g} to {top:g} Hz" if top < 50.0 else f"power from {low:g} Hz"] = S[(f >= low) & (f < top)].sum() / S.sum()
        found |= {f"{axis}: {name}": float(value) for name, value in own.items()}
    across = np.corrcoef(z.T)
    found |= {f"correlation {AXES[i]}, {AXES[j]}": float(abs(across[i, j])) for i in range(4) for j in range(i)}
    return found


def logged(folder: Path) -> Iterator[dict[str, float]]:
    """Measures of the logs of a folder with truth.csv."""
    with open(folder / "truth.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        path = folder / row["path"]
        onsets = [float(t) for t in row["onset_s"].split(";") if t]
        if path.suffixes[-2:][:1] == [".tlog"] or not path.exists() or (row["kind"] != "healthy" and not onsets):
            continue
        name = path.name.removesuffix(".xz")
        with tempfile.TemporaryDirectory() as room:
            copy = Path(room) / name
            copy.write_bytes(lzma.decompress(path.read_bytes()) if path.suffix == ".xz" else path.read_bytes())
            try:
                found = innovations(logs.read(copy), min(onsets, default=np.inf) - LEAD)
            except RotorwatchError:
                continue
        if found is not None:
            yield measures(*found)


def simulated(plan: campaign.Plan, flights: int) -> Iterator[dict[str, float]]:
    """Measures of the flights with healthy rotors among the first of a plan."""
    healthy = [k for k in range(flights) if open_score.group(plan.flight(k)) == "healthy"]
    for k in healthy:
        for _, scenario, numbers, record in batch.simulated(plan, [k], 1):
            try:
                found = innovations(batch.logged(k, scenario, numbers, record))
            except RotorwatchError:
                continue
            if found is not None:
                yield measures(*found)


def compared(ours: list[dict[str, float]], theirs: list[dict[str, float]]) -> list[list[str]]:
    """Rows [what, simulated, real, mark]: medians with 90 % quantiles over flights."""
    rows = []
    for name in theirs[0]:
        a, b = (np.array([m[name] for m in flights]) for flights in (ours, theirs))
        what, kinder = name.partition(": ")[2], ""
        if what in SIZES or what in SIGNED or not what:
            near, far = (np.quantile(x if what in SIZES else np.abs(x), 0.9) for x in (a, b))
            kinder = "kinder" if far > max(FURTHER * near, 1e-3) else ""
        cells = [f"{np.median(x):.3f} ({np.quantile(x, 0.1):.3f} to {np.quantile(x, 0.9):.3f})" for x in (a, b)]
        rows.append([name, *cells, kinder])
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--plan", default=str(Path(__file__).parents[1] / "plans" / "open.toml"))
    parser.add_argument("--flights", type=int, default=90)
    asked = parser.parse_args()
    real = [m for folder in asked.folders for m in logged(folder)]
    ours = list(simulated(campaign.read(asked.plan), asked.flights))
    if not real or not ours:
        raise SystemExit(f"{len(real)} logged and {len(ours)} simulated flights were assessed: nothing to compare.")
    print(f"{len(ours)} simulated and {len(real)} logged flights: median (10 % to 90 % of flights)\n")
    print(tools.table(["innovations", "simulated", "logged", "simulator"], compared(ours, real)))


if __name__ == "__main__":
    main()
