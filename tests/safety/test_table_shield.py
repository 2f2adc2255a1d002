"""Hazards of the shield `joint` by its clearance table: a promise it does not keep, a table of another game,
numbers that are not finite, robots it has no table for."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep import evaluate, goal_seeking, load_scenario, make_pursuer, make_shield
from sidestep.safety import Budget, JointShield, Status, TableShield, name_of
from sidestep.safety.clearance import ClearanceGame, shipped_table
from sidestep.store.runs import OUTCOMES
from sidestep.trials.falsification.attackers import JointSaddle
from sidestep.trials.falsification.chases import Target, run_from
from sidestep.world import World

SCENARIO = load_scenario("paper-0.15")
SHIELD = make_shield("joint:table", SCENARIO)
ASK = eqx.filter_jit(lambda shield, world, nominal: shield(world, nominal, shield.init(world))[0])
AFTER = eqx.filter_jit(
    lambda shield, world, actions: jax.vmap(lambda u: shield._margin_after(world, u))(actions)
)
"""Margins after a period, (n, 2), of actions (n, 2)."""


def world_of(evader, obstacle):
    """The pursuer at the origin, facing along x."""
    parts = (evader, [[0.0, 0.0, 0.0]], [[*obstacle, 0.0, 0.0]], [1.0, 0.0])
    return World(*(jnp.asarray(part) for part in parts))


PINNED = world_of([0.2, 0.0], [0.55, 0.1])
"""Ahead of the pursuer, with an obstacle behind."""


def test_joint_takes_the_table_where_one_is_shipped_and_looks_ahead_elsewhere():
    joint = make_shield("joint", SCENARIO)
    assert isinstance(joint, TableShield)
    assert isinstance(make_shield("joint", load_scenario("paper-0.10")), TableShield)
    assert isinstance(make_shield("joint", load_scenario("paper", control_period=0.1)), JointShield)
    assert isinstance(make_shield("joint:look-ahead", SCENARIO), JointShield)
    assert isinstance(make_shield("joint:table", SCENARIO), TableShield)
    # What its table cannot keep is left to the look-ahead: of 10,000 chases by nash 136 were lost without it.
    assert isinstance(joint.otherwise, JointShield)
    assert joint.looks_ahead
    assert float(joint.otherwise.scenario.capture_distance) == pytest.approx(0.151)
    assert SHIELD.otherwise is None
    # On robots with errors and slow motors looking ahead was safer.
    assert isinstance(make_shield("joint", SCENARIO, Budget(position_error=0.001)), JointShield)
    assert not SHIELD.looks_ahead
    # So does a table for some seconds.
    paper = make_shield("joint", load_scenario("paper"))
    assert isinstance(paper, TableShield)
    assert paper.table.periods * 0.05 == pytest.approx(4.0)
    assert isinstance(paper.otherwise, JointShield)
    assert paper.looks_ahead
    # An evader that has it easier is served too: faster, a smaller obstacle, a slower drift.
    easier = load_scenario("paper-0.15", evader_speed=0.17, collision_distance=0.15)
    assert isinstance(make_shield("joint", easier), TableShield)


def test_in_a_crowd_joint_looks_ahead_and_elsewhere_it_goes_by_the_table():
    scenario = load_scenario("paper-0.15", obstacle_count=2)
    joint = make_shield("joint", scenario)
    forms = {name: make_shield(name, scenario) for name in ("joint:table", "joint:look-ahead")}
    assert forms["joint:table"].otherwise is None
    assert joint.looks_ahead
    nominal = jnp.array([0.1574, 0.0])

    def answers(second):
        world = eqx.tree_at(
            lambda w: w.obstacles, PINNED, jnp.concatenate([PINNED.obstacles, jnp.asarray([second])])
        )
        return {name: ASK(shield, world, nominal) for name, shield in {"joint": joint, **forms}.items()}

    crowd = answers([0.5, -0.45, 0.0, 0.0])
    np.testing.assert_allclose(crowd["joint"].action, crowd["joint:look-ahead"].action, atol=1e-6)
    assert np.linalg.norm(np.asarray(crowd["joint"].action - crowd["joint:table"].action)) > 1e-3
    alone = answers([5.0, -0.45, 0.0, 0.0])
    np.testing.assert_allclose(alone["joint"].action, alone["joint:table"].action, atol=1e-6)
    assert int(alone["joint"].status) == Status.CORRECTED


def test_names_lead_back_to_the_same_shield():
    assert name_of(SHIELD, SCENARIO) == "joint:table"
    assert name_of(make_shield("joint:look-ahead", SCENARIO), SCENARIO) == "joint:look-ahead"
    paper = load_scenario("paper")
    assert name_of(make_shield("joint", paper), paper) == "joint"
    assert name_of(eqx.tree_at(lambda s: s.gain, SHIELD, jnp.asarray(2.0)), SCENARIO) is None


@pytest.mark.parametrize(
    "changes, why",
    [
        ({"pursuer_speed": 0.25}, r"pursuer_speed is 0\.25, the table's 0\.2"),
        ({"capture_distance": 0.16}, r"capture_distance is 0\.16, the table's 0\.15"),
        ({"control_period": 0.1}, r"control_period is 0\.1, the table's 0\.05"),
        ({"obstacle_velocity": (0.03, 0.0)}, r"obstacle_speed is 0\.03, the table's 0\.02"),
        ({"action": "heading"}, "its evader cannot stop"),
    ],
)
def test_a_table_of_another_game_is_refused(changes, why):
    with pytest.raises(ValueError, match=f"does not serve this scenario: .*{why}"):
        TableShield(load_scenario("paper-0.15", **changes), shipped_table(SCENARIO))


def test_where_the_pursuer_wins_there_is_no_table_and_it_says_so():
    with pytest.raises(ValueError, match=r"no design angle keeps the pursuer 0\.3 m away"):
        make_shield("joint:table", load_scenario("paper", capture_distance=0.3))


PAPER = load_scenario("paper")


def test_nearly_the_capture_distance_is_kept_where_the_whole_one_cannot_be():
    """At the paper's distance nobody keeps 0.2 m for ever at 20 Hz; the table is for nearly as much."""
    table = shipped_table(PAPER)
    assert 0.195 < table.game.capture_distance < 0.1983
    assert table.game.capture_distance + table.game.shortfall == pytest.approx(0.2)
    assert table.game == ClearanceGame.of(PAPER, spare=table.game.spare, nearest=True)
    # A table for ever goes first where both serve.
    assert shipped_table(load_scenario("paper-0.15")).periods is None
    # The shield asks for the whole distance.
    world = world_of([0.0, 0.2005], [2.0, 2.0])
    assert float(TableShield(PAPER, table, spare_pursuer=0.0).margin(world)) == pytest.approx(5e-4, abs=1e-5)


