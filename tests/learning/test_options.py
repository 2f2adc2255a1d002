"""Hazard: a training told something it cannot do, or something other than what was meant."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.commands.common import parse_overrides
from sidestep.learning import TD3, TrainingOptions, make_options, options_to_dict

SHARES = {"hindsight", "mirror", "discount", "target_rate", "anneal"}
NOT_NEGATIVE = {
    "exploration_noise",
    "reward_scale",
    "correction_penalty",
    "time_cost",
    "actor_learning_rate",
    "critic_learning_rate",
    "target_noise",
    "target_noise_clip",
    "last_layer_scale",
}
WHOLE = {
    "decision_steps",
    "batch_size",
    "updates_per_decision",
    "warmup_decisions",
    "replay_capacity",
    "policy_delay",
    "worlds",
}
OTHERS = {"hidden", "replay_action", "bound_values", "filter_gradients", "guided"}
ALL = {field.name for owner in (TD3, TrainingOptions) for field in dataclasses.fields(owner)} - {"algorithm"}

BAD = [
    *(
        (name, value)
        for name in sorted(SHARES | NOT_NEGATIVE)
        for value in (-0.1, math.nan, math.inf, "0.5", None, True)
    ),
    *((name, 1.5) for name in sorted(SHARES)),
    *(
        (name, value)
        for name in sorted(WHOLE)
        for value in (0, -3, 2.5, math.nan, math.inf, -math.inf, "4", None, True)
    ),
    *(("hidden", value) for value in ((), (0,), (16, -1), (16.0,), (True,), 16, "16", None, ((16,),))),
    *(("replay_action", value) for value in ("both", "", None, 1, ["proposed"])),
    *((name, value) for name in ("bound_values", "filter_gradients") for value in (1, 0, "true", None)),
    *(("guided", value) for value in (-0.1, 1.0, math.nan, "0.5", None, True)),
]


def test_every_option_is_tested_here():
    assert SHARES | NOT_NEGATIVE | WHOLE | OTHERS == ALL


@pytest.mark.parametrize("name, value", BAD)
def test_bad_value_is_refused_with_its_name_and_itself(name, value):
    with pytest.raises(ValueError, match=f"'{name}' = ") as error:
        make_options(**{name: value})
    assert repr(value) in str(error.value)


@pytest.mark.parametrize(
    "wrong, meant", [("discout", "discount"), ("batchsize", "batch_size"), ("algorithm", None)]
)
def test_unknown_option_is_refused_with_a_guess_at_what_was_meant(wrong, meant):
    with pytest.raises(ValueError, match=f"unknown training option '{wrong}'") as error:
        make_options(**{wrong: 1})
    assert meant is None or f"did you mean '{meant}'" in str(error.value)


CHANGED = {
    **dict.fromkeys(sorted(SHARES), 0.25),
    **dict.fromkeys(sorted(NOT_NEGATIVE), 0.75),
    **dict.fromkeys(sorted(WHOLE), 7),
    "hidden": (8, 9, 10),
    "replay_action": "executed",
    "bound_values": False,
    "filter_gradients": True,
    "guided": 0.25,
}
COMPANIONS = {"filter_gradients": {"replay_action": "executed"}, "guided": {"worlds": 8}}
"""Options that make sense only beside others."""


@pytest.mark.parametrize("name", sorted(ALL))
def test_each_option_arrives_alone_and_comes_back_from_json(precision, name):
    companions = COMPANIONS.get(name, {})
    options, plain = make_options(**{name: CHANGED[name]}, **companions), make_options(**companions)
    stored = json.loads(json.dumps(options_to_dict(options)))
    assert set(stored) == ALL
    given = options_to_dict(plain) | {name: CHANGED[name]}
    assert given != options_to_dict(plain)
    assert options_to_dict(options) == given
    again = make_options(**stored)
    assert options_to_dict(again) == given
    assert jax.tree.structure(again) == jax.tree.structure(options)
    for ours, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(options), strict=True):
        assert ours.dtype == theirs.dtype == (np.float64 if precision else np.float32)
        assert ours == theirs


def test_learning_rates_fall_over_the_last_share_of_the_episodes_only(precision):
    options = make_options(anneal=0.25, actor_learning_rate=1e-3, critic_learning_rate=4e-3)
    for done, share in ((0, 1.0), (149, 1.0), (150, 1.0), (175, 0.525), (200, 0.05)):
        algorithm = options.after(jnp.asarray(done), jnp.asarray(200)).algorithm
        assert float(algorithm.actor_learning_rate) == pytest.approx(share * 1e-3)
        assert float(algorithm.critic_learning_rate) == pytest.approx(share * 4e-3)
    plain = make_options()
    for done in (0, 100, 200):
        # To the last bit.
        after = plain.after(jnp.asarray(done), jnp.asarray(200))
        assert all(np.array_equal(*pair) for pair in zip(*map(jax.tree.leaves, (plain, after)), strict=True))


@pytest.mark.parametrize("given", [{}, {"replay_action": "proposed"}])
def test_filter_between_actor_and_a_critic_of_proposed_actions_is_refused(given):
    """It would be filtered twice, and a price on corrections would never reach the actor."""
    with pytest.raises(ValueError, match=r"'filter_gradients' = True.*replay_action='executed'"):
        make_options(filter_gradients=True, **given)
    with pytest.raises(ValueError, match="filter_gradients"):
        TrainingOptions(filter_gradients=True, **given)


def test_what_the_command_line_is_told_about_corrections_arrives():
    written = ("correction_penalty=2.5", "replay_action=executed", "filter_gradients=true")
    stored = options_to_dict(make_options(**parse_overrides(written)))
    assert stored["correction_penalty"] == 2.5
    assert stored["replay_action"] == "executed"
    assert stored["filter_gradients"] is True


def test_ends_of_ranges_are_allowed():
    for name in SHARES | NOT_NEGATIVE:
        make_options(**{name: 0.0})
        make_options(**{name: 0})
    for name in SHARES:
        make_options(**{name: 1})
    for name in WHOLE:
        make_options(**{name: 1})


@pytest.mark.parametrize("name", sorted(WHOLE))
def test_whole_number_written_as_a_float_still_counts(name):
    """JSON from elsewhere writes 10 as 10.0; as a float it would fail in the middle of the first compile."""
    options = make_options(**{name: 10.0})
    value = options_to_dict(options)[name]
    assert value == 10
    assert isinstance(value, int)


def test_numbers_from_numpy_are_numbers():
    options = make_options(discount=np.float32(0.5), batch_size=np.int64(32), hidden=(np.int64(8), 8))
    assert options_to_dict(options)["discount"] == 0.5
    assert options.batch_size == 32
    assert json.loads(json.dumps(options_to_dict(options)))["hidden"] == [8, 8]


def test_value_too_large_for_the_precision_is_refused():
    """It would be infinite in float32, and every weight NaN after the first update."""
    with pytest.raises(ValueError, match="'reward_scale' = 1e\\+60"):
        make_options(reward_scale=1e60)
