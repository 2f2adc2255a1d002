"""Hazards of verdicts: blaming an assumption that held, or excusing what no assumption excuses."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.safety import Status
from sidestep.trials.falsification import ASSUMPTIONS, certified_clearance, judge
from sidestep.world import Scenario, load_scenario

PAPER = Scenario()


def with_depth(trajectory, clearance):
    """The same capture, but `clearance` m deep."""
    values = jnp.maximum(trajectory.events.pursuer_clearance, clearance).at[-1].set(clearance)
    return eqx.tree_at(lambda t: t.events.pursuer_clearance, trajectory, values)


def collision(trajectory, *, infeasible, depth=1e-3):
    """The same episode, but lost to an obstacle, `depth` m deep."""
    status = jnp.full(trajectory.length, Status.INFEASIBLE if infeasible else Status.CORRECTED)
    events = trajectory.events
    return eqx.tree_at(
        lambda t: (t.events.captured, t.events.collided, t.events.obstacle_clearance, t.status),
        trajectory,
        (events.collided, events.captured, events.obstacle_clearance.at[-1].set(-depth), status),
    )


def test_paper_shield_loses_by_what_its_row_takes_for_granted(chase):
    assert judge(PAPER, "paper", chase()).assumption == "row"
    assert judge(PAPER, "paper", chase(reverse=True)).assumption == "forwards"
    lost = chase()
    across = eqx.tree_at(lambda t: t.worlds.pursuers, lost, lost.worlds.pursuers.at[..., 2].set(jnp.pi / 2))
    assert judge(PAPER, "paper", across).assumption == "straight"


@pytest.mark.parametrize("shield", ["game", "joint:look-ahead"])
def test_shallow_capture_is_put_down_to_sampling(chase, shield):
    verdict = judge(PAPER, shield, with_depth(chase(), -1e-4))
    assert verdict.assumption == "sampling"
    assert not verdict.inside
    assert "0.1 mm" in verdict.words
    assert "50 ms" in verdict.words


def test_certificate_decides_how_deep_sampling_may_go(chase):
    lost = with_depth(chase(), -1e-4)
    excused = judge(PAPER, "game", lost, guaranteed_clearance=-2e-4)
    assert excused.assumption == "sampling"
    for guaranteed in (-5e-5, 0.0, 1e-3):
        verdict = judge(PAPER, "game", lost, guaranteed_clearance=guaranteed)
        assert verdict.inside
        assert verdict.assumption is None


def test_a_shield_by_a_table_is_judged_by_the_table(chase):
    scenario = load_scenario("paper-0.15")
    lost = collision(chase(), infeasible=True)
    start = jnp.asarray(lost.worlds.evader[0])

    def with_obstacles(*places):
        """Every world with obstacles there, relative to the start, at rest."""
        robots = jnp.asarray([[*(start + jnp.asarray(place)), 0.0, 0.0] for place in places])
        everywhere = jnp.broadcast_to(robots, (len(lost.worlds.evader), *robots.shape))
        return eqx.tree_at(lambda t: t.worlds.obstacles, lost, everywhere)

    assert judge(scenario, "joint", with_obstacles((0.201, 0.0))).assumption == "start"
    assert judge(scenario, "joint", with_obstacles((0.0, 3.0))).assumption == "table"
    two = load_scenario("paper-0.15", obstacle_count=2)
    assert judge(two, "joint", with_obstacles((0.0, 3.0), (0.5, 3.0))).assumption == "gaps"
    assert judge(two, "joint", with_obstacles((0.0, 3.0), (2.0, 3.0))).assumption == "table"
    # Its other form keeps the rows.
    assert judge(scenario, "joint:look-ahead", with_obstacles((0.0, 3.0))).assumption == "alone"
    assert certified_clearance(scenario, "joint") is None
    assert certified_clearance(scenario, "joint:look-ahead") is not None


def test_what_a_shield_keeps_is_computed_only_where_it_promises_something():
    for scenario, shield in (
        (PAPER, "paper"),
        (PAPER, "none"),
        (Scenario(pursuer_count=2), "game"),
        (Scenario(pursuer_half_axle=0.1), "game"),
    ):
        assert certified_clearance(scenario, shield) is None
    kept = certified_clearance(PAPER, "game")
    # A swing from beside gains V^2 T^2/(8 b) = 0.06 mm, so no less can be promised away.
    assert -0.2 <= kept < -6e-5


def test_capture_at_a_control_period_short_enough_is_inside_the_assumptions(chase):
    lost = with_depth(chase(), -1e-4)
    # T_est / 2 = b m/(V l) is 3.1 ms at the paper's numbers.
    assert judge(Scenario(control_period=0.004), "game", lost).assumption == "sampling"
    assert judge(Scenario(control_period=0.002), "game", lost).inside


def test_touch_by_rounding_is_no_capture_to_worry_about(chase):
    assert judge(PAPER, "game", with_depth(chase(), -1e-7)).assumption == "rounding"
    assert judge(PAPER, "game", with_depth(chase(), -1e-7), guaranteed_clearance=0.0).assumption == "rounding"
    assert judge(PAPER, "game", with_depth(chase(), -1e-4), guaranteed_clearance=0.0).inside


def test_start_inside_the_capture_set_proves_nothing(chase):
    # The apex lies l/rho - l = 0.054 m ahead of the disc.
    verdict = judge(PAPER, "game", chase(gap=0.05))
    assert verdict.assumption == "start"
    assert "capture set" in verdict.words
    assert judge(PAPER, "game", chase(gap=0.06)).assumption != "start"


def test_start_inside_an_obstacle_proves_nothing(chase):
    lost = chase()
    worlds = eqx.tree_at(lambda w: w.obstacles, lost.worlds, 0.1 * lost.worlds.obstacles)
    verdict = judge(PAPER, "game", eqx.tree_at(lambda t: t.worlds, lost, worlds))
    assert verdict.assumption == "start"
    assert "obstacle" in verdict.words


def test_several_pursuers_are_outside_the_guarantee(chase):
    assert judge(Scenario(pursuer_count=2), "game", chase(pursuers=2)).assumption == "one-pursuer"


def test_pursuer_that_wins_is_outside_the_guarantee(chase):
    verdict = judge(Scenario(pursuer_half_axle=0.1), "game", chase())
    assert verdict.assumption == "winner"
    assert "0.1004" in verdict.words


def test_numbers_that_are_not_finite_are_named(chase):
    lost = chase()
    status = lost.status.at[3].set(Status.INVALID)
    assert judge(PAPER, "game", eqx.tree_at(lambda t: t.status, lost, status)).assumption == "finite"


@pytest.mark.parametrize("shield", ["paper", "game", "joint:look-ahead"])
def test_collision_is_excused_only_where_the_rows_could_not_all_hold(chase, shield):
    assert judge(PAPER, shield, collision(chase(), infeasible=True)).assumption == "alone"
    assert judge(PAPER, shield, collision(chase(), infeasible=False)).inside
    touched = collision(chase(), infeasible=False, depth=1e-8)
    assert judge(PAPER, shield, touched).assumption == "rounding"


def test_a_table_for_some_seconds_answers_for_no_more_than_it_says(chase):
    """That of `paper` keeps 2.1 mm less than the capture distance, for 4 s at a time."""
    verdict = judge(PAPER, "joint", with_depth(chase(), -1e-4))
    assert verdict.assumption == "sampling"
    assert "2.12 mm cannot be ruled out" in verdict.words
    assert judge(PAPER, "joint", with_depth(chase(), -1e-7)).assumption == "rounding"
    assert judge(PAPER, "joint", with_depth(chase(), -4e-3)).assumption == "in-time"
    verdict = judge(PAPER, "joint", collision(chase(), infeasible=False))
    assert verdict.assumption == "in-time"
    assert "is for 4 s at a time" in verdict.words


def test_obstacle_faster_than_the_evader_is_named(chase):
    lost = collision(chase(), infeasible=False)
    rocks = lost.worlds.obstacles.at[..., 2].set(0.16)
    fast = eqx.tree_at(lambda t: t.worlds.obstacles, lost, rocks)
    assert judge(PAPER, "game", fast).assumption == "slow-obstacles"


def test_shield_that_promises_nothing_cannot_break_its_word(chase):
    assert judge(PAPER, "none", chase()).assumption == "promise"
    verdict = judge(PAPER, "mine", chase())
    assert verdict.assumption == "promise"
    assert "'mine'" in verdict.words


def test_safe_episode_is_not_judged(chase):
    with pytest.raises(ValueError, match="neither captured nor collided"):
        judge(PAPER, "game", chase(steps=10))


def test_every_verdict_names_a_known_assumption(chase):
    verdicts = [
        judge(PAPER, shield, lost)
        for shield in ("none", "paper", "game")
        for lost in (chase(), chase(reverse=True), chase(gap=0.02), collision(chase(), infeasible=True))
    ]
    assert {verdict.assumption for verdict in verdicts} <= set(ASSUMPTIONS)
    assert all(verdict.words for verdict in verdicts)
    assert np.all([not verdict.inside for verdict in verdicts])
