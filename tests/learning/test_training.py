"""Hazard: a training loop that is not the one asked for: another end, seed, action, precision, program."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep._arrays import real
from sidestep.learning.bounds import on_disc
from sidestep.learning.players import EVADING
from sidestep.learning.replay import sample
from sidestep.learning.td3 import update
from sidestep.learning.training import Course, _learn, run_chunk, start
from sidestep.learning.variation import FIXED
from sidestep.pursuit import as_pursuer
from sidestep.safety import as_shield
from sidestep.store.runs import CONVERGENCE_WINDOW
from sidestep.world import observe


@pytest.mark.slow
def test_training_stops_exactly_at_its_last_episode_whatever_the_chunk(small, small_run):
    other = small.train(chunk=7)
    assert len(small_run.metrics) == 8
    assert small_run.metrics == other.metrics
    assert small.differences(small_run.state, other.state) == []
    decisions = int(small_run.state.decisions)
    assert decisions % 10
    assert decisions % 7, "the last chunks have to overshoot for this to test anything"
    assert int(small_run.state.replay.written) == decisions
    assert int(small_run.state.env_steps) == sum(line["steps"] for line in small_run.metrics)


def test_one_update_per_decision_after_the_warm_up_and_none_within(small, small_run):
    assert int(small_run.state.learner.updates) == int(small_run.state.decisions) - 10
    scenario, options = small.scenario(), small.options()
    shield, pursuer = as_shield("game", scenario), as_pursuer("turn-then-drive")
    state = start(scenario, shield, options, jax.random.key(0), 64)
    warm, _ = run_chunk(scenario, shield, pursuer, options, state, jnp.asarray(8), 10)
    assert int(warm.decisions) == 10
    assert small.differences(warm.learner, state.learner) == []


@pytest.fixture(scope="module")
def many(small):
    """A training in three worlds."""
    return small.train(options=small.options(worlds=3, replay_capacity=512))


def test_many_worlds_keep_their_episodes_apart(small, many):
    """Within an episode of a world, each transition begins where the last one ended; between episodes not."""
    replay = many.state.replay
    count = int(replay.written)
    assert count == 3 * int(many.state.decisions) <= replay.capacity
    before, after = replay.transitions.world, replay.transitions.next_world
    episode = np.asarray(replay.episode[:count])
    continued = 0
    for slot in range(count - 3):
        same = episode[slot] == episode[slot + 3]
        assert same == np.array_equal(after.evader[slot], before.evader[slot + 3])
        assert same == bool(before.time[slot + 3] > 0.0)
        assert episode[slot] % 3 == slot % 3
        continued += same
    assert 0 < continued < count - 3


def test_many_worlds_count_every_episode_and_period(small, many):
    running = many.state.episode.tally.steps.sum()
    assert int(many.state.env_steps) == sum(line["steps"] for line in many.metrics) + int(running)
    # The last decision may end an episode in each world.
    assert 8 <= len(many.metrics) == int(many.state.ended) <= 10
    assert [line["episode"] for line in many.metrics] == list(range(1, len(many.metrics) + 1))
    assert int(many.state.learner.updates) == int(many.state.decisions) - 4
    assert len({line["return"] for line in many.metrics}) == len(many.metrics)


@pytest.mark.slow
def test_many_worlds_stopped_and_resumed_are_the_same_training(small, many, tmp_path):
    options = small.options(worlds=3, replay_capacity=512)
    small.train(options=options, episodes=4, out=tmp_path / "run")
    resumed = small.train(options=options, out=tmp_path / "run", resume=True)
    assert resumed.metrics == many.metrics
    assert small.differences(resumed.state, many.state) == []


def test_seed_decides_everything(small, small_run):
    again, other = small.train(), small.train(seed=1)
    assert again.metrics == small_run.metrics
    assert small.differences(again.state, small_run.state) == []
    changed = small.differences(other.state, small_run.state)
    for part in (".learner.actor", ".replay.transitions.world.evader", ".episode.world.target", ".key"):
        assert any(name.startswith(part) for name in changed), part


def test_other_numbers_do_not_compile_anything_again(small, small_run):
    """Speeds, gains, rates, noises, seeds: all traced. A recompilation takes longer than many episodes."""
    compiled = []

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(event)

    scenario = small.scenario(
        evader_speed=0.31, pursuer_speed=0.25, pursuer_gain=2.0, obstacle_gain=0.7, capture_distance=0.19
    )
    numbers = {
        "actor_learning_rate": 1e-4,
        "discount": 0.95,
        "hindsight": 0.3,
        "mirror": 0.1,
        "reward_scale": 0.02,
    }
    options = small.options(
        **numbers, exploration_noise=0.3, correction_penalty=0.5, time_cost=0.2, target_noise=0.1
    )
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        training = small.train(scenario, options, seed=5)
        assert compiled == []
        # Shows that the listener hears.
        jax.jit(lambda x: x * 3.25)(real(1.0))
        assert compiled != []
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert small.differences(training.state, small_run.state) != []


def test_chunk_returns_exactly_the_types_it_takes(small):
    """Or else the second chunk of every training compiles anew: a weakly typed count is enough."""
    scenario, options = small.scenario(), small.options()
    shield, pursuer = as_shield("game", scenario), as_pursuer("turn-then-drive")
    state = start(scenario, shield, options, jax.random.key(0), 64)
    after, _ = eqx.filter_eval_shape(run_chunk, scenario, shield, pursuer, options, state, jnp.asarray(8), 10)
    given, returned = jax.tree.leaves(state), jax.tree.leaves(after)
    for before, now in zip(given, returned, strict=True):
        assert (before.shape, before.dtype) == (now.shape, now.dtype)
        assert getattr(before, "weak_type", False) == getattr(now, "weak_type", False)


@pytest.mark.slow
def test_seeds_and_learning_rates_under_vmap_train_as_they_do_alone(small, x64):
    """In float64, where rounding (the one difference there may be) stays far below the tolerance of 1e-8."""
    scenario, options = small.scenario(), small.options()
    shield, pursuer = as_shield("game", scenario), as_pursuer("turn-then-drive")
    limit = jnp.asarray(3)

    def chunk(rate, state):
        changed = eqx.tree_at(lambda o: o.algorithm.actor_learning_rate, options, rate)
        return run_chunk(scenario, shield, pursuer, changed, state, limit, 10)

    states = [start(scenario, shield, options, jax.random.key(seed), 64) for seed in (0, 1)]
    rates = [real(3e-4), real(1e-2)]
    alone = []
    for rate, state in zip(rates, states, strict=True):
        for _ in range(3):
            state, report = chunk(rate, state)
        alone.append((state, report))
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    batched = eqx.filter_jit(eqx.filter_vmap(chunk))
    for _ in range(3):
        together, report = batched(jnp.stack(rates), together)
    expected = small.leaves_of(jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone))
    actual = small.leaves_of((together, report))
    assert int(together.learner.updates.sum()) > 20
    for name, leaf in expected.items():
        np.testing.assert_allclose(actual[name], leaf, rtol=1e-8, atol=1e-8, err_msg=name)
        # What double precision trains in is double precision throughout.
        assert leaf.dtype != np.float32, name
        assert np.all(np.isfinite(leaf)) or name.startswith("[0].episode.tally"), name


# Which action is learned from ------------------------------------------------------------------------------


class Turned(eqx.Module):
    """A shield of anyone's own: half of every velocity, turned by where the robots are."""

    def init(self, world):
        return ()

    def __call__(self, world, nominal, memory):
        from sidestep.safety.shields.shield import ShieldResult

        result = ShieldResult(
            action=half_turned(world, nominal),
            status=jnp.asarray(1, jnp.int32),
            barriers=jnp.zeros(2),
            slack=real(0.0),
            intervention=real(0.0),
        )
        return result, memory


