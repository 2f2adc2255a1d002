"""Check models of custom robots: errors, and whether the control point moves as commanded."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sidestep._arrays import real
from sidestep.world.models import EvaderModel, EvaderState, PursuerModel
from sidestep.world.scenario import Scenario

_ROBOTS = 256
_PERIODS = 40
_PARTS = 4
_ROUNDING = 1e-4
_OFF = 0.01


class ModelWarning(UserWarning):
    """A robot's model works, but its control point does not move exactly as commanded."""


@dataclasses.dataclass(frozen=True)
class EvaderProbe:
    """The result of driving an evader with a new command in every period.

    - `tracking_error` m/s: largest difference between the control point's velocity and the command, for
      `Budget`
    - `offset` m: largest distance of the control point from the robot
    - `errors` of the model, in words
    """

    errors: tuple[str, ...]
    tracking_error: float
    offset: float


@eqx.filter_jit
def _drive(model: EvaderModel, scenario: Scenario, key: Any) -> tuple[Array, Array, EvaderState, EvaderState]:
    """Drive one robot with a new command in every period. Returns the velocity errors of its control point
    (m/s), the distances of that from the robot (m), and the states after one step and after its parts."""
    period = scenario.control_period
    part = period / _PARTS
    start_key, command_key = jax.random.split(key)
    state = model.start(scenario, start_key)
    robot = EvaderState(jnp.zeros(2, dtype=float), jnp.zeros(2, dtype=float), state)
    angles = jax.random.uniform(command_key, (_PERIODS,), dtype=float, minval=-jnp.pi, maxval=jnp.pi)
    commands = scenario.evader_speed * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)

    def hold(robot: EvaderState, command: Array) -> Any:
        here, errors, offsets = robot, [], []
        point = model.control_point(scenario, here)
        for _ in range(_PARTS):
            here = model.after(scenario, here, command, part)
            before, point = point, model.control_point(scenario, here)
            errors.append(jnp.hypot(*((point - before) / part - command)))
            offsets.append(jnp.hypot(*(point - here.position)))
        whole = model.after(scenario, robot, command, period)
        return here, (jnp.stack(errors), jnp.stack(offsets), whole, here)

    _, (errors, offsets, whole, parts) = jax.lax.scan(hold, robot, commands)
    return errors, offsets, whole, parts


def probe_evader(model: EvaderModel, scenario: Scenario) -> EvaderProbe:
    """Drive 256 robots for 40 periods each, with random commands at full speed.

    **Errors**: results of wrong shape or not finite; a motion that differs between one step and its four
    parts; a control point farther from the robot than `offset`.
    """
    wrong = _evader_shapes(model, scenario)
    if wrong:
        return EvaderProbe((wrong,), 0.0, 0.0)
    keys = jax.random.split(jax.random.key(0), _ROBOTS)
    seen = eqx.filter_vmap(_drive, in_axes=(None, None, 0))(model, scenario, keys)
    errors, offsets, whole, parts = jax.tree.map(np.asarray, seen)
    leaves = [np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(end)]) for end in (whole, parts)]
    found: list[str] = []
    if not all(np.all(np.isfinite(values)) for values in (errors, offsets, *leaves)):
        found.append("after(...) or control_point(...) is not finite for a finite robot")
        return EvaderProbe(tuple(found), 0.0, 0.0)
    # Angles may differ by full turns.
    apart = np.abs(leaves[0] - leaves[1])
    apart = float(np.max(np.minimum(apart, np.abs(apart - 2.0 * np.pi))))
    if apart > _ROUNDING:
        found.append(
            f"after(...) over one period and over four parts of it end {apart:.2g} apart: the command must "
            "be held for any time, and time = 0 must not change the robot"
        )
    allowed, farthest = float(model.offset(scenario)), float(np.max(offsets))
    if farthest > allowed + _ROUNDING:
        found.append(
            f"the control point was {farthest:.4g} m from the robot, but offset(...) is {allowed:.4g} m: "
            "shields would keep too little distance"
        )
    return EvaderProbe(tuple(found), float(np.max(errors)), farthest)


