"""Pursuer and obstacle together: what the rows of `game` lose, the look-ahead must keep."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.loop.keys import episode_key, start_and_pursuit
from sidestep.pursuit import make_pursuer, pursue
from sidestep.safety import Budget, GameShield, JointShield, PursuitBarrier, Status, make_shield
from sidestep.safety.shields.escape_plan import CHOICES, SEGMENTS, choice_at, chosen_velocity
from sidestep.safety.shields.look_ahead import imagine, ramp
from sidestep.world import World, load_scenario

# Of the first 300 random starts from key 7, some in which `game` collides while heading for the target.
LOST_BY_GAME = (224, 242)
# Of the first 20 random starts from key 7 with two pursuers, those in which `game` is captured.
LOST_BETWEEN_TWO = (2, 3, 4, 5, 6, 7, 9, 13)


def _starts(scenario, numbers):
    keys = [start_and_pursuit(episode_key(jax.random.key(7), number))[0] for number in numbers]
    return jax.vmap(scenario.reset)(jnp.stack(keys))


def _chase(scenario, shield, pursuer, worlds, periods):
    """Which episodes end in capture, in collision and at the target."""

    def period(world, memory, seen):
        ahead = world.target - world.evader
        nominal = scenario.evader_speed * ahead / jnp.maximum(jnp.sqrt(jnp.sum(ahead**2)), 1e-9)
        result, memory = shield(world, nominal, memory)
        wheels = pursue(scenario, pursuer, world, jax.random.key(0))
        moved, events = scenario.step(world, result.action, wheels)
        now = jnp.stack([events.captured, events.collided, events.reached])
        # Who has finished stays put, far from need.
        return jax.tree.map(
            lambda a, b: jnp.where(jnp.any(seen), a, b), (world, memory, seen), (moved, memory, now)
        )

    def advance(carry):
        return carry[0] + 1, jax.vmap(period)(*carry[1])

    def running(carry):
        return (carry[0] < periods) & ~jnp.all(jnp.any(carry[1][2], axis=-1))

    begin = (worlds, jax.vmap(shield.init)(worlds), jnp.zeros((len(worlds.time), 3), bool))
    chase = eqx.filter_jit(lambda begin: jax.lax.while_loop(running, advance, (jnp.asarray(0), begin)))
    return np.asarray(chase(begin)[1][2]).T


@pytest.mark.slow
def test_where_the_rows_alone_collide_the_look_ahead_does_not():
    scenario = load_scenario("paper")
    worlds, nash = _starts(scenario, LOST_BY_GAME), make_pursuer("nash")
    captured, collided, _ = _chase(scenario, make_shield("game", scenario), nash, worlds, 1000)
    assert not captured.any()
    assert collided.all(), "without collisions to prevent this test says nothing"
    captured, collided, reached = _chase(scenario, make_shield("joint", scenario), nash, worlds, 1000)
    assert not captured.any()
    assert not collided.any()
    assert reached.all()


@pytest.mark.slow
def test_two_pursuers_close_in_on_the_rows_and_not_on_the_look_ahead():
    """No obstacle: what each pursuer's rows leave free, the other's may close."""
    scenario = load_scenario("paper", pursuer_count=2, obstacle_count=0)
    worlds, nash = _starts(scenario, LOST_BETWEEN_TWO), make_pursuer("nash")
    captured, _, _ = _chase(scenario, make_shield("game", scenario), nash, worlds, 1200)
    assert captured.all(), "without captures to prevent this test says nothing"
    captured, _, _ = _chase(scenario, make_shield("joint", scenario), nash, worlds, 1200)
    assert not captured.any()


@pytest.mark.parametrize("acceleration", [None, pytest.param(2.0, marks=pytest.mark.slow)])
def test_an_imagined_chase_is_the_chase_that_follows(acceleration):
    """In the robot's own period, against the pursuer that is there, imagination must be exact."""
    scenario = load_scenario("paper", obstacle_count=2)
    names = ("pure-pursuit", "interceptor")
    models = tuple(make_pursuer(name) for name in names)
    guard = GameShield(scenario, nominal_picks_side=True)
    world = scenario.reset(jax.random.key(4))
    ways = jnp.array([[0, 5, 16, 18], [17, 17, 3, 19]], jnp.int32)
    ages, length = jnp.array([0.0, 0.2]), jnp.asarray(0.5)

    def motors(velocity, wanted):
        """The mean velocity of a period and the one at its end, in small steps."""
        if acceleration is None:
            return wanted, wanted

        def piece(velocity, _):
            lacking = wanted - velocity
            size = jnp.maximum(jnp.sqrt(jnp.sum(lacking**2)), 1e-9)
            after = velocity + jnp.minimum(acceleration * 0.05 / 200 / size, 1.0) * lacking
            return after, 0.5 * (velocity + after)

        end, ways = jax.lax.scan(piece, velocity, length=200)
        return jnp.mean(ways, axis=0), end

    @jax.jit
    def both(world):
        sides = guard.init(world)
        spread = lambda leaf: jnp.broadcast_to(leaf[..., None, None], (*leaf.shape, 2, 2))  # noqa: E731
        outlook = imagine(
            scenario, guard.filter_unchecked, models, jax.tree.map(spread, world), spread(sides), ways, ages,
            length, 30,
            None if acceleration is None else real(acceleration),
        )  # fmt: skip

        def follow(model, way, age):
            def step(carry, index):
                world, sides, velocity = carry
                now = age + index.astype(age.dtype) * scenario.control_period
                nominal = chosen_velocity(scenario, world, sides, choice_at(way, now, length))
                result, sides = guard(world, nominal, sides)
                driven, velocity = motors(velocity, result.action)
                world, _ = scenario.step(world, driven, pursue(scenario, model, world, jax.random.key(0)))
                world = eqx.tree_at(lambda world: world.evader_velocity, world, velocity)
                distance = lambda other: jnp.sqrt(jnp.sum((other - world.evader) ** 2, axis=-1))  # noqa: E731
                gap = jnp.minimum(
                    jnp.min(distance(world.pursuers[:, :2])) - scenario.capture_distance,
                    jnp.min(distance(world.obstacles[:, :2])) - scenario.collision_distance,
                )
                return (world, sides, velocity), gap

            return jnp.min(jax.lax.scan(step, (world, sides, world.evader_velocity), jnp.arange(30))[1])

        return outlook, jnp.stack(
            [jnp.stack([follow(model, *pair) for pair in zip(ways, ages, strict=True)]) for model in models]
        )

    outlook, followed = both(world)
    np.testing.assert_allclose(outlook.least, followed, atol=2e-5)
    assert np.ptp(followed) > 0.01, "ways out that all come to the same would prove little"
    np.testing.assert_allclose(outlook.time[np.asarray(followed) > 1e-3], 1.5, rtol=1e-5)


