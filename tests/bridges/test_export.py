"""Hazard: the robot's small computer decides otherwise than what was trained and tested."""

import io
import json
import subprocess
import sys
import zipfile
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.bridges.export import export_jax, export_onnx
from sidestep.learning import Actor, LearnedPolicy, write_policy
from sidestep.loop.step import decide
from sidestep.safety import Budget, GameShield, Status, make_shield
from sidestep.store.runs import create_run
from sidestep.world import World, load_scenario, observation_size, observe
from sidestep.world.loading import scenario_to_dict

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

STATES = 100_000
SAME = 1e-5
"""m/s within which two answers are the same."""
TOUCHING = 3e-3
"""m/s within which they are where a line just touches the disc, and the square root of rounding counts."""
ON_AXIS = 1e-6
"""m from a pursuer's axis within which rounding may tell the sides apart otherwise."""
LEVEL = 2e-6
"""m/s within which they violate alike."""


def policy_for(scenario):
    return LearnedPolicy(Actor(observation_size(scenario), 2, (32, 32), jax.random.key(1), 4.0), 10)


def session(path):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def worlds(scenario, count, seed):
    """States by name: from far to contact, a third on or next to a pursuer's axis, memories of both sides."""
    rng = np.random.default_rng(seed)
    m, k = scenario.pursuer_count, scenario.obstacle_count

    def around(evader, robots):
        distance, angle = (
            10 ** rng.uniform(-2, 0.6, (count, robots)),
            rng.uniform(-np.pi, np.pi, (count, robots)),
        )
        offset = distance[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        return evader[:, None] + offset, angle

    evader = rng.uniform(-2, 2, (count, 2))
    places, angle = around(evader, m)
    heading = rng.uniform(-np.pi, np.pi, (count, m))
    aside = 10 ** rng.uniform(-9, -1, (count, m)) * rng.choice([-1, 0, 1], (count, m))
    on_axis = rng.random((count, m)) < 1 / 3
    heading = np.where(on_axis, angle + np.pi * rng.integers(0, 2, (count, m)) + aside, heading)
    obstacles = np.concatenate([around(evader, k)[0], 0.1 * rng.normal(size=(count, k, 2))], -1)
    state = {
        "evader": evader,
        "pursuers": np.concatenate([places, heading[..., None]], -1),
        "obstacles": obstacles,
        "target": evader + rng.normal(size=(count, 2)) * 10 ** rng.uniform(-3, 0.5, (count, 1)),
        "sides": rng.choice([-1.0, 1.0], (count, m)),
    }
    state = {name: value.astype(np.float32) for name, value in state.items()}
    # Dead ahead in the world's own axes, where rounding moves nothing; contact; the target reached.
    state["evader"][:50], state["pursuers"][:50, 0] = 0.0, [0.7, 0.0, np.pi]
    state["pursuers"][50:80, 0, :2] = state["evader"][50:80]
    state["obstacles"][80:110, 0, :2] = state["evader"][80:110]
    state["target"][110:140] = state["evader"][110:140]
    # Next to the tips of the capture set, in what the rows keep beyond it and inside it.
    spare = 1e-3 * np.where(
        rng.random(200) < 0.5, rng.uniform(0.02, 0.36, 200), rng.uniform(-0.5, -0.02, 200)
    )
    across = rng.uniform(-1.1e-3, 1.1e-3, 200)
    tip = float(scenario.capture_distance) + spare - np.abs(across) * np.sin(float(scenario.usable_angle))
    ahead = rng.choice([-1, 1], 200) * tip / np.cos(float(scenario.usable_angle))
    state["evader"][140:340] = 0.0
    state["pursuers"][140:340, 0] = np.stack([-ahead, -across, 0.0 * across], -1)
    return state


def spoilt(state, seed):
    """The same states, each with one number that is none."""
    rng = np.random.default_rng(seed)
    state = {name: value.copy() for name, value in state.items()}
    names = [name for name in state if name != "sides"]
    for index in range(len(state["evader"])):
        entry = state[names[index % len(names)]][index].reshape(-1)
        entry[rng.integers(entry.size)] = rng.choice([np.nan, np.inf, -np.inf])
    return state


def aside_of(state):
    """How far the evader is from each pursuer's axis, m."""
    offset = state["evader"][:, None].astype(float) - state["pursuers"][..., :2]
    heading = state["pursuers"][..., 2].astype(float)
    with np.errstate(invalid="ignore"):
        return np.cos(heading) * offset[..., 1] - np.sin(heading) * offset[..., 0]


def reference(scenario, shield, policy, state):
    """Our shield's answers; `wish` in the state is the nominal velocity where there is no policy.

    A target that is no number is a wish that is none: `observe` takes it for one that has been reached.
    """

    @jax.jit
    @jax.vmap
    def answer(state):
        target = state.get("target", state["evader"])
        world = World(state["evader"], state["pursuers"], state["obstacles"], target)
        known = jnp.all(jnp.isfinite(target))
        nominal = (
            state["wish"] if policy is None else jnp.where(known, decide(scenario, policy, world), jnp.nan)
        )
        result, sides = shield(world, nominal, state["sides"])
        rows = shield.rows(world, sides)
        return nominal, result.action, result.status, sides, rows.normals, rows.offsets

    names = ("nominal", "velocity", "status", "sides", "normals", "offsets")
    return SimpleNamespace(**dict(zip(names, map(np.asarray, answer(state)), strict=True)))


def answers(path, state):
    velocity, status, sides = session(path).run(None, state)
    return SimpleNamespace(velocity=velocity, status=status, sides=sides)


def assert_same_decisions(ours, theirs, aside, hard, speed):
    """By status, by distance to the wish and by what the rows are kept by: two answers that are equally near,
    or violate equally little, are both right."""
    np.testing.assert_array_equal(theirs.status, ours.status)
    assert np.all((theirs.sides == ours.sides) | (np.abs(aside) < ON_AXIS) | ~np.isfinite(aside))
    away = np.linalg.norm(theirs.velocity - ours.velocity, axis=1)
    possible = ours.status <= Status.CORRECTED
    same_sides = np.all((theirs.sides == ours.sides) | ~np.isfinite(aside), axis=1)
    assert np.mean(same_sides) > 0.999
    assert np.mean(away[possible & same_sides] > SAME) <= 0.01
    assert np.max(away[same_sides]) <= TOUCHING
    assert np.max(np.linalg.norm(theirs.velocity, axis=1)) <= speed * (1 + 1e-5)

    finite = ours.status != Status.INVALID

    def missed(velocity):
        # A row that is no number is no row.
        lack = np.nan_to_num(
            ours.offsets - np.einsum("bnc,bc->bn", ours.normals, velocity), nan=-1.0, neginf=-1.0, posinf=-1.0
        )
        return np.max(lack[:, :hard], axis=1), np.max(lack, axis=1)

    (hard_ours, all_ours), (hard_theirs, all_theirs) = missed(ours.velocity), missed(theirs.velocity)
    assert np.max((hard_theirs - np.maximum(hard_ours, 0.0))[finite & same_sides]) <= LEVEL
    assert np.max((all_theirs - np.maximum(all_ours, 0.0))[possible & same_sides]) <= LEVEL
    return np.sum(away > SAME)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """The paper's scenario with a policy, its exported policy + filter, states, and our shield's answers."""
    scenario = load_scenario("paper")
    policy, shield = policy_for(scenario), GameShield(scenario)
    path = tmp_path_factory.mktemp("export") / "robot.onnx"
    export_onnx(path, scenario, policy, run="a run")
    state = worlds(scenario, STATES, 0)
    broken = spoilt({name: value[:2000] for name, value in state.items()}, 1)
    everything = {name: np.concatenate([value, broken[name]]) for name, value in state.items()}
    ours = reference(scenario, shield, policy, everything)
    return SimpleNamespace(
        scenario=scenario, policy=policy, shield=shield, path=path, state=everything, ours=ours
    )


def test_policy_and_filter_decide_as_the_shield_does_on_100000_states(robot):
    theirs = answers(robot.path, robot.state)
    counts = np.bincount(robot.ours.status, minlength=4)
    assert counts[Status.INVALID] >= 1900
    assert np.all(counts > 0.01 * STATES)
    differing = assert_same_decisions(
        robot.ours, theirs, aside_of(robot.state), 1, float(robot.scenario.evader_speed)
    )
    # Only where rows cannot all hold.
    assert differing < 0.05 * STATES


def test_no_number_in_gives_a_finite_stop_as_near_as_the_rest_allows(robot):
    theirs = answers(robot.path, {name: value[STATES:] for name, value in robot.state.items()})
    assert np.all(theirs.status == Status.INVALID)
    assert np.all(np.isfinite(theirs.velocity))
    assert np.all(np.abs(theirs.sides) == 1.0)
    lost = np.isnan(robot.state["evader"][STATES:]).any(axis=1)
    assert lost.any()
    np.testing.assert_array_equal(theirs.velocity[lost], 0.0)


def test_numbers_whose_squares_overflow_are_no_numbers(robot):
    state = {name: value[:1].copy() for name, value in robot.state.items()}
    state["pursuers"][0, 0, 0] = 1e30
    theirs = answers(robot.path, state)
    assert theirs.status[0] == Status.INVALID
    assert np.all(np.isfinite(theirs.velocity))


def test_memory_of_zero_is_the_start_of_an_episode(robot):
    state = {name: value[:500].copy() for name, value in robot.state.items()}
    state["sides"][:] = 0.0
    aside = aside_of(state)
    told = np.abs(aside) > ON_AXIS
    np.testing.assert_array_equal(answers(robot.path, state).sides[told], np.sign(aside)[told])


def test_one_state_and_many_give_the_same(robot):
    several = {name: value[:64] for name, value in robot.state.items()}
    many, alone = answers(robot.path, several), session(robot.path)
    one = [alone.run(None, {name: value[i : i + 1] for name, value in several.items()}) for i in range(64)]
    velocity, status, _ = (np.concatenate(entries) for entries in zip(*one, strict=True))
    np.testing.assert_allclose(velocity, many.velocity, atol=SAME)
    np.testing.assert_array_equal(status, many.status)


@pytest.mark.parametrize("robots", [1, 2])
def test_filter_alone_with_a_budget_decides_as_the_shield_does(robots, tmp_path):
    scenario = load_scenario(
        "paper", pursuer_count=robots, obstacle_count=robots, arena_side=6.0, capture_distance=0.12
    )
    budget = Budget(position_error=0.004, heading_error=0.01, delay=0.02, tracking_error=0.005)
    shield = GameShield(scenario, budget)
    export_onnx(tmp_path / "filter.onnx", scenario, None, what="filter", shield=shield)
    state = worlds(scenario, 20_000, 2)
    rng = np.random.default_rng(3)
    # From slow to so fast that only the direction is left of it.
    size = float(scenario.evader_speed) * 10 ** rng.uniform(-2, 2, (20_000, 1))
    state["wish"] = (rng.normal(size=(20_000, 2)) * size).astype(np.float32)
    state["wish"][:20, 0] = np.nan
    del state["target"]
    ours = reference(scenario, shield, None, state)
    theirs = answers(tmp_path / "filter.onnx", state)
    assert_same_decisions(ours, theirs, aside_of(state), robots, float(scenario.evader_speed))
    assert np.all(ours.status[:20] == Status.INVALID)


def test_policy_alone_acts_as_trained_and_in_the_frame_of_the_world_too(tmp_path):
    scenario = load_scenario("paper", frame="world", obstacle_count=0)
    policy = policy_for(scenario)
    about = export_onnx(tmp_path / "policy.onnx", scenario, policy, what="policy")
    observations = np.random.default_rng(0).normal(size=(50, observation_size(scenario))).astype(np.float32)
    (actions,) = session(tmp_path / "policy.onnx").run(None, {"observation": observations})
    np.testing.assert_allclose(actions, jax.jit(jax.vmap(policy))(observations), atol=1e-6)
    assert len(about["observation"]) == observations.shape[1]
    assert about["decision_steps"] == 10

    export_onnx(tmp_path / "both.onnx", scenario, policy)
    state = worlds(load_scenario("paper"), 500, 4)
    world = [state[name] for name in ("evader", "pursuers")]
    velocity, status, _ = session(tmp_path / "both.onnx").run(
        None, {name: value for name, value in state.items() if name != "obstacles"}
    )
    none = jnp.zeros((500, 0, 4))
    act = jax.jit(jax.vmap(lambda e, p, o, t: policy(observe(scenario, World(e, p, o, t)))))
    actions = np.asarray(act(*world, none, state["target"]))
    actions = actions / np.maximum(np.linalg.norm(actions, axis=1, keepdims=True), 1.0)
    free = status == Status.OK
    assert free.sum() > 50
    np.testing.assert_allclose(velocity[free], 0.1574 * actions[free], atol=1e-6)


def test_model_is_valid_says_what_it_is_and_comes_out_the_same_twice(robot, tmp_path):
    model = onnx.load(robot.path)
    onnx.checker.check_model(model, full_check=True)
    assert [entry.version for entry in model.opset_import] == [17]
    shapes = {
        value.name: [size.dim_param or size.dim_value for size in value.type.tensor_type.shape.dim]
        for value in (*model.graph.input, *model.graph.output)
    }
    assert shapes["pursuers"] == ["batch", 1, 3]
    assert shapes["velocity"] == ["batch", 2]
    assert shapes["status"] == ["batch"]
    about = {entry.key: entry.value for entry in model.metadata_props}
    assert about["run"] == "a run"
    assert about["shield"] == "game"
    assert "m/s" in about["units"]
    # JSON is what a scenario is rebuilt from.
    rebuilt = load_scenario("paper", **json.loads(about["scenario"]))
    assert scenario_to_dict(rebuilt) == scenario_to_dict(robot.scenario)
    export_onnx(tmp_path / "again.onnx", robot.scenario, robot.policy, run="a run")
    assert (tmp_path / "again.onnx").read_bytes() == robot.path.read_bytes()


def test_jax_program_answers_as_the_shield_in_a_process_that_has_only_jax(robot, tmp_path):
    path = tmp_path / "robot.zip"
    export_jax(path, robot.scenario, robot.policy, shield=robot.shield, shield_name="game")
    state = {name: value[1000:1003] for name, value in robot.state.items()}
    np.savez(tmp_path / "state.npz", **state)
    code = f"""
import sys, zipfile, io, numpy as np
sys.modules["sidestep"] = None
import jax
from jax import export
with zipfile.ZipFile({str(path)!r}) as file:
    start, step = (export.deserialize(bytearray(file.read(name))).call for name in ("start", "step"))
state = np.load({str(tmp_path / "state.npz")!r})
world = [*(state[name] for name in ("evader", "pursuers", "obstacles", "target")), np.zeros((3, 1, 2), "f4")]
(memory,) = start(*world)
assert memory.shape == (3, 1)
velocity, status, barriers, slack, sides = step(*world, state["sides"])
np.savez({str(tmp_path / "answer.npz")!r}, velocity=velocity, status=status, sides=sides)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
    with np.load(tmp_path / "answer.npz") as file:
        answer = dict(file)
    np.testing.assert_allclose(answer["velocity"], robot.ours.velocity[1000:1003], atol=SAME)
    np.testing.assert_array_equal(answer["status"], robot.ours.status[1000:1003])
    np.testing.assert_array_equal(answer["sides"], robot.ours.sides[1000:1003])
    with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as file:
        assert json.loads(file.read("about.json"))["batch"] == "symbolic"


@pytest.mark.slow
def test_jax_program_of_joint_keeps_its_memory_over_a_chase(tmp_path):
    scenario = load_scenario("paper-test")
    shield, policy = make_shield("joint", scenario), policy_for(scenario)
    export_jax(tmp_path / "joint.zip", scenario, policy, shield=shield, shield_name="joint")
    with zipfile.ZipFile(tmp_path / "joint.zip") as file:
        start, step = (jax.export.deserialize(bytearray(file.read(name))).call for name in ("start", "step"))
    ask = jax.jit(lambda world, nominal, memory: shield(world, nominal, memory))
    world = scenario.reset(jax.random.key(0))
    memory = shield.init(world)
    flat = start(world.evader, world.pursuers, world.obstacles, world.target, world.wheel_speeds)
    for _ in range(25):
        nominal = decide(scenario, policy, world)
        result, memory = ask(world, nominal, memory)
        velocity, status, _, _, *flat = step(
            world.evader, world.pursuers, world.obstacles, world.target, world.wheel_speeds, *flat
        )
        np.testing.assert_allclose(velocity, result.action, atol=SAME)
        assert status == result.status
        world, _ = scenario.step(world, result.action, jnp.array([0.2, 0.15]))


def test_what_a_graph_cannot_hold_is_refused_by_name(robot, tmp_path):
    path = tmp_path / "x.onnx"
    with pytest.raises(ValueError, match=r"'heading'.*--format jax"):
        export_onnx(path, load_scenario("paper", action="heading"), robot.policy)
    with pytest.raises(ValueError, match=r"12 entries.*17.*obstacle_count"):
        export_onnx(path, load_scenario("paper", obstacle_count=2), robot.policy)
    with pytest.raises(ValueError, match="'policy\\+filter', 'policy', 'filter'"):
        export_onnx(path, robot.scenario, robot.policy, what="everything")
    with pytest.raises(ValueError, match="pursuer_gain"):
        export_onnx(path, load_scenario("paper", pursuer_gain=0.0), robot.policy)
    assert not path.exists()


def test_missing_package_is_named_with_the_command_that_installs_it(robot, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"'onnx'.*pip install .*\[export\]"):
        export_onnx(tmp_path / "x.onnx", robot.scenario, robot.policy)


def test_command_writes_once_and_never_over_a_file_unasked(robot, tmp_path, capsys):
    from sidestep.cli import main

    run = tmp_path / "run"
    create_run(run, {"scenario": scenario_to_dict(robot.scenario), "shield": "joint"})
    write_policy(run, robot.policy)
    out = tmp_path / "small" / "robot.onnx"
    command = ["export", str(run), "--out", str(out)]
    assert main([*command, "--json", str(tmp_path / "about.json")]) == 0
    assert json.loads((tmp_path / "about.json").read_text())["shield"] == "game"
    first = out.read_bytes()
    assert main([*command, "--what", "policy"]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert out.read_bytes() == first
    assert main([*command, "--what", "policy", "--overwrite"]) == 0
    assert out.read_bytes() != first
    assert main(["export", str(run), "--shield", "joint", "--out", str(tmp_path / "y")]) == 2
    assert "--format jax" in capsys.readouterr().err
