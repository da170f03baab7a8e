"""Makes docs/comparison.md: all estimators on simulated flights and, where the test logs are, on logs.

    python benchmarks/compare.py [--flights ../shared/flights] [--seeds 1] [--estimators NAME,NAME]

One estimator after the other, and each result is kept in the temporary folder (--kept): a run that is
interrupted goes on where it was. Flights: simulated ones of three frames; simulated autopilots' logs with known faults
(truth.csv); healthy logs of a real quad, as they are and with losses put in.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "comparison.md"
HEAD = """# Comparison

Every estimator on the same flights, the default diagnoser among them. Published methods run with their defaults on
rotational dynamics identified from each flight's first seconds ([methods](methods/index.md)); the default on its own plant.
Events are read from all of them the same way. Regenerate with `python benchmarks/compare.py`; the same on your own logs:

```sh
rotorwatch compare healthy1.bin healthy2.bin --losses 0.2,0.4
```

- **loss RMSE** of the faulty rotors, from 2 s after the onset on; 0 counts as the estimate where nothing was announced.
- **delay** from onset to the first event that names the rotor, median. **right**: the first event names exactly the faulty
  rotors; **named**: or names them among alternatives.
- **false alarms/h**: events before the onset or of other rotors, per hour judged; these are minutes of flight, so one false
  alarm is a large number.
- **coverage**: right events whose 95 % interval holds the loss.
- **us a step**: microseconds of one step of a quad in a compiled scan on one core of a loaded machine; best of three.
"""


def scenes(flights: Path, seeds: int) -> list:
    from rotorwatch.experiments.studies import compare_flights

    found = compare_flights.simulated(seeds)
    sitl = sorted((flights / "ardupilot-sitl").glob("*.bin.xz"))
    if sitl:
        found += compare_flights.with_truth(sitl, flights / "truth.csv")
    real = sorted((flights / "ardupilot-real-rrc").glob("good_prop_*.bin.xz"))
    return found + compare_flights.injected(real)


def main() -> None:
    from rotorwatch import discovery
    from rotorwatch.experiments.studies.compare import compare, markdown

    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--flights", type=Path, default=ROOT / "../shared/flights")
    arguments.add_argument("--seeds", type=int, default=1)
    arguments.add_argument("--estimators", default="")
    arguments.add_argument("--kept", type=Path, default=Path(tempfile.gettempdir()) / "rotorwatch-comparison.json")
    chosen = arguments.parse_args()
    result = {"groups": {}, "us_per_step": {}, "failed": {}}
    if chosen.kept.exists():
        result = json.loads(chosen.kept.read_text())
    flown = scenes(chosen.flights, chosen.seeds)
    names = chosen.estimators.split(",") if chosen.estimators else list(discovery.estimators())
    for name in names:
        if name in result["us_per_step"] or name in result["failed"]:
            continue
        try:
            one = compare(flown, [name])
        except Exception as why:  # a method that breaks must not cost the others' rows
            print(f"{name}: {type(why).__name__}: {why}", flush=True)
            continue
        for group, rows in one["groups"].items():
            result["groups"].setdefault(group, {}).update(rows)
        result["us_per_step"] |= one["us_per_step"]
        result["failed"] |= one["failed"]
        chosen.kept.write_text(json.dumps(result))
        print(name, one["us_per_step"] or one["failed"], flush=True)
        PAGE.write_text(HEAD + markdown(result), encoding="utf-8")


if __name__ == "__main__":
    main()
