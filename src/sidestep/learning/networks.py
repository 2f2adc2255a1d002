"""Actor and critics: perceptrons with two hidden ReLU layers, as in TD3."""

from __future__ import annotations

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import AnyArray, real


class Perceptron(eqx.Module):
    """Fully connected ReLU network for a batch, one sample per row.

    Weights have shape (inputs, outputs). They are initialised uniformly in +-1/sqrt(inputs), the PyTorch
    default in TD3's reference; the last layer is scaled by `last_scale`.
    """

    weights: list[Float[Array, "inputs outputs"]]
    biases: list[Float[Array, "outputs"]]

    def __init__(self, sizes: tuple[int, ...], key: PRNGKeyArray, last_scale: float = 1.0):
        self.weights, self.biases = [], []
        last = len(sizes) - 2
        for layer, (inputs, outputs) in enumerate(pairwise(sizes)):
            key, weight_key, bias_key = jax.random.split(key, 3)
            bound = inputs**-0.5 * (last_scale if layer == last else 1.0)
            self.weights.append(
                jax.random.uniform(weight_key, (inputs, outputs), dtype=float, minval=-bound, maxval=bound)
            )
            self.biases.append(
                jax.random.uniform(bias_key, (outputs,), dtype=float, minval=-bound, maxval=bound)
            )

    def __call__(self, batch: Float[AnyArray, "batch inputs"]) -> Float[Array, "batch outputs"]:
        layer = real(batch)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            layer = jax.nn.relu(layer @ weight + bias)
        return layer @ self.weights[-1] + self.biases[-1]


class Actor(eqx.Module):
    """Deterministic policy: tanh of a perceptron, so actions lie in [-1, 1]^n."""

    body: Perceptron

    def __init__(
        self,
        observations: int,
        actions: int,
        hidden: tuple[int, ...],
        key: PRNGKeyArray,
        last_scale: float = 1.0,
    ):
        self.body = Perceptron((observations, *hidden, actions), key, last_scale)

    def __call__(self, observations: Float[AnyArray, "batch observation"]) -> Float[Array, "batch action"]:
        return jnp.tanh(self.body(observations))


class TwinCritic(eqx.Module):
    """Two independent action values Q1, Q2 of the same observation and action."""

    first: Perceptron
    second: Perceptron

    def __init__(self, observations: int, actions: int, hidden: tuple[int, ...], key: PRNGKeyArray):
        first_key, second_key = jax.random.split(key)
        sizes = (observations + actions, *hidden, 1)
        self.first = Perceptron(sizes, first_key)
        self.second = Perceptron(sizes, second_key)

    def __call__(
        self, observations: Float[AnyArray, "batch observation"], actions: Float[AnyArray, "batch action"]
    ) -> tuple[Float[Array, "batch"], Float[Array, "batch"]]:
        joined = jnp.concatenate([observations, actions], axis=-1)
        return self.first(joined)[:, 0], self.second(joined)[:, 0]

    def first_value(
        self, observations: Float[AnyArray, "batch observation"], actions: Float[AnyArray, "batch action"]
    ) -> Float[Array, "batch"]:
        """Q1 alone, which TD3's actor maximises."""
        return self.first(jnp.concatenate([observations, actions], axis=-1))[:, 0]