def half_turned(world, vector):
    angle = 20.0 * world.evader[1] + 10.0 * world.pursuers[0, 0] + 1.0
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return 0.5 * jnp.stack([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])


@pytest.mark.slow
def test_executed_actions_are_learned_from_through_the_shield_of_their_own_world(small, small_run):
    """The target action through that of the world after; the actor's, if asked for, of the one before."""
    scenario, replay, key = small.scenario(), small_run.state.replay, jax.random.key(11)
    # Steep target critics and no bonus, so that the target action makes a difference; the next update is one
    # that moves the actor, and without momentum its moments tell its gradient.
    learner = eqx.tree_at(
        lambda x: (x.target_critic, x.updates, x.actor_moments),
        small_run.state.learner,
        (
            jax.tree.map(lambda w: 5.0 * w, small_run.state.learner.critic),
            jnp.asarray(1),
            jax.tree.map(jnp.zeros_like, small_run.state.learner.actor_moments),
        ),
    )
    asked = {"replay_action": "executed", "hindsight": 0.0}

    def slope(result):
        return np.asarray(result[0].actor_moments.mu.body.weights[-1])

    options = small.options(**asked)

    @jax.jit
    def by_hand(learner):
        sample_key, update_key = jax.random.split(jax.random.split(key, 1)[0])
        settings = {
            "hindsight": options.hindsight,
            "mirror": options.mirror,
            "executed_action": True,
            "correction_penalty": options.correction_penalty,
            "time_cost": options.time_cost,
            "reward_scale": options.reward_scale,
        }
        batch, before, after, _ = sample(scenario, replay, sample_key, 16, **settings)

        def shielded(worlds):
            # A turn of the velocity is the same turn of the action, whatever their axes.
            return lambda actions, key: jax.vmap(half_turned)(worlds, on_disc(actions, key))

        return [
            update(options.algorithm, learner, batch, update_key, bound, target, real(10.0))
            for bound, target in (
                (on_disc, shielded(after)),
                (shielded(before), shielded(after)),
                (on_disc, on_disc),
                (shielded(after), shielded(after)),
            )
        ]

    *expected, no_target, wrong_world = by_hand(learner)
    for filtered, wanted in zip((False, True), expected, strict=True):
        chosen = small.options(**asked, filter_gradients=filtered)
        course = Course(scenario, Turned(), None, chosen, EVADING, FIXED)
        learn = jax.jit(lambda x, course=course: _learn(course, course.options, x, replay, key))
        actual = learn(learner)
        leaves = small.leaves_of(actual)
        for name, leaf in small.leaves_of(wanted).items():
            np.testing.assert_allclose(leaf, leaves[name], rtol=1e-4, atol=1e-5, err_msg=name)
        largest = np.max(np.abs(slope(wanted)))
        np.testing.assert_allclose(slope(actual), slope(wanted), rtol=0.0, atol=1e-3 * largest)

    # What it is told apart from.
    assert abs(float(no_target[1].critic / expected[0][1].critic) - 1.0) > 2e-3
    for other in (expected[0], wrong_world):
        assert np.max(np.abs(slope(other) - slope(expected[1]))) > 0.05 * largest


