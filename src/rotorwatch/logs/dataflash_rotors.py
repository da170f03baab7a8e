"""The servo output of each rotor, and the airframe, of a DataFlash log."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rotorwatch.base.arrays import unique
from rotorwatch.flight import output_functions
from rotorwatch.flight.output_functions import SERVO_MOTORS

# FRAME_CLASS -> motor numbers. A tricopter's motor 7 is its tail servo, motor 3 does not exist.
FRAME_ROTORS: dict[int, tuple[int, ...]] = {
    class_: tuple(range(1, count + 1)) for class_, count in ((1, 4), (2, 6), (3, 8), (4, 8), (5, 6), (10, 2), (12, 12), (14, 10))
} | {7: (1, 2, 4)}
BY_NUMBER = "No output has a motor function; rotor k was taken to be output k."
LEAST_THROTTLE = 0.02  # standard deviation below which the throttle counts as constant
TAIL = 39  # SERVOn_FUNCTION of a tricopter's tail servo: "motor 7"
DRIVEN_US, ENOUGH, MOVES = (1050.0, 100, 10)  # pulses of a motor that runs; samples, and different values, of one that is flown with
UNLIKE = 0.2  # share of an output's deviation not explained by the others
FRAME_NAMES = {"QUAD": 1, "HEXA": 2, "OCTA": 3, "OCTA_QUAD": 4, "OCTAQUAD": 4, "Y6": 5, "HELI": 6, "TRI": 7}
FRAME_NAMES |= {"SINGLE": 8, "COAX": 9, "BICOPTER": 10, "DODECA_HEXA": 12, "DODECAHEXA": 12, "DECA": 14}

FRAME_TYPES = {"PLUS": 0, "X": 1, "V": 2, "H": 3}


def frame(parameters: Mapping[str, float], announced: tuple[str, str]) -> tuple[int | None, int | None]:
    """(FRAME_CLASS, FRAME_TYPE) from the parameters or, before Copter 3.5, from FRAME and the announced name."""
    class_, type_ = parameters.get("FRAME_CLASS"), parameters.get("FRAME_TYPE", parameters.get("FRAME"))
    if not class_:
        class_ = FRAME_NAMES.get(announced[0].upper())
    return (int(class_) if class_ else None), (int(type_) if type_ is not None else None)


def announced(parameters: dict[str, float], text: tuple[str, str]) -> list[str]:
    """Put the frame that the autopilot announces ("Frame: QUAD/X") into parameters that lack theirs, with a note.

    Only for firmware that has FRAME_CLASS and FRAME_TYPE at all: one of the two, or the text's second half, is there."""
    class_, type_ = FRAME_NAMES.get(text[0].upper()), FRAME_TYPES.get(text[1].upper())
    announced_frame = {"FRAME_CLASS": class_, "FRAME_TYPE": type_}
    lacking = {k: float(v) for k, v in announced_frame.items() if k not in parameters and v is not None}
    if class_ is None or type_ is None or "FRAME" in parameters or not lacking:
        return []
    parameters.update(lacking)
    names = " and ".join(lacking)
    return [f"{names} not in the log; the frame that the autopilot announced, {text[0]}/{text[1]}, was taken."]


def _functions(parameters: Mapping[str, float]) -> dict[int, int]:
    """Servo output -> its SERVOn_FUNCTION."""
    given = ((output_functions.function(name, value), value) for name, value in parameters.items())
    return {one.output: int(value) for one, value in given if one is not None and one.driver == output_functions.SERVO}


