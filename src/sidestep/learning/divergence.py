"""Detect divergence of a training: networks, losses and actions must stay finite."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from sidestep.learning.options import TrainingOptions
from sidestep.learning.td3 import Learner
from sidestep.learning.training import Report
from sidestep.store.checkpoints import CheckpointError

_PARTS = {
    "actor": "weights of the actor",
    "critic": "weights of the critics",
    "target_actor": "weights of the target actor",
    "target_critic": "weights of the target critics",
    "actor_moments": "Adam moments of the actor",
    "critic_moments": "Adam moments of the critics",
}

_USUAL_RATE = 3e-4
_USUAL_SCALE = 0.01


class Diverged(ValueError):
    """A training stopped because a number in it is not finite.

    **Arguments:** `found` as `divergence` returns it; `options` of the training; `done` episodes of the last
    finite state, and its `checkpoint`, None for a training without a folder.
    """

    def __init__(
        self, found: tuple[int, str], options: TrainingOptions, done: int, checkpoint: Path | None
    ) -> None:
        episode, what = found
        actor, critic, scale = (
            float(value)
            for value in (
                options.algorithm.actor_learning_rate,
                options.algorithm.critic_learning_rate,
                options.reward_scale,
            )
        )
        rates = [min(rate / 10.0, _USUAL_RATE) for rate in (actor, critic)]
        smaller = f"actor_learning_rate={rates[0]:g} critic_learning_rate={rates[1]:g}"
        if scale > _USUAL_SCALE:
            smaller += f" reward_scale={_USUAL_SCALE:g}"
        kept = ""
        if checkpoint is not None:
            kept = (
                f" The last state that was finite, after {done} episodes, is in {checkpoint}; with "
                "--resume the training would continue from there and diverge again."
            )
        super().__init__(
            f"training stopped in episode {episode}: {what} not finite. The usual causes are learning rates "
            f"that are too high (actor_learning_rate = {actor:g}, critic_learning_rate = {critic:g}) and "
            f"rewards that are too large (reward_scale = {scale:g}); start another run with smaller "
            f"ones, say --learner {smaller}.{kept}"
        )


@jax.jit
def _finite_parts(learner: Learner) -> Bool[Array, "parts"]:
    def finite(part: object) -> Array:
        leaves = [leaf for leaf in jax.tree.leaves(part) if eqx.is_inexact_array(leaf)]
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))

    return jnp.stack([finite(getattr(learner, name)) for name in _PARTS])


def broken_networks(learner: Learner) -> list[str]:
    """The parts of a learner that are not finite, in words; empty if all are finite."""
    return [
        words
        for words, good in zip(_PARTS.values(), np.asarray(_finite_parts(learner)), strict=True)
        if not good
    ]


def check_networks(learner: Learner, folder: Path) -> None:
    """**Raises** `CheckpointError` if the learner, restored from `folder`, is not finite."""
    if broken := broken_networks(learner):
        raise CheckpointError(
            f"the newest checkpoint in {folder} cannot be trained on: the {', '.join(broken)} are not "
            "finite; remove that file to go on from the one before, or start another run with --out"
        )


def divergence(report: Report, learner: Learner, done: int) -> tuple[int, str] | None:
    """The first episode (from 1) with a non-finite value, and what it was; None if all are finite.

    **Arguments:** `report` of a chunk of decisions, `learner` at its end, `done` episodes before it.
    """
    signs = {
        "the actor's action is": np.asarray(report.finite),
        "the critics' loss is": np.isfinite(np.asarray(report.losses.critic)),
        "the actor's loss is": np.isfinite(np.asarray(report.losses.actor)),
        "the critics' mean value is": np.isfinite(np.asarray(report.losses.value)),
    }
    first = {words: int(np.argmin(good)) for words, good in signs.items() if not np.all(good)}
    ended = np.asarray(report.ended)
    if first:
        words = min(first, key=lambda words: first[words])
        return done + int(np.sum(ended[: first[words]])) + 1, words
    if broken := broken_networks(learner):
        return done + int(np.sum(ended[:-1])) + 1, f"the {', '.join(broken)} are"
    return None
