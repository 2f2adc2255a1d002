"""Check the options of `reset`, such as the world to start in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sidestep.world import Scenario, World

_PARTS = ("evader", "pursuers", "obstacles", "target")


def checked_options(options: Any, *known: str) -> dict[str, Any]:
    """The options of `reset` as a dict. **Raises** `ValueError` for an unknown option."""
    options = {} if options is None else options
    unknown = [name for name in options if name not in known]
    if unknown:
        raise ValueError(f"options has {unknown}; reset knows {', '.join(map(repr, known))}")
    return options


def given_world(scenario: Scenario, given: Any, lanes: tuple[int, ...] = ()) -> World:
    """The world of `options={"world": ...}`, at time 0, in lanes if there are several.

    **Arguments:** `given` a `World`, or a mapping with `evader` (2,), `pursuers` (m, 3), `obstacles` (k, 4)
    and `target` (2,), each with a leading axis of worlds if there are several.

    **Raises** `ValueError` for a part that is missing, has the wrong shape or is not finite, and for a start
    in which the evader is captured or collides.
    """
    if not isinstance(given, (World, Mapping)):
        raise ValueError(f"options['world'] must be a World or a mapping, not a {type(given).__name__}")
    shapes = {
        "evader": (2,),
        "pursuers": (scenario.pursuer_count, 3),
        "obstacles": (scenario.obstacle_count, 4),
        "target": (2,),
    }
    parts: dict[str, np.ndarray] = {}
    for name in _PARTS:
        value: Any = getattr(given, name) if isinstance(given, World) else given.get(name)
        if value is None:
            raise ValueError(f"options['world'] has no {name!r}; it needs {', '.join(_PARTS)}")
        parts[name] = np.asarray(value, np.float64)
        wanted = (*lanes, *shapes[name])
        if parts[name].shape != wanted or not np.all(np.isfinite(parts[name])):
            raise ValueError(
                f"options['world']: {name!r} must be {wanted} finite numbers, not {parts[name].shape}"
            )
    _check_contacts(scenario, parts)
    if not lanes:
        return World(**parts)
    worlds = jax.vmap(World)(**{name: jnp.asarray(part, dtype=float) for name, part in parts.items()})
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), worlds)


def _check_contacts(scenario: Scenario, parts: Mapping[str, np.ndarray]) -> None:
    for name, distance, outcome in (
        ("pursuers", float(scenario.capture_distance), "captured"),
        ("obstacles", float(scenario.collision_distance), "in collision"),
    ):
        apart = np.hypot(*np.moveaxis(parts[name][..., :2] - parts["evader"][..., None, :], -1, 0))
        touched = np.argwhere(apart <= distance)
        if len(touched):
            *world, number = touched[0]
            where = f" in world {world[0]}" if world else ""
            raise ValueError(
                f"options['world']: the evader starts {outcome}{where}, {apart[tuple(touched[0])]:.3g} m "
                f"from {name[:-1]} {number}; {distance:.3g} m is contact"
            )
