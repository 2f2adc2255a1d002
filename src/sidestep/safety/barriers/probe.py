"""Is this a barrier? What is wrong with it, before anything relies on it?"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sidestep.safety.barriers.barrier import Barrier
from sidestep.safety.barriers.frame_barrier import pursuer_corners
from sidestep.world.scenario import Scenario
from sidestep.world.state import World

_SAMPLES = 2048
_GRADIENT_OFF = 0.02
_KINKS = 0.05
"""Share of positions at which normal and gradient may differ: a barrier may have edges."""
_VANISHED = 1e-3
_NEAR = 0.1
"""A row must be feasible at values of h from 0 to this share of the contact distance."""
_INSIDE = 0.9
"""Within this share of the contact distance there certainly is contact."""
_FEW = 0.001
"""Share of positions that may be due to rounding."""


class BarrierWarning(UserWarning):
    """A barrier that works, but has no guarantee."""


@dataclasses.dataclass(frozen=True)
class BarrierProbe:
    """What a probe found.

    - `errors` why it is no barrier
    - `doubts` why it guarantees nothing
    - `shortfall` m/s, by how much its rate is below the fastest that the other robot can lower h
    - `infeasible` share of the positions with h just above 0 at which no velocity keeps the row
    """

    errors: tuple[str, ...]
    doubts: tuple[str, ...]
    shortfall: float
    infeasible: float


def _sample_world(scenario: Scenario) -> World:
    return World(
        jnp.asarray([0.7, 0.4]),
        jnp.asarray([[0.0, 0.0, 0.3]]),
        jnp.asarray([[0.0, 0.0, 0.02, 0.0]]),
        jnp.zeros(2),
    )


def _shape_errors(barrier: Barrier, scenario: Scenario, world: World) -> list[str]:
    """The first wrong shape among a barrier's answers, since later ones may follow from it."""
    evader, shapes = world.evader, eqx.filter_eval_shape

    def shape(answer: Any) -> Any:
        return jax.tree.map(np.shape, answer)

    try:
        robots = barrier.robots(world)
    except Exception as error:
        return [f"robots(world) raised {type(error).__name__}: {error}"]
    if np.ndim(robots) != 2 or len(robots) != 1:
        return [
            "robots(world) must give one row of numbers for each robot, world.pursuers or world.obstacles; "
            f"of a world with one of each it gave shape {np.shape(robots)}"
        ]
    robot = robots[0]
    try:
        asked = "update_memory(scenario, evader, robot, None)"
        memory = shapes(barrier.update_memory, scenario, evader, robot, None)
        if shape(memory) != ():
            return [
                f"{asked} must give one number, 0 for a barrier without memory; got shape {shape(memory)}"
            ]
        asked = "value(scenario, evader, robot, memory)"
        memory = jnp.zeros((), evader.dtype)
        h = shapes(barrier.value, scenario, evader, robot, memory)
        if shape(h) != ():
            return [f"{asked} must give one number, h in m; got shape {shape(h)}"]
        asked = "gradient_and_rate(scenario, evader, robot, memory)"
        answer: Any = shapes(barrier.gradient_and_rate, scenario, evader, robot, memory)
        if not isinstance(answer, tuple) or shape(answer) != ((2,), ()):
            return [f"{asked} must give (normal (2,), rate ()); got shapes {shape(answer)}"]
        asked = "alpha(scenario, h)"
        allowed = shapes(barrier.alpha, scenario, memory)
        if shape(allowed) != ():
            return [f"{asked} must give one number, in m/s; got shape {shape(allowed)}"]
    except Exception as error:
        return [f"{asked} raised {type(error).__name__}: {error}"]
    return []


def _motions(scenario: Scenario, world: World, robots: Array, robot: Array) -> Float[Array, "n d"] | None:
    """Rates of a robot's numbers, one row for each extreme motion; None if they are unknown."""
    if robots.shape == world.obstacles.shape:
        return jnp.concatenate([robot[2:4], jnp.zeros(2)])[None]
    if robots.shape != world.pursuers.shape:
        return None
    corners = pursuer_corners(scenario)
    speed, turn_rate = corners[:, 0], corners[:, 1]
    return jnp.stack([speed * jnp.cos(robot[2]), speed * jnp.sin(robot[2]), turn_rate], axis=1)


