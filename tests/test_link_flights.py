"""A small part of what `python -m tests.link_flights` runs: recorded flights of a real autopilot over a link, against their own logs."""

import pytest
from tests.link_flights import RECORDED, compared, sent

from rotorwatch import diagnose, logs


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize(
    "name, link, late_s",
    [
        ("quadx_m1_mul0.90_hover", "asked for", 0.3),
        ("quadx_m1_mul0.90_hover", "4 Hz", 0.5),
        ("hexax_m3_mul0.80_square_wind", "asked for, 3 s cut", 0.3),  # taken for a landing, the gap hid the loss: rotor 4 was named
        ("quadx_m3_mul0.85_tlog", "asked for, 3 s cut", 0.3),  # the loss begins within the gap
    ],
)
def test_over_a_link_a_flight_is_assessed_as_its_log_is(name, link, late_s):
    if not (RECORDED / f"{name}.bin.xz").exists():
        pytest.skip(f"the shared flight {name} is not here")
    row = compared(name, link)
    assert row["watch"] == row["own"] == row["recording"] == {row["weak"]}
    assert not row["wrong"] and 0.0 <= row["late_s"] < late_s


def test_over_a_link_a_vehicle_that_falls_is_reported_with_its_rotor():
    if not (CRASH := RECORDED.parent / "crash" / "quad-off-1.bin.xz").exists():
        pytest.skip("the shared flight quad-off-1 is not here")
    flight = logs.read(CRASH)
    reported, recording, _ = sent(flight, 2, "asked for")
    (own,) = [e for e in diagnose(flight).events if e.kind == "loss_of_control"]
    for events in (reported, recording):
        (lost,) = [e for e in events if e["kind"] == "loss_of_control"]
        assert lost["rotors"] == list(own.rotors) == [2] and lost["cause"] == "rotor"
        assert abs(lost["detected_s"] - own.detected_s) < 0.5 and abs(lost["impact_s"] - own.extra["impact_s"]) < 0.3
