"""Hazard: a replay that teaches what never happened: wrong rewards, another episode's future, stale slots."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.learning.replay import Replay, Transition, mirror_world, reward_along, sample
from sidestep.learning.training import run_chunk, start
from sidestep.loop.step import decide
from sidestep.pursuit import as_pursuer
from sidestep.safety import as_shield
from sidestep.safety.filter.status import Status
from sidestep.store.runs import OUTCOMES
from sidestep.world import (
    EvaderModel,
    EvaderState,
    Quadrotor,
    World,
    load_scenario,
    observation_names,
    observe,
    to_action,
    to_velocity,
)

REACH, COST = 0.25, 0.01


# A made-up replay in which every number tells where it comes from --------------------------------------

CAPACITY, PERIODS = 8, 3


def place(count, knot):
    """Where the evader was at a knot of transition number `count`: no two the same, all 0.1 m apart."""
    return np.array([count + 0.1 * knot, 0.01 * count])


def made_up(count, steps=PERIODS, lost=False):
    """Transition number `count`: the robots' places follow from the number."""

    def world(knot):
        return World(
            evader=place(count, knot),
            pursuers=np.array([[count, 1.0, 0.3]]),
            obstacles=np.array([[count, 2.0, 0.02, 0.01]]),
            target=np.array([1000.0 + count, 3.0]),
            time=float(count),
            wheel_speeds=np.array([[0.1, 0.2]]),
        )

    return Transition(
        world=world(0),
        next_world=world(steps),
        path=real(np.stack([place(count, min(knot, steps)) for knot in range(PERIODS + 1)])),
        steps=jnp.asarray(steps, int),
        proposed=real([0.1, 0.02 * (count % 5)]),
        executed=real([-0.05, 0.03 * (count % 4)]),
        correction=real(0.01 * count),
        lost=jnp.asarray(lost),
    )


def segment_distance(start, end, point):
    along = end - start
    share = np.clip(np.dot(point - start, along) / max(np.dot(along, along), 1e-12), 0.0, 1.0)
    return np.linalg.norm(start + share * along - point)


def reward_by_hand(path, steps, lost, target):
    """The paper's reward, period by period, and whether the episode ends."""
    total = 0.0
    for period in range(steps):
        lost_now = lost and period == steps - 1
        if segment_distance(path[period], path[period + 1], target) <= REACH and not lost_now:
            return total + 1000.0, True
        total -= COST * np.linalg.norm(path[period + 1] - target)
    return total, lost


def draw(replay, key, **more):
    """A batch and the worlds after it."""
    batch, _, after, _ = draw_all(replay, key, **more)
    return batch, after


def draw_all(
    replay, key, rows=512, *, mirror=0.0, hindsight=1.0, executed=False, penalty=0.0, time_cost=0.0, scale=1.0
):
    scenario = load_scenario("paper", reach_distance=REACH)
    numbers = [real(number) for number in (penalty, time_cost, scale)]
    return _draw(scenario, replay, key, rows, real(hindsight), real(mirror), executed, *numbers)


@eqx.filter_jit
def _draw(scenario, replay, key, rows, hindsight, mirror, executed, penalty, time_cost, scale):
    return sample(
        scenario,
        replay,
        key,
        rows,
        hindsight=hindsight,
        mirror=mirror,
        executed_action=executed,
        correction_penalty=penalty,
        time_cost=time_cost,
        reward_scale=scale,
    )


add = jax.jit(lambda replay, transition, episode, active: replay.add(transition, episode, active))


def fill(lengths, steps_of=lambda count: PERIODS, lost_of=lambda count: False):
    """Replays after every transition of episodes of these lengths, with the episode of each transition."""
    replay = Replay.init(made_up(0), CAPACITY)
    episode_of = []
    for episode, length in enumerate(lengths):
        for _ in range(length):
            count = len(episode_of)
            one = made_up(count, steps_of(count), lost_of(count))
            replay = add(replay, one, jnp.asarray(episode), jnp.asarray(True))
            episode_of.append(episode)
            yield replay, episode_of