def test_pursuers_go_first_where_not_both_margins_can_be_kept():
    """Pinned ahead of the pursuer with an obstacle close behind: the evader stays free of the pursuer."""
    shield = make_shield("joint:table", PAPER)
    world = world_of([0.2535, 0.0], [0.46, 0.01])
    result = ASK(shield, world, jnp.array([-0.1574, 0.0]))
    assert int(result.status) == Status.INFEASIBLE
    options = 0.1574 * jnp.stack([jnp.cos(a := jnp.linspace(-3.1, 3.1, 100)), jnp.sin(a)], -1)
    after = np.asarray(AFTER(shield, world, options))
    (got,) = np.asarray(AFTER(shield, world, result.action[None]))
    assert got[0] >= min(after[:, 0].max(), 0.0) - 1e-4
    assert got[1] < 0.0


def test_what_the_table_cannot_keep_is_left_to_the_look_ahead():
    joint, world = make_shield("joint", PAPER), world_of([0.2535, 0.0], [0.46, 0.01])
    nominal = jnp.array([-0.1574, 0.0])
    one, other = ASK(joint, world, nominal), ASK(make_shield("joint:look-ahead", PAPER), world, nominal)
    np.testing.assert_allclose(one.action, other.action, atol=1e-6)


def test_a_budget_and_slow_motors_are_kept_by_the_table_too():
    budget = Budget(position_error=0.004, tracking_error=0.002)
    plain = make_shield("joint:table", SCENARIO)
    careful = make_shield("joint:table", SCENARIO, budget)
    assert float(plain.margin(PINNED) - careful.margin(PINNED)) == pytest.approx(0.0041, abs=1e-5)
    # An evader that drives at the pursuer does not stop at once.
    world = dataclasses.replace(PINNED, evader_velocity=jnp.array([-0.1574, 0.0]))
    slow = plain.with_acceleration(1.0)
    stop = jnp.zeros(2)
    # 25 mm less speed after half of the period: 1/2 a T^2 is gained on driving on.
    gained = slow._margin_after(world, stop)[0] - slow._margin_after(world, jnp.array([-0.1574, 0.0]))[0]
    assert float(gained) == pytest.approx(0.5 * 1.0 * 0.05**2, rel=0.3)
    assert float(plain._margin_after(world, stop)[0]) > float(slow._margin_after(world, stop)[0]) + 0.004


