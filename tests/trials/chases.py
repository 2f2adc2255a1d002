"""Episodes made by hand: a pursuer drives straight at an evader that flees straight ahead."""

import jax
import jax.numpy as jnp
import numpy as np

from sidestep.loop import Trajectory
from sidestep.world import Events, World

EVADER_SPEED, PURSUER_SPEED, PERIOD, REACH = 0.1574, 0.2, 0.05, 0.2


def make_chase(*, reverse=False, gap=0.08, obstacles=1, pursuers=1, steps=400):
    """The evader flees along x from `gap` m outside the capture distance until caught (or `steps` pass).

    The other pursuers, if any, stand still far away.
    """
    times = PERIOD * np.arange(steps + 1)
    evader = np.stack([EVADER_SPEED * times, 0.0 * times], axis=-1)
    behind = PURSUER_SPEED * times - REACH - gap
    distance = evader[:, 0] - behind
    length = int(np.argmax(distance <= REACH)) if np.any(distance <= REACH) else steps
    count = length + 1
    heading = np.pi if reverse else 0.0
    poses = np.zeros((count, pursuers, 3))
    poses[:, 0] = np.stack([behind, 0.0 * times, heading + 0.0 * times], axis=-1)[:count]
    poses[:, 1:] = [5.0, 5.0, 0.0]
    rim = -PURSUER_SPEED if reverse else PURSUER_SPEED
    wheels = np.zeros((count, pursuers, 2))
    wheels[1:, 0] = rim
    rocks = np.broadcast_to(np.array([1.0, 1.0, 0.02, 0.0]), (count, obstacles, 4))
    worlds = jax.vmap(World)(
        jnp.asarray(evader[:count]),
        jnp.asarray(poses),
        jnp.asarray(rocks),
        jnp.broadcast_to(jnp.array([2.5, 0.0]), (count, 2)),
        jnp.asarray(times[:count]),
        jnp.zeros((count, 2)),
        jnp.asarray(wheels),
    )
    captured = jnp.arange(length) == (length - 1 if length < steps else -1)
    no = jnp.zeros(length, bool)
    action = jnp.broadcast_to(jnp.array([EVADER_SPEED, 0.0]), (length, 2))
    h = distance[:length] - REACH
    to_rocks = np.hypot(*(evader[:length] - 1.0).T) - 0.2
    barriers = np.concatenate(
        [np.repeat(h[:, None], pursuers, axis=1), np.repeat(to_rocks[:, None], obstacles, axis=1)], axis=1
    )
    return Trajectory(
        worlds=worlds,
        nominal=-action,
        action=action,
        wheel_speeds=worlds.wheel_speeds[1:],
        status=jnp.where(jnp.asarray(h) < 0.0355, 2, 1),
        barriers=jnp.asarray(barriers, dtype=float),
        slack=jnp.zeros(length),
        intervention=jnp.full(length, 2 * EVADER_SPEED),
        events=Events(
            reward=jnp.full(length, -0.02),
            captured=captured,
            collided=no,
            reached=no,
            timed_out=no,
            pursuer_clearance=jnp.asarray(h, dtype=float) - 0.001,
            obstacle_clearance=jnp.asarray(to_rocks, dtype=float),
        ),
    )