@pytest.mark.parametrize(
    "lengths", [(3, 1, 5, 2, 7, 1, 1, 4), (1,) * 20, (25,)], ids=["mixed", "single decisions", "one long"]
)
def test_hindsight_targets_lie_later_in_the_same_episode_and_never_in_overwritten_slots(lengths):
    seen_later = 0
    for number, (replay, episode_of) in enumerate(fill(lengths, steps_of=lambda count: 1 + count % PERIODS)):
        newest = len(episode_of) - 1
        _, after = draw(replay, jax.random.key(number))
        counts = np.asarray(after.time).round().astype(int)
        assert set(counts) <= set(range(max(0, newest - CAPACITY + 1), newest + 1))
        for count, target in zip(counts, np.asarray(after.target), strict=True):
            later = int(np.floor(target[0] + 1e-3))
            knot = round((target[0] - later) * 10)
            np.testing.assert_allclose(target, place(later, knot), atol=1e-5)
            assert count <= later <= newest, "the target lies in the past, or was overwritten"
            assert episode_of[later] == episode_of[count], "the target lies in another episode"
            assert 1 <= knot <= 1 + later % PERIODS, "the target was never visited within that decision"
            seen_later += later > count
    assert (seen_later > 100) == (max(lengths) > 1)


def test_hindsight_among_many_worlds_stays_in_the_world_and_its_episode():
    """World i of 4 has episodes of i + 1 decisions; the ring wraps round several times."""
    worlds, replay = 4, Replay.init(made_up(0), 38, worlds=4)
    assert replay.capacity == 40
    episode_of, seen_later = [], 0
    for decision in range(31):
        ones = [made_up(decision * worlds + world) for world in range(worlds)]
        lanes = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1), *ones)
        ended = [decision // (world + 1) for world in range(worlds)]
        episode_of += list(enumerate(ended))
        replay = add(replay, lanes, jnp.asarray(ended), jnp.asarray(True))
        _, after = draw(replay, jax.random.key(decision))
        newest = len(episode_of) - 1
        for count, target in zip(
            np.asarray(after.time).round().astype(int), np.asarray(after.target), strict=True
        ):
            later = int(np.floor(target[0] + 1e-3))
            assert max(0, newest + 1 - 40) <= count <= later <= newest
            assert episode_of[later] == episode_of[count], "the target lies in another world or episode"
            seen_later += later > count
    assert seen_later > 1000
    unchanged = add(replay, lanes, jnp.asarray(ended), jnp.asarray(False))
    assert all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (replay, unchanged)), strict=True))


def test_every_slot_and_every_later_place_can_be_drawn():
    *_, (replay, _) = fill((3, 6))
    counts, places = [], set()
    for seed in range(6):
        _, after = draw(replay, jax.random.key(seed))
        counts += np.asarray(after.time).round().astype(int).tolist()
        places |= set(
            zip(counts[-512:], (np.asarray(after.target)[:, 0] * 10).round().astype(int), strict=True)
        )
    assert set(counts) == set(range(1, 9))
    assert np.bincount(counts)[1:].min() > 0.8 * len(counts) / 8
    expected = {
        (c, 10 * later + knot)
        for c in range(1, 9)
        for later in range(c, 3 if c < 3 else 9)
        for knot in (1, 2, 3)
    }
    assert places == expected


def test_rewards_for_any_target_are_what_they_would_have_been():
    *_, (replay, _) = fill((4, 3, 2), steps_of=lambda c: 1 + c % PERIODS, lost_of=lambda c: c in (3, 8))
    batch, after = draw(replay, jax.random.key(1))
    kinds = set()
    for row, count in enumerate(np.asarray(after.time).round().astype(int)):
        steps, lost = 1 + count % PERIODS, count in (3, 8)
        path = [place(count, min(knot, steps)) for knot in range(PERIODS + 1)]
        reward, ended = reward_by_hand(path, steps, lost, np.asarray(after.target[row]))
        assert float(batch.reward[row]) == pytest.approx(reward, rel=1e-4, abs=1e-5)
        assert bool(batch.terminated[row]) == ended
        kinds.add((reward > 0.0, ended, lost))
    # Reached, on the way, lost without and after reaching: all of them were met.
    assert kinds == {(True, True, False), (False, False, False), (False, True, True), (True, True, True)}


