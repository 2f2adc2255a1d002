"""Both forms of the pursuit row, over the whole reduced plane and along the robots' true motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.pursuit import CaptureGame
from sidestep.pursuit.game import turning_moment
from sidestep.safety import PursuitBarrier
from sidestep.world import World, load_scenario
from sidestep.world.robots import drive, glide

ANY, KNOWN = PursuitBarrier(), PursuitBarrier(known_velocity=True)
L_MAX = 0.2 * 0.787**2 / np.sqrt(1.0 - 0.787**2)
SMALL = {"evader_speed": 0.18, "pursuer_speed": 0.22, "pursuer_half_axle": 0.08, "capture_distance": 0.09}
SETS = {
    "paper": {},
    "well below the largest capture distance": {"capture_distance": 0.05},
    "at the largest capture distance": {"capture_distance": L_MAX - 1e-12},
    "small wheelbase": SMALL,
    "almost as fast": {"evader_speed": 0.1999},
    "faster": {"evader_speed": 0.25},
}
every_set = pytest.mark.parametrize("parameters", SETS.values(), ids=SETS)


def _points(scenario, cells=90, extra=6000, seed=0):
    """A dense grid over the reduced plane, and random points, half of them within millimetres of the axis,
    of the usable part's seam or of the capture set's edge."""
    size = float(scenario.capture_distance)
    usable = float(scenario.usable_angle)
    reach = 5.0 * max(size, float(scenario.pursuer_half_axle))
    axis = np.linspace(-reach, reach, cells)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    rng = np.random.default_rng(seed)
    free = rng.uniform(-reach, reach, (extra // 2, 2))
    bearing = rng.choice([0.0, np.pi, usable, -usable, np.pi - usable, usable - np.pi], extra // 4)
    bearing = bearing + rng.normal(size=len(bearing)) * 10.0 ** rng.uniform(-9, -1, len(bearing))
    distance = rng.uniform(0.0, reach, len(bearing))
    rim = rng.uniform(-np.pi, np.pi, extra // 4)
    off_axis = np.minimum(np.abs(rim), np.pi - np.abs(rim))
    edge = (size + 10.0 ** rng.uniform(-9, -1, len(rim))) / np.cos(np.maximum(usable - off_axis, 0.0))
    polar = lambda r, a: r[:, None] * np.stack([np.cos(a), np.sin(a)], axis=-1)  # noqa: E731
    return jnp.asarray(np.concatenate([grid, free, polar(distance, bearing), polar(edge, rim)]), float)


@eqx.filter_jit
def _rows(barrier, scenario, points, wheels, sides):
    """Memory, value, normal and offset with the pursuer at the origin facing x."""

    @jax.vmap
    def one(z, wheel, side):
        robot = jnp.concatenate([jnp.zeros(3, z.dtype), wheel]) if barrier.known_velocity else jnp.zeros(3)
        memory = barrier.update_memory(scenario, z, robot, side)
        return memory, *barrier.row(scenario, z, robot, memory)

    return one(points, wheels, sides)


@eqx.filter_jit
def _rates(barrier, scenario, points, wheels, sides):
    """Rates (n, w) of every point against each of `wheels` (w, 2), following `sides`."""

    def one(z, side, wheel):
        robot = jnp.concatenate([jnp.zeros(3, z.dtype), wheel])
        return barrier.gradient_and_rate(scenario, z, robot, side)[1]

    over_wheels = jax.vmap(one, in_axes=(None, None, 0))
    return jax.vmap(over_wheels, in_axes=(0, 0, None))(points, sides, wheels)


def _wheels(scenario, cells):
    grid = np.linspace(-1.0, 1.0, cells)
    return scenario.pursuer_speed * jnp.asarray(np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2))


@every_set
def test_some_velocity_keeps_the_row_whatever_the_wheels_and_the_gain(x64, parameters):
    for gain in (0.0, 1.2, 30.0):
        scenario = load_scenario("paper", pursuer_gain=gain, **parameters)
        points = _points(scenario)
        rng = np.random.default_rng(1)
        corners = rng.choice([-1.0, 1.0], (len(points), 2))
        inside = rng.uniform(-1.0, 1.0, (len(points), 2))
        mixed = np.where(rng.random((len(points), 1)) < 0.5, corners, inside)
        wheels = scenario.pursuer_speed * jnp.asarray(mixed)
        sides = jnp.asarray(rng.choice([-1.0, 1.0], len(points)))
        _, value, normal, offset = _rows(KNOWN, scenario, points, wheels, sides)
        _, _, _, worst = _rows(ANY, scenario, points, wheels, sides)
        free = np.asarray(value >= 0.0)
        assert free.mean() > 0.5
        np.testing.assert_allclose(jnp.sum(normal**2, axis=-1), 1.0, atol=1e-12)
        assert np.all(worst[free] <= scenario.evader_speed + 1e-9)
        # Equal where the wheels are the worst ones, up to how each is rounded.
        assert np.all(offset <= worst + 1e-12)


@every_set
def test_the_unknown_pursuers_rate_is_the_worst_over_a_fine_grid_of_wheels_and_attained(x64, parameters):
    scenario = load_scenario("paper", **parameters)
    points = _points(scenario, cells=40, extra=1200)
    sides = jnp.asarray(np.random.default_rng(2).choice([-1.0, 1.0], len(points)))
    # No memory here: even a side that memory would give up must not be underestimated.
    every = np.asarray(_rates(KNOWN, scenario, points, _wheels(scenario, 41), sides))
    worst = np.asarray(_rates(ANY, scenario, points, jnp.zeros((1, 0)), sides))[:, 0]
    np.testing.assert_allclose(every.max(axis=1), worst, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(every.min(axis=1), -worst, rtol=1e-12, atol=1e-15)


@eqx.filter_jit
def _along_true_motion(scenario, points, poses, wheels, velocities, sides):
    """h' by central differences along the exact motion, and n.u - rate as the row has them."""

    @jax.vmap
    def one(point, pose, wheel, velocity, side):
        def h(t):
            moved = drive(pose, wheel, scenario.pursuer_half_axle, t)
            return KNOWN.value(scenario, glide(point, velocity, t), moved, side)

        step = jnp.asarray(2e-6)
        normal, rate = KNOWN.gradient_and_rate(scenario, point, jnp.concatenate([pose, wheel]), side)
        return (h(step) - h(-step)) / (2.0 * step), jnp.sum(normal * velocity) - rate

    return one(points, poses, wheels, velocities, sides)