def test_the_time_to_contact_counts_until_the_first_touch():
    """Head-on into an obstacle 0.3 m away at 0.1574 m/s, no pursuer near, rows out of the way."""
    scenario = load_scenario(
        "paper", obstacle_gain=1e6, pursuer_gain=1e6, obstacle_velocity=[0.0, 0.0], control_period=0.1
    )
    world = World(
        jnp.zeros(2), jnp.array([[30.0, 0.0, 0.0]]), jnp.array([[0.5, 0.0, 0.0, 0.0]]), jnp.array([2.0, 0.0])
    )
    free = lambda world, nominal, sides: (nominal, sides)  # noqa: E731
    spread = lambda leaf: leaf[..., None, None]  # noqa: E731
    outlook = jax.jit(
        lambda world: imagine(
            scenario, free, (make_pursuer("still"),), jax.tree.map(spread, world), spread(jnp.ones(1)),
            jnp.zeros((1, SEGMENTS), jnp.int32), jnp.zeros(1), jnp.asarray(1.5), 60,
        )
    )(world)  # fmt: skip
    assert float(outlook.time[0, 0]) == pytest.approx(1.9, abs=0.11)
    assert float(outlook.least[0, 0]) < 0.0


def _random_worlds(count, seed):
    """Close worlds: pursuer within 0.35 m, obstacle within 0.45 m, nobody in contact."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-np.pi, np.pi, (count, 3))
    away, apart = rng.uniform(0.26, 0.35, count), rng.uniform(0.22, 0.45, count)
    pursuers = np.stack([away * np.cos(turn[:, 0]), away * np.sin(turn[:, 0]), turn[:, 1]], axis=-1)
    obstacles = np.stack([apart * np.cos(turn[:, 2]), apart * np.sin(turn[:, 2])], axis=-1)
    obstacles = np.concatenate([obstacles, np.full((count, 1), 0.02), np.zeros((count, 1))], axis=-1)
    return jax.vmap(World)(
        jnp.zeros((count, 2)),
        jnp.asarray(pursuers[:, None], float),
        jnp.asarray(obstacles[:, None], float),
        jnp.asarray(rng.normal(size=(count, 2)), float),
    )


@pytest.fixture(scope="module")
def decided():
    """Decisions in close worlds, made in one batch; in every eighth the obstacle is far away."""
    scenario = load_scenario("paper")
    shield, worlds = JointShield(scenario, models=("turn-then-drive", "pure-pursuit")), _random_worlds(96, 0)
    worlds = eqx.tree_at(lambda worlds: worlds.obstacles, worlds, worlds.obstacles.at[5::8, :, 0].add(5.0))
    rng = np.random.default_rng(1)
    nominal = jnp.asarray(rng.uniform(-0.15, 0.15, (96, 2)), float)
    act = eqx.filter_jit(jax.vmap(lambda world, nominal: shield(world, nominal, shield.init(world))))
    return scenario, shield, worlds, nominal, act(worlds, nominal)


def test_whatever_is_driven_has_passed_the_pursuers_row(decided):
    scenario, shield, worlds, _, (result, memory) = decided
    relaxed = eqx.tree_at(lambda s: s.pursuer_gain, scenario, shield.pursuer_gain)
    rows = jax.jit(jax.vmap(lambda world, sides: PursuitBarrier().rows(relaxed, world, sides)))
    row = rows(worlds, memory.sides)
    slack = np.einsum("nki,ni->nk", row.normals, result.action) - row.offsets
    outside = np.asarray(row.values >= 0.0)
    assert outside.sum() >= 60
    assert slack[outside].min() >= -1e-5
    assert np.linalg.norm(result.action, axis=-1).max() <= 0.1574 * (1.0 + 1e-5)
    assert set(np.unique(result.status)) <= {Status.OK, Status.CORRECTED, Status.INFEASIBLE}
    changed = np.linalg.norm(result.action - decided[3], axis=-1)
    np.testing.assert_allclose(result.intervention, changed, atol=1e-6)
    assert np.all(np.asarray(result.status)[changed > 1e-4] != Status.OK)
    # The look-ahead has something to say here, or the tests of this file would be about `game`.
    assert np.mean(np.asarray(memory.plan) != CHOICES - 1) > 0.2


@pytest.mark.slow
def test_where_no_way_keeps_the_margin_one_without_contact_is_followed_for_a_while():
    """In a chase by a pursuer that never lets go; the memory before and after every period is looked at."""
    scenario = load_scenario("paper", obstacle_starts=[[0.35, 0.45]], obstacle_velocity=[0.0, 0.0])
    shield, driver = JointShield(scenario), make_pursuer("turn-then-drive")
    start = World(
        jnp.zeros(2),
        jnp.array([[-0.35, 0.0, 0.0]]),
        jnp.array([[0.35, 0.45, 0.0, 0.0]]),
        jnp.array([1.0, 0.0]),
    )

    @jax.jit
    def chase(world):
        def period(carry, _):
            world, memory = carry
            result, later = shield(world, 0.15 * (world.target - world.evader), memory)
            wheels = pursue(scenario, driver, world, jax.random.key(0))
            return (scenario.step(world, result.action, wheels)[0], later), (memory, later)

        return jax.lax.scan(period, (world, shield.init(world)), length=160)[1]

    before, after = chase(start)
    period = float(scenario.control_period)
    waits = np.asarray(before.pause) > 1e-6
    assert 5 <= waits.sum() < len(waits)
    assert not np.any(np.asarray(before.clear)[waits])
    same = np.all(np.asarray(before.plan == after.plan), axis=-1)
    left = np.asarray(before.pause - after.pause)
    # Either the pause goes on with the same way, or it is over: something else was found, or nobody is near.
    goes_on = waits & np.isclose(left, period, atol=1e-5)
    assert goes_on.sum() >= 5
    assert np.all(same[goes_on])
    assert np.asarray(after.pause).max() <= 0.15 - period + 1e-6


def test_an_action_is_accepted_only_if_what_it_leads_to_is_clear():
    """The period in which the action itself is driven counts, not only the escape plan after it."""
    scenario = load_scenario("paper", obstacle_gain=3.0)
    shield = JointShield(scenario, models=("turn-then-drive",))
    away, act = np.pi / 8.0 * 3.0, eqx.filter_jit(shield)
    ahead = jnp.array([-np.cos(away), -np.sin(away)], float)
    for gap, accepted in ((0.3, True), (0.018, False)):
        place = (scenario.collision_distance + gap) * ahead
        world = World(
            jnp.zeros(2),
            jnp.array([[0.6, 0.0, 0.0]]),
            jnp.concatenate([place, jnp.zeros(2)])[None],
            jnp.array([-1.0, 0.0]),
        )
        # The way out makes good in its first period what the action, straight at the obstacle, loses.
        memory = eqx.tree_at(
            lambda m: (m.clear, m.plan),
            shield.init(world),
            (jnp.asarray(True), jnp.full(SEGMENTS, 3, jnp.int32)),
        )
        greedy, _ = eqx.filter_jit(shield.rows_only)(world, 0.157 * ahead, memory.sides)
        lost = 0.05 * float(greedy.action @ ahead)
        assert lost > 0.0011, "rows that already refuse would prove little"
        result, _ = act(world, 0.157 * ahead, memory)
        assert bool(jnp.all(result.action == greedy.action)) == accepted


def test_alone_a_robot_decides_as_it_does_in_a_batch(decided):
    _, shield, worlds, nominal, (result, memory) = decided
    act = eqx.filter_jit(lambda world, nominal: shield(world, nominal, shield.init(world)))
    for index in (0, 7, 31, 95):
        world = jax.tree.map(lambda leaf, index=index: leaf[index], worlds)
        alone, kept = act(world, nominal[index])
        np.testing.assert_allclose(alone.action, result.action[index], atol=2e-6)
        assert int(alone.status) == int(result.status[index])
        np.testing.assert_array_equal(kept.plan, memory.plan[index])


def test_where_it_need_not_look_ahead_it_says_so_and_answers_the_same_at_once(decided):
    _, shield, worlds, nominal, (result, memory) = decided
    ask = jax.vmap(lambda world, nominal: shield.at_once(world, nominal, shield.init(world)))
    *found, at_once = eqx.filter_jit(ask)(worlds, nominal)
    np.testing.assert_array_equal(at_once, ~memory.looked)
    assert 5 < np.sum(at_once) < len(at_once) - 5
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves([result, memory]), strict=True):
        np.testing.assert_allclose(ours[at_once], theirs[at_once], atol=2e-6)


@pytest.mark.slow
def test_far_away_and_without_obstacles_it_is_the_game_shield():
    for count, obstacle in ((0, None), (1, [[5.0, 5.0]])):
        scenario = load_scenario(
            "paper", obstacle_count=count, **({} if obstacle is None else {"obstacle_starts": obstacle})
        )
        joint = JointShield(scenario, models=("turn-then-drive",))
        faster = eqx.tree_at(lambda s: s.pursuer_gain, scenario, joint.pursuer_gain)
        game = GameShield(faster, nominal_picks_side=True)
        world = World(
            jnp.zeros(2),
            jnp.array([[0.27, 0.02, 3.0]]),
            jnp.array([[5.0, 5.0, 0.0, 0.0]])[:count],
            jnp.array([1.0, 0.0]),
        )
        nominal = jnp.array([0.1574, 0.0])
        ours, memory = eqx.filter_jit(joint)(world, nominal, joint.init(world))
        theirs, _ = eqx.filter_jit(game)(world, nominal, game.init(world))
        np.testing.assert_allclose(ours.action, theirs.action, atol=1e-7)
        assert ours.status == theirs.status == Status.CORRECTED
        assert not memory.clear


def test_a_pursuer_that_drives_as_a_model_does_is_recognised():
    scenario = load_scenario("paper", obstacle_starts=[[0.0, 1.0]])
    shield = JointShield(scenario, models=("turn-then-drive", "turn-while-driving"))
    world = World(
        jnp.zeros(2), jnp.array([[0.7, 0.1, 2.0]]), jnp.array([[0.0, 1.0, 0.0, 0.0]]), jnp.array([-1.0, 0.0])
    )
    memory, driver = shield.init(world), make_pursuer("turn-while-driving")

    @eqx.filter_jit
    def period(world, memory):
        result, memory = shield(world, jnp.array([-0.1, 0.05]), memory)
        wheels = pursue(scenario, driver, world, jax.random.key(0))
        return scenario.step(world, result.action, wheels)[0], memory

    for _ in range(8):
        world, memory = period(world, memory)
    surprise = dict(zip(shield.models, np.asarray(memory.surprise), strict=True))
    assert surprise["turn-while-driving"] < 1e-3
    assert surprise["turn-then-drive"] > 0.1


def test_close_to_the_axis_the_nominal_action_picks_the_side_and_farther_off_it_does_not():
    """Without that a pursuer that keeps turning after the evader leads it round to one side for ever."""
    scenario = load_scenario("paper", pursuer_gain=4.0)
    barrier = PursuitBarrier()
    pick = jax.jit(
        lambda place, nominal, side: barrier.choose_sides(
            scenario, World(place, jnp.zeros((1, 3)), jnp.zeros((0, 4)), jnp.zeros(2)), side[None], nominal
        )[0]
    )
    left, right = jnp.array([0.05, 0.1]), jnp.array([0.05, -0.1])
    for side in (jnp.ones(()), -jnp.ones(())):
        near = jnp.array([0.27, 0.004])
        assert pick(near, left, side) == 1.0
        assert pick(near, right, side) == -1.0
        # Straight on decides nothing.
        assert pick(near, jnp.array([0.15, 0.001]), side) == barrier.update_memory(
            scenario, near, jnp.zeros(3), side
        )
        # At the tip of the capture set, or far to one side, only the evader's own side can be kept.
        assert pick(jnp.array([0.2542, 0.004]), right, side) == 1.0
        assert pick(jnp.array([0.27, 0.06]), right, side) == 1.0


def test_who_has_used_up_what_is_kept_beyond_the_distance_does_not_change_to_a_side_that_is_lost():
    """Close to the axis and outside the capture set by less than the margin, the falsifier found a
    `joint` that followed the nominal action across and gave away a millimetre."""
    scenario = load_scenario("paper")
    angle, capture = float(scenario.usable_angle), float(scenario.capture_distance)
    rng = np.random.default_rng(0)
    spare = rng.uniform(0.02e-3, 0.38e-3, 100)
    across = rng.uniform(0.3e-3, 0.98e-3, 100) * rng.choice([-1.0, 1.0], 100)
    ahead = (capture + spare - np.abs(across) * np.sin(angle)) / np.cos(angle)
    places = jnp.asarray(np.stack([ahead * rng.choice([-1.0, 1.0], 100), across], axis=1), float)
    others = jnp.asarray(-np.sign(across), float)
    for shield in (GameShield(scenario), make_shield("joint", scenario).rows_only):

        def answer(place, other, shield=shield):
            world = World(place, jnp.zeros((1, 3)), jnp.zeros((0, 4)), jnp.zeros(2))
            # It remembers the other side, and wants to go there.
            result, memory = shield(
                world, scenario.evader_speed * jnp.stack([0.0 * other, other]), other[None]
            )
            moved, _ = scenario.step(world, result.action, jnp.sign(place[0]) * jnp.full((1, 2), 0.2))
            after, _ = shield(moved, jnp.zeros(2), memory)
            return result.barriers[0], memory[0], after.barriers[0]

        values, sides, later = (np.asarray(part) for part in jax.jit(jax.vmap(answer))(places, others))
        np.testing.assert_array_equal(sides, np.sign(across))
        np.testing.assert_allclose(values, spare, atol=1e-6)
        assert np.min(later - values) > -1e-6


def test_a_ramp_is_what_small_steps_at_that_acceleration_come_to():
    rng = np.random.default_rng(3)
    velocity, wanted = rng.uniform(-0.2, 0.2, (2, 2, 40))
    acceleration, period, pieces = 2.0, 0.05, 4000
    mean, end = ramp(jnp.asarray(velocity), jnp.asarray(wanted), real(acceleration), real(period))
    now, way = velocity.copy(), np.zeros((2, 40))
    for _ in range(pieces):
        lacking = wanted - now
        size = np.maximum(np.hypot(*lacking), 1e-12)
        step = np.minimum(acceleration * period / pieces / size, 1.0) * lacking
        way += (now + 0.5 * step) * period / pieces
        now = now + step
    np.testing.assert_allclose(end, now, atol=1e-6)
    np.testing.assert_allclose(mean, way / period, atol=1e-5)
    arrived = np.hypot(*(wanted - velocity)) <= acceleration * period
    assert 5 < arrived.sum() < 35
    for unlimited in (np.inf, 1e9):
        mean, end = ramp(jnp.asarray(velocity), jnp.asarray(wanted), real(unlimited), real(period))
        np.testing.assert_allclose(end, wanted, atol=1e-7)
        np.testing.assert_allclose(mean, wanted, atol=1e-7)


def _at_the_axis(count, seed):
    """A pursuer backs after the evader, which is within 4 mm of its axis and has an obstacle ahead."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(-np.pi, np.pi, count)
    ahead, across = -rng.uniform(0.262, 0.28, count), rng.uniform(-0.004, 0.004, count)
    cosine, sine = np.cos(heading), np.sin(heading)
    pursuers = np.stack([sine * across - cosine * ahead, -sine * ahead - cosine * across, heading], axis=-1)
    way = heading + np.pi + rng.uniform(-0.9, 0.9, count)
    apart = rng.uniform(0.28, 0.4, count)
    obstacles = np.stack(
        [apart * np.cos(way), apart * np.sin(way), np.full(count, 0.02), np.zeros(count)], axis=-1
    )
    worlds = jax.vmap(
        lambda pursuer, obstacle, velocity: World(
            jnp.zeros(2), pursuer, obstacle, jnp.ones(2), evader_velocity=velocity
        )
    )(pursuers[:, None], obstacles[:, None], -0.1574 * np.stack([cosine, sine], axis=-1))
    return worlds, 0.1574 * np.stack([-sine, cosine], axis=-1)


