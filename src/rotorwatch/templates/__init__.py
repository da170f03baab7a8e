"""The beginning of a plug-in: a folder with its file, a sample and a test that passes. Templates are the text files beside this one."""

from __future__ import annotations

import keyword
import os
import shutil
import zlib
from pathlib import Path

from rotorwatch.base.choices import meant
from rotorwatch.errors import ConfigError

HERE = Path(__file__).parent
SAMPLES = HERE.parent / "samples"
KINDS = {"reader": "quadx_healthy_hover.bin.xz", "method": "hexax_m3_mul0.80_square_wind.bin.xz", "witness": "quadx_healthy_hover.bin.xz"}
"""Kind -> the flight that its sample is made of."""
GROUPS = {
    "reader": "[project.entry-points.'rotorwatch.logs']\n{name} = '{name}'\n\n"
    "[project.entry-points.'rotorwatch.airframes']\n{name} = '{name}'\n",
    "method": "[project.entry-points.'rotorwatch.estimators']\n{name} = '{name}:{title}'\n",
    "witness": "[project.entry-points.'rotorwatch.witnesses']\n{name} = '{name}'\n",
}
PROJECT = """[project]
name = '{name}'
version = '0.1'
dependencies = ['rotorwatch']

{groups}
[build-system]
requires = ['hatchling']
build-backend = 'hatchling.build'

[tool.hatch.build.targets.wheel]
only-include = ['{name}.py']
"""
FLOWN_S = 60.0  # of the sample of a reader


def new(kind: str, name: str, folder: str | os.PathLike = ".") -> Path:
    """Write the beginning of a plug-in into FOLDER/NAME: NAME.py, a sample, test_NAME.py and pyproject.toml.

    kind: reader (a log format), method (an estimator) or witness (further evidence). name: of the module, an identifier in small letters.
    folder: created where it is missing. Returns FOLDER/NAME. Raises ConfigError for another kind or name, and where that exists."""
    if kind not in KINDS:
        raise ConfigError(f"There is no template of a {kind}{meant(kind, KINDS)}; give one of {', '.join(KINDS)}.")
    if not (name.isascii() and name.isidentifier() and name.islower()) or keyword.iskeyword(name) or name.startswith("_"):
        raise ConfigError(f"{name} cannot be the name of a module: give small letters, digits and underscores, such as my_{kind}.")
    target = Path(folder) / name
    title = "".join(part.capitalize() for part in name.split("_"))
    fields = {"NAME": name, "TITLE": title, "NUMBER": str(200 + zlib.crc32(name.encode()) % 56)}
    try:
        target.mkdir(parents=True)
        for template, file in ((f"{kind}.txt", f"{name}.py"), (f"{kind}_test.txt", f"test_{name}.py")):
            text = (HERE / template).read_text(encoding="utf-8")
            for field, value in fields.items():
                text = text.replace(f"@{field}@", value)
            (target / file).write_text(text, encoding="utf-8")
        project = PROJECT.format(name=name, groups=GROUPS[kind].format(name=name, title=title))
        (target / "pyproject.toml").write_text(project, encoding="utf-8")
        if kind == "reader":
            (target / f"sample.{name}").write_text(_log(SAMPLES / KINDS[kind], name), encoding="ascii")
        else:
            shutil.copyfile(SAMPLES / KINDS[kind], target / "sample.bin.xz")
    except FileExistsError:
        raise ConfigError(f"{target} exists already; give another name.") from None
    except OSError as why:
        raise ConfigError(f"{target} cannot be written: {why.strerror}.") from None
    return target


def _log(path: Path, name: str) -> str:
    """A flight as the template's text log: M,t_us and outputs in per cent; I,t_us, body rates in deg/s and specific force in g."""
    from rotorwatch import logs

    flight = logs.read(path).until(FLOWN_S)
    motors, gyro, accel = flight["motors"], flight["gyro"], flight["accel"]
    rows = [(t, "M", 0.1 * (row - 1000.0)) for t, row in zip(motors.time, motors.values)]
    rows += [(t, "I", (*rate * 57.29577951308232, *force / 9.80665)) for t, rate, force in zip(gyro.time, gyro.values, accel.values)]
    rows.sort(key=lambda row: row[0])
    lines = [f"{kind},{1e6 * t:.0f}," + ",".join(f"{v:.6g}" for v in values) for t, kind, values in rows]
    return "\n".join([f"{name.upper()} 1", *lines]) + "\n"