def test_share_of_hindsight_targets_is_the_one_asked_for():
    *_, (replay, _) = fill((8,))
    for share in (0.0, 0.3, 1.0):
        _, after = draw(replay, jax.random.key(2), hindsight=share)
        own = np.asarray(after.target)[:, 0] >= 1000.0
        assert 1.0 - own.mean() == pytest.approx(share, abs=0.04 if share == 0.3 else 0.0)
        np.testing.assert_array_equal(
            np.asarray(after.target)[own][:, 0] - 1000.0, np.asarray(after.time)[own].round()
        )


def test_inactive_write_changes_nothing(small):
    *_, (replay, _) = fill((3, 2))
    same = add(replay, made_up(77), jnp.asarray(9), jnp.asarray(False))
    assert small.differences(replay, same) == []
    assert small.differences(replay, add(replay, made_up(77), jnp.asarray(9), jnp.asarray(True))) != []


def test_ring_keeps_the_newest_transitions_in_order(small):
    for replay, episode_of in fill((3, 1, 5, 2)):
        written = len(episode_of)
        assert int(replay.written) == written
        assert int(replay.size) == min(written, CAPACITY)
        for count in range(max(0, written - CAPACITY), written):
            slot = jax.tree.map(lambda ring, at=count % CAPACITY: ring[at], replay.transitions)
            assert small.differences(slot, made_up(count)) == []
            assert int(replay.episode[count % CAPACITY]) == episode_of[count]


def test_penalty_scale_and_choice_of_action_are_read_as_asked():
    *_, (replay, _) = fill((8,))
    scenario = load_scenario("paper", reach_distance=REACH)
    key = jax.random.key(3)
    plain, after = draw(replay, key)
    counts = np.asarray(after.time)
    penalised, _ = draw(replay, key, penalty=2.0, scale=0.5)
    expected = 0.5 * (np.asarray(plain.reward) - 2.0 * 0.01 * counts / 0.1574)
    np.testing.assert_allclose(penalised.reward, expected, rtol=1e-4)
    executed, _ = draw(replay, key, executed=True)
    for batch, name in ((plain, "proposed"), (executed, "executed")):
        for row in range(8):
            count = int(counts[row].round())
            world = eqx.tree_at(lambda w: w.target, made_up(count).world, after.target[row])
            wanted = to_action(scenario, world, getattr(made_up(count), name))
            np.testing.assert_allclose(batch.action[row], wanted, atol=1e-5)
    np.testing.assert_array_equal(plain.observation, executed.observation)


def test_time_cost_lowers_the_reward_by_the_time_that_is_driven():
    *_, (replay, _) = fill((8,), steps_of=lambda count: 1 + count % PERIODS)
    key = jax.random.key(3)
    plain, after = draw(replay, key, hindsight=0.0)
    costly, _ = draw(replay, key, hindsight=0.0, time_cost=3.0, scale=0.5)
    # Nothing is reached, so every transition is driven to its end.
    seconds = 0.05 * (1 + np.asarray(after.time).round() % PERIODS)
    assert len(np.unique(seconds)) == PERIODS
    np.testing.assert_allclose(costly.reward, 0.5 * (plain.reward - 3.0 * seconds), rtol=1e-5)


def test_time_cost_ends_when_a_target_is_reached_on_the_way():
    scenario = load_scenario("paper", reach_distance=0.01)
    transition = made_up(2)
    target = transition.path[1]
    (free, reached), (costly, _) = (reward_along(scenario, transition, target, real(c)) for c in (0.0, 3.0))
    assert bool(reached)
    assert float(free - costly) == pytest.approx(3.0 * 0.05, abs=1e-4)


# Mirror and frame ------------------------------------------------------------------------------------------