@eqx.filter_jit
def _look(
    barrier: Barrier, scenario: Scenario, world: World, evaders: Array, angles: Array
) -> dict[str, Any]:
    robots = barrier.robots(world)

    def at(evader: Array, angle: Array) -> dict[str, Any]:
        robot = robots[0]
        if robots.shape == world.pursuers.shape:
            robot = robot.at[2].set(angle)
        memory = barrier.update_memory(scenario, evader, robot, None)
        h, normal, _ = barrier.row(scenario, evader, robot, memory)
        rate = barrier.gradient_and_rate(scenario, evader, robot, memory)[1]
        gradient, by_robot = jax.grad(
            lambda evader, robot: barrier.value(scenario, evader, robot, memory), argnums=(0, 1)
        )(evader, robot)
        motions = _motions(scenario, world, robots, robot)
        worst = rate if motions is None else jnp.max(-motions @ by_robot)
        return {
            "h": h,
            "normal": normal,
            "gradient": gradient,
            "rate": rate,
            "worst": worst,
            "allowed": barrier.alpha(scenario, h),
        }

    return jax.vmap(at)(evaders, angles)


def probe_barrier(barrier: Barrier, scenario: Scenario) -> BarrierProbe:
    """Try a barrier at 2048 positions around another robot, up to three contact distances away.

    It is no barrier (`errors`) if its answers have wrong shapes or are not finite, if alpha is not of class
    K, if h is above 0 in contact, if the normal is not dh/dp_e, or if dh/dp_e vanishes: the evader's velocity
    then does not act on h (relative degree above 1). It guarantees nothing (`doubts`) if the other robot can
    lower h faster than the rate, or if the row asks for more speed than the evader has.
    """
    world = _sample_world(scenario)
    errors = _shape_errors(barrier, scenario, world)
    if errors:
        return BarrierProbe(tuple(errors), (), 0.0, 0.0)
    around, away, heading = jax.random.split(jax.random.key(0), 3)
    robots = barrier.robots(world)
    contact = (
        scenario.collision_distance if robots.shape == world.obstacles.shape else scenario.capture_distance
    )
    bearing = jax.random.uniform(around, (_SAMPLES,), dtype=float, minval=-jnp.pi, maxval=jnp.pi)
    distance = contact * jax.random.uniform(away, (_SAMPLES,), dtype=float, minval=0.3, maxval=3.0)
    places = robots[0, :2] + distance[:, None] * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)], axis=1)
    angles = jax.random.uniform(heading, (_SAMPLES,), dtype=float, minval=-jnp.pi, maxval=jnp.pi)
    seen = {
        name: np.asarray(value) for name, value in _look(barrier, scenario, world, places, angles).items()
    }
    relative = np.asarray(places - robots[0, :2])
    errors, doubts, shortfall, infeasible = _judge(barrier, scenario, float(contact), relative, seen)
    return BarrierProbe(tuple(errors), tuple(doubts), shortfall, infeasible)


