"""Unit quaternions (Hamilton, scalar first, body to world), written by components for vectorised simulation.

Written for one flight and mapped over many with the batch as the last axis, where every line is an operation on long vectors.
"""

from __future__ import annotations

from rotorwatch.base.backend import jax as load_jax


def axes(q):
    """Rows of the rotation matrix body -> world, as nine scalars ((xx, xy, xz), (yx, ...), (zx, ...))."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def to_world(R, v):
    """R v for the rows R of `axes` and v (3,)."""
    jnp = load_jax().numpy
    return jnp.stack([row[0] * v[0] + row[1] * v[1] + row[2] * v[2] for row in R])


def to_body(R, v):
    """R' v: a world vector (3,) in body axes."""
    jnp = load_jax().numpy
    return jnp.stack([R[0][k] * v[0] + R[1][k] * v[1] + R[2][k] * v[2] for k in range(3)])


def multiply(a, b):
    """Hamilton product a b: first b, then a."""
    jnp = load_jax().numpy
    return jnp.stack(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


def conjugate(q):
    """The inverse rotation."""
    jnp = load_jax().numpy
    return jnp.stack([q[0], -q[1], -q[2], -q[3]])


def heading(yaw):
    """The quaternion of a turn by yaw [rad] about down."""
    jnp = load_jax().numpy
    half = 0.5 * yaw
    return jnp.stack([jnp.cos(half), 0.0 * half, 0.0 * half, jnp.sin(half)])


def unit(q):
    """q, scaled to length 1."""
    jnp = load_jax().numpy
    return q / jnp.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


def rate(q, omega):
    """dq/dt for body rates omega (3,)."""
    jnp = load_jax().numpy
    w, x, y, z = q
    p, s, r = omega
    return 0.5 * jnp.stack([-x * p - y * s - z * r, w * p + y * r - z * s, w * s - x * r + z * p, w * r + x * s - y * p])


def cross(a, b):
    """a x b."""
    jnp = load_jax().numpy
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def product(A, v):
    """A v for a matrix A (3, 3), by components."""
    jnp = load_jax().numpy
    return jnp.stack([A[k][0] * v[0] + A[k][1] * v[1] + A[k][2] * v[2] for k in range(3)])
