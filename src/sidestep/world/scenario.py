"""A scenario: every constant of the problem, how an episode starts, and one step of its physics."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import AnyArray, Flag, Lanes, Scalar, apart, fold, length, norm, real, stack
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame, usable_angle
from sidestep.world.events import Events
from sidestep.world.robots import (
    closest_approach_driving,
    closest_approach_straight,
    drive,
    glide,
    limit_speed,
    limit_wheels,
)
from sidestep.world.state import World

_RESET_TRIES = 10_000


class Scenario(eqx.Module):
    """All constants of one problem, with units. Build one with `sidestep.load_scenario`, which validates.

    Real-valued fields are traced arrays, so one may `vmap` over speeds, gains or distances and another
    value never recompiles; counts and modes are static. Starts left as `None` are drawn at random.

    **Speeds and sizes**

    - `evader_speed` v_e, `pursuer_speed` V (wheel rim), m/s
    - `pursuer_half_axle` b, `capture_distance` l, `collision_distance` d_oc, `reach_distance` d_t, m
    - `obstacle_velocity (2,)`, m/s; with `obstacle_directions="random"` only its magnitude is used
    - `control_period` T, s

    **Shield** `pursuer_gain`, `obstacle_gain`, 1/s.
    **Reward** `reach_reward`; `distance_cost` per metre and control period.

    **Random starts**, all uniform in a square of side `arena_side` (m) centred on the origin, subject to
    evader and pursuer `initial_separation` apart, evader and obstacle `obstacle_separation` apart, evader
    and target `target_separation` apart, target clear of obstacles, nobody captured at once. The square
    only bounds the starts: the plane has no walls.

    **Counts and modes** `pursuer_count`, `obstacle_count`, `episode_steps` (control periods),
    `action` = `"velocity"` (disc |u| <= v_e) or `"heading"` (circle |u| = v_e), `frame` = `"target"` or
    `"world"` (axes of observation and policy action).
    """

    evader_speed: Scalar = eqx.field(converter=real, default=0.1574)
    pursuer_speed: Scalar = eqx.field(converter=real, default=0.2)
    pursuer_half_axle: Scalar = eqx.field(converter=real, default=0.2)
    capture_distance: Scalar = eqx.field(converter=real, default=0.2)
    collision_distance: Scalar = eqx.field(converter=real, default=0.2)
    reach_distance: Scalar = eqx.field(converter=real, default=0.05)
    obstacle_velocity: Float[Array, "2"] = eqx.field(converter=real, default=(0.02, 0.0))
    control_period: Scalar = eqx.field(converter=real, default=0.05)
    pursuer_gain: Scalar = eqx.field(converter=real, default=1.2)
    obstacle_gain: Scalar = eqx.field(converter=real, default=1.0)
    reach_reward: Scalar = eqx.field(converter=real, default=1000.0)
    distance_cost: Scalar = eqx.field(converter=real, default=0.01)
    arena_side: Scalar = eqx.field(converter=real, default=3.0)
    initial_separation: Scalar = eqx.field(converter=real, default=0.6)
    obstacle_separation: Scalar = eqx.field(converter=real, default=0.3)
    target_separation: Scalar = eqx.field(converter=real, default=0.5)
    evader_start: Float[Array, "2"] | None = None
    pursuer_starts: Float[Array, "m 3"] | None = None
    obstacle_starts: Float[Array, "k 2"] | None = None
    target_start: Float[Array, "2"] | None = None
    name: str = eqx.field(static=True, default="paper")
    pursuer_count: int = eqx.field(static=True, default=1)
    obstacle_count: int = eqx.field(static=True, default=1)
    episode_steps: int = eqx.field(static=True, default=5000)
    action: str = eqx.field(static=True, default="velocity")
    obstacle_directions: str = eqx.field(static=True, default="fixed")
    frame: str = eqx.field(static=True, default="target")

    @property
    def usable_angle(self) -> Scalar:
        """S = arccos(v_e / V), rad; 0 when the evader is at least as fast."""
        return usable_angle(self.evader_speed, self.pursuer_speed)

    def _draw(self, key: PRNGKeyArray) -> World:
        """One random world, not yet checked."""
        evader_key, pursuer_key, heading_key, obstacle_key, drift_key, target_key = jax.random.split(key, 6)
        half = self.arena_side / 2.0

        def place(key: PRNGKeyArray, *shape: int) -> Float[Array, "..."]:
            return jax.random.uniform(key, (*shape, 2), dtype=float, minval=-half, maxval=half)

        m, k = self.pursuer_count, self.obstacle_count
        if self.pursuer_starts is None:
            headings = jax.random.uniform(heading_key, (m, 1), dtype=float, minval=-jnp.pi, maxval=jnp.pi)
            pursuers = jnp.concatenate([place(pursuer_key, m), headings], axis=-1)
        else:
            pursuers = self.pursuer_starts
        obstacles = place(obstacle_key, k) if self.obstacle_starts is None else self.obstacle_starts
        drift = jnp.broadcast_to(self.obstacle_velocity, (k, 2))
        if self.obstacle_directions == "random":
            angle = jax.random.uniform(drift_key, (k,), dtype=float, minval=-jnp.pi, maxval=jnp.pi)
            speed = jnp.sqrt(jnp.sum(self.obstacle_velocity**2))
            drift = speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        return World(
            evader=place(evader_key) if self.evader_start is None else self.evader_start,
            pursuers=pursuers,
            obstacles=jnp.concatenate([obstacles, drift], axis=-1),
            target=place(target_key) if self.target_start is None else self.target_start,
        )

    def accepts(self, world: World) -> Flag:
        """Whether a world may start an episode: nobody captured at once, nothing inside an obstacle.

        The separations of the random distribution bind only what is drawn, never a start that the user
        fixed.
        """
        in_frame = jax.vmap(to_pursuer_frame, in_axes=(None, 0))(world.evader, world.pursuers)
        escape = jax.vmap(capture_set_distance, in_axes=(0, None, None))(
            in_frame, self.usable_angle, self.capture_distance
        )
        evader_to_obstacle = norm(world.obstacles[:, :2] - world.evader)
        target_to_obstacle = norm(world.obstacles[:, :2] - world.target)
        target_to_evader = norm(world.target - world.evader)
        good = (
            jnp.all(escape > 0.0)
            & jnp.all(evader_to_obstacle > self.collision_distance)
            & jnp.all(target_to_obstacle > self.collision_distance)
            & (target_to_evader > self.reach_distance)
        )
        evader_drawn = self.evader_start is None
        if evader_drawn or self.pursuer_starts is None:
            good &= jnp.all(norm(world.pursuers[:, :2] - world.evader) >= self.initial_separation)
        if evader_drawn or self.obstacle_starts is None:
            good &= jnp.all(evader_to_obstacle >= self.obstacle_separation)
        if evader_drawn or self.target_start is None:
            good &= target_to_evader >= self.target_separation
        return good

    def reset(self, key: PRNGKeyArray) -> World:
        """A world that starts an episode: drawn until `accepts` agrees.

        `load_scenario` has checked that such worlds exist; should one be out of reach all the same
        (a scenario changed under `vmap`, say), the last draw is returned after 10,000 tries.
        """

        def again(carry: tuple[PRNGKeyArray, World, Array]) -> Array:
            return ~self.accepts(carry[1]) & (carry[2] < _RESET_TRIES)

        def draw(carry: tuple[PRNGKeyArray, World, Array]) -> tuple[PRNGKeyArray, World, Array]:
            key, draw_key = jax.random.split(carry[0])
            return key, self._draw(draw_key), carry[2] + 1

        first_key, later_key = jax.random.split(key)
        return jax.lax.while_loop(again, draw, (later_key, self._draw(first_key), jnp.asarray(0)))[1]

    def step(
        self,
        world: World,
        action: Float[AnyArray, "2 *lanes"],
        wheel_speeds: Float[AnyArray, "m 2 *lanes"] | Float[AnyArray, "2 *lanes"],
    ) -> tuple[World, Events]:
        """One control period of pure physics: no shield, no policy; of one world, or of many in lanes.

        **Arguments:** `action` the evader's velocity (m/s, world axes), projected on what the robot can
        do (disc or circle); `wheel_speeds` left and right rim speed (m/s) of each pursuer, clipped to
        [-V, V]. Non-finite commands count as a stop.

        **Returns** the world one period later and the `Events` of the period. The reward is
        `reach_reward` when the target was reached, else -`distance_cost` times the distance to it at the
        end of the period (paper, eq. for r).
        """
        period = self.control_period
        velocity = self.executable(action)
        shape = (self.pursuer_count, *velocity.shape)
        wheels = jax.vmap(limit_wheels, in_axes=(0, None))(
            jnp.reshape(wheel_speeds, shape), self.pursuer_speed
        )

        def pass_by(obstacle: Array) -> Lanes:
            return closest_approach_straight(world.evader - obstacle[:2], velocity - obstacle[2:], period)

        # Every event asks for it, and in lanes XLA would compute it anew for each of them.
        given = (self, world, velocity, wheels)
        to_pursuers = apart(_approaches, *given) if world.lanes else _approaches(*given)
        to_obstacles = jax.vmap(pass_by)(world.obstacles)
        to_target = closest_approach_straight(world.evader - world.target, velocity, period)
        pursuer_clearance = fold(jnp.minimum, to_pursuers, jnp.inf) - self.capture_distance
        obstacle_clearance = fold(jnp.minimum, to_obstacles, jnp.inf) - self.collision_distance

        moved = self.moved(world, velocity, wheels)
        # As counted there, in whole periods.
        periods = jnp.round(moved.time / period)
        captured = pursuer_clearance <= 0.0
        collided = obstacle_clearance <= 0.0
        reached = (to_target <= self.reach_distance) & ~captured & ~collided
        timed_out = (periods >= self.episode_steps) & ~captured & ~collided & ~reached
        distance = length(moved.evader[0] - moved.target[0], moved.evader[1] - moved.target[1])
        return moved, Events(
            reward=jnp.where(reached, self.reach_reward, -self.distance_cost * distance),
            captured=captured,
            collided=collided,
            reached=reached,
            timed_out=timed_out,
            pursuer_clearance=pursuer_clearance,
            obstacle_clearance=obstacle_clearance,
        )

    def moved(
        self,
        world: World,
        velocity: Float[Array, "2 *lanes"],
        wheel_speeds: Float[Array, "m 2 *lanes"],
    ) -> World:
        """Where everything is one control period later, for commands that the robots can execute."""
        period, obstacles = self.control_period, world.obstacles
        # Counting whole periods keeps float32 time exact enough to compare with the limit.
        periods = jnp.round(world.time / period) + 1.0
        return eqx.tree_at(
            lambda w: (w.evader, w.pursuers, w.obstacles, w.time, w.evader_velocity, w.wheel_speeds),
            world,
            (
                glide(world.evader, velocity, period),
                jax.vmap(drive, in_axes=(0, 0, None, None))(
                    world.pursuers, wheel_speeds, self.pursuer_half_axle, period
                ),
                jnp.concatenate([obstacles[:, :2] + obstacles[:, 2:] * period, obstacles[:, 2:]], axis=1),
                periods * period,
                velocity,
                wheel_speeds,
            ),
        )

    def executable(self, velocity: Float[AnyArray, "2 *lanes"]) -> Float[Array, "2 *lanes"]:
        """The velocity (m/s) the evader drives when told `velocity`: on the disc, or on the circle.

        In `heading` mode a robot told to stop keeps its circle speed along world x, since the speed is
        not its to choose.
        """
        limited = limit_speed(velocity, self.evader_speed)
        if self.action == "velocity":
            return limited
        # Scaled before it is squared, or else a tiny command underflows and loses its direction.
        largest = jax.lax.stop_gradient(jnp.maximum(jnp.abs(limited[0]), jnp.abs(limited[1])))
        moving = largest > 0.0
        safe = jnp.where(moving, largest, 1.0)
        x, y = jnp.where(moving, limited[0] / safe, 1.0), jnp.where(moving, limited[1] / safe, 0.0)
        scale = self.evader_speed / length(x, y)
        return stack(x * scale, y * scale)


def _approaches(
    scenario: Scenario, world: World, velocity: Float[Array, "2 *lanes"], wheels: Float[Array, "m 2 *lanes"]
) -> Float[Array, "m *lanes"]:
    """The smallest distance (m) to each pursuer within a control period."""

    def approach(pose: Array, wheel: Array) -> Lanes:
        return closest_approach_driving(
            world.evader, velocity, pose, wheel, scenario.pursuer_half_axle, scenario.control_period
        )

    return jax.vmap(approach)(world.pursuers, wheels)
