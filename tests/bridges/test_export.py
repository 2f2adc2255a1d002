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

from sidestep.bridges.export import NotTranslatable, export_jax, export_onnx
from sidestep.bridges.export.exported import Exported, Field
from sidestep.bridges.export.graph import Graph
from sidestep.bridges.export.onnx_code import write_numbers
from sidestep.bridges.export.parity import answers as reference
from sidestep.bridges.export.parity import random_states
from sidestep.bridges.export.program import Program
from sidestep.bridges.export.translate import translate
from sidestep.learning import Actor, LearnedPolicy, write_policy
from sidestep.loop.step import decide
from sidestep.safety import Budget, GameShield, Status, make_shield
from sidestep.store.runs import create_run
from sidestep.world import load_scenario, observation_size
from sidestep.world.loading import scenario_to_dict

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

STATES = 6000
TOUCHING = 3e-3
"""m/s within which two answers are the same where a line just touches the disc: a square root of rounding."""


def policy_for(scenario):
    return LearnedPolicy(Actor(observation_size(scenario), 2, (32, 32), jax.random.key(1), 4.0), 10)


def session(path):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def state_of(exported, count, seed=0):
    """States by the names of their fields, with memories of all kinds."""
    rng = np.random.default_rng(seed + 1)
    memory = {
        field.name: rng.integers(-1, 2, (count, *field.shape)).astype(np.float32) for field in exported.memory
    }
    return random_states(exported.scenario, count, seed) | memory


def ask(path, state):
    """Velocity, status and next memory, flat."""
    alone = session(path)
    found = alone.run(None, {given.name: state[given.name] for given in alone.get_inputs()})
    return np.concatenate([np.asarray(part, np.float32).reshape(len(part), -1) for part in found], 1)


def assert_as_in_jax(path, exported, count, *, remembers=True):
    """What the graph answers, and what JAX does, where rounding does not decide between two answers."""
    state = state_of(exported, count)
    for field in exported.memory:
        state[field.name] *= remembers
    names = [field.name for field in (*exported.fields, *exported.memory)]
    function = exported.both
    if exported.what == "filter":
        names.insert(len(exported.fields), "wish")
        function = exported.filtered
    measured = len(names) - len(exported.memory)
    wanted, allowed = reference(function, [state[name] for name in names], measured=measured, loose=2, seed=2)
    found, clear = ask(path, state), np.isfinite(allowed)
    assert np.mean(clear) > 0.9
    off = np.abs(found - wanted)
    assert np.all(np.isfinite(found))
    np.testing.assert_array_equal(found[clear, 2:], wanted[clear, 2:])
    assert np.max(off[clear, :2] - allowed[clear, None]) <= TOUCHING
    assert np.mean(np.max(off[clear, :2], 1) > allowed[clear]) <= 3e-3
    speed = float(exported.scenario.evader_speed)
    assert np.max(np.linalg.norm(found[:, :2], axis=1)) <= speed * (1 + 1e-5)
    return state, found, wanted


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """The paper's scenario with a policy, and its exported policy + `game`."""
    scenario = load_scenario("paper")
    policy, shield = policy_for(scenario), make_shield("game", scenario)
    path = tmp_path_factory.mktemp("export") / "robot.onnx"
    export_onnx(path, scenario, policy, shield=shield, run="a run")
    exported = Exported(scenario, policy, shield, "policy+filter")
    return SimpleNamespace(scenario=scenario, policy=policy, shield=shield, path=path, exported=exported)


def test_policy_and_filter_decide_as_in_jax(robot):
    state, found, _ = assert_as_in_jax(robot.path, robot.exported, STATES)
    counts = np.bincount(found[:, 2].astype(int), minlength=4)
    assert np.all(counts > 0.01 * STATES)
    lost = ~np.isfinite(state["evader"]).all(axis=1)
    assert lost.sum() > 20
    np.testing.assert_array_equal(found[lost, 2], Status.INVALID)
    np.testing.assert_array_equal(found[lost, :2], 0.0)


def test_memory_of_zero_is_the_start_of_an_episode(robot):
    _, found, _ = assert_as_in_jax(robot.path, robot.exported, 1000, remembers=False)
    assert np.all(np.abs(found[:, 3]) == 1.0)


def test_one_state_and_many_give_the_same(robot):
    state = state_of(robot.exported, 64)
    one = [ask(robot.path, {name: value[k : k + 1] for name, value in state.items()}) for k in range(64)]
    np.testing.assert_allclose(np.concatenate(one), ask(robot.path, state), atol=1e-5)