def outputs(parameters: Mapping[str, float], frame_class: int | None, pwm: Mapping[int, np.ndarray]) -> tuple[dict[int, int], list[str]]:
    """({rotor: servo output}, sentences on assumptions), both numbered from 1.

    pwm: servo output -> its logged pulse widths [us]; only used when neither SERVOn_FUNCTION nor the frame are known."""
    functions = _functions(parameters)
    mapped: dict[int, int] = {}
    for output in sorted(functions):
        rotor = SERVO_MOTORS.get(functions[output])
        if rotor and (rotor not in mapped or rotor == output):
            mapped[rotor] = output
    expected = FRAME_ROTORS.get(frame_class or 0)
    notes = []
    if mapped and expected:
        if extra := sorted(set(mapped) - set(expected)):
            # A tricopter's tail servo is function 39 ("motor 7"); nothing odd about that.
            if not (frame_class == 7 and extra == [7]):
                notes.append(f"Outputs of motors {_listed(extra)} are not part of this frame and were ignored.")
        if missing := [k for k in expected if k not in mapped]:
            free = {k: k for k in missing if not functions.get(k) or _one_bit_off(functions[k], k)}
            # An output drives one rotor: of two parameters for it, the one with a bit error is damaged.
            twice = {k: k for k, output in mapped.items() if output in free and not functions.get(k)}
            mapped |= free | twice
            notes.append(f"The log does not say which output drives motors {_listed(missing)}; outputs of the same number were assumed.")
        return {k: mapped[k] for k in expected if k in mapped}, notes
    if mapped:
        return dict(sorted(mapped.items())), notes
    if expected and (other := [k for k in expected if functions.get(k)]):
        # ArduPilot drives no rotor through an output that has another function.
        notes.append(
            f"No output has a motor function, and outputs {_listed(other)} have others (SERVO{other[0]}_FUNCTION "
            f"{functions[other[0]]}): the motor outputs are not in this log."
        )
        return {}, notes
    if expected:
        if functions:
            notes.append(BY_NUMBER)
        return {k: k for k in expected}, notes
    moving = [k for k, u in sorted(pwm.items()) if unique(u[(u > 500) & (u < 2600)]).size > 1]
    if moving:
        notes.append(f"Neither outputs nor frame are named in the log; moving outputs {_listed(moving)} were taken as rotors.")
    return {rotor + 1: output for rotor, output in enumerate(moving)}, notes


def left_out(parameters: Mapping[str, float], outputs: Mapping[int, int], pwm: Mapping[int, np.ndarray]) -> list[int]:
    """Servo outputs (from 1) that move like motors though they drive no rotor of the frame, which is then not the one that flew: outputs
    with a motor function that move, and, without known functions, those that are combinations of the same demands as the rotors'
    outputs.

    outputs: {rotor: servo output}, as of `outputs`. A tricopter's tail servo has a motor function too."""
    functions = _functions(parameters)
    rotors = [pwm[output] for output in outputs.values() if output in pwm]
    extra = []
    for output, pulses in sorted(pwm.items()):
        function = functions.get(output, 0)
        if output in outputs.values() or len(rotors) < 3 or function == TAIL:
            continue
        columns = np.stack([*rotors, pulses], axis=1)
        fine = (columns > DRIVEN_US).all(axis=1)
        if fine.sum() < ENOUGH or unique(pulses[fine]).size < MOVES:
            continue
        if SERVO_MOTORS.get(function) if functions else _of_one_mixer(columns[fine]):
            extra.append(output)
    return extra


def _of_one_mixer(columns: np.ndarray) -> bool:
    """True if the last of the outputs (n, k) is a combination of the others, of similar size."""
    sizes = columns.std(axis=0)
    if sizes[-1] < 0.5 * sizes[:-1].min():
        return False
    apart = columns - columns.mean(axis=0)
    left = apart[:, -1] - apart[:, :-1] @ np.linalg.lstsq(apart[:, :-1], apart[:, -1], rcond=None)[0]
    return bool(left.std() < UNLIKE * sizes[-1])


def follow(time: np.ndarray, pulses: np.ndarray, stamps: np.ndarray, throttle: np.ndarray) -> bool:
    """True if these outputs, pulses (n, k) at `time`, rise and fall with the throttle at `stamps`. True where the throttle does not."""
    mean = np.nanmean(np.where(pulses > 500, pulses, np.nan), axis=1)
    commanded = np.interp(time, stamps, throttle)
    fine = np.isfinite(mean) & np.isfinite(commanded)
    if fine.sum() < 20 or np.std(commanded[fine]) < LEAST_THROTTLE:
        return True
    return bool(np.std(mean[fine]) > 0.0 and np.corrcoef(mean[fine], commanded[fine])[0, 1] > 0.5)


def _one_bit_off(function: int, rotor: int) -> bool:
    """True if a logged SERVOn_FUNCTION is one wrong bit of a float32 away from that of the rotor."""
    meant = next(f for f, k in SERVO_MOTORS.items() if k == rotor)
    a, b = np.array([function, meant], np.float32).view(np.uint32).tolist()
    return (a ^ b).bit_count() == 1


def _listed(numbers) -> str:
    return ", ".join(str(n) for n in numbers)