def test_mirrored_rows_are_the_same_rows_seen_in_a_mirror():
    *_, (replay, _) = fill((8,))
    scenario = load_scenario("paper", reach_distance=REACH)
    plain, after = draw(replay, jax.random.key(4))
    mirrored, after_mirror = draw(replay, jax.random.key(4), mirror=1.0)
    names = observation_names(scenario)
    sign = np.array([-1.0 if name.endswith(("_y", "_sin", "_vy")) else 1.0 for name in names])
    assert (sign < 0.0).sum() == 4
    for part in ("observation", "next_observation"):
        np.testing.assert_allclose(getattr(mirrored, part), sign * getattr(plain, part), atol=1e-6)
    np.testing.assert_allclose(mirrored.action, plain.action * np.array([1.0, -1.0]), atol=1e-6)
    np.testing.assert_array_equal(mirrored.reward, plain.reward)
    np.testing.assert_array_equal(mirrored.terminated, plain.terminated)
    np.testing.assert_allclose(after_mirror.target, after.target * np.array([1.0, -1.0]), atol=1e-6)
    half, *half_worlds, _ = draw_all(replay, jax.random.key(4), mirror=0.5)
    whole, _ = draw(replay, jax.random.key(4))
    flipped = np.any(np.abs(np.asarray(half.observation - whole.observation)) > 1e-6, axis=-1)
    assert flipped.mean() == pytest.approx(0.5, abs=0.06)
    # Whatever else is computed in the worlds of a batch belongs to its rows: observed, they are its rows.
    look = jax.jit(jax.vmap(lambda world: observe(scenario, world)))
    for worlds, seen in zip(half_worlds, (half.observation, half.next_observation), strict=True):
        np.testing.assert_allclose(look(worlds), seen, atol=1e-6)
        np.testing.assert_array_equal(np.asarray(worlds.evader)[:, 1] < 0.0, flipped & (worlds.time > 0))


class Secretive(EvaderModel):
    """Obeys at once, keeps a number, and says nothing of mirrors."""

    def start(self, scenario, key):
        return jnp.ones(1)

    def after(self, scenario, robot, command, time):
        return EvaderState(robot.position + command * time, command, robot.state)


@pytest.mark.parametrize("model", [Quadrotor(), Secretive()], ids=["quadrotor", "knows no mirror"])
def test_robots_of_ones_own_are_mirrored_with_what_they_keep_or_not_at_all(model):
    scenario = load_scenario("quadrotor", evader_model=model, obstacle_count=1)
    reset = eqx.filter_jit(scenario.reset)
    kept = 2 if isinstance(model, Quadrotor) else 1
    worlds = [
        eqx.tree_at(lambda w: w.evader_state, reset(jax.random.key(n)), real([0.3, 0.7 + n])[:kept])
        for n in range(4)
    ]
    replay = Replay.init(own_transition(worlds[0]), CAPACITY)
    for world in worlds:
        replay = add(replay, own_transition(world), jnp.asarray(0), jnp.asarray(True))
    numbers = jax.random.key(5), 64, real(0.0)
    (plain, before, _, _), (image, mirrored, _, _) = (
        _draw(scenario, replay, *numbers, real(share), False, real(0.0), real(0.0), real(1.0))
        for share in (0.0, 1.0)
    )
    flip = np.array([1.0, -1.0]) if isinstance(model, Quadrotor) else 1.0
    np.testing.assert_array_equal(mirrored.evader, before.evader * flip)
    np.testing.assert_array_equal(mirrored.evader_state, before.evader_state * flip)
    np.testing.assert_allclose(image.action, plain.action * flip, atol=1e-6)
    assert len(np.unique(before.evader_state, axis=0)) == (4 if isinstance(model, Quadrotor) else 1)


def own_transition(world):
    return Transition(
        world=world, next_world=world, path=jnp.stack([world.evader] * (PERIODS + 1)),
        steps=jnp.asarray(PERIODS, int), proposed=real([0.1, 0.2]), executed=real([0.1, 0.2]),
        correction=real(0.0), lost=jnp.asarray(False),
    )  # fmt: skip


def test_mirrored_quadrotor_moves_as_the_mirror_of_it(x64):
    scenario = load_scenario("quadrotor")
    step = jax.jit(lambda world, action, wheels: scenario.step(world, action, wheels)[0])
    mirror = jax.jit(lambda world: mirror_world(world, scenario.evader_model))
    world, action, wheels = scenario.reset(jax.random.key(1)), real([0.3, 0.6]), real([[0.7, 1.2]])
    moved = step(step(world, action, wheels), action, wheels)
    image = step(mirror(step(world, action, wheels)), action * real([1.0, -1.0]), wheels[:, ::-1])
    assert np.abs(moved.evader_state).min() > 0.1
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), mirror(moved), image)


