"""What does the `game` shield keep beyond the distances of capture and collision?"""

import equinox as eqx
import jax.numpy as jnp

from sidestep._arrays import Scalar
from sidestep.pursuit.game import CaptureGame
from sidestep.safety.barriers.budget import Budget
from sidestep.world.scenario import Scenario

TOUCH = 1e-5
"""Distance (m) kept beyond the collision distance. A barrier that is long held at its row comes to 0 up to
rounding, and that would count as contact."""


def sampling_margin(scenario: Scenario) -> Scalar:
    """Distance (m) that the shield keeps beyond the capture distance: min(V^2 T^2/b, (l_max - l)/2).

    A pursuer beside the evader that drives an arc with its inner wheel at rest lowers the barrier by up to
    V^2 T^2/(8 b) within one period T. Attacks that repeat it gained about two such steps; the margin is
    eight. If l_max leaves less than that, the margin is half of what it leaves, and 0 where the pursuer wins.
    This was enough from ordinary starts. It is not a bound of what is possible, see `certify`.
    """
    game = CaptureGame.of(scenario)
    spare = jnp.maximum(game.largest_capture_distance - game.capture_distance, 0.0)
    axle = jnp.where(game.half_axle > 0.0, game.half_axle, 1.0)
    gained = (game.pursuer_speed * scenario.control_period) ** 2 / axle
    return jnp.minimum(gained, 0.5 * spare)


def margins(scenario: Scenario, budget: Budget | None = None) -> tuple[Scalar, Scalar]:
    """Distances (m) that the rows keep beyond those of capture and collision: `sampling_margin` and `TOUCH`,
    and those of the budget."""
    pursuers, obstacles = sampling_margin(scenario), jnp.asarray(TOUCH, scenario.collision_distance.dtype)
    if budget is None:
        return pursuers, obstacles
    return pursuers + budget.towards_pursuers(scenario), obstacles + budget.towards_obstacles(scenario)


def with_margins(scenario: Scenario, budget: Budget | None = None) -> Scenario:
    """The scenario with the distances that the rows keep, see `margins`, and the evader speed for the capture
    set, see `Budget.sure_speed`."""
    pursuers, obstacles = margins(scenario, budget)
    kept = scenario.capture_distance + pursuers
    speed = scenario.evader_speed if budget is None else budget.sure_speed(scenario, kept)
    return eqx.tree_at(
        lambda s: (s.capture_distance, s.collision_distance, s.evader_speed),
        scenario,
        (kept, scenario.collision_distance + obstacles, speed),
    )
