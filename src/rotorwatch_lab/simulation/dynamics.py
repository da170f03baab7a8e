"""A multirotor as a rigid body in moving air: forces, torques and one Runge-Kutta step.

    m dv/dt = m g e_z + R F          J domega/dt = tau - omega x (J omega + h) - dh/dt         dq/dt = q omega / 2

NED world, FRD body, SI; positions are the centre of mass. Rotor i at r_i = (x_i, y_i, z) turns at share w_i of its full
speed, which follows its command w_c like a first-order lag: w_i(t) = w_c + (w_i - w_c) exp(-t / lag), solved exactly.
With a_i = R'(v - wind) + (omega - gust rates) x r_i, the air's velocity past rotor i:

    thrust     T_i = (1 - theta_i) (T_max,i w_i^2 E(height) + k_z w_i a_i,z)      along -z
    rotor drag H_i = -(1 - theta_i) k_d w_i (a_i,x, a_i,y)                       (Martin and Salaun 2010)
    torque     r_i x (H_i, -T_i) + s_i c T_max,i w_i^2 (1 - theta_i) e_z          s_i: +1 counter-clockwise from above
    a mount that leans by l_i (sine) about its arm: T_max,i w_i^2 (1 - theta_i) l_i along the circle through the hub
    body drag  -C |a| a, C diagonal, at the centre of mass, or where `extra` has it
    h = -sum s_i I_r W w_i e_z: the rotors' own angular momentum

Near ground a rotor of radius b at height z is stronger by E = 1 / (1 - (b / 4 z)^2) (Cheeseman and Bennett 1955). The
ground itself is a spring and a damper under level feet; legs, a load on a line and a tether are in `attached`. All of this is
in the axes of the frame; body axes are those of the autopilot's board, which may be turned against it (`mount`).
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

from rotorwatch.base.backend import jax as load_jax
from rotorwatch.base.physics import G0
from rotorwatch_lab.simulation import attached, rotation
from rotorwatch_lab.simulation.rigid import Air, Body, runge_kutta

Array = Any
CONTACT_RATE = 30.0  # rad/s: how stiff the feet are (one centimetre deep under the weight)
CONTACT_DAMPING = 0.8
SLIDE = 0.1  # m/s: below this speed friction fades


class Craft(
    namedtuple(
        "Craft",
        "mass J J_inverse x y z spin thrust_max drag_ratio expo lag rotor_momentum k_d k_z drag radius ground_effect "
        "lean mount push push_z extra",
        defaults=[()],
    )
):
    """The physical vehicle; n rotors. Everything SI and about the centre of mass, payload included.

    mass; J, J_inverse (3, 3); x, y (n,) and z of the rotor hubs (z < 0: above the centre of mass); spin, thrust_max (n,);
    drag_ratio [m]; expo of the thrust curve; lag [s]; rotor_momentum: I_r W, angular momentum of one rotor at full speed;
    k_d, k_z [N s/m] at full speed; drag (3,) [N s^2/m^2]; radius [m]; ground_effect 0 or 1; lean (n,): sine of each mount's turn about its
    arm, positive where it yaws the vehicle to the right; mount (3, 3): body axes to the frame's; push (3,) NED [N] of something outside,
    that acts at (0, 0, push_z) of the frame; extra: `attached.Extra`, or nothing.
    """


def thrust_share(expo, drive):
    """Thrust of a drive (command share times battery ratio) as a share of full: (1 - expo) a + expo a^2."""
    return (1.0 - expo) * drive + expo * drive * drive


class Sums(namedtuple("Sums", "push flow h h_dot side")):
    """Sums over the rotors: all that forces and torques need of their speeds w (n,) and strengths.

    push (4,): sums of T_max w^2 (1 - theta) times 1, x, y, spin. flow (6,): sums of w times 1, x, y, x^2, x y, y^2. h, h_dot: angular
    momentum of the rotors about the frame's z and its change. side (3,): force along x and y and torque about z of mounts that lean.
    """


def sums(craft: Craft, w, w_dot, theta) -> Sums:
    """The sums over rotors at speeds w (n,), changing by w_dot (n,), with losses theta (n,)."""
    jnp = load_jax().numpy
    x, y, one = craft.x, craft.y, 1.0 + 0.0 * craft.x
    thrust = craft.thrust_max * w * w * (1.0 - theta)
    push = jnp.sum(thrust * (1.0 - 0.5 * craft.lean**2) * jnp.stack([one, x, y, craft.spin]), axis=1)
    arm = jnp.maximum(jnp.sqrt(x * x + y * y), 1e-9)
    side = jnp.sum(thrust * craft.lean * jnp.stack([-y / arm, x / arm, arm]), axis=1)
    flow = jnp.sum(w * (1.0 - theta) * jnp.stack([one, x, y, x * x, x * y, y * y]), axis=1)
    h, h_dot = (-craft.rotor_momentum * jnp.sum(craft.spin * rate) for rate in (w, w_dot))
    return Sums(push, flow, h, h_dot, side)


def wrench(craft: Craft, body: Any, R, rotors: Sums, air: Air):
    """Force (3,) without weight and torque (3,) on the body in body axes; R: `rotation.axes` of body.q."""
    jnp = load_jax().numpy
    a = rotation.product(craft.mount, rotation.to_body(R, body.v - air.wind))
    p, q, r = rotation.product(craft.mount, body.omega - air.turning)
    height = jnp.maximum(-body.p[2] - craft.z + 0.5 * craft.radius, 0.5 * craft.radius)
    if craft.extra:  # the floor is as far below as the legs are high
        height = jnp.maximum(craft.extra.floor - body.p[2] - craft.z, 0.5 * craft.radius)
    cushion = 1.0 + craft.ground_effect * air.ground * (1.0 / (1.0 - (0.25 * craft.radius / height) ** 2) - 1.0)
    one, x, y, xx, xy, yy = rotors.flow
    # The air past rotor i moves by (a_x - r y_i, a_y + r x_i, a_z + p y_i - q x_i).
    a_x, a_y, a_z = a[0] + q * craft.z, a[1] - p * craft.z, a[2]
    # Air that comes up (a_z > 0: sinking) adds thrust.
    T = cushion * rotors.push[0] + craft.k_z * (a_z * one + p * y - q * x)
    Tx = cushion * rotors.push[1] + craft.k_z * (a_z * x + p * xy - q * xx)
    Ty = cushion * rotors.push[2] + craft.k_z * (a_z * y + p * yy - q * xy)
    H_x, H_y = rotors.side[0] - craft.k_d * (a_x * one - r * y), rotors.side[1] - craft.k_d * (a_y * one + r * x)
    twist = rotors.side[2] - craft.k_d * (a_y * x + r * xx - a_x * y + r * yy)
    if craft.extra:
        a = a + rotation.cross(jnp.stack([p, q, r]), craft.extra.drag_at)
    speed = jnp.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    dragged = craft.drag * speed * a
    force = jnp.stack([H_x, H_y, -T]) - dragged
    torque = jnp.stack([-Ty - craft.z * H_y, Tx + craft.z * H_x, twist + craft.drag_ratio * rotors.push[3]])
    if craft.extra:
        torque = torque - rotation.cross(craft.extra.drag_at, dragged) + craft.extra.twist
    push = rotation.product(craft.mount, rotation.to_body(R, craft.push))
    lever = jnp.stack([-craft.push_z * push[1], craft.push_z * push[0], 0.0 * push[2]])
    return rotation.to_body(craft.mount, force + push), rotation.to_body(craft.mount, torque + lever)


def contact(craft: Craft, body: Body, R, ground):
    """Force (3,) NED [N] and torque (3,) body [N m] of the ground on the feet; zero in the air."""
    jnp = load_jax().numpy
    depth = jnp.maximum(body.p[2], 0.0) * ground
    touching = jnp.where(depth > 0.0, 1.0, 0.0)
    push = craft.mass * CONTACT_RATE * (CONTACT_RATE * depth + 2.0 * CONTACT_DAMPING * body.v[2] * touching)
    push = jnp.maximum(push, 0.0)
    slide = jnp.sqrt(body.v[0] ** 2 + body.v[1] ** 2 + SLIDE**2)
    force = jnp.stack([-push * body.v[0] / slide, -push * body.v[1] / slide, -push])
    # Feet level the vehicle as long as it stands on them; e_z in body axes is the last row of R.
    upright = jnp.maximum(R[2][2], 0.0)
    inertia = jnp.stack([craft.J[0][0], craft.J[1][1], craft.J[2][2]])
    off_level = jnp.stack([R[2][1] * upright, -R[2][0] * upright, 0.0 * upright])
    stiff = touching * inertia * CONTACT_RATE
    return force, -stiff * (CONTACT_RATE * off_level + 2.0 * CONTACT_DAMPING * body.omega)


def derivative(craft: Craft, body: Any, rotors: Sums, air: Air) -> tuple[Any, Array]:
    """(d body / dt, specific force (3,) in body axes [m/s^2])."""
    jnp = load_jax().numpy
    R = rotation.axes(body.q)
    force, torque = wrench(craft, body, R, rotors, air)
    load_v_dot: Any = ()
    if craft.extra:
        ground_force, ground_torque = attached.ground(craft.extra, craft.mount, body, R, air.ground)
        line_force, line_torque, load_v_dot = attached.lines(craft.extra, craft.mount, body, R, air)
        ground_force, ground_torque = ground_force + line_force, ground_torque + line_torque
    else:
        ground_force, ground_torque = contact(craft, body, R, air.ground)
    push = (rotation.to_world(R, force) + ground_force) / craft.mass
    zero = 0.0 * rotors.h
    axis = craft.mount[2]
    L = rotation.product(craft.J, body.omega) + axis * rotors.h
    turn = torque + ground_torque - rotation.cross(body.omega, L) - axis * rotors.h_dot
    omega_dot = rotation.product(craft.J_inverse, turn)
    v_dot = push + jnp.stack([zero, zero, zero + G0])
    slope: Any = Body(body.v, v_dot, rotation.rate(body.q, body.omega), omega_dot)
    if craft.extra:
        slope = attached.Attached(slope.p, slope.v, slope.q, slope.omega, body.load_v, load_v_dot, 0.0 * body.grip)
    return slope, rotation.to_body(R, push)


def step(craft: Craft, body: Any, w, w_command, lag, air: Air, theta, dt):
    """Body, rotor speeds (n,) and mean specific force (3,) after dt: classical Runge-Kutta, rotors exact at its nodes.

    w_command (n,): share of full speed that each rotor is driven to; lag (n,) [s]. A craft with `extra` has an `attached.Attached` as body.
    """
    jax = load_jax()
    jnp = jax.numpy
    gap = w - w_command
    fade = jnp.exp(-0.5 * dt / lag)
    gaps = (gap, gap * fade, gap * fade * fade)
    nodes = [sums(craft, w_command + g, -g / lag, theta) for g in gaps]
    rows = jax.tree.map(lambda a, b, c: jnp.stack([a, b, b, c]), *nodes)
    body, force = runge_kutta(lambda at, rotors: derivative(craft, at, rotors, air), body, rows, dt)
    if craft.extra:
        body = attached.gripped(craft.extra, craft.mount, body)
    return body, w_command + gaps[2], force
