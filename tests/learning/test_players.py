"""Hazards of a pursuer that learns, and of robots that vary: another game than the one that is scored."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep import goal_seeking, load_policy, load_pursuer, make_pursuer, make_shield
from sidestep._arrays import real
from sidestep.learning import HUNTER, Actor, LearnedPursuer, policy_file, train
from sidestep.learning.players import EVADING, Pursuing, pursuers_view
from sidestep.learning.policy import from_anywhere
from sidestep.learning.replay import mirror_world, sample
from sidestep.learning.variation import VARIED, Variation
from sidestep.pursuit import CaptureGame, Mixed
from sidestep.store.runs import RunError
from sidestep.world import World, load_scenario, observe

HUNT = {"decision_steps": 2, "hindsight": 0.0}
RANGES = {
    "evader_speed": [0.2, 0.35],
    "pursuer_half_axle": [0.1, 0.3],
    "capture_distance": [0.05, 0.3],
    "obstacle_count": [0, 2],
}


def world_of(seed):
    generator = np.random.default_rng(seed)
    return World(
        evader=generator.normal(size=2),
        pursuers=generator.normal(size=(1, 3)),
        obstacles=generator.normal(size=(2, 4)),
        target=generator.normal(size=2),
        time=0.05 * seed,
        evader_velocity=0.1 * generator.normal(size=2),
        wheel_speeds=generator.uniform(-0.2, 0.2, (1, 2)),
    )


def in_lanes_of(worlds):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1), *worlds)


@pytest.fixture(scope="module")
def hunt(small, tmp_path_factory):
    """A pursuer that has learned a little, its folder, and its training."""
    folder = tmp_path_factory.mktemp("hunt") / "hunter"
    training = small.train(options=small.options(**HUNT), against="goal-seeking", out=folder, episodes=6)
    return folder, training


# The pursuer that learns -----------------------------------------------------------------------------------


def test_a_pursuer_sees_the_mirror_image_of_its_world_mirrored():
    scenario = load_scenario("paper", obstacle_count=2)
    look = jax.jit(
        lambda world: (pursuers_view(scenario, world), pursuers_view(scenario, mirror_world(world)))
    )
    for seed in range(5):
        plain, mirrored = look(world_of(seed))
        # Its wheels, entries 5 and 6, change places.
        sign = np.array([1, -1, 1, 1, -1, 0, 0, 1, -1, 1, 1, -1, 1])
        np.testing.assert_allclose(np.asarray(mirrored) * np.abs(sign), sign * np.asarray(plain), atol=1e-6)
        np.testing.assert_allclose(mirrored[5:7], plain[5:7][::-1], atol=1e-6)
    player = Pursuing(goal_seeking)
    np.testing.assert_allclose(player.mirrored(jnp.array([[0.1, -0.2]])), [[-0.2, 0.1]])


def test_a_pursuer_sees_the_evader_ahead_and_how_near_it_is():
    scenario = load_scenario("paper", obstacle_count=0)
    pose = [[0.0, 0.0, np.pi / 2]]
    world = World(np.array([0.0, 1.0]), np.array(pose), np.zeros((0, 4)), np.array([-1.0, 0.0]))
    expected = [0.5, 0.0, np.exp(-0.8 / 0.2), 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(pursuers_view(scenario, world), expected, atol=1e-6)


def test_the_game_is_zero_sum(small, small_run):
    """What the evader gains, the pursuer loses; a lost evader pays the bonus."""
    scenario, replay = small.scenario(), small_run.state.replay
    lost = jnp.arange(replay.capacity) % 3 == 0
    replay = eqx.tree_at(lambda replay: replay.transitions.lost, replay, lost)
    settings = {"hindsight": real(0.0), "mirror": real(0.5), "executed_action": False, "time_cost": real(2.0)}
    settings |= {"correction_penalty": real(0.0), "reward_scale": real(0.5)}

    def draw(player):
        return jax.jit(lambda key: sample(scenario, replay, key, 256, **settings, player=player)[0])(
            jax.random.key(3)
        )

    ours, theirs = draw(EVADING), draw(Pursuing(goal_seeking))
    both = np.asarray(ours.reward + theirs.reward)
    assert set(np.round(both, 2)) == {0.0, 500.0}
    assert np.all(np.asarray(ours.terminated)[both > 1.0] == 1.0)
    # Their wheels, as shares of the limit.
    assert np.abs(theirs.observation - 0.0).max() <= 1.0 + 1e-6


def test_the_evader_drives_by_its_policy_against_a_pursuer_that_learns(hunt, small):
    _, training = hunt
    scenario, stored = small.scenario(), training.state.replay.transitions
    count = int(training.state.replay.size)
    shield = make_shield("game", scenario)
    ask = jax.jit(lambda world, memory, nominal: shield(world, nominal, memory))
    checked = 0
    for index in range(count):
        one = jax.tree.map(lambda leaf, index=index: jnp.asarray(leaf[index]), stored)
        if float(one.world.time) > 0.0 or int(one.steps) < 2:
            continue
        checked += 1
        towards = np.asarray(one.world.target - one.world.evader)
        nominal = float(scenario.evader_speed) * towards / np.linalg.norm(towards)
        first = ask(one.world, shield.init(one.world), jnp.asarray(nominal))[0].action
        np.testing.assert_allclose(one.path[1] - one.path[0], 0.05 * np.asarray(first), atol=1e-5)
        # The wheels are held for the decision.
        np.testing.assert_allclose(
            one.next_world.wheel_speeds[0], np.clip(one.proposed, -0.2, 0.2), atol=1e-6
        )
    assert checked


def test_a_trained_pursuer_holds_its_wheels_between_decisions_and_answers_in_lanes():
    scenario = load_scenario("paper", obstacle_count=2)
    pursuer = LearnedPursuer(Actor(13, 2, (8,), jax.random.key(0)), 4)
    worlds = [world_of(seed) for seed in range(8)]
    key = jax.random.key(0)
    ask = jax.jit(lambda world: pursuer(scenario, world, key))
    alone = [np.asarray(ask(world)) for world in worlds]
    for seed, (world, wheels) in enumerate(zip(worlds, alone, strict=True)):
        held = np.asarray(world.wheel_speeds[0])
        assert np.allclose(wheels, held, atol=1e-6) == (seed % 4 != 0)
    together = ask(in_lanes_of(worlds))
    np.testing.assert_allclose(together, np.stack(alone, axis=-1), atol=1e-6)
    with pytest.raises(ValueError, match="among 2 obstacles, this scenario has 1"):
        pursuer(load_scenario("paper"), dataclasses.replace(worlds[0], obstacles=jnp.zeros((1, 4))), key)


def test_a_trained_pursuer_is_kept_and_goes_where_pursuers_go(hunt):
    folder, training = hunt
    pursuer = load_pursuer(folder)
    assert isinstance(pursuer, LearnedPursuer)
    assert pursuer.decision_steps == 2
    for ours, theirs in zip(jax.tree.leaves(pursuer), jax.tree.leaves(training.policy), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    config = json.loads((folder / "config.json").read_text())
    assert config["against"] == "goal-seeking"
    with pytest.raises(RunError, match=r"has trained a pursuer.*goes with --pursuer"):
        load_policy(folder)
    with pytest.raises(RunError, match=r"trained a policy for the evader.*train one with --against"):
        load_pursuer(_evaders(folder))


def _evaders(folder):
    """A file like the pursuer's, of an evader's policy."""
    from sidestep.learning import LearnedPolicy, write_policy

    (folder.parent / "evader").mkdir(exist_ok=True)
    return write_policy(folder.parent / "evader", LearnedPolicy(load_pursuer(folder).actor, 2))


def test_the_pursuer_that_comes_with_the_package_fits_its_scenario_and_ships_small():
    assert policy_file(HUNTER).stat().st_size < 2_000_000
    world = dataclasses.replace(world_of(4), obstacles=jnp.ones((1, 4)))
    wheels = load_pursuer(HUNTER)(load_scenario("paper"), world, jax.random.key(0))
    assert np.abs(wheels).max() <= 0.2 + 1e-6


@pytest.mark.slow
def test_it_delays_the_policy_that_it_has_learned_against():
    from sidestep.trials import evaluate

    scenario = load_scenario("paper", observation="motion", episode_steps=2400)
    policy, pursuers = load_policy("pretrained"), (HUNTER, "turn-then-drive", "nash")
    means = [
        np.mean(evaluate(scenario, policy, "joint:table", load_pursuer(name), 256, 1).times_to_target)
        for name in pursuers
    ]
    assert means[0] > 1.2 * means[1] > 1.2 * means[2]


def test_a_run_names_its_opponents_so_that_it_can_be_resumed_from_anywhere(hunt, monkeypatch):
    folder, _ = hunt
    monkeypatch.chdir(folder.parent)
    # The folder is called hunter, too: the shipped one goes first.
    assert folder.name == "hunter"
    assert from_anywhere("mixed+hunter+./hunter") == f"mixed+hunter+{folder}"
    assert from_anywhere("goal-seeking") == "goal-seeking"


def test_names_of_pursuers_can_be_joined(hunt):
    folder, _ = hunt
    mixed = load_pursuer(f"mixed+{folder}")
    assert isinstance(mixed, Mixed)
    assert len(mixed.strategies) == 8
    assert isinstance(mixed.strategies[-1], LearnedPursuer)
    assert len(load_pursuer("nash+interceptor").strategies) == 2
    with pytest.raises(ValueError, match=r"unknown pursuer 'huntr'.*nor is there a run folder huntr"):
        load_pursuer("nash+huntr")
    with pytest.raises(ValueError, match="random cannot be mixed"):
        load_pursuer("nash+random")


def test_a_pursuers_training_is_resumed_bit_for_bit(hunt, small, tmp_path):
    from sidestep.learning import resume_settings

    _, whole = hunt
    out = tmp_path / "hunter"
    small.train(options=small.options(**HUNT), against="goal-seeking", out=out, episodes=3)
    settings = resume_settings(out)
    assert settings["against"] == "goal-seeking"
    resumed = train(**{**settings, "episodes": 6}, out=out, resume=True, chunk=10)
    assert resumed.metrics == whole.metrics
    assert small.differences(resumed.state.learner, whole.state.learner) == []


def test_guided_worlds_are_driven_by_the_strategy_and_the_others_by_the_learner(small):
    training = small.train(
        options=small.options(**HUNT, worlds=4, guided=0.5, replay_capacity=512), against="goal-seeking"
    )
    replay = training.state.replay
    # It decides as seldom as the learner, so that it does not turn too far.
    guide, paced = make_pursuer("turn-then-drive"), small.scenario(control_period=0.1)
    ask = jax.jit(jax.vmap(lambda world: guide(paced, world, jax.random.key(0))))
    driven = np.asarray(replay.transitions.proposed[: int(replay.written)]).reshape(-1, 4, 2)
    asked = np.asarray(ask(replay.transitions.world))[: int(replay.written)].reshape(-1, 4, 2)
    np.testing.assert_allclose(driven[:, :2], asked[:, :2], atol=1e-5)
    assert np.abs(driven[:, 2:] - asked[:, 2:]).max(axis=-1).min() > 1e-5


def test_evaders_are_guided_straight_to_their_targets(small):
    scenario, world = small.scenario(), world_of(3)
    towards = np.asarray(world.target - world.evader)
    expected = float(scenario.evader_speed) * towards / np.linalg.norm(towards)
    np.testing.assert_allclose(EVADING.guide(scenario, None, world, None), expected, rtol=1e-5)
    for worlds, guided in ((1, 0.5), (4, 0.1), (2, 0.9)):
        with pytest.raises(ValueError, match="it must take at least one and leave some"):
            small.options(worlds=worlds, guided=guided)


def test_what_a_pursuer_cannot_learn_from_is_refused(small):
    with pytest.raises(ValueError, match="a pursuer learns alone, but the scenario has 2 pursuers"):
        small.train(small.scenario(pursuer_count=2), against="goal-seeking")
    with pytest.raises(ValueError, match=r"'replay_action' and 'correction_penalty' are about the evader"):
        small.train(options=small.options(correction_penalty=1.0), against="goal-seeking")
    with pytest.raises(ValueError, match="only evaluate and rollout take it"):
        Pursuing.against("planner", small.scenario())


@pytest.mark.slow
def test_a_pursuer_learns_to_catch_an_evader_without_a_shield():
    scenario = load_scenario("paper", obstacle_count=0, arena_side=2.0, episode_steps=300)
    from sidestep.learning import make_options
    from sidestep.trials import evaluate

    options = make_options(
        worlds=32, batch_size=256, updates_per_decision=4, decision_steps=4, discount=0.99, hidden=[64, 64],
        replay_capacity=100_000, actor_learning_rate=1e-3, critic_learning_rate=1e-3, exploration_noise=0.3,
    )  # fmt: skip
    training = train(scenario, shield="none", against="goal-seeking", episodes=1500, options=options)
    rates = [
        evaluate(scenario, "goal-seeking", "none", pursuer, 200, 1).captured / 200
        for pursuer in ("still", training.policy)
    ]
    assert rates[1] > rates[0] + 0.3


# Robots that vary ------------------------------------------------------------------------------------------


def varied(small, **more):
    return small.train(
        small.scenario(observation="robots"), vary=RANGES, options=small.options(**more), episodes=12
    )


@pytest.fixture(scope="module")
def various(small):
    """A training in three worlds with other robots in every episode."""
    return varied(small, worlds=3, replay_capacity=512)


def test_every_episode_is_played_by_the_robots_that_were_drawn_for_it(small, various):
    replay = various.state.replay
    count = int(replay.written)
    variation, scenario, shield = Variation.of(
        RANGES, small.scenario(), make_shield("game", small.scenario())
    )
    assert scenario.obstacle_count == 2

    @jax.jit
    def again(one):
        mine = variation.scenario(scenario, one.drawn)
        guard = variation.shield(shield, mine)
        result, _ = guard(one.world, one.proposed, guard.init(one.world))
        wheels = jax.numpy.zeros((1, 2))
        moved, _ = mine.step(one.world, result.action, wheels)
        return moved.evader, mine.evader_speed, mine.capture_distance, mine.pursuer_half_axle

    drawn, seen = np.asarray(replay.transitions.drawn[:count]), set()
    for index in range(count):
        one = jax.tree.map(lambda leaf, index=index: jnp.asarray(leaf[index]), replay.transitions)
        evader, speed, level, axle = again(one)
        if float(one.world.time) == 0.0:
            np.testing.assert_allclose(one.path[1], evader, atol=1e-5)
            seen.add(tuple(drawn[index]))
        # Never faster than drawn, whatever the policy asked for, and at times as fast as that.
        steps = np.linalg.norm(np.diff(one.path, axis=0), axis=-1)
        assert steps.max() <= 0.05 * float(speed) + 1e-5
        game = CaptureGame.of(
            load_scenario("paper", evader_speed=float(speed), pursuer_half_axle=float(axle))
        )
        assert float(level) <= 0.9961 * float(game.largest_capture_distance)
        there = np.abs(np.asarray(one.world.obstacles[:, 0])) < 100.0
        assert there.sum() == drawn[index][3]
    assert len(seen) >= 8
    assert {0.0, 1.0, 2.0} == set(drawn[:, 3])
    low, high = np.array(list(RANGES.values()), float).T
    assert np.all((drawn >= low - 1e-6) & (drawn <= high + 1e-6))
    # Straight times are of the evader that drove.
    lines = [line for line in various.metrics if line["outcome"] == "reached"]
    assert all(0.05 * line["steps"] >= line["straight_time"] - 0.051 for line in lines)


def test_batches_are_observed_and_rewarded_with_the_robots_of_their_episode(small, various):
    scenario, replay = small.scenario(observation="robots", obstacle_count=2), various.state.replay
    variation, *_ = Variation.of(RANGES, scenario, make_shield("game", scenario))
    settings = {"hindsight": real(0.0), "mirror": real(0.0), "executed_action": False}
    settings |= {"correction_penalty": real(7.0), "time_cost": real(0.0), "reward_scale": real(1.0)}
    batch, world, _, drawn = jax.jit(
        lambda key: sample(scenario, replay, key, 64, **settings, variation=variation)
    )(jax.random.key(0))
    look = jax.jit(lambda one, values: observe(variation.scenario(scenario, values), one))
    for i in range(64):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], world)
        np.testing.assert_allclose(look(one, drawn[i]), batch.observation[i], atol=1e-6)
        assert float(batch.observation[i][-6]) == pytest.approx(float(drawn[i][0]) / 0.2, rel=1e-5)
        assert np.linalg.norm(batch.action[i]) <= 1.0 + 1e-5


@pytest.mark.slow
def test_a_training_with_varied_robots_is_resumed_bit_for_bit(small, tmp_path):
    from sidestep.learning import resume_settings

    scenario = small.scenario(observation="robots")
    whole = small.train(scenario, vary=RANGES, episodes=6)
    small.train(scenario, vary=RANGES, episodes=3, out=tmp_path / "run")
    settings = resume_settings(tmp_path / "run")
    resumed = train(**{**settings, "episodes": 6}, out=tmp_path / "run", resume=True, chunk=10)
    assert resumed.metrics == whole.metrics
    assert small.differences(resumed.state.learner, whole.state.learner) == []
    assert resumed.policy.actor.body.weights[0].shape[0] == 40


def test_draws_are_uniform_and_counts_whole():
    scenario = load_scenario("paper")
    variation, *_ = Variation.of(RANGES, scenario, make_shield("game", scenario))
    draws = np.asarray(jax.vmap(variation.draw)(jax.random.split(jax.random.key(0), 4000)))
    counts = np.bincount(draws[:, 3].astype(int))
    assert np.all(draws[:, 3] % 1.0 == 0.0)
    np.testing.assert_allclose(counts / 4000, 1 / 3, atol=0.03)
    np.testing.assert_allclose(np.quantile(draws[:, 0], [0.25, 0.75]), [0.2375, 0.3125], atol=0.01)


def test_without_ranges_nothing_is_drawn_and_nothing_changes():
    scenario = load_scenario("paper")
    shield = make_shield("game", scenario)
    variation, same, guard = Variation.of({}, scenario, shield)
    assert (same, guard) == (scenario, shield)
    assert variation.scenario(scenario, jnp.zeros(0)) is scenario


@pytest.mark.parametrize(
    "ranges, words",
    [
        ({"evader_sped": [0.1, 0.2]}, "evader_sped cannot vary.*evader_speed"),
        ({"control_period": [0.05, 0.1]}, f"control_period cannot vary.*{', '.join(VARIED)}"),
        ({"evader_speed": [0.2, 0.1]}, "a range is two numbers, the least and the most"),
        ({"evader_speed": 0.2}, "a range is two numbers"),
        ({"evader_speed": [-0.1, 0.2]}, "the range of evader_speed"),
        ({"obstacle_count": [0, 2.5]}, "the range of obstacle_count"),
    ],
)
def test_impossible_ranges_are_refused(ranges, words):
    scenario = load_scenario("paper")
    with pytest.raises(ValueError, match=words):
        Variation.of(ranges, scenario, make_shield("game", scenario))


def test_a_shield_for_one_scenario_is_refused():
    scenario = load_scenario("paper-0.15")
    with pytest.raises(ValueError, match=r"TableShield is made for one scenario.*use none, paper, game"):
        Variation.of({"evader_speed": [0.1, 0.2]}, scenario, make_shield("joint:table", scenario))
    fixed = load_scenario("paper", obstacle_starts=[[1.0, 1.0]])
    with pytest.raises(ValueError, match="obstacle_starts are fixed"):
        Variation.of({"obstacle_count": [0, 2]}, fixed, make_shield("game", fixed))