def random_worlds(count, seed):
    """Worlds with two pursuers and one obstacle, crowded enough that all kinds of contact occur."""
    rng = np.random.default_rng(seed)

    def uniform(*shape):
        return real(rng.uniform(-0.6, 0.6, (count, *shape)))

    return jax.vmap(World)(
        uniform(2), jnp.concatenate([uniform(2, 2), 5.0 * uniform(2, 1)], axis=-1), uniform(1, 4), uniform(2)
    )


def test_mirrored_world_moves_as_the_mirror_of_the_world(x64):
    scenario = load_scenario("paper", pursuer_count=2)
    flip = jnp.array([1.0, -1.0])

    @jax.jit
    @jax.vmap
    def twice(world, action, wheels):
        moved, _ = scenario.step(world, action, wheels)
        return scenario.step(moved, action, wheels)

    world = random_worlds(512, seed=0)
    rng = np.random.default_rng(1)
    action, wheels = real(rng.uniform(-0.2, 0.2, (512, 2))), real(rng.uniform(-0.25, 0.25, (512, 2, 2)))
    moved, events = twice(world, action, wheels)
    mirrored = twice(jax.vmap(mirror_world)(world), action * flip, wheels[..., ::-1])
    expected = jax.vmap(mirror_world)(moved), events
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), expected, mirrored)
    assert events.captured.any() & events.collided.any() & events.reached.any() & ~events.captured.all()
    for frame in ("target", "world"):
        framed = load_scenario("paper", pursuer_count=2, frame=frame)
        look = jax.jit(jax.vmap(lambda world, framed=framed: observe(framed, world)))
        seen, seen_mirrored = look(moved), look(mirrored[0])
        sign = [-1.0 if name.endswith(("_y", "_sin", "_vy")) else 1.0 for name in observation_names(framed)]
        np.testing.assert_allclose(seen_mirrored, np.array(sign) * seen, atol=1e-12)
        assert not np.allclose(seen_mirrored, seen)


@pytest.mark.parametrize("frame", ["target", "world"])
def test_action_relabelled_for_any_target_asks_for_the_same_velocity(frame):
    scenario = load_scenario("paper", frame=frame)
    rng = np.random.default_rng(2)
    angle, speed = rng.uniform(-np.pi, np.pi, 256), 0.1574 * rng.uniform(0.0, 1.0, 256)
    velocity = real(np.stack([speed * np.cos(angle), speed * np.sin(angle)], axis=-1))
    world = random_worlds(256, seed=3)
    # In the last one the evader is at the target, which then has no direction.
    world = eqx.tree_at(lambda w: w.target, world, world.target.at[-1].set(world.evader[-1]))

    @jax.jit
    @jax.vmap
    def round_trip(world, velocity):
        action = to_action(scenario, world, velocity)
        return action, to_velocity(scenario, world, action)

    action, again = round_trip(world, velocity)
    np.testing.assert_allclose(velocity, again, atol=1e-7)
    np.testing.assert_allclose(jnp.linalg.norm(action, axis=-1), speed / 0.1574, rtol=1e-4)


# What the training loop stores, driven again by hand -----------------------------------------------------


@pytest.fixture(scope="module")
def driven(small):
    """Every transition and report of a training in which everything happens, chunk by chunk."""
    scenario = small.scenario(
        evader_speed=1.0,
        pursuer_speed=1.6,
        reach_distance=0.2,
        target_separation=0.25,
        initial_separation=0.3,
        arena_side=1.6,
    )
    options = small.options(exploration_noise=1.0)
    shield, pursuer = as_shield("game", scenario), as_pursuer("turn-then-drive")
    state = start(scenario, shield, options, jax.random.key(3), 64)
    transitions, reports, seen = [], [], set()
    # Rounding differs between processors, so how long it takes until everything has happened does too.
    while len(reports) < 30 or (len(seen) < len(OUTCOMES) and len(reports) < 200):
        before = int(state.replay.written)
        state, report = run_chunk(scenario, shield, pursuer, options, state, jnp.asarray(10_000), 10)
        slots = np.arange(before, int(state.replay.written)) % 64
        transitions.append(
            jax.tree.map(lambda ring, slots=slots: np.asarray(ring)[slots], state.replay.transitions)
        )
        reports.append(jax.tree.map(np.asarray, report))
        seen |= set(reports[-1].outcome[reports[-1].ended].tolist())

    def join(parts):
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)

    return scenario, shield, pursuer, join(transitions), join(reports)