def test_an_unhindered_action_passes_and_a_deadly_one_does_not():
    free = dataclasses.replace(PINNED, pursuers=jnp.array([[-3.0, 0.0, 0.0]]))
    nominal = jnp.array([0.1, 0.05])
    result = ASK(SHIELD, free, nominal)
    assert int(result.status) == Status.OK
    np.testing.assert_array_equal(result.action, nominal)
    assert float(result.intervention) == 0.0
    towards = jnp.array([-0.1574, 0.0])
    result = ASK(SHIELD, PINNED, towards)
    assert int(result.status) == Status.CORRECTED
    assert float(jnp.linalg.norm(result.action)) <= 0.1574 * (1 + 1e-5)
    assert float(result.intervention) == pytest.approx(float(jnp.linalg.norm(result.action - towards)))
    # The barriers say how much is left to both.
    assert result.barriers.shape == (2,)
    assert np.all(np.asarray(result.barriers) > 0.0)


def test_the_nearest_velocity_that_keeps_the_margin_is_taken_among_all_it_may_choose():
    generator, margin_of = np.random.default_rng(0), jax.jit(lambda world: SHIELD.margin(world))
    checked = 0
    for _ in range(40):
        angle, distance = generator.uniform(-math.pi, math.pi), generator.uniform(0.24, 0.6)
        obstacle = [0.22 + distance * math.cos(angle), 0.03 + distance * math.sin(angle)]
        world = world_of([0.22, 0.03], obstacle)
        least = float(margin_of(world))
        if least < 0.0:
            continue
        nominal = 0.15 * np.array([math.cos(angle), math.sin(angle)])
        result = ASK(SHIELD, world, nominal)
        margin = float(jnp.min(AFTER(SHIELD, world, result.action[None])))
        assert margin >= 0.0
        if int(result.status) == Status.CORRECTED and margin >= 0.8 * least:
            checked += 1
            # No full or half speed among 200 headings is nearer by more than the grid of headings.
            headings = np.linspace(-math.pi, math.pi, 200)
            for speed in (0.1574, 0.0787):
                others = speed * np.stack([np.cos(headings), np.sin(headings)], -1)
                after = np.min(np.asarray(AFTER(SHIELD, world, jnp.asarray(others))), axis=-1)
                nearer = np.linalg.norm(others - nominal, axis=-1) < float(result.intervention) - 0.012
                assert not np.any(after[nearer] >= 0.8 * least + 1e-5)
    assert checked


@pytest.mark.parametrize("part", ["nominal", "pursuer", "obstacle", "evader"])
def test_numbers_that_are_not_finite_are_reported_and_never_driven(part):
    world, nominal = PINNED, jnp.array([-0.1, 0.0])
    if part == "nominal":
        nominal = jnp.array([jnp.nan, 0.0])
    elif part == "pursuer":
        world = eqx.tree_at(lambda w: w.pursuers, world, world.pursuers.at[0, 2].set(jnp.nan))
    elif part == "obstacle":
        world = eqx.tree_at(lambda w: w.obstacles, world, world.obstacles.at[0, 0].set(jnp.inf))
    else:
        world = eqx.tree_at(lambda w: w.evader, world, world.evader.at[0].set(jnp.nan))
    result = ASK(SHIELD, world, nominal)
    assert int(result.status) == Status.INVALID
    assert np.all(np.isfinite(result.action))
    assert float(jnp.linalg.norm(result.action)) <= 0.1574 * (1 + 1e-5)
    if part == "obstacle":
        # What is known is still kept.
        alone = eqx.tree_at(lambda w: w.obstacles, PINNED, jnp.array([[50.0, 0.0, 0.0, 0.0]]))
        assert float(jnp.min(SHIELD._margin_after(alone, result.action))) >= 0.0


@pytest.mark.parametrize(
    "pursuers, obstacles",
    [(1, 0), pytest.param(1, 2, marks=pytest.mark.slow), pytest.param(2, 3, marks=pytest.mark.slow)],
)
def test_any_number_of_robots(pursuers, obstacles):
    scenario = load_scenario("paper-0.15", pursuer_count=pursuers, obstacle_count=obstacles)
    shield = make_shield("joint", scenario)
    assert isinstance(shield, TableShield)
    assert isinstance(shield.otherwise, JointShield)
    if obstacles < 3:
        count = 4 if obstacles else 40
        result = evaluate(scenario, goal_seeking, shield, "nash", count, jax.random.key(0))
        assert result.safe == count
        assert result.reached >= 0.9 * count
    worlds = jax.vmap(scenario.reset)(jax.random.split(jax.random.key(1), 3))
    nominal = jnp.full((3, 2), 0.1)
    together = eqx.filter_jit(jax.vmap(ASK, in_axes=(None, 0, 0)))(shield, worlds, nominal)
    for i in range(3):
        alone = ASK(shield, jax.tree.map(lambda leaf, i=i: leaf[i], worlds), nominal[i])
        np.testing.assert_allclose(together.action[i], alone.action, atol=1e-6)
        assert together.barriers.shape == (3, pursuers + obstacles)


