"""Every registered barrier against the true motion of the robots, the certified one over its whole plane."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit.game import CaptureGame
from sidestep.safety import BARRIERS, BarrierRows, ObstacleBarrier, PursuitBarrier, RangeBarrier, compose
from sidestep.world import World, load_scenario
from sidestep.world.capture_geometry import to_pursuer_frame
from sidestep.world.robots import drive

every_barrier = pytest.mark.parametrize("name", BARRIERS)


def _worlds(n, seed=0, obstacles=2, pursuers=2):
    """Random worlds with all robots within a metre or so of the evader."""
    rng = np.random.default_rng(seed)
    return jax.vmap(World)(
        *(
            jnp.asarray(v, float)
            for v in (
                rng.normal(size=(n, 2)),
                np.concatenate(
                    [rng.normal(size=(n, pursuers, 2)), rng.uniform(-np.pi, np.pi, (n, pursuers, 1))], axis=-1
                ),
                np.concatenate(
                    [rng.normal(size=(n, obstacles, 2)), 0.05 * rng.normal(size=(n, obstacles, 2))], axis=-1
                ),
                rng.normal(size=(n, 2)),
                np.zeros(n),
                np.zeros((n, 2)),
                rng.uniform(-0.2, 0.2, (n, pursuers, 2)),
            )
        )
    )


def _assumed_motion(name, scenario, evader, robot, memory, duration):
    """Where the robot is after `duration` if it moves as the barrier takes it to move now."""
    if name == "obstacle":
        return jnp.concatenate([robot[:2] + duration * robot[2:], robot[2:]])
    pose, known = robot[:3], robot[3:]
    if name == "range":
        wheels = jnp.full(2, scenario.pursuer_speed)
    elif name == "pursuit":
        game, z = CaptureGame.of(scenario), to_pursuer_frame(evader, pose)
        wheels = game.steer_against(z, game.barrier(z, memory)[1])
    else:
        wheels = known
    return jnp.concatenate([drive(pose, wheels, scenario.pursuer_half_axle, duration), known])


@every_barrier
def test_analytic_automatic_and_numeric_gradients_agree(x64, name):
    scenario, barrier = load_scenario("paper"), BARRIERS[name]

    @jax.jit
    @jax.vmap
    def check(world):
        memory = barrier.update_memories(scenario, world)

        def one(robot, side):
            value = lambda point: barrier.value(scenario, point, robot, side)  # noqa: E731
            h = 1e-6
            axes = h * jnp.eye(2)
            numeric = jax.vmap(lambda d: (value(world.evader + d) - value(world.evader - d)) / (2 * h))(axes)
            return (
                barrier.gradient_and_rate(scenario, world.evader, robot, side)[0],
                jax.grad(value)(world.evader),
                numeric,
            )

        return jax.vmap(one)(barrier.robots(world), memory)

    analytic, automatic, numeric = check(_worlds(500))
    np.testing.assert_allclose(automatic, analytic, atol=1e-9)
    np.testing.assert_allclose(numeric, analytic, atol=1e-4)
    np.testing.assert_allclose(jnp.sum(analytic**2, axis=-1), 1.0, atol=1e-12)


@every_barrier
def test_the_row_is_the_derivative_along_true_motion(x64, name):
    """With the evader at velocity u and the other robot as assumed: h' + alpha(h) = n.u - c."""
    scenario, barrier = load_scenario("paper"), BARRIERS[name]

    @jax.jit
    @jax.vmap
    def check(world, velocity):
        memory = barrier.update_memories(scenario, world)
        rows = barrier.rows(scenario, world, memory)

        def rate(robot, side):
            def later(t):
                moved = _assumed_motion(name, scenario, world.evader, robot, side, t)
                return barrier.value(scenario, world.evader + t * velocity, moved, side)

            h = jnp.asarray(1e-6)
            return (later(h) - later(-h)) / (2 * h), barrier.alpha(scenario, later(0.0 * h))

        derivative, allowance = jax.vmap(rate)(barrier.robots(world), memory)
        return derivative + allowance, rows.normals @ velocity - rows.offsets

    velocity = 0.1 * jnp.asarray(np.random.default_rng(1).normal(size=(500, 2)))
    left, right = check(_worlds(500), velocity)
    # A difference across a seam (a change of region) sees two derivatives; there are few.
    wrong = np.abs(np.asarray(left - right)) > 1e-7
    assert wrong.mean() <= 0.002


