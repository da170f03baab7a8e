"""A small part of what `python -m tests.link_flights` runs: recorded flights of a real autopilot over a link, against their own logs."""

import pytest
from tests.link_flights import RECORDED, compared


@pytest.mark.parametrize(
    "name, link, late_s",
    [
        ("quadx_m1_mul0.90_hover", "asked for", 0.3),
        ("quadx_m1_mul0.90_hover", "4 Hz", 0.5),
        (
            "hexax_m3_mul0.80_square_wind",
            "asked for, 3 s cut",
            0.3,
        ),  # taken for a landing, the gap hid the loss: rotor 4 was named
        ("quadx_m3_mul0.85_tlog", "asked for, 3 s cut", 0.3),  # the loss begins within the gap
    ],
)
def test_over_a_link_a_flight_is_judged_as_its_log_is(name, link, late_s):
    if not (RECORDED / f"{name}.bin.xz").exists():
        pytest.skip(f"the shared flight {name} is not here")
    row = compared(name, link)
    assert row["watch"] == row["own"] == row["recording"] == {row["weak"]}
    assert not row["wrong"] and 0.0 <= row["late_s"] < late_s
