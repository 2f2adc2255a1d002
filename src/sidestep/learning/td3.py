"""TD3: Fujimoto, van Hoof, Meger, "Addressing Function Approximation Error in Actor-Critic Methods",
ICML 2018, and the authors' code where the two differ.

One `update` is one step of the algorithm on one batch. The training loop fills the batch and defines the
meaning of an action.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sidestep._arrays import Scalar, real, static_field
from sidestep._bounds import within
from sidestep.learning.networks import Actor, TwinCritic

Bound = Callable[[Float[Array, "batch action"], PRNGKeyArray], Float[Array, "batch action"]]


class TD3(eqx.Module):
    """Hyper-parameters. Real values are traced, so `vmap` over learning rates is possible.

    Noises are in units of the action range [-1, 1]. `policy_delay` is the number of critic updates per update
    of the actor and of both target networks. `last_layer_scale` initialises the actor near zero action (it is
    1 in the reference); all else is as in the reference.
    """

    actor_learning_rate: Scalar = eqx.field(converter=real, default=3e-4, metadata=within(least=0.0))
    critic_learning_rate: Scalar = eqx.field(converter=real, default=3e-4, metadata=within(least=0.0))
    discount: Scalar = eqx.field(converter=real, default=0.99, metadata=within(least=0.0, most=1.0))
    target_rate: Scalar = eqx.field(converter=real, default=0.005, metadata=within(least=0.0, most=1.0))
    target_noise: Scalar = eqx.field(converter=real, default=0.2, metadata=within(least=0.0))
    target_noise_clip: Scalar = eqx.field(converter=real, default=0.5, metadata=within(least=0.0))
    policy_delay: int = static_field(2, least=1)
    hidden: tuple[int, ...] = static_field((256, 256), whole=True, shape=(None,), least=1)
    last_layer_scale: float = static_field(0.01, least=0.0)

    def init(self, observations: int, actions: int, key: PRNGKeyArray) -> Learner:
        """New networks, with equal target networks."""
        actor_key, critic_key = jax.random.split(key)
        actor = Actor(observations, actions, self.hidden, actor_key, self.last_layer_scale)
        critic = TwinCritic(observations, actions, self.hidden, critic_key)
        optimiser = optax.scale_by_adam()
        return Learner(
            actor=actor,
            critic=critic,
            target_actor=actor,
            target_critic=critic,
            actor_moments=optimiser.init(eqx.filter(actor, eqx.is_array)),
            critic_moments=optimiser.init(eqx.filter(critic, eqx.is_array)),
            updates=jnp.zeros((), int),
        )


class Learner(eqx.Module):
    """The state of TD3: networks, target networks, Adam moments, count of updates."""

    actor: Actor
    critic: TwinCritic
    target_actor: Actor
    target_critic: TwinCritic
    actor_moments: optax.OptState
    critic_moments: optax.OptState
    updates: Int[Array, ""]


class Batch(eqx.Module):
    """Transitions to learn from. `terminated` is 1 where the next value is zero, and 0 at time limits."""

    observation: Float[Array, "batch observation"]
    action: Float[Array, "batch action"]
    reward: Float[Array, "batch"]
    next_observation: Float[Array, "batch observation"]
    terminated: Float[Array, "batch"]


class Losses(eqx.Module):
    """Diagnostics of one update; `actor` is 0 in updates that do not change the actor."""

    critic: Scalar
    actor: Scalar
    value: Scalar


def no_bound(actions: Float[Array, "batch action"], key: PRNGKeyArray) -> Float[Array, "batch action"]:
    """Every action is possible."""
    return actions


def _adam(gradients, moments, network, rate: Scalar):
    """One Adam step with a traced learning rate."""
    # Optax raises floats to integer powers, which strict dtype promotion forbids.
    with jax.numpy_dtype_promotion("standard"):
        directions, moments = optax.scale_by_adam().update(gradients, moments)
    return jax.tree.map(lambda weight, direction: weight - rate * direction, network, directions), moments


def actor_loss(
    actor: Actor, critic: TwinCritic, observation: Float[Array, "batch observation"], bound: Bound, key: Any
) -> Scalar:
    """The actor's loss, -mean Q1(s, bound(pi(s)))."""
    return -jnp.mean(critic.first_value(observation, bound(actor(observation), key)))


def update(
    algorithm: TD3,
    learner: Learner,
    batch: Batch,
    key: PRNGKeyArray,
    bound: Bound = no_bound,
    target_bound: Bound | None = None,
    value_limit: Scalar | None = None,
) -> tuple[Learner, Losses]:
    """One TD3 update.

    y = r + discount (1 - terminated) min_i Q_i'(s', a'),  a' = clip(pi'(s') + clip(noise)), and the critic
    loss is the *sum* of the two mean squared errors. Every `policy_delay` updates the actor's loss is
    descended and both target networks are updated.

    `bound` maps actions to those the robot can execute (such as a disc) before a critic evaluates them; the
    actor's gradient passes through it. `target_bound` does so for the target action (the shield in the next
    worlds, when learning from executed actions); by default it is `bound`. `value_limit` is an upper bound of
    y.
    """
    noise_key, bound_key, actor_key = jax.random.split(key, 3)
    target_bound = bound if target_bound is None else target_bound

    noise = algorithm.target_noise * jax.random.normal(noise_key, batch.action.shape, dtype=float)
    noise = jnp.clip(noise, -algorithm.target_noise_clip, algorithm.target_noise_clip)
    smoothed = jnp.clip(learner.target_actor(batch.next_observation) + noise, -1.0, 1.0)
    next_action = target_bound(smoothed, bound_key)
    next_values = learner.target_critic(batch.next_observation, next_action)
    wanted = batch.reward + algorithm.discount * (1.0 - batch.terminated) * jnp.minimum(*next_values)
    if value_limit is not None:
        wanted = jnp.minimum(wanted, value_limit)

    def critic_loss(critic: TwinCritic) -> tuple[Scalar, Scalar]:
        first, second = critic(batch.observation, batch.action)
        return jnp.mean((first - wanted) ** 2) + jnp.mean((second - wanted) ** 2), jnp.mean(first)

    (critic_error, value), gradients = jax.value_and_grad(critic_loss, has_aux=True)(learner.critic)
    critic, critic_moments = _adam(
        gradients, learner.critic_moments, learner.critic, algorithm.critic_learning_rate
    )

    def delayed(learner: Learner) -> tuple[Learner, Scalar]:
        loss, gradients = jax.value_and_grad(actor_loss)(
            learner.actor, critic, batch.observation, bound, actor_key
        )
        actor, moments = _adam(gradients, learner.actor_moments, learner.actor, algorithm.actor_learning_rate)
        rate = algorithm.target_rate

        def follow(target, online):
            return jax.tree.map(lambda old, new: (1.0 - rate) * old + rate * new, target, online)

        moved = Learner(
            actor=actor,
            critic=critic,
            target_actor=follow(learner.target_actor, actor),
            target_critic=follow(learner.target_critic, critic),
            actor_moments=moments,
            critic_moments=critic_moments,
            updates=learner.updates + 1,
        )
        return moved, loss

    def not_yet(learner: Learner) -> tuple[Learner, Scalar]:
        moved = eqx.tree_at(
            lambda x: (x.critic, x.critic_moments, x.updates),
            learner,
            (critic, critic_moments, learner.updates + 1),
        )
        return moved, real(0.0)

    due = (learner.updates + 1) % algorithm.policy_delay == 0
    learner, actor_error = jax.lax.cond(due, delayed, not_yet, learner)
    return learner, Losses(critic=critic_error, actor=actor_error, value=value)