@pytest.mark.parametrize(
    "acceleration, depends", [(None, True), pytest.param(2.0, False, marks=pytest.mark.slow)]
)
def test_an_action_that_is_not_driven_changes_no_side_of_a_robot_with_motors(acceleration, depends):
    """Where nothing is clear the plan that touches last is driven, whatever the nominal action."""
    scenario = load_scenario("paper-test")
    budget = Budget(position_error=0.002, heading_error=0.002, delay=0.02)
    shield = JointShield(scenario, budget=budget, acceleration=acceleration)
    worlds, left = _at_the_axis(48, 0)

    @jax.jit
    @jax.vmap
    def ask(world, nominal):
        memory = shield.init(world)
        result, after = shield(world, nominal, memory)
        through, _ = shield.rows_only(world, nominal, memory.sides)
        rejected = ~after.clear & jnp.any(jnp.abs(result.action - through.action) > 1e-6)
        return result.action, rejected

    one, other = ask(worlds, left), ask(worlds, -left)
    rejected = np.asarray(one[1] & other[1])
    assert rejected.sum() > 15
    differ = np.abs(np.asarray(one[0] - other[0])).max(axis=-1) > 1e-4
    assert differ[rejected].any() == depends


@pytest.mark.slow
def test_a_robot_with_motors_goes_on_looking_ahead_until_well_away():
    """A look-ahead that sets in and breaks off would have it turn to and fro."""
    scenario = load_scenario("paper-test")
    looked = {}
    for acceleration in (None, 2.0):
        shield = JointShield(scenario, acceleration=acceleration)

        @jax.jit
        def ask(gap, memory, shield=shield):
            obstacle = jnp.array([[scenario.collision_distance + gap, 0.0, 0.0, 0.0]])
            world = World(jnp.zeros(2), jnp.array([[0.0, 0.5, 0.0]]), obstacle, jnp.array([-1.0, 0.0]))
            memory = shield.init(world) if memory is None else memory
            return shield(world, jnp.array([-0.1, 0.0]), memory)[1]

        far = ask(0.9, None)
        near = ask(0.7, far)
        looked[acceleration] = [bool(one.looked) for one in (far, near, ask(0.9, near), ask(1.1, near))]
    assert looked == {None: [False, True, False, False], 2.0: [False, True, True, False]}
