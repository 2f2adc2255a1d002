"""The capture set: where a differential-drive pursuer captures by driving straight, in its frame."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sidestep._arrays import AnyArray, Lanes, Scalar, length, stack


def to_pursuer_frame(
    point: Float[AnyArray, "2 *lanes"], pose: Float[AnyArray, "3 *lanes"]
) -> Float[Array, "2 *lanes"]:
    """z = R(-theta)(p_e - p_d): a world point (m) in the frame of a pursuer at `pose` (x ahead, y left)."""
    x, y = point[0] - pose[0], point[1] - pose[1]
    cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
    return stack(cosine * x + sine * y, -sine * x + cosine * y)


def to_pursuer_axes(
    vector: Float[AnyArray, "2 *lanes"], heading: Float[AnyArray, "*lanes"]
) -> Float[Array, "2 *lanes"]:
    """R(-theta) v: a vector in the axes of a pursuer with that heading (rad)."""
    origin = jnp.zeros_like(heading)
    return to_pursuer_frame(vector, stack(origin, origin, heading))


def usable_angle(evader_speed: Float[AnyArray, ""], pursuer_speed: Float[AnyArray, ""]) -> Scalar:
    """S = arccos(min(v_e/V, 1)), rad: contact at larger angles to the pursuer's axis cannot be forced."""
    return jnp.arccos(jnp.clip(evader_speed / pursuer_speed, 0.0, 1.0))


def capture_set_distance(
    z: Float[AnyArray, "2 *lanes"], usable: Float[AnyArray, ""], capture_distance: Float[AnyArray, ""]
) -> Lanes:
    """Signed distance (m) from the capture set K(l): h = r cos((S - beta')+) - l.

    beta' is the angle between z and the pursuer's axis, front or rear. K is the convex hull of the
    disc of radius l and the two points (+-l/rho, 0): inside it the pursuer captures by driving
    straight, for any motion of the evader (Ruiz, Murrieta-Cid, Marroquin, IEEE T-RO 2013). Outside the
    usable angle h is the range, inside it the distance to a tangent line,
    h = |x| cos S + |y| sin S - l.
    """
    ahead, aside = jnp.abs(z[0]), jnp.abs(z[1])
    cosine, sine = jnp.cos(usable), jnp.sin(usable)
    in_front = aside * cosine < ahead * sine
    return jnp.where(in_front, ahead * cosine + aside * sine, length(z[0], z[1])) - capture_distance