@every_barrier
def test_rows_are_ordered_like_their_robots_and_every_count_works(precision, name):
    barrier = BARRIERS[name]
    scenario = load_scenario("paper")
    row = jax.jit(functools.partial(barrier.row, scenario))
    for pursuers, obstacles in ((1, 0), (2, 3)):
        world = jax.tree.map(lambda v: v[0], _worlds(1, obstacles=obstacles, pursuers=pursuers))
        memory = jax.jit(barrier.update_memories)(scenario, world)
        rows = jax.jit(barrier.rows)(scenario, world, memory)
        robots = barrier.robots(world)
        assert rows.values.shape == (len(robots),) == memory.shape
        assert rows.normals.shape == (len(robots), 2)
        for i, robot in enumerate(robots):
            value, normal, offset = row(world.evader, robot, memory[i])
            np.testing.assert_allclose(rows.values[i], value, rtol=1e-5)
            np.testing.assert_allclose(rows.normals[i], normal, rtol=1e-5)
            np.testing.assert_allclose(rows.offsets[i], offset, rtol=1e-4, atol=1e-6)


@every_barrier
def test_never_nan_on_top_of_the_other_robot_or_on_its_axis(precision, name):
    scenario, barrier = load_scenario("paper"), BARRIERS[name]
    evader = jnp.zeros(2)
    size = {"obstacle": 4, "pursuit, velocity known": 5}.get(name, 3)
    for place in ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (1e-30, 0.0)):
        robot = jnp.zeros(size).at[:2].set(jnp.asarray(place, float))
        for side in (-1.0, 0.0, 1.0):
            memory = barrier.update_memory(scenario, evader, robot, jnp.asarray(side))
            value, normal, offset = barrier.row(scenario, evader, robot, memory)
            gradient = jax.grad(lambda p, r=robot, m=memory: barrier.value(scenario, p, r, m))(evader)
            for entry in (value, normal, offset, gradient, memory):
                assert np.all(np.isfinite(entry)), (place, side)
            np.testing.assert_allclose(jnp.sum(normal**2), 1.0, rtol=1e-5)


def test_composition_demands_every_row_and_its_value_is_the_least(precision):
    scenario = load_scenario("paper")
    world = jax.tree.map(lambda v: v[0], _worlds(1))
    parts = [
        b.rows(scenario, world, b.update_memories(scenario, world))
        for b in (RangeBarrier(), ObstacleBarrier())
    ]
    whole = compose(*parts)
    assert whole.values.shape == (4,)
    assert whole.value == min(part.value for part in parts)
    assert np.array_equal(whole.offsets[2:], parts[1].offsets)
    none = BarrierRows(jnp.zeros(0), jnp.zeros((0, 2)), jnp.zeros(0))
    assert none.value == np.inf


def test_the_papers_row_cannot_be_kept_close_ahead_of_the_pursuer(x64):
    """n.u <= v_e = 0.1574 while c contains V = 0.2: lost for h < (V - v_e)/gamma = 0.0355 m."""
    scenario = load_scenario("paper")
    pose = jnp.zeros(3)
    critical = (0.2 - 0.1574) / 1.2
    for h, feasible in ((critical - 1e-6, False), (critical + 1e-6, True)):
        evader = jnp.array([0.2 + h, 0.0])
        _, normal, offset = RangeBarrier().row(scenario, evader, pose, jnp.zeros(()))
        assert (scenario.evader_speed >= offset) == feasible
        np.testing.assert_allclose(normal, [1.0, 0.0])
    # Half a millimetre from the capture set the certified row still can be.
    evader = jnp.array([0.2 / (0.1574 / 0.2) + 5e-4, 0.0])
    h, _, offset = PursuitBarrier().row(scenario, evader, pose, jnp.ones(()))
    assert 0.0 < h < 1e-3
    assert scenario.evader_speed >= offset


def test_the_papers_row_does_not_see_a_pursuer_that_backs_up(x64):
    """Known weakness of the baseline: it takes the pursuer behind whose back the evader is to drive away."""
    scenario = load_scenario("paper")
    _, _, offset = RangeBarrier().row(scenario, jnp.array([-0.201, 0.0]), jnp.zeros(3), jnp.zeros(()))
    assert offset < -0.19
    _, _, offset = PursuitBarrier().row(scenario, jnp.array([-0.255, 0.0]), jnp.zeros(3), jnp.ones(()))
    assert offset > 0.15


