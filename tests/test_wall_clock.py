"""UTC of second 0."""

import numpy as np
import pytest

from rotorwatch.logs import wall_clock


@pytest.mark.parametrize(
    ("week", "milliseconds", "utc"),
    [
        (2200, 296408600, "2022-03-09T10:19:50.600Z"),  # 18 leap seconds
        (1867, 604_800_000 - 86_400_000 * 4, "2015-10-20T23:59:43.000Z"),  # 17
        (1694, 0, "2012-06-23T23:59:45.000Z"),  # 15: a week before the next
    ],
)
def test_gps_time_less_leap_seconds(week, milliseconds, utc):
    assert wall_clock.stamp(float(wall_clock.of_gps(week, milliseconds))) == utc


def test_the_start_is_what_most_samples_say():
    time = np.arange(0.0, 20.0, 0.2)
    unix = 1.7e9 + time
    unix[3], unix[50] = 0.0, 1.9e9  # no fix, and a flipped bit
    assert wall_clock.start(time + 5.0, unix) == wall_clock.stamp(1.7e9 - 5.0)


@pytest.mark.parametrize("unix", [[], [0.0, 0.0], [1.2e9, 1.7e9, 1.5e9, 1.6e9], [np.nan]])
def test_no_start_is_made_up(unix):
    assert wall_clock.start(np.arange(len(unix)), unix) is None
