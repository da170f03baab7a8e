"""Imbalance of each rotor, and the vibration that it is heard in."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotorwatch.answer.wording import rotors
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report import colours
from rotorwatch.report.axes import blank, flight_range, hover
from rotorwatch.report.blocks import Block, Table, Text

name, title, order = "balance", "Balance of each rotor", 170
views = ("page", "terminal", "post", "notebook")
COLUMNS = 300  # of the spectrogram
DARKEST = 0.995  # quantile of the amplitudes that has the darkest colour
QUIET_DB = 40.0  # below that, the lightest
UNITS = {"g mm/kg": "unbalance for each mass of the vehicle, g mm/kg", "urad": "angular acceleration over speed squared, urad"}


def data(diagnosis: Diagnosis) -> Diagnosis | None:
    """None where no rotor was heard."""
    return diagnosis if any(r.imbalance for r in diagnosis.rotors) else None


def words(data: Diagnosis) -> list[Block]:
    rows, together = [], []
    for r in data.rotors:
        found = r.imbalance
        if not found:
            rows.append((str(r.rotor), r.place, "not heard", ""))
            continue
        low, high = found["interval"]
        rows.append((str(r.rotor), r.place, f"{found['value']:.2f}", f"{low:.2f}–{high:.2f}"))
        if len(found["together"]) > 1 and found["together"][0] == r.rotor:
            together.append(rotors(found["together"]))
    unit = next(r.imbalance["unit"] for r in data.rotors if r.imbalance)
    text = f"Vibration once per turn over speed squared: {UNITS.get(unit, unit)}."
    if together:
        text += f" The speeds of {'; of '.join(together)} are too alike to tell them apart: each has their root mean square."
    return [Table(("rotor", "where", "imbalance", "95 % interval"), rows, right=(2,), most=None, name=name), Text(text)]


def plot(data: Diagnosis) -> dict[str, Any]:
    """balance: a bar of each rotor; spectrogram: the sensor's, with once per turn of each rotor, at its alias where it is above half the
    sampling rate."""
    drawn = {"balance": _bars(data)}
    if data.balance is not None and data.trace is not None and len(data.balance.windows.time) > 1:
        drawn["spectrogram"] = _spectrogram(data)
    return drawn


def _bars(diagnosis: Diagnosis) -> Any:
    from bokeh.models import ColumnDataSource, Range1d, Whisker

    heard = [(r.rotor, r.imbalance) for r in diagnosis.rotors if r.imbalance]
    looks, names = colours.looks(diagnosis), [str(r.rotor) for r in diagnosis.rotors]
    low, high = zip(*(found["interval"] for _, found in heard))
    source = ColumnDataSource(
        {
            "rotor": [str(k) for k, _ in heard], "value": [found["value"] for _, found in heard], "low": low, "high": high,
            "tint": [looks[k][0] for k, _ in heard], "windows": [found["windows"] for _, found in heard],
        }
    )  # fmt: skip
    unit = heard[0][1]["unit"]
    top = 1.15 * max(*high, 1e-6)
    p = blank(names, 220, f"imbalance [{unit}]", [])
    p.name, p.y_range, p.xaxis.axis_label = "balance", Range1d(start=0.0, end=top), "rotor"
    bars = p.vbar("rotor", top="value", width=0.6, source=source, fill_color="tint", fill_alpha=0.6, line_color="tint")
    p.add_layout(Whisker(base="rotor", lower="low", upper="high", source=source, line_color=colours.INK))
    tips = {"rotor": "@rotor", "imbalance": "@value{0.00}", "95 %": "@low{0.00} to @high{0.00}", "windows": "@windows"}
    hover(p, bars, tooltips=list(tips.items()))
    return p


def _spectrogram(diagnosis: Diagnosis) -> Any:
    from bokeh.models import Range1d

    heard = diagnosis.balance
    windows, half = heard.windows, 0.5 * heard.rate_hz
    start, end = float(windows.time[0]), float(windows.time[-1])
    edges = np.linspace(start, end, COLUMNS)
    nearest = np.clip(np.searchsorted(0.5 * (windows.time[1:] + windows.time[:-1]), edges), 0, len(windows.time) - 1)
    spectrum = np.maximum(windows.spectrum, 1e-12)
    level = 20.0 * np.log10(spectrum / np.quantile(spectrum, DARKEST))
    shade = (255.0 * np.clip(1.0 + level / QUIET_DB, 0.0, 1.0)).astype(np.uint8)
    away = np.abs(windows.time[nearest] - edges) > (end - start) / max(len(windows.time), 1) * 2.0
    image = np.where(away[None, :], 0, shade[nearest].T).astype(np.uint8)
    tints = [f"#{v:02x}{v:02x}{v:02x}" for v in range(255, -1, -1)]
    p = blank(flight_range(diagnosis), 260, "frequency [Hz]", [], y_range=Range1d(start=0.0, end=half))
    p.name = "spectrogram"
    p.image(image=[image], x=start, y=0.0, dw=end - start, dh=half, palette=tints, alpha=0.8)
    looks, lines = colours.looks(diagnosis, windows.speed.shape[1]), []
    for k in range(windows.speed.shape[1]):
        turning = windows.speed[:, k] > 0.0
        hz = windows.speed[turning, k] / (2.0 * np.pi)
        folded = np.abs((hz + half) % (2.0 * half) - half)  # where a tone above half the sampling rate is seen
        lines.append(p.scatter(windows.time[turning], folded, size=3, color=looks[k + 1][0], alpha=0.8, legend_label=f"rotor {k + 1}"))
    p.legend.update(orientation="horizontal", label_text_font_size="11px", background_fill_alpha=0.6, location="top_left")
    return p
