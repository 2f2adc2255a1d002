"""Hazards of attacks: plans not played as planned, starts that are not allowed, searches that stall."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.loop.step import RUNNING
from sidestep.pursuit import pursue
from sidestep.safety import make_shield
from sidestep.safety.barriers.sampling_margin import sampling_margin
from sidestep.trials.falsification.attackers import (
    Herder,
    Script,
    Sideswiper,
    bang_bang,
    escape_margin,
    script,
)
from sidestep.trials.falsification.attacks import ATTACKS, make_attack
from sidestep.trials.falsification.chases import Target, begin, run, shortfall
from sidestep.trials.falsification.counterexamples import play
from sidestep.trials.falsification.cross_entropy import Search, minimise
from sidestep.trials.falsification.planned import Planning, chase_with_plans, search_starts
from sidestep.trials.falsification.starts import (
    EDGE,
    LEAST_MARGIN,
    admissible,
    at_edge,
    decode,
    draw_starts,
    encode,
    freedom,
)
from sidestep.world import World, goal_seeking, load_scenario

PAPER = load_scenario("paper")
EMPTY = load_scenario("paper", obstacle_count=0)
UNSHIELDED = Target(EMPTY, goal_seeking, make_shield("none", EMPTY))


def world(evader, pose, target=(3.0, 0.0), obstacles=()):
    return World(
        jnp.array(evader),
        jnp.array([pose]),
        jnp.array(obstacles).reshape(-1, 4),
        jnp.array(target),
    )


def test_script_plays_its_rows_in_their_periods_and_keeps_the_last():
    plan = 0.01 * jnp.arange(6.0).reshape(3, 1, 2)
    pursuer = Script(plan, jnp.asarray(2, jnp.int32))
    start, key = world((0.0, 0.0), (1.0, 0.0, 0.0)), jax.random.key(0)
    for period, row in ((0, 0), (2, 0), (3, 1), (4, 2), (9, 2)):
        now = eqx.tree_at(lambda w: w.time, start, jnp.asarray(0.05 * period))
        assert np.allclose(pursuer(PAPER, now, key), plan[row, 0])


def test_script_steers_each_of_several_pursuers_by_its_own_row():
    plan = jnp.array([[[0.1, 0.1], [-0.05, 0.2]]])
    start = World(jnp.zeros(2), jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), jnp.zeros((0, 4)), jnp.ones(2))
    pair = load_scenario("paper", obstacle_count=0, pursuer_count=2)
    wheels = pursue(pair, Script(plan, jnp.zeros((), jnp.int32)), start, jax.random.key(0))
    assert np.allclose(wheels, plan[0])


def test_bang_bang_wheels_are_always_full_and_dwell():
    plan = bang_bang(PAPER, jax.random.key(1), 4000, jnp.asarray(40.0))
    assert plan.shape == (4000, 1, 2)
    assert np.allclose(np.abs(plan), 0.2)
    switches = np.mean(np.diff(np.asarray(plan), axis=0) != 0.0, axis=(0, 1))
    assert np.all(switches > 0.005)
    assert np.all(switches < 0.51)


def test_herder_goes_behind_the_evader_before_it_strikes():
    herder = eqx.filter_jit(Herder(jnp.asarray(False), jnp.asarray(0.5)))
    rock = ((0.6, 0.0, 0.0, 0.0),)
    key = jax.random.key(0)
    # Behind the evader as seen from the obstacle, facing it, and near: straight on.
    strike = herder(PAPER, world((0.0, 0.0), (-0.26, 0.0, 0.0), obstacles=rock), key)
    assert np.allclose(strike, 0.2)
    # On the obstacle's side it does not strike but makes for the other side.
    away = herder(PAPER, world((0.0, 0.0), (0.35, 0.0, 0.5), obstacles=rock), key)
    assert not np.allclose(away, -0.2)
    assert np.max(np.abs(away)) <= 0.2 + 1e-6
    # Told to herd toward the target it takes the target for the trap.
    toward = eqx.filter_jit(Herder(jnp.asarray(True), jnp.asarray(0.5)))
    facing = world((0.0, 0.0), (0.26, 0.0, np.pi), target=(-2.0, 0.0), obstacles=rock)
    assert np.allclose(toward(PAPER, facing, key), 0.2)


def test_sideswiper_gains_what_swinging_in_can_gain_on_either_side_and_in_either_direction():
    swiper = eqx.filter_jit(Sideswiper(jnp.asarray(1.0), jnp.asarray(0.0)))
    key = jax.random.key(0)
    for side in (1.0, -1.0):
        for speed in (0.1, -0.1):
            start = world((0.0, side * 0.20001), (0.0, 0.0, 0.0), target=(0.0, -2.0 * side))
            start = eqx.tree_at(lambda w: w.evader_velocity, start, jnp.array([speed, 0.0]))
            wheels = swiper(EMPTY, start, key)
            still, _ = EMPTY.step(start, jnp.array([speed, 0.0]), jnp.full((1, 2), speed))
            swung, _ = EMPTY.step(start, jnp.array([speed, 0.0]), wheels[None])
            gained = float(escape_margin(EMPTY, still) - escape_margin(EMPTY, swung))
            assert gained == pytest.approx((0.2 * 0.05) ** 2 / (8 * 0.2), rel=0.03)


def test_start_survives_its_own_encoding():
    start = PAPER.reset(jax.random.key(3))
    again = eqx.filter_jit(lambda world: decode(PAPER, world, encode(PAPER, world)))(start)
    for name in ("evader", "pursuers", "obstacles", "target"):
        assert np.allclose(getattr(again, name), getattr(start, name), atol=2e-6)


def test_searched_starts_stay_outside_the_capture_set():
    start = EMPTY.reset(jax.random.key(3))
    vector = np.asarray(eqx.filter_jit(encode)(EMPTY, start))
    margin_of = eqx.filter_jit(lambda vector: escape_margin(EMPTY, decode(EMPTY, start, vector)))
    for h, bearing in ((-1.0, 0.0), (0.0, 0.3), (-0.01, 2.0), (0.2, np.pi)):
        margin = margin_of(np.concatenate([[h, bearing], vector[2:]]).astype(vector.dtype))
        assert float(margin) == pytest.approx(max(h, LEAST_MARGIN), abs=5e-7)


def test_edge_starts_lie_at_the_edge_and_are_allowed():
    keys = jax.random.split(jax.random.key(0), 64)
    edge = np.arange(64) < 48
    starts = draw_starts(PAPER, keys, edge)
    margins = np.asarray(jax.vmap(lambda w: escape_margin(PAPER, w))(starts))
    assert np.all(margins[edge] > 0.0)
    assert np.mean(margins[edge] <= EDGE + 1e-6) > 0.9
    assert np.all(np.asarray(jax.vmap(lambda w: admissible(PAPER, w))(starts)))
    assert np.min(np.hypot(*(starts.pursuers[~edge, 0, :2] - starts.evader[~edge]).T)) >= 0.6 - 1e-5


def test_starts_that_the_user_fixed_stay():
    fixed = load_scenario("paper-test")
    assert not freedom(fixed, edge=False).any()
    assert freedom(PAPER, edge=False).any()
    base = PAPER.reset(jax.random.key(0))
    assert at_edge(fixed, base, jax.random.key(1)) is base


def test_cross_entropy_finds_a_minimum_and_never_gets_worse():
    wanted = jnp.array([0.7, -0.4, 2.0])

    def evaluate(drawn):
        scores = jnp.sum((drawn - wanted) ** 2, axis=-1)
        return jnp.where(drawn[:, 0] > 1.0, jnp.inf, scores)

    mean = jnp.zeros((5, 3))
    found = minimise(evaluate, mean, jnp.ones_like(mean), jax.random.key(0), Search(64, 8, 20, 0.02))
    history = np.asarray(found.history)
    assert history.shape == (20, 5)
    assert np.all(np.diff(history, axis=0) <= 0.0)
    assert np.all(found.score < 0.01)
    assert np.allclose(found.best, wanted, atol=0.12)
    assert np.allclose(evaluate(found.best), found.score, atol=1e-6)


def test_cross_entropy_where_nothing_is_allowed_says_so():
    mean = jnp.zeros((2, 3))
    found = minimise(
        lambda drawn: jnp.full(len(drawn), jnp.nan), mean, mean + 1.0, jax.random.key(0), Search(8, 2, 2)
    )
    assert np.all(np.isinf(found.score))
    assert np.all(np.isfinite(found.best))


PLANNING = Planning(Search(24, 4, 3), Search(24, 4, 4), 4, 16, 8, 16)


def searched(target):
    bases = draw_starts(EMPTY, jax.random.split(jax.random.key(1), 3), np.zeros(3, bool))
    free = jnp.asarray(freedom(EMPTY, edge=False), jnp.float32)
    return search_starts(target, PLANNING, bases, free, "capture", jax.random.key(2))


@pytest.mark.slow
def test_search_with_the_shield_in_the_loop_improves():
    target = Target(EMPTY, goal_seeking, make_shield("paper", EMPTY))
    starts, knots, found = searched(target)
    assert np.all(np.asarray(found.history)[-1] < np.asarray(found.history)[0])
    assert np.all(jax.vmap(lambda world: admissible(EMPTY, world))(starts))
    assert knots.shape == (3, 2 * 16 // 4)


def test_goal_decides_what_counts_as_near():
    start = begin(Target(PAPER, goal_seeking, make_shield("none", PAPER)), PAPER.reset(jax.random.key(0)))
    chases = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), start)
    chases = eqx.tree_at(
        lambda c: (c.margin, c.tally.pursuer_clearance, c.tally.obstacle_clearance),
        chases,
        (jnp.array([0.1, 0.5]), jnp.array([0.2, 0.5]), jnp.array([0.9, 0.3])),
    )
    for goal, nearer in (("capture", 0), ("collision", 1), ("both", 0)):
        assert int(np.argmin(shortfall(goal, chases))) == nearer


def test_every_attack_can_be_made_and_others_are_refused():
    for name in ATTACKS:
        assert make_attack(name, 8, 40) is not None
    with pytest.raises(ValueError, match="no attack 'tickle'"):
        make_attack("tickle")


class Slow(eqx.Module):
    """A policy that decides every second period."""

    decision_steps: int = eqx.field(static=True, default=2)

    def __call__(self, observation):
        return jnp.array([jnp.tanh(observation[0]), 0.5])


def test_chase_cut_in_two_holds_decisions_as_an_episode_does():
    target = Target(EMPTY, Slow(), make_shield("none", EMPTY))
    start = EMPTY.reset(jax.random.key(7))
    chases = jax.tree.map(lambda leaf: leaf[None], begin(target, start))
    plans = jnp.zeros((1, 8, 1, 2)).at[..., 0].set(0.1)
    keys = jax.random.split(jax.random.key(0), 1)
    drive = eqx.filter_jit(run)
    for begun in (0, 3):
        parts = (plans, jnp.zeros(1, jnp.int32))
        chases, _ = drive(target, script, parts, chases, jnp.asarray(begun, jnp.int32), 3, keys)
    alone = play(EMPTY, target.policy, target.shield, start, np.asarray(plans)[0, :6], 6)
    assert np.allclose(alone.worlds.evader[-1], chases.world.evader[0], atol=1e-6)
    assert np.allclose(alone.worlds.pursuers[-1], chases.world.pursuers[0], atol=1e-6)
    assert len(np.unique(np.asarray(alone.nominal), axis=0)) == 3


@pytest.mark.slow
def test_planned_attack_drives_what_it_planned():
    """The plans, played alone, come as near as they said."""
    starts, knots, _ = searched(UNSHIELDED)
    chases, wheels = chase_with_plans(UNSHIELDED, PLANNING, starts, knots, 32, "capture", jax.random.key(3))
    assert np.any(np.asarray(chases.outcome) == 0)
    for number in range(3):
        steps = int(chases.tally.steps[number])
        world = jax.tree.map(lambda leaf, number=number: np.asarray(leaf[number]), starts)
        driven = wheels[number, :steps]
        alone = play(EMPTY, UNSHIELDED.policy, UNSHIELDED.shield, world, driven, 32)
        assert alone.length == steps or int(chases.outcome[number]) == RUNNING
        least = np.min(np.asarray(alone.events.pursuer_clearance)[:steps])
        assert least == pytest.approx(float(chases.tally.pursuer_clearance[number]), abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ATTACKS)
def test_every_attack_breaks_the_papers_shield(name):
    target = Target(EMPTY, goal_seeking, make_shield("paper", EMPTY))
    attack = make_attack(name, 128, 400)
    state = attack.init(jax.random.key(0))
    captured = 0
    for number in range(3):
        state, result = attack.round(target, "capture", state, jax.random.key(number))
        captured += int(np.sum(result.outcome == 0))
    assert captured > 0


@pytest.mark.slow
def test_the_sampling_margin_is_what_a_sideswipe_costs():
    """Ordinary starts, 20 Hz, and a pursuer that swings in within a period."""
    margin = float(sampling_margin(EMPTY))
    # Rows that keep the capture distance itself: the shield of a scenario that is smaller by the margin.
    smaller = load_scenario(
        "paper", obstacle_count=0, capture_distance=float(EMPTY.capture_distance) - margin
    )

    def clearances(shield):
        attack, target = make_attack("sideswipe", 256, 1200), Target(EMPTY, goal_seeking, shield)
        rounds = [attack.round(target, "capture", None, jax.random.key(n))[1] for n in range(3)]
        return np.concatenate([result.pursuer_clearance for result in rounds])

    without, kept = clearances(make_shield("game", smaller)), clearances(make_shield("game", EMPTY))
    assert kept.min() > 0.0
    swung_at = without < margin
    assert swung_at.sum() > 100
    assert np.median((kept - without)[swung_at]) > 0.5 * margin
