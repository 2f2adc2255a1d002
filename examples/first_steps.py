"""One shielded episode against a pursuer, then a hundred at once."""

import jax
import jax.numpy as jnp

import sidestep

scenario = sidestep.load_scenario("paper", evader_speed=0.16, obstacle_count=2)
shield = sidestep.make_shield("game", scenario)
pursuer = sidestep.make_pursuer("nash")

# One control step by hand: the shield corrects the nominal velocity, then everything moves.
world = scenario.reset(jax.random.key(0))
memory = shield.init(world)
result, memory = shield(world, jnp.array([0.16, 0.0]), memory)
wheel_speeds = pursuer(scenario, world, jax.random.key(1))
world, events = scenario.step(world, result.action, wheel_speeds)
print(f"asked for (0.16, 0), drove ({result.action[0]:.3f}, {result.action[1]:.3f}) m/s")
print(f"{events.pursuer_clearance:.3f} m from capture, {events.obstacle_clearance:.3f} m from collision")

# Many episodes with the untrained policy; a trained one comes from sidestep.load_policy("runs/first").
evaluation = sidestep.evaluate(
    scenario, sidestep.goal_seeking, "game", "nash", episodes=100, key=jax.random.key(2)
)
print(f"{evaluation.reached} of {evaluation.episodes} reached, {evaluation.captured} captured")