def _evader_shapes(model: EvaderModel, scenario: Scenario) -> str | None:
    key = jax.random.key(0)
    command, time = real((0.1, 0.0)), scenario.control_period
    try:
        asked = "start(scenario, key)"
        state = eqx.filter_eval_shape(model.start, scenario, key)
        if np.ndim(state) != 1:
            return f"{asked} must give a row of numbers, (s,); got shape {np.shape(state)}"
        robot = EvaderState(real((0.0, 0.0)), real((0.0, 0.0)), jnp.zeros(state.shape, state.dtype))
        asked = "after(scenario, robot, command, time)"
        there: Any = eqx.filter_eval_shape(model.after, scenario, robot, command, time)
        shapes = jax.tree.map(np.shape, (robot, there))
        if not isinstance(there, EvaderState) or not eqx.tree_equal(*shapes):
            return f"{asked} must give an EvaderState of the shapes it was given; got {shapes[1]}"
        asked = "control_point(scenario, robot)"
        point = eqx.filter_eval_shape(model.control_point, scenario, robot)
        if np.shape(point) != (2,):
            return f"{asked} must give a point (2,); got shape {np.shape(point)}"
        asked = "offset(scenario)"
        eqx.filter_eval_shape(model.offset, scenario)
        offset = model.offset(scenario)
        if np.shape(offset) != () or not float(offset) >= 0.0:
            return f"{asked} must give one distance in m, 0 or more; got {offset!r}"
    except Exception as error:
        return f"{asked} raised {type(error).__name__}: {error}"
    return None


def pursuer_errors(model: PursuerModel, scenario: Scenario) -> list[str]:
    """What is wrong with a pursuer's model: a pair that it takes outside the hull of its `corners`, or beyond
    the differential drive that is to cover it; shapes; numbers that are not finite."""
    try:
        asked = "corners(scenario)"
        eqx.filter_eval_shape(model.corners, scenario)
        corners = np.asarray(model.corners(scenario))
        if corners.ndim != 2 or corners.shape[1] != 2 or not np.all(np.isfinite(corners)):
            return [f"{asked} must give finite pairs (speed, turn rate), (n, 2); got shape {corners.shape}"]
        asked = "limit(scenario, speed, turn_rate)"
        reach = 3.0 * np.max(np.abs(corners), axis=0) + 1e-3
        wanted = jnp.asarray(np.random.default_rng(0).uniform(-reach, reach, (512, 2)), dtype=float)
        limit = jax.vmap(lambda pair: model.limit(scenario, pair[0], pair[1]))
        taken = np.stack([np.asarray(part) for part in limit(wanted)], axis=-1)
        if taken.shape != wanted.shape:
            return [f"{asked} must give two numbers (speed, turn rate); got shape {taken.shape[1:]}"]
        asked = "covering(scenario)"
        eqx.filter_eval_shape(model.covering, scenario)
        covering = model.covering(scenario)
    except Exception as error:
        return [f"{asked} raised {type(error).__name__}: {error}"]
    if not np.all(np.isfinite(taken)):
        return ["limit(...) is not finite for finite numbers"]
    found = []
    # A pair is outside a convex hull if it is farther than every corner in some direction.
    angles = np.linspace(-np.pi, np.pi, 181)
    size = np.max(np.abs(np.concatenate([corners, taken])), axis=0) + 1e-9
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=0)
    beyond = (taken / size) @ directions - np.max((corners / size) @ directions, axis=0)
    if np.max(beyond) > _OFF:
        pair = taken[np.unravel_index(np.argmax(beyond), beyond.shape)[0]]
        found.append(
            f"limit(...) lets the pair ({pair[0]:.3g} m/s, {pair[1]:.3g} rad/s) through, which is outside "
            "the hull of corners(...): barriers would not account for it"
        )
    if covering is not None:
        rim, axle = (float(part) for part in covering)
        if not (np.isfinite(rim) and np.isfinite(axle) and rim > 0.0 and axle > 0.0):
            return [*found, f"covering(...) = ({rim}, {axle}): rim speed and half axle must be above 0"]
        used = np.abs(corners[:, 0]) + axle * np.abs(corners[:, 1])
        if np.max(used) > rim * (1.0 + _ROUNDING):
            pair = corners[np.argmax(used)]
            found.append(
                f"covering(...) = ({rim:.4g} m/s, {axle:.4g} m) cannot do ({pair[0]:.3g} m/s, {pair[1]:.3g} "
                f"rad/s): |v| + b |omega| is {np.max(used):.4g} m/s"
            )
    return found


def check_models(scenario: Scenario) -> list[str]:
    """Errors of a scenario's models, in words. **Warns** `ModelWarning`, with the tracking error for
    `Budget`, if the control point does not move as commanded."""
    found = []
    if scenario.pursuer_model is not None:
        name = type(scenario.pursuer_model).__name__
        found += [f"{name}: {error}" for error in pursuer_errors(scenario.pursuer_model, scenario)]
    if scenario.evader_model is not None:
        seen, name = probe_evader(scenario.evader_model, scenario), type(scenario.evader_model).__name__
        found += [f"{name}: {error}" for error in seen.errors]
        if not seen.errors and seen.tracking_error > _OFF * float(scenario.evader_speed):
            warnings.warn(
                f"{name}: its control point's velocity differs by up to {seen.tracking_error:.3g} m/s from "
                "the command. Shields allow for that with "
                f"Budget(tracking_error={seen.tracking_error:.2g}), if the game leaves room; or choose a "
                "point that follows the command",
                ModelWarning,
                stacklevel=4,
            )
    return found