def test_stored_decisions_and_metrics_are_what_the_physics_did(driven):
    scenario, shield, pursuer, stored, report = driven

    @jax.jit
    def period(world, memory, nominal):
        result, memory = shield(world, nominal, memory)
        wheels = pursuer(scenario, world, jax.random.key(0))
        world, events = scenario.step(world, result.action, wheels)
        return world, memory, result, events

    relabelled = jax.jit(lambda one: reward_along(scenario, one, one.world.target, real(0.0)))
    first_of_episode, env_steps = True, 0
    ends = []
    for index in range(len(stored.steps)):
        one = jax.tree.map(lambda leaf, index=index: jnp.asarray(leaf[index]), stored)
        world = one.world
        if first_of_episode:
            assert float(world.time) == 0.0
            memory, tally = (
                shield.init(world),
                dict.fromkeys(("reward", "steps", "corrected", "infeasible"), 0.0),
            )
            nearest = np.inf
        reward, actions, corrections, path = 0.0, [], [], [np.asarray(world.evader)]
        for _ in range(5):
            world, memory, result, events = period(world, memory, one.proposed)
            reward += float(events.reward)
            tally["steps"] += 1
            tally["corrected"] += int(result.status) != Status.OK
            tally["infeasible"] += int(result.status) == Status.INFEASIBLE
            nearest = min(nearest, float(events.pursuer_clearance))
            actions.append(np.asarray(result.action))
            corrections.append(float(result.intervention))
            path.append(np.asarray(world.evader))
            over = bool(events.terminated | events.truncated)
            if over:
                break
        tally["reward"] += reward
        env_steps += len(actions)
        assert int(one.steps) == len(actions)
        assert bool(one.lost) == bool(events.captured | events.collided)
        path += [path[-1]] * (6 - len(path))
        np.testing.assert_allclose(one.path, np.array(path), atol=1e-5)
        np.testing.assert_allclose(one.next_world.pursuers, world.pursuers, atol=1e-5)
        np.testing.assert_allclose(one.executed, np.mean(actions, axis=0), atol=1e-5)
        assert float(one.correction) == pytest.approx(np.mean(corrections), abs=1e-5)

        value, ended = relabelled(one)
        assert float(value) == pytest.approx(reward, rel=1e-4, abs=1e-5)
        assert bool(ended) == bool(events.terminated)
        assert bool(report.ended[index]) == over
        first_of_episode = over
        if over:
            outcome = OUTCOMES[int(report.outcome[index])]
            assert bool(getattr(events, outcome))
            ends.append((outcome, len(actions)))
            assert int(report.env_steps[index]) == env_steps
            assert float(report.tally.total_reward[index]) == pytest.approx(
                tally["reward"], rel=1e-4, abs=1e-4
            )
            assert int(report.tally.steps[index]) == tally["steps"]
            assert int(report.tally.interventions[index]) == tally["corrected"]
            assert int(report.tally.infeasible[index]) == tally["infeasible"]
            assert float(report.tally.pursuer_clearance[index]) == pytest.approx(nearest, abs=1e-5)
    # The run has to have contained what this test is about, and in the middle of decisions too.
    for outcome in ("captured", "reached"):
        assert any(name == outcome and steps < 5 for name, steps in ends), outcome
    assert {name for name, _ in ends} == set(OUTCOMES)


def test_first_nominal_velocity_is_held_in_world_axes(driven):
    scenario, _, _, stored, _ = driven
    # After the warm-up the proposed velocity is the policy's plus noise: never faster than the evader.
    assert np.linalg.norm(stored.proposed, axis=-1).max() <= 1.0 + 1e-6
    world = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), stored.world)
    ahead = decide(scenario, lambda observation: jnp.array([1.0, 0.0]), world)
    offset = world.target - world.evader
    np.testing.assert_allclose(ahead, offset / jnp.linalg.norm(offset), atol=1e-6)