PARAMETERS = [
    {},
    {"capture_distance": 0.1},
    {"evader_speed": 0.18, "pursuer_speed": 0.22, "pursuer_half_axle": 0.08, "capture_distance": 0.09},
    {"evader_speed": 0.25},
    {"evader_speed": 0.2},
]


def _plane(scenario, n=161):
    reach = 5.0 * float(scenario.capture_distance)
    axis = np.linspace(-reach, reach, n)
    return jnp.asarray(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))


@pytest.mark.parametrize("gain", [0.0, 0.2, 1.2, 20.0])
@pytest.mark.parametrize("parameters", PARAMETERS)
def test_a_feasible_row_everywhere_outside_the_capture_set_whatever_the_gain(x64, parameters, gain):
    scenario = load_scenario("paper", pursuer_gain=gain, **parameters)
    assert CaptureGame.of(scenario).evader_can_escape
    barrier = PursuitBarrier()

    @jax.jit
    @jax.vmap
    def row(z, side):
        memory = barrier.update_memory(scenario, z, jnp.zeros(3), side)
        return *barrier.row(scenario, z, jnp.zeros(3), memory), barrier.value(
            scenario, z, jnp.zeros(3), jnp.sign(z[1])
        )

    plane = _plane(scenario)
    for side in (-1.0, 1.0):
        followed, _, offset, h = row(plane, jnp.full(len(plane), side))
        free = h >= 0.0
        # The branch that memory follows must be as safe as the barrier itself is.
        assert np.all(followed[free] >= 0.0)
        assert np.all(followed <= h + 1e-12)
        assert np.all(offset[free] <= scenario.evader_speed + 1e-9)


@pytest.mark.parametrize("parameters", PARAMETERS[:4])
def test_no_admissible_wheel_speeds_beat_the_row(x64, parameters):
    """Against a grid of wheel speeds, by differences along the true motion; and one of them attains it."""
    scenario = load_scenario("paper", **parameters)
    barrier = PursuitBarrier()
    grid = np.linspace(-1.0, 1.0, 9)
    wheels = float(scenario.pursuer_speed) * jnp.asarray(
        np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    )
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform(-3.0, 3.0, (400, 2)) * float(scenario.capture_distance))
    sides = jnp.asarray(rng.choice([-1.0, 1.0], 400))

    @jax.jit
    @jax.vmap
    def check(z, side):
        pose = jnp.zeros(3)
        memory = barrier.update_memory(scenario, z, pose, side)
        _, rate = barrier.gradient_and_rate(scenario, z, pose, memory)

        def lowered(wheel):
            later = lambda t: barrier.value(  # noqa: E731
                scenario, z, drive(pose, wheel, scenario.pursuer_half_axle, t), memory
            )
            h = jnp.asarray(1e-6)
            return -(later(h) - later(-h)) / (2.0 * h)

        return rate, jnp.max(jax.vmap(lowered)(wheels))

    rate, worst = check(points, sides)
    # At seams a two-sided difference mixes two regions.
    assert np.mean(np.abs(np.asarray(rate - worst)) <= 1e-6) >= 0.98
    assert np.all(worst <= rate + 1e-2)
    assert np.mean(worst <= rate + 1e-6) >= 0.99


def test_left_right_and_front_rear_are_alike(x64):
    scenario, barrier = load_scenario("paper"), PursuitBarrier()
    row = jax.jit(
        jax.vmap(
            lambda z, side: barrier.row(
                scenario, z, jnp.zeros(3), barrier.update_memory(scenario, z, jnp.zeros(3), side)
            )
        )
    )
    z = jnp.asarray(np.random.default_rng(0).normal(size=(2000, 2)) * 0.3)
    for flip in ([1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]):
        flip = jnp.array(flip)
        for side in (-1.0, 1.0):
            value, normal, offset = row(z, jnp.full(len(z), side))
            value2, normal2, offset2 = row(z * flip, jnp.full(len(z), side) * flip[1])
            np.testing.assert_allclose(value2, value, atol=1e-12)
            np.testing.assert_allclose(normal2, normal * flip, atol=1e-12)
            np.testing.assert_allclose(offset2, offset, atol=1e-12)


