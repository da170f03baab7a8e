"""A rotor that is weak from take-off on: one flight's balance of commands against that of healthy vehicles of any build.

Without a healthy flight of the build the balance w = B f / sum f (roll, pitch, yaw; whole_flight.py) is compared with how unequally healthy
vehicles are commanded. It is a t distribution about 0 with FREEDOM degrees of freedom, of scale CENTRE of an arm length in roll and pitch
(the centre of mass) and TILT / sqrt(n) in yaw (motors that do not stand upright, each on its own).

Source: 18 real healthy flights of 12 quadrotors (7 with ArduPilot, 3 with PX4, 2 Crazyflies, from public logs; none with a known fault);
maximum likelihood of one mean w for each vehicle: scales 0.040 and 0.10, 6 degrees of freedom. With any one vehicle left out: 0.035 to
0.045 and 0.09 to 0.11. There are no hexas or octas among them; the scaling of yaw is assumed.

    healthy          w ~ t(0)
    rotor i weak     w ~ t(B_i e / (n + e)), e = theta / (1 - a theta), theta uniform between 0 and MOST
    centre of mass   w ~ t((x, y, 0)), x and y normal with SHIFT_SD

a is the diagonal of B+ B (B+: pseudoinverse, with the row of thrust): the mixer compensates B_i e with all rotors, f = 1 + (B+ B)_i e, and
rotor i lacks e = theta f_i. Of a quadrotor a is 1.

A weak rotor asks for as much yaw as its column says, a shifted centre for none. The yaw trim of healthy vehicles reaches that of a loss of
a third, so yaw discriminates large losses alone: smaller ones are `ambiguous`, or undetected within the bound of a healthy answer.

What others testify on a rotor, such as its balance, is independent of w: it multiplies that rotor's probability, and by as much, at most
(Markov's inequality), the rarity that a fault must have.

A flight that is not rare still leans to a rotor where w is likelier with a loss above MATTERS of some rotor, each equally probable, than
without, and a shifted centre is not CLEAR times likelier: then the bound is no sign of health. By the model that concerns 5 % of healthy
quadrotors, and 27, 84 and 99 % of those that lost 0.20, 0.33 and 0.50. Of a hexa and an octa it would be 14 and 19 % of healthy ones, for
41 and 38 % of those that lost 0.33: their bound is so wide that leaning says little, and it is not asked for.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.engine.events.decisions import CERTAIN, CLEAR, FALSE_ALARM, FALSE_FAULT_OF_ANY, MATTERS, MENTIONED
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.stats import multivariate_t as student
from rotorwatch.witnesses.healthy.whole_flight import CENTRE_RHO_SD, LIMITED, RHO_SD, Features, features

CENTRE, TILT, FREEDOM = 0.04, 0.2, 6.0
SHIFT_SD = 0.15  # arm lengths: a camera or a battery that hangs out in front
HEALTHY, ROTOR, SHIFTED = 0.9, 0.05, 0.05  # prior probabilities
MOST = 0.9
FEW = 4  # rotors, up to which a flight may lean to one


def assess(
    flight: Flight, vehicle: Vehicle, air: Sequence[tuple[float, float]], until: float = np.inf, said: np.ndarray | float = 0.0
) -> dict | None:
    """Evidence of damage present at take-off, from the steady part of the flight before `until` [s]; None where that is too short or where
    a rotor was at its limit. said (n,): log-odds by which others testify to a loss of each rotor's thrust (`View.testimony`).

    -> verdict healthy, ambiguous or fault; reason; rotors (1-based, named); loss (n,), interval (n, 2), of a healthy flight with 0 and the
    largest undetected loss of each rotor; causes as in WholeFlight; leaning: of a healthy flight that leans to a rotor, the fields of an
    ambiguous answer, for whoever minds a loss within the bound."""
    hovering = features(flight, vehicle, [(a, min(b, until)) for a, b in air if a < until])
    if not hovering.usable or max(hovering.limited) > LIMITED:
        return None
    return weigh(hovering, vehicle.effectiveness(), said)


def weigh(found: Features, B: np.ndarray, said: np.ndarray | float = 0.0) -> dict:
    """The same for a flight's features and effectiveness B (4, n)."""
    n = B.shape[1]
    w = np.array(found.wrench)
    scale = np.diag([CENTRE**2, CENTRE**2, TILT**2 / n]) + np.array(found.covariance)
    p_value = student.tail(w, scale, FREEDOM)
    theta = np.linspace(0.0, MOST, 181)[1:]
    shifts = [_weak(B, i, theta) for i in range(n)]
    # RHO_SD (whole_flight.py): of the yaw of a damaged rotor; a rotor without a yaw moment asks for none.
    likelihood = np.stack([_density(w - at, scale, RHO_SD * at[:, 2]) for at in shifts])
    where, distance, mass = student.centred_grid(SHIFT_SD, 3.0)
    centre = mass @ _density(w - np.pad(where, ((0, 0), (0, 1))), scale, CENTRE_RHO_SD * distance)
    weight = np.array([HEALTHY * _density(w, scale, 0.0), SHIFTED * centre])
    supported = np.exp(np.broadcast_to(said, n))
    rotor = ROTOR / n * supported * likelihood.mean(axis=1)
    total = weight.sum() + rotor.sum()
    probability = rotor / total
    means, intervals = zip(*(student.mean_and_interval(theta, likely) for likely in likelihood))
    loss, (low, high) = np.array(means), np.array(intervals).T
    best = int(np.argmax(probability))
    named = [i for i in np.argsort(-probability) if probability[i] > MENTIONED * probability.sum()]
    causes = [{"kind": "rotors", "rotors": [int(i) + 1], "probability": float(probability[i])} for i in named]
    causes.append({"kind": "centre_of_mass", "rotors": [], "probability": float(weight[1] / total)})
    rare, sure = p_value < FALSE_ALARM and probability.sum() > 0.5, probability[best] > CERTAIN
    verdict = "fault" if rare and sure and p_value < FALSE_FAULT_OF_ANY * supported[best] else "ambiguous" if rare else "healthy"
    if verdict == "healthy":
        bounded = {"verdict": verdict, "reason": "", "rotors": [], "causes": [], "p_value": p_value, "loss": [0.0] * n,
                         "interval": [[0.0, float(v)] for v in high]}  # fmt: skip
        large = supported @ likelihood[:, theta > MATTERS].mean(axis=1) / n
        if n > FEW or large < weight[0] / HEALTHY or CLEAR * large < centre:
            return bounded
        others = "".join(f", rotor {i + 1}" for i in named if i != best)
        reason = (
            f"rotor {best + 1}{others} may have lacked up to {100 * high[best]:.0f} % of its thrust since take-off: the balance of "
            "commands is likelier with such a loss than without, but an off-centre mass, or the trim of a healthy vehicle, looks the same."
        )
        leaning = {"verdict": "ambiguous", "reason": reason, "rotors": [best + 1], "causes": causes, "trim": True}
        return bounded | {"leaning": leaning}
    suspect = f"rotor {best + 1} ({100 * loss[best]:.0f} % loss)"
    if verdict == "fault":
        named = [best]
        reason = f"{suspect} has needed more command since take-off than in any healthy vehicle, and roll, pitch and yaw agree."
    else:
        others = "".join(f", rotor {i + 1}" for i in named if i != best)
        reason = (
            f"{suspect}{others} or an off-centre mass: since take-off the balance of commands has differed from that of healthy "
            "vehicles, and yaw does not distinguish the two."
        )
        low = np.zeros(n)
    mine = np.isin(np.arange(n), named)
    return {"verdict": verdict, "reason": reason, "rotors": [best + 1], "causes": causes, "p_value": p_value,
            "loss": np.where(mine, loss, 0.0).tolist(),
            "interval": [[float(a), float(b)] for a, b in zip(np.where(mine, low, 0.0), high)]}  # fmt: skip


def _density(rest: np.ndarray, scale: np.ndarray, yaw_sd) -> np.ndarray:
    """(g,) t densities, but for a factor, of rest (g, 3) with variances yaw_sd (g,) squared more in yaw."""
    return student.density(rest, scale, FREEDOM, (0.0, 0.0, np.square(yaw_sd)))


def _weak(B: np.ndarray, rotor: int, theta: np.ndarray) -> np.ndarray:
    """(g, 3) w of an otherwise equal vehicle of effectiveness B (4, n) whose rotor lost theta (g,)."""
    share = (np.linalg.pinv(B) @ B)[rotor, rotor]
    lacks = theta / (1.0 - share * theta)
    return lacks[:, None] * B[:3, rotor] / (B[3].sum() + lacks * B[3, rotor])[:, None]
