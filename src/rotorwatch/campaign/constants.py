"""The constants of the default method: of each its unit, what it means, and the value that leaves its part out, where there is one.

`rotorwatch ablate` says what each is worth (docs/ablation.md).
"""

from __future__ import annotations

from typing import NamedTuple


class Constant(NamedTuple):
    """One line of the table. off: None where leaving it out means nothing."""

    unit: str
    meaning: str
    off: float | None = None


BIG = 1e6
TABLE: dict[str, Constant] = {
    "plant.TAU": Constant("s", "time constants of the two coloured disturbances"),
    "plant.ANSWER_S": Constant("s", "by when a controller has answered what happened"),
    "plant.USUAL_S": Constant("s", "over which what is usual is averaged, and a new loss is refined"),
    "plant.GAIN_MEAN": Constant("hover thrusts s^2/rad", "angular gains of any multirotor, per rotor"),
    "plant.GAIN_SD": Constant("hover thrusts s^2/rad", "how much multirotors differ in them"),
    "plant.DAMPING_RATE": Constant("1/s", "damping over gain of any multirotor"),
    "plant.DAMPING_RATE_SD": Constant("1/s", "how much multirotors differ in it"),
    "plant.SIDE": Constant("hover thrusts s^2/m", "roll and pitch that a side force takes, per rotor"),
    "plant.SIDE_SD": Constant("hover thrusts s^2/m", "how much multirotors differ in it", 1e-6),
    "plant.BIAS_SD": Constant("hover thrusts", "trim before take-off"),
    "plant.SHARE_SD": Constant("1", "what lower coaxial rotors give may be off by so much", 1e-6),
    "noise.MEMORY_S": Constant("s", "how long a residual counts; evidence that chance brings in it stops learning"),
    "noise.CLIP": Constant("1", "a square counts at most so many times its mean: a fault is not noise", BIG),
    "noise.GROWTH_WEIGHT": Constant("samples", "weight of: variance grows with the lag", 1e-9),
    "noise.FLOOR": Constant("hover thrusts^2", "least white variance: one step of a few outputs"),
    "noise.GENERIC": Constant("hover thrusts^2", "variances before a flight has shown its own"),
    "noise.GENERIC_WEIGHT": Constant("samples", "weight of those"),
    "caution.GARROTE": Constant("1", "motion teaches gains only above so many times its calm level", 0.0),
    "caution.LEVEL_MEMORY_S": Constant("s", "over which that level is averaged"),
    "caution.GAIN_ERROR": Constant("1", "share by which gains may be wrong for a moment", 0.0),
    "caution.DAMPING_ERROR": Constant("1", "share by which damping may be", 0.0),
    "caution.ERROR_TICKS": Constant("ticks", "how long such an error lasts"),
    "caution.LAG_ERROR_S": Constant("s", "by so much a command's time may be off", 0.0),
    "caution.SNAPSHOT": Constant("1", "share of a step that one slow command may be off by within its tick", 0.0),
    "caution.BURST_MEMORY_S": Constant("s", "over which innovations are compared with the noise model"),
    "caution.BURST_CLIP": Constant("1", "a square counts in that at most so many times what the model expects"),
    "caution.LASTING_MEMORY_S": Constant("s", "the same for innovations that lean to one side"),
    "caution.GUST_SHARE": Constant("1", "motion teaches gains only above so many times what gusts do", 0.0),
    "caution.LEAST_GAIN": Constant("1", "share of the usual gain that motion takes at least"),
    "caution.FAR": Constant(
        "hover thrusts", "collective thrust or load factor away from usual, up to which the thrust curve holds"
    ),
    "caution.FAR_ERROR": Constant("1", "share of what is beyond it that may be wrong", 0.0),
    "caution.BELIEVED": Constant("full thrust", "up to which a rotor gives what it is commanded"),
    "caution.AT_LIMIT": Constant("full thrust", "above which it may give only that much", BIG),
    "kalman.MOVING_S": Constant("s", "a loss that has left its mean over so long by its sd is refined on"),
    "kalman.THETA_WALK": Constant("1/s", "variance by which a loss walks while it is refined", 0.0),
    "kalman.OUTLIER": Constant("sd", "an innovation counts as at most so large", BIG),
    "hypotheses.CLEAR": Constant("nats", "so much better an explanation must be to count: ten times likelier"),
    "hypotheses.GONE": Constant("loss", "from which on a rotor is as good as gone"),
    "hypotheses.NONE": Constant("loss", "below which it is none"),
    "hypotheses.LOSS_WIDTH": Constant("loss", "prior sd of losses"),
    "hypotheses.SMALL_WIDTH": Constant("loss", "prior sd of the half of them that are small"),
    "hypotheses.SLOP": Constant("1", "share by which what a loss does to each axis may differ from geometry", 0.0),
    "hypotheses.FAR_SHARE": Constant("1", "share of disturbances that are FAR times as large as this flight's", 1e-30),
    "hypotheses.FAR": Constant("1", "how much larger those are"),
    "hypotheses.WEIGHT[pair]": Constant("1", "prior weight of two rotors at once, against one particular rotor"),
    "hypotheses.WEIGHT[recovery]": Constant("1", "prior weight of a rotor that is well again"),
    "hypotheses.WEIGHT[disturbance]": Constant("1", "prior weight of a disturbance"),
    "hypotheses.RECOVERY_SHARE": Constant(
        "1", "share of it by which a loss that ends may differ from what it was thought to be"
    ),
    "evidence.DISTURBANCE_SCALE": Constant("1", "size of disturbances, over sd of this flight's over ten seconds"),
    "evidence.DISTURBANCE_RANGE": Constant("hover thrusts", "that size is within"),
    "announcement.GATES": Constant("1", "share of the statistic's false alarms that the other conditions let pass"),
    "announcement.TICKS": Constant("ticks", "in a row for which all conditions hold"),
    "announcement.EDGE": Constant("reach", "an onset so far back in the bank is a drift", 2.0),
    "announcement.ABSORB_S": Constant("s", "after which what is certain is explained without an announcement"),
    "announcement.CERTAIN_NATS": Constant("nats", "from which on it is certain", BIG),
    "plausibility.ASKED_SHARE": Constant("1", "share of a loss that must have been asked for, and be missing", -BIG),
    "plausibility.ASKED_SLACK": Constant("hover thrusts", "what may be missing in that"),
    "plausibility.ASKED_MOST": Constant("loss", "that counts at most for it"),
    "plausibility.MISSING_SLACK": Constant("hover thrusts", "the same for thrust that is missing", BIG),
    "plausibility.LIMIT_S": Constant("s", "for which a rotor at its limit is remembered", 1e-3),
    "opposite.TURNING": Constant("rad/s", "yaw above which its drag is known too badly to suspect opposite rotors"),
    "opposite.HEAVING": Constant("1", "load factor away from 1, the same"),
    "posterior.RESOLVE_S": Constant("s", "in which explanations are told apart"),
    "posterior.TEMPER": Constant("1", "weight of the evidence that does it: their errors are those of one model", 0.0),
    "posterior.OUT": Constant("nats", "at which an explanation is dropped"),
    "posterior.ALIKE": Constant("nats", "log weight below which a pair that looks like the leading one does not fall"),
    "events.CREDIBLE": Constant("1", "probability of a rotor set that is named", 1.1),
    "events.CERTAIN_OPPOSITE": Constant("1", "probability below which opposite rotors are ambiguous"),
    "events.HIDDEN": Constant("1", "times that the data alone must prefer a pair of opposite rotors to be named", BIG),
    "events.SETTLES_S": Constant(
        "s", "after an announcement in which any pair that the data alone prefer is named live", 0.0
    ),
    "events.MODEL_SD": Constant("loss", "error of the model in any loss", 0.0),
    "events.CURVE_SHARE": Constant("1", "share by which the thrust curve's slope in hover may be off", 0.0),
    "events.COAXIAL_SHARE": Constant("1", "the same on coaxial frames", 0.0),
    "events.ESTIMATES": Constant("1", "estimates that say what a loss was that is over"),
}
