"""The task as a gymnax environment, which is what rejax trains on: JAX throughout, with our own physics."""

from __future__ import annotations

from typing import Any

from speed.gymnasium_task import REWARD_SCALE
from speed.peers import peer


class PursuedInJax:
    """Holds `environment`, a gymnax `Environment` of the scenario `paper` without a shield.

    rejax 0.1.3 unpacks five values from a step, and gymnax 1.0 gives six; so the environment has a `step`
    of its own, with the automatic reset that gymnax does.
    """

    def __init__(self, pursuer: str):
        import jax
        import jax.numpy as jnp

        from sidestep.pursuit import make_pursuer, pursue
        from sidestep.world import load_scenario, observation_size, observe, to_velocity

        base, spaces = peer("gymnax.environments.environment"), peer("gymnax.environments.spaces")
        scenario, chase = load_scenario("paper"), make_pursuer(pursuer)

        class Pursued(base.Environment):
            @property
            def default_params(self) -> Any:
                return base.EnvParams(max_steps_in_episode=scenario.episode_steps)

            def reset(self, key: Any, params: Any = None) -> Any:
                world = scenario.reset(key)
                return observe(scenario, world), world

            def step(self, key: Any, state: Any, action: Any, params: Any = None) -> Any:
                chase_key, reset_key = jax.random.split(key)
                wheels = pursue(scenario, chase, state, chase_key)
                moved, events = scenario.step(state, to_velocity(scenario, state, action), wheels)
                done = events.terminated | events.truncated
                fresh = scenario.reset(reset_key)
                world = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, moved)
                return observe(scenario, world), world, REWARD_SCALE * events.reward, done, {}

            def observation_space(self, params: Any = None) -> Any:
                return spaces.Box(-jnp.inf, jnp.inf, (observation_size(scenario),), jnp.float32)

            def action_space(self, params: Any = None) -> Any:
                return spaces.Box(-1.0, 1.0, (2,), jnp.float32)

        self.environment = Pursued()
