"""What touches a vehicle besides the air: legs on the ground, a load on a line, a tether. Absent from a program without them.

Points are fixed to the frame, r from the centre of mass; P = p + R r is where one is (NED), V = v + R (omega x r) how fast.

    contact    N = max(0, k d + c V_z) at depth d = P_z - floor > 0, one spring and damper for each point
    grip       F = -k_g s - c_g V_h along the ground, no more than mu N: s is how far the point is from where it holds the ground, and
               that place is dragged along once the cone is reached (Cundall and Strack, Geotechnique 29, 1979)
    line       T = max(0, k (l - L) + c dl/dt) while longer than L, else slack: a load of mass m_l under its weight, its drag and its own
               ground; a tether's other end is fixed

Points are the legs' ends and the rotors' hubs, which a vehicle that tips over lies on. Stiffness follows from the mass that a spring moves,
so that its frequency is CONTACT or LINE whatever the vehicle: a step of 1/200 s still resolves it (Runge-Kutta is stable to 2.8 / step).
"""

from __future__ import annotations

from collections import namedtuple

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.simulation import rotation

LEGS = 4  # at most
CONTACT = 45.0  # rad/s: the whole vehicle on its legs (5 mm deep under its weight)
CONTACT_DAMPING = 0.35
LINE = 80.0  # rad/s: load and vehicle on their line (stretch of 2 mm under the load)
LINE_DAMPING = 0.1
SLIDE = 0.05  # m/s: below this speed a load's friction fades


class Extra(
    namedtuple(
        "Extra",
        "points stands stiff damp grip grip_damp friction floor drag_at twist hook load line line_stiff line_damp load_drag "
        "tether anchor tether_stiff tether_damp",
    )
):
    """Numbers of one vehicle. P contact points.

    points (P, 3) frame axes [m]; stands (P,): 1 where there is one; stiff (P,) [N/m], damp (P,) [N s/m] down, grip, grip_damp (P,)
    along the ground; friction: mu; floor: z of the ground [m]; drag_at (3,): where body drag acts; twist (3,): torque from outside,
    frame axes [N m]; hook (3,): where line and tether begin. load [kg], line [m], line_stiff [N/m], line_damp [N s/m],
    load_drag [N s^2/m^2]; tether [m], anchor (3,) NED, tether_stiff, tether_damp.
    """


class Attached(namedtuple("Attached", "p v q omega load_p load_v grip")):
    """A `rigid.Body` and what is attached. load_p [m], load_v [m/s] (3,) NED; grip (P, 2): north, east where each point holds the
    ground."""


def standing(extra: Extra, mount, body) -> Attached:
    """A `rigid.Body` on the ground with its load, which lies below with a slack line."""
    jnp = load_jax().numpy
    place, _ = _points(body, rotation.axes(body.q), _in_body(mount, extra.points))
    load = jnp.stack([body.p[0], body.p[1], extra.floor + 0.005 + 0.0 * body.p[2]])
    return Attached(body.p, body.v, body.q, body.omega, load, 0.0 * load, place[:2].T)


def struck(extra: Extra, mount, body):
    """True where a hub of an `Attached` is in the ground: a crash."""
    jnp = load_jax().numpy
    place, _ = _points(body, rotation.axes(body.q), _in_body(mount, extra.points[LEGS:]))
    return jnp.max(place[2]) > extra.floor


def _points(body, R, points):
    """Places and velocities (3, P) NED of points (P, 3) of the frame in body axes."""
    jnp = load_jax().numpy
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    p, q, r = body.omega
    turned = (q * z - r * y, r * x - p * z, p * y - q * x)
    place = jnp.stack([body.p[k] + R[k][0] * x + R[k][1] * y + R[k][2] * z for k in range(3)])
    speed = jnp.stack([body.v[k] + R[k][0] * turned[0] + R[k][1] * turned[1] + R[k][2] * turned[2] for k in range(3)])
    return place, speed


def _in_body(mount, points):
    """Points (P, 3) of the frame in the board's axes, which `omega` and R are in."""
    jnp = load_jax().numpy
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    return jnp.stack([mount[0][k] * x + mount[1][k] * y + mount[2][k] * z for k in range(3)], axis=1)


