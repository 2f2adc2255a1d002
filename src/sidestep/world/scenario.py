"""The scenario: all constants of the problem, the start of an episode, and one step of the physics."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from sidestep._arrays import (
    AnyArray,
    Flag,
    Lanes,
    Scalar,
    fold,
    lane_by_lane,
    length,
    no_fuse,
    norm,
    real,
    stack,
    static_field,
)
from sidestep._bounds import bounded, one_of, within
from sidestep.world.capture_geometry import capture_set_distance, to_pursuer_frame, usable_angle
from sidestep.world.events import Events
from sidestep.world.models import EvaderModel, EvaderState, PursuerModel, evader_of
from sidestep.world.robots import (
    body_velocity,
    closest_approach_driving,
    closest_approach_straight,
    drive,
    glide,
    limit_speed,
    limit_wheels,
    wheels_from_body,
)
from sidestep.world.state import World

_RESET_TRIES = 10_000
_CHORDS = 8
"""Number of chords that approximate the path of a custom evader within one control period."""


class Scenario(eqx.Module):
    """All constants of one problem, with units. Build one with `sidestep.load_scenario`, which validates.

    Real-valued fields are traced arrays: `vmap` over speeds, gains or distances is possible, and another
    value never recompiles. Counts and modes are static. Starts that are `None` are drawn at random.

    **Speeds and sizes**

    - `evader_speed` v_e, `pursuer_speed` V (wheel rim), m/s
    - `pursuer_half_axle` b, `capture_distance` l, `collision_distance` d_oc, `reach_distance` d_t, m
    - `obstacle_velocity (2,)`, m/s; only its magnitude is used with `obstacle_directions="random"` or
      `obstacle_motion="adversarial"`
    - `control_period` T, s

    **Shield** `pursuer_gain`, `obstacle_gain`, 1/s.
    **Reward** `reach_reward`; `distance_cost` per metre and control period.

    **Random starts**, uniform in a square of side `arena_side` (m) centred on the origin, with least
    distances (m) of the evader: `initial_separation` from pursuers, `obstacle_separation` from obstacles,
    `target_separation` from the target. The target is clear of obstacles, and the evader outside every
    capture set. The square only bounds the starts: the plane has no walls.

    **Counts and modes** `pursuer_count`, `obstacle_count`, `episode_steps` (control periods),
    `obstacle_motion` = `"steady"` or `"adversarial"`: obstacles then head for where the evader will be at the
    end of each period; `action` = `"velocity"` (disc |u| <= v_e) or `"heading"` (circle |u| = v_e), `frame` =
    `"target"` or `"world"` (axes of observation and policy action), `observation` = `"poses"`, `"motion"`
    (the pursuers' wheel speeds too), or `"robots"` (these, the robots' speeds and sizes, and any number of
    obstacles).

    **Custom robots** `evader_model`, `pursuer_model`, see `EvaderModel` and `PursuerModel`; None for the
    omnidirectional evader and the differential drive. They are code, and so not in files.
    """

    evader_speed: Scalar = eqx.field(converter=real, default=0.1574, metadata=within(above=0.0, unit="m/s"))
    pursuer_speed: Scalar = eqx.field(converter=real, default=0.2, metadata=within(above=0.0, unit="m/s"))
    pursuer_half_axle: Scalar = eqx.field(converter=real, default=0.2, metadata=within(above=0.0, unit="m"))
    capture_distance: Scalar = eqx.field(converter=real, default=0.2, metadata=within(above=0.0, unit="m"))
    collision_distance: Scalar = eqx.field(converter=real, default=0.2, metadata=within(above=0.0, unit="m"))
    reach_distance: Scalar = eqx.field(converter=real, default=0.05, metadata=within(above=0.0, unit="m"))
    obstacle_velocity: Float[Array, "2"] = eqx.field(
        converter=real, default=(0.02, 0.0), metadata=within(shape=(2,), unit="m/s")
    )
    control_period: Scalar = eqx.field(converter=real, default=0.05, metadata=within(above=0.0, unit="s"))
    pursuer_gain: Scalar = eqx.field(converter=real, default=1.2, metadata=within(least=0.0, unit="1/s"))
    obstacle_gain: Scalar = eqx.field(converter=real, default=1.0, metadata=within(least=0.0, unit="1/s"))
    reach_reward: Scalar = eqx.field(converter=real, default=1000.0, metadata=within(least=0.0))
    distance_cost: Scalar = eqx.field(converter=real, default=0.01, metadata=within(least=0.0))
    arena_side: Scalar = eqx.field(converter=real, default=3.0, metadata=within(above=0.0, unit="m"))
    initial_separation: Scalar = eqx.field(converter=real, default=0.6, metadata=within(least=0.0, unit="m"))
    obstacle_separation: Scalar = eqx.field(converter=real, default=0.3, metadata=within(least=0.0, unit="m"))
    target_separation: Scalar = eqx.field(converter=real, default=0.5, metadata=within(least=0.0, unit="m"))
    evader_start: Float[Array, "2"] | None = bounded(None, shape=(2,))
    pursuer_starts: Float[Array, "m 3"] | None = bounded(None, shape=(None, 3))
    obstacle_starts: Float[Array, "k 2"] | None = bounded(None, shape=(None, 2), empty=True)
    target_start: Float[Array, "2"] | None = bounded(None, shape=(2,))
    evader_model: EvaderModel | None = None
    pursuer_model: PursuerModel | None = None
    name: str = eqx.field(static=True, default="paper")
    pursuer_count: int = static_field(1, least=1)
    obstacle_count: int = static_field(1, least=0)
    episode_steps: int = static_field(5000, least=1)
    action: str = static_field("velocity", one_of("velocity", "heading"))
    obstacle_directions: str = static_field("fixed", one_of("fixed", "random"))
    obstacle_motion: str = static_field("steady", one_of("steady", "adversarial"))
    frame: str = static_field("target", one_of("target", "world"))
    observation: str = static_field("poses", one_of("poses", "motion", "robots"))

    @property
    def usable_angle(self) -> Scalar:
        """S = arccos(v_e / V), rad; 0 if the evader is at least as fast as the pursuer."""
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
        model = self.evader_model
        if self.obstacle_directions == "random":
            angle = jax.random.uniform(drift_key, (k,), dtype=float, minval=-jnp.pi, maxval=jnp.pi)
            speed = jnp.sqrt(jnp.sum(self.obstacle_velocity**2))
            drift = speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        return World(
            evader=place(evader_key) if self.evader_start is None else self.evader_start,
            pursuers=pursuers,
            obstacles=jnp.concatenate([obstacles, drift], axis=-1),
            target=place(target_key) if self.target_start is None else self.target_start,
            evader_state=None if model is None else model.start(self, jax.random.fold_in(key, 6)),
        )

    def draw(self, key: PRNGKeyArray) -> tuple[World, Flag]:
        """One try of `reset`: a random world, and whether an episode may start in it."""
        world = self._draw(key)
        return world, self.accepts(world)

    def accepts(self, world: World) -> Flag:
        """Whether an episode may start in a world: no immediate capture, nothing inside an obstacle.

        The separations of random starts hold for drawn positions only, not for fixed ones.
        """
        in_frame = jax.vmap(to_pursuer_frame, in_axes=(None, 0))(world.evader, world.pursuers)
        # The capture set is known for differential drives only.
        angle = self.usable_angle if self.pursuer_model is None else jnp.zeros_like(self.usable_angle)
        escape = jax.vmap(capture_set_distance, in_axes=(0, None, None))(
            in_frame, angle, self.capture_distance
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
        """The start of an episode: a random world that `accepts` allows.

        `load_scenario` has checked that such worlds exist. If none is found (for example in a scenario
        changed under `vmap`), the last draw is returned after 10,000 tries.
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
        """One control period of the physics, without shield and policy; for one world, or many in lanes.

        **Arguments:** `action` the evader's velocity (m/s, world axes), projected on the disc or circle of
        possible ones; `wheel_speeds` left and right rim speed (m/s) of each pursuer, clipped to [-V, V].
        Non-finite commands count as a stop.

        **Returns** the world one period later and the `Events` of the period. The reward is `reach_reward` if
        the target was reached, else -`distance_cost` times the distance (m) to it at the end of the period
        (paper, equation for r).
        """
        period = self.control_period
        velocity = self.executable(action)
        shape = (self.pursuer_count, *velocity.shape)
        wheels = jax.vmap(self.drivable)(jnp.reshape(wheel_speeds, shape))
        world = self._aimed(world, velocity)
        if self.evader_model is None:
            given = (self, world, velocity, wheels, period)
            # Every event uses them, and in lanes XLA would recompute them for each.
            least = no_fuse(Scenario._approaches, *given) if world.lanes else Scenario._approaches(*given)
            to_pursuers, to_obstacles, to_target = least
        else:
            # One program for all pieces: a loop in Python takes long to compile.
            to_pursuers, to_obstacles, to_target = jax.tree.map(
                lambda least: jnp.min(least, axis=0),
                jax.vmap(self._approaches, in_axes=(0, 0, None, None))(
                    *self._pieces(world, velocity, wheels), wheels, period / _CHORDS
                ),
            )
        pursuer_clearance = fold(jnp.minimum, to_pursuers, jnp.inf) - self.capture_distance
        obstacle_clearance = fold(jnp.minimum, to_obstacles, jnp.inf) - self.collision_distance

        moved = self._moved_a_period(world, velocity, wheels)
        # In whole periods, as in `moved`.
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

    def _approaches(
        self, world: World, velocity: Array, wheels: Array, duration: Scalar
    ) -> tuple[Float[Array, "m *lanes"], Float[Array, "k *lanes"], Lanes]:
        """Least distances (m) to pursuers, obstacles and target, while the evader moves straight."""

        def approach(pose: Array, wheel: Array) -> Lanes:
            return closest_approach_driving(
                world.evader, velocity, pose, wheel, self.pursuer_half_axle, duration
            )

        def pass_by(obstacle: Array) -> Lanes:
            return closest_approach_straight(world.evader - obstacle[:2], velocity - obstacle[2:], duration)

        to_pursuers = jax.vmap(approach)(world.pursuers, wheels)
        to_obstacles = jax.vmap(pass_by)(world.obstacles)
        return (
            to_pursuers,
            to_obstacles,
            closest_approach_straight(world.evader - world.target, velocity, duration),
        )

    def _pieces(
        self, world: World, command: Array, wheels: Array
    ) -> tuple[World, Float[Array, "pieces 2 *lanes"]]:
        """The period in pieces, along a first axis: the worlds at their beginnings, and the evader's
        velocities (m/s) along the chords of its path.

        A path with acceleration a deviates from its chords by up to a (T/8)^2/8, 5 um for 1 m/s^2 at 20 Hz.
        """
        piece = self.control_period / _CHORDS
        times = piece * jnp.arange(_CHORDS + 1).astype(piece.dtype)
        worlds = jax.vmap(lambda time: self._moved(world, command, wheels, time))(times)
        chords = (worlds.evader[1:] - worlds.evader[:-1]) / piece
        return jax.tree.map(lambda leaf: leaf[:-1], worlds), chords

    def moved(
        self,
        world: World,
        velocity: Float[Array, "2 *lanes"],
        wheel_speeds: Float[Array, "m 2 *lanes"],
    ) -> World:
        """The world one control period later, for commands within the robots' limits."""
        return self._moved_a_period(self._aimed(world, velocity), velocity, wheel_speeds)

    def _moved_a_period(
        self, world: World, velocity: Float[Array, "2 *lanes"], wheel_speeds: Float[Array, "m 2 *lanes"]
    ) -> World:
        """`moved`, for obstacles that are aimed already."""
        # Counting whole periods keeps the float32 time exact enough for the time limit.
        periods = jnp.round(world.time / self.control_period) + 1.0
        there = self._moved(world, velocity, wheel_speeds, self.control_period)
        return eqx.tree_at(
            lambda w: (w.time, w.wheel_speeds), there, (periods * self.control_period, wheel_speeds)
        )

    def _aimed(self, world: World, velocity: Float[Array, "2 *lanes"]) -> World:
        """The world with the velocities of obstacles that move adversarially."""
        if self.obstacle_motion == "steady" or self.obstacle_count == 0:
            return world
        end = glide(world.evader, velocity, self.control_period)
        x, y = end[0] - world.obstacles[:, 0], end[1] - world.obstacles[:, 1]
        apart = jnp.maximum(length(x, y), 1e-6)
        speed = length(self.obstacle_velocity[0], self.obstacle_velocity[1])
        aimed = jnp.stack([speed * x / apart, speed * y / apart], axis=1)
        obstacles = jnp.concatenate([world.obstacles[:, :2], aimed], axis=1)
        return eqx.tree_at(lambda w: w.obstacles, world, obstacles)

    def _moved(self, world: World, velocity: Array, wheel_speeds: Array, duration: Scalar) -> World:
        """The world after `duration` (s); time and wheel speeds are not updated."""
        obstacles = world.obstacles
        pursuers = jax.vmap(drive, in_axes=(0, 0, None, None))(
            world.pursuers, wheel_speeds, self.pursuer_half_axle, duration
        )
        drifted = jnp.concatenate([obstacles[:, :2] + obstacles[:, 2:] * duration, obstacles[:, 2:]], axis=1)
        evader = glide(world.evader, velocity, duration)
        if self.evader_model is not None:
            robot = self._evader_after(world, velocity, duration)
            evader, velocity = robot.position, robot.velocity
            world = eqx.tree_at(lambda w: w.evader_state, world, robot.state)
        return eqx.tree_at(
            lambda w: (w.evader, w.pursuers, w.obstacles, w.evader_velocity),
            world,
            (evader, pursuers, drifted, velocity),
        )

    def _evader_after(self, world: World, command: Array, duration: Scalar) -> EvaderState:
        model = self.evader_model
        assert model is not None

        def after(robot: EvaderState, command: Array) -> EvaderState:
            return model.after(self, robot, command, duration)

        return lane_by_lane(after, world.lanes, evader_of(world), command)

    def drivable(self, wheel_speeds: Float[AnyArray, "2 *lanes"]) -> Float[Array, "2 *lanes"]:
        """The wheel speeds (m/s) a pursuer drives for commanded `wheel_speeds`; non-finite ones count as
        0."""
        if self.pursuer_model is None:
            return limit_wheels(wheel_speeds, self.pursuer_speed)
        wheels = stack(*(jnp.where(jnp.isfinite(speed), speed, 0.0) for speed in wheel_speeds))
        speed, turn_rate = body_velocity(wheels, self.pursuer_half_axle)
        limit, lanes = self.pursuer_model.limit, wheels.ndim - 1
        speed, turn_rate = lane_by_lane(
            lambda speed, turn_rate: limit(self, speed, turn_rate), lanes, speed, turn_rate
        )
        return wheels_from_body(speed, turn_rate, self.pursuer_half_axle)

    @property
    def built_in(self) -> bool:
        """Whether the robots are the omnidirectional evader and the differential drive, for which barriers,
        certificate and falsifier are made."""
        return self.evader_model is None and self.pursuer_model is None

    def check_built_in(self, what: str, instead: str) -> None:
        """**Raises** `ValueError` for other robots: `what` supports the built-in robots only; the message
        ends with the advice `instead`."""
        models = [
            type(model).__name__ for model in (self.evader_model, self.pursuer_model) if model is not None
        ]
        if models:
            raise ValueError(
                f"{what} supports only the omnidirectional evader and the differential drive, but scenario "
                f"'{self.name}' has {' and '.join(models)}: {instead}"
            )

    def executable(self, velocity: Float[AnyArray, "2 *lanes"]) -> Float[Array, "2 *lanes"]:
        """The velocity (m/s) the evader drives for the commanded `velocity`: on the disc, or on the circle.

        In `heading` mode the speed is fixed, so a stop becomes the circle's speed along world x.
        """
        limited = limit_speed(velocity, self.evader_speed)
        if self.action == "velocity":
            return limited
        # Scaled before it is squared, so that a tiny command does not underflow and lose its direction.
        largest = jax.lax.stop_gradient(jnp.maximum(jnp.abs(limited[0]), jnp.abs(limited[1])))
        moving = largest > 0.0
        safe = jnp.where(moving, largest, 1.0)
        x, y = jnp.where(moving, limited[0] / safe, 1.0), jnp.where(moving, limited[1] / safe, 0.0)
        scale = self.evader_speed / length(x, y)
        return stack(x * scale, y * scale)