def test_the_derivative_is_that_of_an_accepted_action_and_none_of_a_corrected_one():
    free = dataclasses.replace(PINNED, pursuers=jnp.array([[-3.0, 0.0, 0.0]]))
    jacobian = jax.jacobian(lambda nominal, world: ASK(SHIELD, world, nominal).action)
    np.testing.assert_allclose(jacobian(jnp.array([0.1, 0.05]), free), np.eye(2), atol=1e-6)
    np.testing.assert_array_equal(jacobian(jnp.array([-0.1574, 0.0]), PINNED), np.zeros((2, 2)))
    assert SHIELD.rows_only is not SHIELD


def _chased(shield, drift, count=48, seconds=20.0):
    """Outcomes against the table's own worst case, an obstacle that hunts the evader, from within the set."""
    periods = round(seconds / 0.05)
    scenario = load_scenario(
        "paper-0.15",
        obstacle_velocity=(drift, 0.0),
        obstacle_motion="adversarial",
        episode_steps=periods,
    )
    # Whatever happens at the target, the chase goes on.
    scenario = eqx.tree_at(lambda s: s.reach_distance, scenario, jnp.asarray(-1.0))
    worlds = jax.vmap(scenario.reset)(jax.random.split(jax.random.key(0), 4 * count))
    # Pursuer and obstacle close to the evader, which presses at the obstacle.
    generator = np.random.default_rng(0)
    angles, shares = generator.uniform(-math.pi, math.pi, (2, 4 * count)), generator.random((2, 4 * count))
    away = np.stack([np.cos(angles), np.sin(angles)], -1)
    pursuer = worlds.evader + (0.15 + 0.3 * shares[0])[:, None] * away[0]
    obstacle = worlds.evader + (0.2 + 0.4 * shares[1])[:, None] * away[1]
    worlds = eqx.tree_at(
        lambda w: (w.pursuers, w.obstacles, w.target),
        worlds,
        (
            worlds.pursuers.at[:, 0, :2].set(pursuer),
            worlds.obstacles.at[:, 0, :2].set(obstacle),
            jnp.asarray(obstacle),
        ),
    )
    least = jax.jit(jax.vmap(lambda world: SHIELD.margin(world)))(worlds)
    some = np.flatnonzero(np.asarray(least) >= 0.0)[:count]
    worlds = jax.tree.map(lambda leaf: leaf[some], worlds)
    if isinstance(shield, TableShield):
        # Too fast a drift for the table is tried too.
        shield = eqx.tree_at(lambda s: s.scenario, shield, scenario)
    target = Target(scenario, goal_seeking, shield)
    pull = jax.random.uniform(jax.random.key(1), (count, 2), dtype=float) * jnp.array([0.1, 0.02])
    chases, _ = run_from(
        target,
        lambda pull: JointSaddle(SHIELD.table, pull),
        pull,
        worlds,
        periods,
        jax.random.split(jax.random.key(2), count),
    )
    return [OUTCOMES[i] if i >= 0 else "running" for i in np.asarray(chases.outcome)]


@pytest.mark.slow
def test_the_look_ahead_leaves_to_the_table_what_it_keeps_towards_pursuers():
    # A chase that was lost by 0.02 mm after 2.35 s.
    world = World(
        evader=jnp.array([-0.44163018465042114, -0.197444349527359]),
        pursuers=jnp.array([[-0.35329869389533997, -0.5621863007545471, -2.421478509902954]]),
        obstacles=jnp.array([[-0.1029361933469, -0.2546027600765, -0.0055933087132, -0.0192019492387]]),
        target=jnp.array([-0.14220383763313293, -0.4563651978969574]),
    )
    shield = make_shield("joint", SCENARIO)
    target = Target(SCENARIO, goal_seeking, shield)
    worlds = jax.tree.map(lambda leaf: leaf[None], world)
    keys = jax.random.split(jax.random.key(0), 1)
    nash = make_pursuer("nash")
    chases, _ = run_from(target, lambda _: nash, jnp.zeros(1), worlds, 60, keys)
    assert float(chases.tally.pursuer_clearance[0]) > 0.0002
    assert float(chases.tally.obstacle_clearance[0]) > 0.0


@pytest.mark.slow
def test_the_tables_own_worst_case_and_a_hunting_obstacle_lose_to_it_and_beat_the_rows():
    assert set(_chased(SHIELD, 0.02)) == {"timed_out"}
    behind_rows = _chased(make_shield("game", SCENARIO), 0.02)
    assert sum(outcome in ("captured", "collided") for outcome in behind_rows)
