"""Custom pursuers: plain callables, written with JAX or not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import real
from sidestep.pursuit.catalogue import make_pursuer
from sidestep.pursuit.pursuers import Pursuer
from sidestep.world.scenario import Scenario
from sidestep.world.state import World


class _NotTraceable(TypeError):
    """The callable's answer contains no JAX array."""


@final
class CallablePursuer(Pursuer):
    """A callable `(scenario, world, key) -> wheel_speeds (2,)` as a pursuer.

    A callable written with JAX is traced. One that needs concrete numbers (NumPy, Python's `if` or `math`)
    runs on the host through `jax.pure_callback`, under `jit` and `vmap` too: slower, and one world at a time.
    There `scenario` and `world` have NumPy arrays as fields, and `key` is the key's raw words, which seed
    NumPy as in `numpy.random.default_rng(key)`. The callable must not keep state.

    Arrays inside the callable, such as a learned pursuer's weights, are traced data; the rest is static.
    """

    _arrays: Any
    _rest: Any = eqx.field(static=True)

    def __init__(self, strategy: Callable[..., Any]):
        self._arrays, self._rest = eqx.partition(strategy, eqx.is_inexact_array)

    def steer(self, scenario: Scenario, world: World, key: PRNGKeyArray) -> Float[Array, "2"]:
        strategy = eqx.combine(self._arrays, self._rest)
        if _is_traceable(strategy, scenario, world, key):
            return _checked(strategy(scenario, world, key))
        return _on_host(strategy, scenario, world, key)


def runs_on_host(pursuer: Pursuer, scenario: Scenario) -> bool:
    """Whether this is a callable that needs concrete numbers and so runs on the host."""
    if not isinstance(pursuer, CallablePursuer):
        return False
    strategy, traceable = eqx.combine(pursuer._arrays, pursuer._rest), False

    def start(key: PRNGKeyArray) -> None:
        nonlocal traceable
        traceable = _is_traceable(strategy, scenario, scenario.reset(key), key)

    # Shapes only: nothing is computed.
    jax.eval_shape(start, jax.random.key(0))
    return not traceable


def _is_traceable(strategy: Callable[..., Any], scenario: Scenario, world: World, key: PRNGKeyArray) -> bool:
    """Whether JAX can trace the callable; checked outside `jit` too, so that it behaves the same there.

    A callable that returns NumPy values while being traced counts as not traceable: a draw from NumPy's
    random state, for example, would become a constant of the compiled program. NumPy rejects tracers with a
    TypeError; a TypeError of another cause is raised again on the host.
    """

    def attempt(*arguments: Any) -> Any:
        answer = strategy(*arguments)
        if not any(isinstance(leaf, Array) for leaf in jax.tree.leaves(answer)):
            raise _NotTraceable
        return answer

    try:
        jax.eval_shape(attempt, scenario, world, key)
    except TypeError:
        return False
    return True


def _checked(answer: Any) -> Float[Array, "2"]:
    if np.shape(answer) != (2,):
        raise ValueError(
            "a pursuer must return its two wheel rim speeds (left, right), shape (2,); "
            f"got shape {np.shape(answer)}"
        )
    return real(answer)


def _on_host(strategy: Callable[..., Any], scenario: Scenario, world: World, key: PRNGKeyArray) -> Array:
    words = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    wanted = jax.ShapeDtypeStruct((2,), real(0.0).dtype)

    def ask(scenario: Scenario, world: World, words: Any) -> np.ndarray:
        scenario, world, words = jax.tree.map(np.asarray, (scenario, world, words))
        answer = np.asarray(strategy(scenario, world, words), dtype=wanted.dtype)
        if answer.shape != (2,):
            _checked(answer)
        return answer

    return jax.pure_callback(ask, wanted, scenario, world, words, vmap_method="sequential")


def as_pursuer(pursuer: str | Pursuer | Callable[..., Any]) -> Pursuer:
    """A pursuer from a name, a `Pursuer` or any callable `(scenario, world, key) -> wheel_speeds (2,)`.

    **Raises** `ValueError` for an unknown name and `TypeError` for any other object.
    """
    if isinstance(pursuer, str):
        return make_pursuer(pursuer)
    if isinstance(pursuer, Pursuer):
        return pursuer
    if callable(pursuer):
        return CallablePursuer(pursuer)
    raise TypeError(
        "a pursuer is a name, a Pursuer or a callable (scenario, world, key) -> wheel_speeds; "
        f"got {pursuer!r}"
    )