@every_set
def test_the_known_velocitys_row_is_the_derivative_along_true_motion(x64, parameters):
    """Random worlds, wheels and velocities, either tangent: h' = n.u - (v n_x - omega sigma)."""
    scenario = load_scenario("paper", **parameters)
    rng = np.random.default_rng(3)
    z = np.asarray(_points(scenario, cells=30, extra=3000))
    # A difference across the seam of the usable part sees the turn of the normal there, of order step/r.
    z = z[np.hypot(*z.T) > 0.02]
    heading, place = rng.uniform(-np.pi, np.pi, len(z)), rng.normal(size=(len(z), 2))
    ahead, left = z.T
    turned = np.stack(
        [np.cos(heading) * ahead - np.sin(heading) * left, np.sin(heading) * ahead + np.cos(heading) * left],
        axis=-1,
    )
    poses = jnp.asarray(np.concatenate([place, heading[:, None]], axis=-1))
    wheels = scenario.pursuer_speed * jnp.asarray(rng.uniform(-1.0, 1.0, (len(z), 2)))
    velocities = scenario.evader_speed * jnp.asarray(rng.normal(size=(len(z), 2)))
    sides = jnp.asarray(np.where(left < 0.0, -1.0, 1.0))
    across = (rng.random(len(z)) < 0.3) & (np.abs(left) < 0.8 * np.abs(ahead) * np.tan(scenario.usable_angle))
    sides = jnp.where(across, -sides, sides)
    on_axis = (np.abs(left) < 1e-5) & ~across
    derivative, row = _along_true_motion(
        scenario, jnp.asarray(place + turned), poses, wheels, velocities, sides
    )
    error = np.abs(np.asarray(derivative - row))
    # On the axis the followed side's derivative is one-sided; elsewhere there is no exception.
    assert error[~on_axis].max() < 2e-4
    assert np.median(error) < 1e-8


def test_a_period_of_the_known_motion_loses_what_the_row_says_and_second_order_more(x64):
    """Over one period T of exact motion with n.u = rate: h falls by no more than order T^2."""
    scenario = load_scenario("paper", capture_distance=0.1)
    rng = np.random.default_rng(4)
    z = np.asarray(_points(scenario, cells=30, extra=2000))
    z = z[(np.hypot(*z.T) > 0.1) & (np.abs(z[:, 1]) > 1e-3)]
    wheels = scenario.pursuer_speed * jnp.asarray(rng.uniform(-1.0, 1.0, (len(z), 2)))

    @jax.jit
    @jax.vmap
    def loss(point, wheel, period):
        robot = jnp.concatenate([jnp.zeros(3), wheel])
        side = jnp.sign(point[1])
        normal, rate = KNOWN.gradient_and_rate(scenario, point, robot, side)
        moved = drive(robot[:3], wheel, scenario.pursuer_half_axle, period)
        before = KNOWN.value(scenario, point, robot, side)
        return before - KNOWN.value(scenario, point + period * rate * normal, moved, side)

    lost = [np.asarray(loss(jnp.asarray(z), wheels, jnp.full(len(z), t))).max() for t in (0.2, 0.1, 0.05)]
    assert lost[0] < 0.03
    # Halving the period quarters the loss, where a wrong row would only halve it.
    np.testing.assert_allclose([lost[0] / lost[1], lost[1] / lost[2]], 4.0, rtol=0.25)


