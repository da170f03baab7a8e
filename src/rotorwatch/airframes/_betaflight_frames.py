"""Frames of Betaflight, INAV and their relatives: of each motor, in their order (motor[0] is the first), [angle clockwise from the
nose, yaw] or, where the arms are not on a circle, [right, forward, yaw]. Yaw: 1 counter-clockwise, -1 clockwise seen from above, as the
mixer tables of mixer_init.c have it (there roll is to the right, pitch nose down); yaw_motors_reversed ("props out") turns all of them
round. A servo yaws the tri."""

from __future__ import annotations

FRAMES: dict[str, tuple[tuple[float, ...], ...]] = {
    "quad-x": ((135, -1), (45, 1), (-135, 1), (-45, -1)),
    "quad-plus": ((180, -1), (90, 1), (-90, 1), (0, -1)),
    "hexa-x": ((150, 1), (30, 1), (-150, -1), (-30, -1), (90, -1), (-90, 1)),
    "hexa-plus": ((120, 1), (60, -1), (-120, 1), (-60, -1), (0, 1), (180, -1)),
    "y6": (
        (0, -1.3333333333333333, 1), (1, 0.6666666666666666, -1), (-1, 0.6666666666666666, -1),
        (0, -1.3333333333333333, -1), (1, 0.6666666666666666, 1), (-1, 0.6666666666666666, 1),
    ),
    "octa-x8": ((135, -1), (45, 1), (-135, 1), (-45, -1), (135, 1), (45, -1), (-135, -1), (-45, 1)),
    "octa-x": ((-67.5, 1), (22.5, 1), (112.5, 1), (-157.5, 1), (-22.5, -1), (67.5, -1), (157.5, -1), (-112.5, -1)),
    "octa-plus": ((-45, 1), (45, 1), (135, 1), (-135, 1), (0, -1), (90, -1), (180, -1), (-90, -1)),
    "tri": ((180, 0), (60, 0), (-60, 0)),
}  # fmt: skip
"""Motors of each frame."""
