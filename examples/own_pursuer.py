"""A custom pursuer: it guards the target and strikes when the evader comes near."""

import jax
import jax.numpy as jnp

import sidestep

scenario = sidestep.load_scenario("paper", episode_steps=600)
nash = sidestep.make_pursuer("nash")


def guard(scenario, world, key):
    """Wheel speeds (left, right) in m/s from the whole world; the pursuer's own pose comes first."""
    pose = world.pursuers[0]
    way = world.target - pose[:2]
    off = jnp.arctan2(way[1], way[0]) - pose[2]
    off = (off + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
    turn = jnp.clip(2.0 * off, -1.0, 1.0)
    ahead = jnp.where(jnp.hypot(*way) > 0.3, jnp.cos(off), 0.0)
    home = scenario.pursuer_speed * jnp.clip(jnp.stack([ahead - turn, ahead + turn]), -1.0, 1.0)
    near = jnp.hypot(*(world.evader - world.target)) < 0.8
    return jnp.where(near, nash(scenario, world, key), home)


outcome = sidestep.evaluate(
    scenario, sidestep.goal_seeking, "game", guard, episodes=200, key=jax.random.key(0)
)
print(f"{outcome.captured} captured, {outcome.collided} collided, {outcome.reached} of 200 reached")