@pytest.mark.parametrize("barrier", [ANY, KNOWN], ids=["any motion", "known velocity"])
def test_left_right_and_front_rear_are_alike(x64, barrier):
    """Mirrored across the axis the wheels change places; turned round they also change sign."""
    scenario = load_scenario("paper")
    points = _points(scenario, cells=40, extra=2000)
    rng = np.random.default_rng(5)
    wheels = scenario.pursuer_speed * jnp.asarray(rng.uniform(-1.0, 1.0, (len(points), 2)))
    sides = jnp.asarray(rng.choice([-1.0, 1.0], len(points)))
    memory, value, normal, offset = _rows(barrier, scenario, points, wheels, sides)
    swapped = wheels[:, ::-1]
    for flip, mirrored_wheels in (([1, -1], swapped), ([-1, -1], -swapped), ([-1, 1], -wheels)):
        flip = jnp.array(flip, float)
        mirrored = _rows(barrier, scenario, points * flip, mirrored_wheels, sides * flip[1])
        # A point on the axis belongs to the left.
        off = np.abs(points[:, 1]) > 0.0
        for ours, theirs in zip((memory * flip[1], value, normal * flip, offset), mirrored, strict=True):
            np.testing.assert_allclose(theirs[off], ours[off], atol=1e-12)


def test_the_same_robot_described_from_its_other_end_gives_the_same_row(x64):
    scenario = load_scenario("paper")
    points = _points(scenario, cells=20, extra=1000)

    @jax.jit
    @jax.vmap
    def both(point):
        pose, wheels = jnp.array([0.1, -0.2, 0.7]), jnp.array([0.13, -0.05])
        turned = jnp.array([0.0, 0.0, jnp.pi])
        row = lambda pose, wheels, side: KNOWN.row(  # noqa: E731
            scenario, point, jnp.concatenate([pose, wheels]), side
        )
        left = jnp.ones(())
        return row(pose, wheels, left), row(pose + turned, -wheels[::-1], -left)

    ours, theirs = both(points)
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(b, a, atol=1e-12)


def test_rows_and_their_slopes_are_finite_in_every_awkward_place(precision):
    """At the centre, on the axis, on the seam, far out; wheels unknown or beyond the limits; b = 0."""

    @eqx.filter_jit
    def everything(scenario, points, wheels):
        def one(point, wheel, side):
            robot = jnp.concatenate([jnp.zeros(3, point.dtype), wheel])
            memory = KNOWN.update_memory(scenario, point, robot, side)

            def row(point, wheel):
                return KNOWN.row(scenario, point, jnp.concatenate([robot[:3], wheel]), memory)

            value, offset = (lambda *a, part=part: row(*a)[part] for part in (0, 2))
            slopes = jax.grad(value)(point, wheel), jax.grad(offset, (0, 1))(point, wheel)
            return memory, row(point, wheel), slopes

        inner = jax.vmap(jax.vmap(one, in_axes=(0, None, None)), in_axes=(None, 0, None))
        return jax.vmap(inner, in_axes=(None, None, 0))(points, wheels, jnp.array([-1.0, 1.0]))

    scenarios = [load_scenario("paper", **parameters) for parameters in SETS.values()]
    no_axle = eqx.tree_at(lambda s: s.pursuer_half_axle, scenarios[0], jnp.zeros(()))
    for scenario in (*scenarios, no_axle):
        seam = 0.3 * np.array([np.cos(scenario.usable_angle), np.sin(scenario.usable_angle)])
        places = np.array(
            [[0, 0], [0.3, 0], [-0.3, 0], [0, 0.3], [0, -0.3], [-0.0, -0.0], [1e-20, -1e-20], [1e6, -1e6]]
        )
        mirrors = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
        points = jnp.asarray(np.concatenate([places, seam * mirrors]), float)
        known = [[0.2, 0.2], [0.2, -0.2], [0.0, 0.0], [9.0, -9.0]]
        wheels = jnp.array([*known, [np.nan, 0.1], [np.inf, -np.inf]])
        for leaf in jax.tree.leaves(everything(scenario, points, wheels)):
            assert np.all(np.isfinite(leaf))