def ground(extra: Extra, mount, body: Attached, R, there):
    """Force (3,) NED [N] and torque (3,) body axes [N m] of the ground on all points. there: 0 or 1, whether there is ground."""
    jnp = load_jax().numpy
    points = _in_body(mount, extra.points)
    place, speed = _points(body, R, points)
    depth = place[2] - extra.floor
    touches = extra.stands * jnp.where(depth > 0.0, 1.0, 0.0) * there
    push = jnp.maximum(extra.stiff * depth + extra.damp * speed[2], 0.0) * touches
    held = extra.grip * (place[:2] - body.grip.T) + extra.grip_damp * speed[:2]
    most = extra.friction * push
    share = jnp.minimum(1.0, most / jnp.maximum(jnp.sqrt(held[0] ** 2 + held[1] ** 2), 1e-9))
    north, east = -share * held[0], -share * held[1]
    # r x R'F for each point, in body axes.
    fx, fy, fz = (R[0][k] * north + R[1][k] * east - R[2][k] * push for k in range(3))
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    torque = jnp.stack([jnp.sum(y * fz - z * fy), jnp.sum(z * fx - x * fz), jnp.sum(x * fy - y * fx)])
    return jnp.stack([jnp.sum(north), jnp.sum(east), -jnp.sum(push)]), torque


def gripped(extra: Extra, mount, body: Attached) -> Attached:
    """The body with the places where its points hold the ground, as far as friction lets them: at the point itself in the air."""
    jnp = load_jax().numpy
    R = rotation.axes(body.q)
    place, speed = _points(body, R, _in_body(mount, extra.points))
    depth = place[2] - extra.floor
    push = jnp.where(depth > 0.0, jnp.maximum(extra.stiff * depth + extra.damp * speed[2], 0.0), 0.0) * extra.stands
    s = place[:2] - body.grip.T
    reach = extra.friction * push / jnp.maximum(extra.grip, 1e-9)
    share = jnp.minimum(1.0, reach / jnp.maximum(jnp.sqrt(s[0] ** 2 + s[1] ** 2), 1e-12))
    return body._replace(grip=(place[:2] - share * s).T)


def _tension(start, end, start_speed, end_speed, length, stiff, damp):
    """Force (3,) NED [N] that a line pulls `start` towards `end` with."""
    jnp = load_jax().numpy
    apart, speed = end - start, end_speed - start_speed
    long = jnp.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2 + 1e-12)
    along = apart / long
    stretch = along[0] * speed[0] + along[1] * speed[1] + along[2] * speed[2]
    pull = jnp.where(long > length, jnp.maximum(stiff * (long - length) + damp * stretch, 0.0), 0.0)
    return pull * along


def lines(extra: Extra, mount, body: Attached, R, air):
    """(force (3,) NED, torque (3,) body axes on the vehicle, acceleration (3,) NED of the load) of the load's line and the tether."""
    jnp = load_jax().numpy
    hook = _in_body(mount, extra.hook[None])
    place, speed = (a[:, 0] for a in _points(body, R, hook))
    pull = _tension(place, body.load_p, speed, body.load_v, extra.line, extra.line_stiff, extra.line_damp)
    tied = _tension(place, extra.anchor, speed, 0.0 * speed, extra.tether, extra.tether_stiff, extra.tether_damp)
    mass = jnp.maximum(extra.load, 1e-3)
    wind = body.load_v - air.wind
    drag = -extra.load_drag * jnp.sqrt(wind[0] ** 2 + wind[1] ** 2 + wind[2] ** 2 + 1e-12) * wind
    depth = body.load_p[2] - extra.floor
    touches = jnp.where(depth > 0.0, 1.0, 0.0) * air.ground
    rests = jnp.maximum(CONTACT * (CONTACT * depth + 1.4 * body.load_v[2]), 0.0) * touches
    slide = extra.friction * rests / jnp.sqrt(body.load_v[0] ** 2 + body.load_v[1] ** 2 + SLIDE**2)
    floor = jnp.stack([-slide * body.load_v[0], -slide * body.load_v[1], G0 - rests])
    force = pull + tied
    return force, rotation.cross(hook[0], rotation.to_body(R, force)), (drag - pull) / mass + floor