@pytest.mark.slow
def test_each_choice_of_replay_action_trains_and_gives_another_policy(small):
    # A pursuer fast enough that the shield has to correct much.
    scenario = small.scenario(pursuer_speed=1.0)
    runs = {
        "proposed": small.train(scenario),
        "penalty": small.train(scenario, small.options(correction_penalty=50.0)),
        "executed": small.train(scenario, small.options(replay_action="executed")),
        "through the filter": small.train(
            scenario, small.options(replay_action="executed", filter_gradients=True)
        ),
    }
    assert sum(line["interventions"] for line in runs["proposed"].metrics) > 20
    actors = []
    for training in runs.values():
        assert len(training.metrics) == 8
        leaves = small.leaves_of(training.state.learner)
        assert all(np.all(np.isfinite(leaf)) for leaf in leaves.values())
        actors.append(leaves[".actor.body.weights[0]"])
    for one, other in itertools.combinations(actors, 2):
        assert not np.allclose(one, other, atol=1e-6)


# Does it learn? --------------------------------------------------------------------------------------------

TOY = {
    "obstacle_count": 0,
    "evader_start": (0.0, 0.0),
    "pursuer_starts": ((50.0, 50.0, 0.0),),
    "evader_speed": 1.0,
    "target_separation": 0.7,
    "reach_distance": 0.1,
}
QUICK = {"actor_learning_rate": 3e-3, "critic_learning_rate": 3e-3, "replay_capacity": 512}


def toy_train(small, scenario, episodes, **options):
    chosen = small.options(**{**QUICK, **options})
    return small.train(scenario, chosen, shield="none", pursuer="still", episodes=episodes)


@pytest.mark.parametrize("seed", [0, 1])
def test_training_learns_to_reach_and_not_training_does_not(small, seed):
    scenario = small.scenario(**TOY)
    reached = {}
    for rate in (3e-3, 0.0):
        settings = small.options(
            **{**QUICK, "actor_learning_rate": rate, "critic_learning_rate": rate},
            discount=0.9,
            target_rate=0.02,
        )
        training = small.train(scenario, settings, shield="none", pursuer="still", episodes=64, seed=seed)
        last = training.metrics[-CONVERGENCE_WINDOW:]
        reached[rate] = sum(line["outcome"] == "reached" for line in last) / len(last)
    assert reached[3e-3] >= 0.9
    assert reached[0.0] <= 0.3


def test_time_limits_are_bootstrapped_through_all_the_way(small):
    """An evader that cannot move pays the same for ever; that its episodes are cut must not show."""
    scenario = small.scenario(**{**TOY, "evader_speed": 1e-6})
    training = toy_train(
        small, scenario, 150, discount=0.8, target_rate=0.1, hindsight=0.0, reward_scale=20.0
    )
    assert all(line["outcome"] == "timed_out" for line in training.metrics)
    ratios = []
    for seed in range(8):
        world = scenario.reset(jax.random.key(seed))
        per_decision = -20.0 * 0.01 * 5 * float(jnp.linalg.norm(world.target - world.evader))
        values = training.state.learner.critic(observe(scenario, world)[None], jnp.zeros((1, 2)))
        ratios += [float(value[0]) / (per_decision / (1.0 - 0.8)) for value in values]
    # Were the cuts taken for ends, eight decisions to an episode, the values would be 0.58 of this.
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)
    assert min(ratios) > 0.8