def _judge(
    barrier: Barrier, scenario: Scenario, contact: float, places: np.ndarray, seen: dict[str, np.ndarray]
) -> tuple[list[str], list[str], float, float]:
    speed = float(scenario.evader_speed)

    def where(index: Any) -> str:
        x, y = places[index]
        return f"the evader at ({x:+.3f}, {y:+.3f}) m from the other robot"

    broken = [name for name, value in seen.items() if not np.all(np.isfinite(value))]
    if broken:
        finite = np.isfinite(seen[broken[0]]).reshape(len(places), -1).all(axis=1)
        at = where(np.argmin(finite))
        return [f"{', '.join(broken)} not finite, for instance with {at}"], [], 0.0, 0.0

    errors, doubts = _alpha_errors(barrier, scenario, float(np.max(seen["h"]))), []
    size = np.linalg.norm(seen["gradient"], axis=1)
    off = np.linalg.norm(seen["normal"] - seen["gradient"], axis=1)
    wrong = off > _GRADIENT_OFF * np.maximum(size, 1e-6)
    vanished = size < _VANISHED * max(float(np.max(size)), 1e-12)
    if np.mean(vanished) > _KINKS:
        errors.append(
            f"h does not change with the evader's position at {np.mean(vanished):.0%} of the places: its "
            "velocity does not act on h there (relative degree above 1). Write h of the point that moves as "
            "commanded (EvaderModel.control_point), or of position and velocity together"
        )
    elif np.mean(wrong) > _KINKS:
        at = int(np.argmax(off))
        errors.append(
            f"the normal is not the gradient dh/dp_e at {np.mean(wrong):.0%} of the places: {where(at)} it "
            f"is {seen['normal'][at].round(3).tolist()}, the gradient is "
            f"{seen['gradient'][at].round(3).tolist()} (in world axes)"
        )
    inside = np.linalg.norm(places, axis=1) < _INSIDE * contact
    free = float(np.mean(seen["h"][inside] > 0.0))
    if free > 0.5:
        errors.append(
            f"h is above 0 at {free:.0%} of the places in contact, where all is lost: is its sign turned "
            "round? It must be at least 0 where the evader is free"
        )
        return errors, [], 0.0, 0.0
    near = (seen["h"] >= 0.0) & (seen["h"] <= _NEAR * contact)
    if not np.any(near):
        errors.append(
            f"h is nowhere between 0 and {_NEAR * contact:.3g} m: of {len(places)} places within three "
            f"contact distances, it runs from {np.min(seen['h']):.3g} to {np.max(seen['h']):.3g} m. Is it in "
            "metres, and 0 where contact can no longer be avoided?"
        )
        return errors, [], 0.0, 0.0
    short = np.where(near & ~wrong, seen["worst"] - seen["rate"], -np.inf)
    shortfall = max(float(np.max(short)), 0.0)
    if np.mean(short[near] > 0.01 * float(scenario.pursuer_speed)) > _FEW:
        doubts.append(
            f"the other robot can lower h faster than the rate says, by up to {shortfall:.3g} m/s: "
            f"{where(int(np.argmax(short)))}. The row lets that through"
        )
    asked = seen["rate"] - seen["allowed"] - speed * np.linalg.norm(seen["normal"], axis=1)
    asked = np.where(near, asked, -np.inf)
    infeasible = float(np.mean(asked[near] > 1e-3 * speed))
    if infeasible > _FEW:
        doubts.append(
            f"at {infeasible:.0%} of the places just outside h = 0 the evader cannot keep the row: it asks "
            f"for up to {float(np.max(asked)) + speed:.3g} m/s of its {speed:.3g}, "
            f"{where(int(np.argmax(asked)))}"
        )
    return errors, doubts, shortfall, infeasible


def _alpha_errors(barrier: Barrier, scenario: Scenario, largest: float) -> list[str]:
    """Why alpha is not of class K."""
    values = jnp.linspace(0.0, max(largest, 1e-3), 65, dtype=float)
    allowed = np.asarray(jax.vmap(lambda h: barrier.alpha(scenario, h))(values))
    errors = []
    if abs(allowed[0]) > 1e-6:
        errors.append(
            f"alpha(0) = {allowed[0]:.3g} m/s: it must be 0 (class K through zero), or else h may go on "
            "sinking at 0"
        )
    if np.any(np.diff(allowed) <= 0.0):
        at = int(np.argmin(np.diff(allowed)))
        errors.append(
            f"alpha does not increase with h: {allowed[at]:.3g} m/s at h = {values[at]:.3g} m, "
            f"{allowed[at + 1]:.3g} at {values[at + 1]:.3g} (it must be of class K)"
        )
    return errors


def announce(found: BarrierProbe) -> None:
    """**Raises** `ValueError` with all errors of a probe; **warns** `BarrierWarning` of its doubts."""
    if found.errors:
        raise ValueError("this is no barrier: " + "; ".join(found.errors))
    for doubt in found.doubts:
        warnings.warn(doubt, BarrierWarning, stacklevel=3)