def test_rows_turn_with_the_world(x64):
    scenario = load_scenario("paper")
    worlds = _worlds(200)
    angle = 0.7
    turn = jnp.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = eqx.tree_at(
        lambda w: (w.evader, w.pursuers, w.obstacles),
        worlds,
        (
            worlds.evader @ turn.T,
            jnp.concatenate([worlds.pursuers[..., :2] @ turn.T, worlds.pursuers[..., 2:] + angle], axis=-1),
            jnp.concatenate(
                [worlds.obstacles[..., :2] @ turn.T, worlds.obstacles[..., 2:] @ turn.T], axis=-1
            ),
        ),
    )
    for barrier in BARRIERS.values():
        rows = jax.vmap(lambda w, b=barrier: b.rows(scenario, w, b.update_memories(scenario, w)))
        a, b = rows(worlds), rows(turned)
        np.testing.assert_allclose(b.values, a.values, atol=1e-9)
        np.testing.assert_allclose(b.normals, a.normals @ turn.T, atol=1e-9)
        np.testing.assert_allclose(b.offsets, a.offsets, atol=1e-9)


def test_a_side_is_kept_across_the_axis_and_left_within_the_overlap(x64):
    """m = b rho - l tan S is the half-width of the overlap; the side changes at half of it, at h = 0."""
    scenario = load_scenario("paper", capture_distance=0.15)
    game, barrier = CaptureGame.of(scenario), PursuitBarrier()
    usable, ratio = float(game.usable_angle), float(scenario.evader_speed / scenario.pursuer_speed)
    margin = 0.2 * ratio - 0.15 * np.tan(usable)
    for share, kept in ((0.0, True), (0.45, True), (0.55, False), (1.1, False)):
        y = -share * margin * np.cos(usable)
        x = (0.15 - y * np.sin(usable)) / np.cos(usable)  # on the left tangent, h_left = 0
        for front in (1.0, -1.0):
            memory = barrier.update_memory(scenario, jnp.array([front * x, y]), jnp.zeros(3), jnp.ones(()))
            assert memory == (1.0 if kept or y >= 0.0 else -1.0)
    # Beside the pursuer there is only one normal, and the side is simply the evader's own.
    assert barrier.update_memory(scenario, jnp.array([0.0, -0.5]), jnp.zeros(3), jnp.ones(())) == -1.0
    assert barrier.update_memory(scenario, jnp.array([0.5, -0.1]), jnp.zeros(3), None) == -1.0


def test_a_lost_evader_still_commits_to_one_side(x64):
    """Inside the capture set no row holds; changing sides at each crossing would make it worse."""
    scenario, barrier = load_scenario("paper"), PursuitBarrier()
    assert barrier.update_memory(scenario, jnp.array([0.24, -0.001]), jnp.zeros(3), jnp.ones(())) == 1.0
    hopeless = load_scenario("paper", capture_distance=0.3)
    assert barrier.update_memory(hopeless, jnp.array([0.4, -0.001]), jnp.zeros(3), jnp.ones(())) == 1.0
    assert barrier.update_memory(hopeless, jnp.array([0.4, -0.1]), jnp.zeros(3), jnp.ones(())) == -1.0


@pytest.mark.parametrize("parameters", [{"capture_distance": 0.25}, {"evader_speed": 0.1}])
def test_where_the_pursuer_wins_rows_are_finite_and_unkeepable_near_its_axis(precision, parameters):
    scenario = load_scenario("paper", **parameters)
    assert not CaptureGame.of(scenario).evader_can_escape
    row = jax.jit(jax.vmap(lambda z: PursuitBarrier().row(scenario, z, jnp.zeros(3), jnp.ones(()))))
    value, normal, offset = row(_plane(scenario).astype(float))
    assert all(np.all(np.isfinite(entry)) for entry in (value, normal, offset))
    tip = jnp.array([[1.02 * float(scenario.capture_distance / jnp.cos(scenario.usable_angle)), 0.0]])
    value, _, offset = row(tip)
    assert value[0] > 0.0
    assert offset[0] > scenario.evader_speed


def test_the_allowance_grows_with_h_from_zero(x64):
    for parameters in PARAMETERS:
        for gain in (0.0, 0.3, 5.0):
            scenario = load_scenario("paper", pursuer_gain=gain, obstacle_gain=gain, **parameters)
            for barrier in BARRIERS.values():
                allowance = jax.vmap(functools.partial(barrier.alpha, scenario))
                assert allowance(jnp.zeros(1))[0] == 0.0
                assert np.all(np.diff(allowance(jnp.linspace(-0.1, 3.0, 200))) >= 0.0)
                np.testing.assert_allclose(allowance(jnp.array([-0.1]))[0], -0.1 * gain, atol=1e-12)
