"""A conditional that also saves work under `jax.vmap`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from sidestep._arrays import Flag


def masked_cond(
    function: Callable[..., Any], need: Flag, otherwise: Any, *arguments: Any, width: int = 16
) -> Any:
    """`function(*arguments)` where `need`, else `otherwise`.

    Without `vmap` this is `jax.lax.cond`. Under `vmap`, where a conditional runs both branches for every
    element, the elements in need are gathered and computed `width` at a time. So the cost follows their
    number.

    **Arguments:** `need ()`; `otherwise` a pytree with the shapes and types that `function` returns;
    `arguments` pytrees of arrays. `function` must close over no traced array. Carries no derivatives.
    """

    # As lists of arrays, because `batched` below speaks of each leaf.
    values, build_values = jax.tree.flatten(arguments)
    defaults, build_result = jax.tree.flatten(otherwise)

    @jax.jit  # so that it is traced once, though it is used alone and in batches
    def run(*values: Any) -> list[Any]:
        return jax.tree.leaves(function(*jax.tree.unflatten(build_values, values)))

    @custom_vmap
    def choose(need: Any, defaults: Any, values: Any) -> Any:
        return jax.lax.cond(need, lambda: run(*values), lambda: defaults)

    @choose.def_vmap
    def _(size: int, batched: Any, need: Any, defaults: Any, values: Any) -> Any:
        def spread(leaf: Any, is_batched: bool) -> Any:
            return leaf if is_batched else jnp.broadcast_to(leaf, (size, *leaf.shape))

        need = spread(need, batched[0])
        defaults = [spread(*pair) for pair in zip(defaults, batched[1], strict=True)]
        many = jax.vmap(run, in_axes=tuple(0 if is_batched else None for is_batched in batched[2]))
        lot = min(width, size)
        # Those in need first; places beyond the last are out of range, and dropped on the way back.
        order = jnp.concatenate([jnp.argsort(~need), jnp.full(lot, size)])
        count = jnp.sum(need)

        def compute(turn: Any, results: Any) -> Any:
            places = jax.lax.dynamic_slice_in_dim(order, turn * lot, lot)
            places = jnp.where(turn * lot + jnp.arange(lot) < count, places, size)
            picked = [
                leaf.at[places].get(mode="clip") if is_batched else leaf
                for leaf, is_batched in zip(values, batched[2], strict=True)
            ]
            return [
                whole.at[places].set(part, mode="drop")
                for whole, part in zip(results, many(*picked), strict=True)
            ]

        results = jax.lax.fori_loop(0, (count + lot - 1) // lot, compute, defaults)
        return results, [True] * len(results)

    return jax.tree.unflatten(build_result, choose(need, defaults, values))