@pytest.mark.parametrize("robots", [1, 2])
def test_filter_alone_with_a_budget_decides_as_in_jax(robots, tmp_path):
    scenario = load_scenario(
        "paper", pursuer_count=robots, obstacle_count=robots, arena_side=6.0, capture_distance=0.12
    )
    budget = Budget(position_error=0.004, heading_error=0.01, delay=0.02, tracking_error=0.005)
    shield = GameShield(scenario, budget)
    export_onnx(tmp_path / "filter.onnx", scenario, None, what="filter", shield=shield)
    assert_as_in_jax(tmp_path / "filter.onnx", Exported(scenario, None, shield, "filter"), STATES // 4)


@pytest.mark.parametrize("name", ["paper", "none"])
def test_other_shields_decide_as_in_jax(name, tmp_path):
    scenario = load_scenario("paper")
    shield = make_shield(name, scenario)
    export_onnx(tmp_path / "f.onnx", scenario, None, what="filter", shield=shield, shield_name=name)
    assert_as_in_jax(tmp_path / "f.onnx", Exported(scenario, None, shield, "filter"), 400)


def test_a_fixed_speed_and_a_seen_motion_can_be_exported(tmp_path):
    scenario = load_scenario("paper", action="heading", observation="motion")
    policy, shield = policy_for(scenario), make_shield("game", scenario)
    export_onnx(tmp_path / "f.onnx", scenario, policy, shield=shield)
    assert_as_in_jax(tmp_path / "f.onnx", Exported(scenario, policy, shield, "policy+filter"), 800)


def test_policy_alone_acts_as_trained_and_in_the_frame_of_the_world_too(tmp_path):
    scenario = load_scenario("paper", frame="world", obstacle_count=0)
    policy = policy_for(scenario)
    about = export_onnx(tmp_path / "policy.onnx", scenario, policy, what="policy")
    observations = np.random.default_rng(0).normal(size=(50, observation_size(scenario))).astype(np.float32)
    (actions,) = session(tmp_path / "policy.onnx").run(None, {"observation": observations})
    np.testing.assert_allclose(actions, jax.jit(jax.vmap(policy))(observations), atol=1e-6)
    assert len(about["observation"]) == observations.shape[1]
    assert about["decision_steps"] == 10

    shield = make_shield("none", scenario)
    export_onnx(tmp_path / "both.onnx", scenario, policy, shield=shield, shield_name="none")
    assert_as_in_jax(tmp_path / "both.onnx", Exported(scenario, policy, shield, "policy+filter"), 2000)


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
    export_onnx(tmp_path / "again.onnx", robot.scenario, robot.policy, shield=robot.shield, run="a run")
    assert (tmp_path / "again.onnx").read_bytes() == robot.path.read_bytes()


def test_jax_program_answers_as_the_shield_in_a_process_that_has_only_jax(robot, tmp_path):
    path = tmp_path / "robot.zip"
    export_jax(path, robot.scenario, robot.policy, shield=robot.shield, shield_name="game")
    state = {name: value[:3] for name, value in state_of(robot.exported, 3, seed=3).items()}
    np.savez(tmp_path / "state.npz", **state)
    code = f"""
import sys, zipfile, io, numpy as np
sys.modules["sidestep"] = None
import jax
from jax import export
with zipfile.ZipFile({str(path)!r}) as file:
    start, step = (export.deserialize(bytearray(file.read(name))).call for name in ("start", "step"))
state = np.load({str(tmp_path / "state.npz")!r})
world = [state[name] for name in ("evader", "pursuers", "obstacles", "target", "wheel_speeds")]
assert [entry.shape for entry in start(*world)] == [(3, 1), (3,)]
velocity, status, barriers, slack, sides, turn = step(*world, state["sides"], state["turn"])
answer = np.concatenate([velocity, status[:, None], sides, turn[:, None]], 1)
np.save({str(tmp_path / "answer.npy")!r}, answer)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
    np.testing.assert_allclose(np.load(tmp_path / "answer.npy"), ask(robot.path, state), atol=1e-5)
    with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as file:
        assert json.loads(file.read("about.json"))["batch"] == "symbolic"


@pytest.mark.slow
def test_jax_program_of_joint_keeps_its_memory_over_a_chase(tmp_path):
    scenario = load_scenario("paper-test")
    shield, policy = make_shield("joint", scenario), policy_for(scenario)
    export_jax(tmp_path / "joint.zip", scenario, policy, shield=shield, shield_name="joint")
    with zipfile.ZipFile(tmp_path / "joint.zip") as file:
        start, step = (jax.export.deserialize(bytearray(file.read(name))).call for name in ("start", "step"))
    answer = jax.jit(lambda world, nominal, memory: shield(world, nominal, memory))
    world = scenario.reset(jax.random.key(0))
    memory = shield.init(world)
    flat = start(world.evader, world.pursuers, world.obstacles, world.target, world.wheel_speeds)
    for _ in range(25):
        nominal = decide(scenario, policy, world)
        result, memory = answer(world, nominal, memory)
        velocity, status, _, _, *flat = step(
            world.evader, world.pursuers, world.obstacles, world.target, world.wheel_speeds, *flat
        )
        np.testing.assert_allclose(velocity, result.action, atol=1e-5)
        assert status == result.status
        world, _ = scenario.step(world, result.action, jnp.array([0.2, 0.15]))


def test_what_a_graph_cannot_hold_is_refused_by_name(robot, tmp_path):
    path = tmp_path / "x.onnx"
    with pytest.raises(ValueError, match=r"12 entries.*17.*obstacle_count"):
        export_onnx(path, load_scenario("paper", obstacle_count=2), robot.policy)
    with pytest.raises(ValueError, match="'policy\\+filter', 'policy', 'filter'"):
        export_onnx(path, robot.scenario, robot.policy, what="everything")
    with pytest.raises(ValueError, match=r"looks ahead here.*'joint:table'"):
        export_onnx(path, robot.scenario, robot.policy, shield=make_shield("joint", robot.scenario))
    assert not path.exists()


def test_an_operation_that_onnx_lacks_is_named():
    program, field = Program(), Field("x", (2,), "i")
    (result,) = translate(program, lambda x: (x[0] ^ x[1],), [field.given(program)])
    with pytest.raises(NotTranslatable, match="'xor' of whole numbers"):
        write_numbers(Graph(), program, [field], [(Field("y", (), "i"), result)])


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
    assert "'joint:table'" in capsys.readouterr().err