def test_wheels_that_are_not_known_count_as_the_worst_and_measured_ones_are_cut_to_the_limit():
    scenario = load_scenario("paper", pursuer_count=4)
    wheels = jnp.array([[np.nan, 0.1], [0.0, np.inf], [5.0, -5.0], [0.0, 0.0]])
    pose = jnp.array([0.3, 0.1, 3.0])
    world = World(jnp.zeros(2), jnp.tile(pose, (4, 1)), jnp.zeros((0, 4)), jnp.ones(2), wheel_speeds=wheels)
    rows = eqx.filter_jit(lambda b, world: b.rows(scenario, world, jnp.ones(4)))
    known, worst = (rows(barrier, world).offsets for barrier in (KNOWN, ANY))
    cut = eqx.tree_at(lambda w: w.wheel_speeds, world, jnp.clip(jnp.nan_to_num(wheels), -0.2, 0.2))
    np.testing.assert_array_equal(known[:2], worst[:2])
    np.testing.assert_allclose(known[2], rows(KNOWN, cut).offsets[2], rtol=1e-6)
    assert known[3] < worst[3]


# What errors and time cost


@pytest.mark.parametrize("parameters", [SETS[name] for name in list(SETS)[:4]], ids=list(SETS)[:4])
def test_an_error_in_heading_costs_at_most_b_rho_per_radian_of_the_clipped_barrier(x64, parameters):
    """min(h, h_max) loses no more than b rho eps to any heading error eps, anywhere in the plane. Beyond
    h_max the barrier itself can lose (l + h) tan S eps ahead of the pursuer, which is more."""
    scenario = load_scenario("paper", **parameters)
    game = CaptureGame.of(scenario)
    spare = game.largest_capture_distance - scenario.capture_distance
    cost = scenario.pursuer_half_axle * scenario.evader_speed / scenario.pursuer_speed
    points = np.asarray(_points(scenario, cells=60, extra=6000))
    errors = np.random.default_rng(6).uniform(-0.6, 0.6, len(points))
    cosine, sine = np.cos(errors), np.sin(errors)
    ahead, left = points.T
    turned = np.stack([cosine * ahead + sine * left, cosine * left - sine * ahead])
    values = jax.jit(jax.vmap(lambda z: game.barrier(z)[0]))
    h, wrong = (np.asarray(values(jnp.asarray(z))) for z in (points, turned.T))
    clipped = np.abs(np.minimum(h, spare) - np.minimum(wrong, spare))
    assert np.all(clipped <= cost * np.abs(errors) + 1e-12)
    # The bound is met at the tip of {h = h_max}, and not kept by h beyond it.
    far = jnp.array([(scenario.capture_distance + spare + 0.1) / jnp.cos(game.usable_angle), 0.0])
    moment = jnp.abs(turning_moment(far, game.barrier(far)[1]))
    expected = (game.largest_capture_distance + 0.1) * jnp.tan(game.usable_angle)
    np.testing.assert_allclose(moment, expected, rtol=1e-9)
    assert moment > cost


@pytest.mark.parametrize("parameters", [SETS[name] for name in list(SETS)[:4]], ids=list(SETS)[:4])
def test_a_pursuer_alone_cannot_lower_the_clipped_barrier_faster_than_the_evader_drives(x64, parameters):
    """Exact motion over times long enough to drive, turn and drive again; the evader stands still."""
    scenario = load_scenario("paper", **parameters)
    game = CaptureGame.of(scenario)
    spare = game.largest_capture_distance - scenario.capture_distance
    points = _points(scenario, cells=40, extra=4000)
    rng = np.random.default_rng(7)
    wheels = rng.uniform(-1.0, 1.0, (len(points), 3, 2))
    extreme = rng.random((len(points), 3, 1)) < 0.7
    wheels = scenario.pursuer_speed * jnp.asarray(np.where(extreme, np.sign(wheels), wheels))
    times = jnp.asarray(10.0 ** rng.uniform(-3.0, 0.5, (len(points), 3)))

    @jax.jit
    @jax.vmap
    def lost(z, wheels, times):
        def clipped(pose):
            return jnp.minimum(ANY.value(scenario, z, pose, _own_side(z, pose)), spare)

        pose = jnp.zeros(3)
        before = clipped(pose)
        for wheel, duration in zip(wheels, times, strict=True):
            pose = drive(pose, wheel, scenario.pursuer_half_axle, duration)
        return before - clipped(pose)

    def _own_side(z, pose):
        return ANY.update_memory(scenario, z, pose, None)

    allowed = scenario.evader_speed * jnp.sum(times, axis=1)
    assert np.all(lost(points, wheels, times) <= allowed + 1e-12)
