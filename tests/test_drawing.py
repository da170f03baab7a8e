"""The report's drawings: dots, bars and rotors stand where the numbers are."""

import re
from dataclasses import replace

import pytest

from conftest import against_healthy, hexa_diagnosis
from rotorwatch.report import drawing


def test_the_drawing_of_the_comparison_has_its_dots_where_the_numbers_are():
    """A row for each rotor and axis: bar from low to high, dot at the value; on one scale, whose zero line is where 0 is."""
    drawn = drawing.baseline(against_healthy())
    losses, balance = drawn.split("<figure>")[1:]
    span = drawing.WIDTH - drawing.LEFT - 60
    dots = [float(x) for x in re.findall(r'class="dot" cx="([\d.]+)"', losses)]
    assert dots == pytest.approx([drawing.LEFT + span * v / 0.4 for v in (0.0, 0.02, 0.3, 0.0, 0.0, 0.05)], abs=0.06)
    bars = re.findall(r'class="band" x1="([\d.]+)" y1="\d+" x2="([\d.]+)"', losses)
    assert [float(v) for v in bars[2]] == pytest.approx([drawing.LEFT + span / 2, drawing.LEFT + span], abs=0.06)
    assert f'class="zero" x1="{drawing.LEFT:.1f}"' in losses and re.findall(r">(\d+ %)<", losses)[2] == "30 %"
    middle = drawing.LEFT + span / 2
    assert f'class="zero" x1="{middle:.1f}"' in balance
    dots = [float(x) for x in re.findall(r'class="dot" cx="([\d.]+)"', balance)]
    assert dots[0] > middle + 1 > middle > dots[1] and dots[2] == pytest.approx(middle, abs=0.06)
    for left, right in re.findall(r'class="band" x1="([\d.]+)" y1="\d+" x2="([\d.]+)"', balance):
        assert float(left) + float(right) == pytest.approx(2 * middle, abs=0.2) and float(left) < middle
    assert dots[0] == pytest.approx(drawing.LEFT + span, abs=0.06)  # the furthest is at the end


@pytest.mark.parametrize("change", [{"verdict": "inconclusive"}, {"verdict": None}, {"loss": []}, {"interval": None}, {"loss": [0.1] * 4}])
def test_a_comparison_that_says_nothing_of_every_rotor_is_not_drawn(change):
    whole = against_healthy()
    whole = replace(whole, whole_flight={**whole.whole_flight, **change})
    assert drawing.baseline(whole) == "" and drawing.baseline(hexa_diagnosis()) == ""


def test_the_airframe_fits_its_frame(fault):
    drawn = drawing.airframe(fault)
    left, top, width, height = map(float, re.search(r'viewBox="([-\d. ]+)"', drawn).group(1).split())
    for x, y in re.findall(r"translate\((-?[\d.]+) (-?[\d.]+)\)", drawn):
        assert left + 30 < float(x) < left + width - 30 and top + 30 < float(y) < top + height - 30
    assert (left + width / 2, width) == (pytest.approx(0.0), pytest.approx(height - 14))
