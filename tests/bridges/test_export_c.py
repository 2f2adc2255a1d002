"""Hazard: the microcontroller decides otherwise than what was trained and tested, or does so unnoticed."""

import ctypes
import json
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.bridges.export import NotTranslatable, export_c, export_onnx
from sidestep.bridges.export.c_code import HELPERS, CBody, table
from sidestep.bridges.export.exported import Field
from sidestep.bridges.export.graph import Graph
from sidestep.bridges.export.onnx_code import write_numbers
from sidestep.bridges.export.program import Program
from sidestep.bridges.export.translate import LONG, translate
from sidestep.cli import main
from sidestep.learning import Actor, LearnedPolicy
from sidestep.safety import make_shield
from sidestep.world import load_scenario, observation_size

ROOT = Path(__file__).parents[2]
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]


@pytest.fixture
def compiler(need_program):
    """A C compiler."""
    return need_program("cc", package="gcc")


def policy_for(scenario):
    return LearnedPolicy(Actor(observation_size(scenario), 2, (32, 32), jax.random.key(1), 4.0), 10)


def checked(compiler, folder, *options):
    """Build check.c and run it; its exit status and what it says."""
    build = [
        compiler,
        *STRICT,
        *options,
        "-o",
        folder / "check",
        folder / "sidestep.c",
        folder / "check.c",
        "-lm",
    ]
    subprocess.run(build, check=True)
    done = subprocess.run(
        [folder / "check", folder / "states.bin"], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Policy and `game` for two pursuers and two obstacles, 3,000 states."""
    folder = tmp_path_factory.mktemp("game")
    scenario = load_scenario("paper", pursuer_count=2, obstacle_count=2)
    shield = make_shield("game", scenario)
    about = export_c(folder, scenario, policy_for(scenario), shield=shield, shield_name="game", states=3000)
    assert about == json.loads((folder / "about.json").read_text())
    assert about["shield"] == "game"
    return folder


def test_policy_and_filter_answer_as_in_jax_without_undefined_behaviour(compiler, exported):
    sanitized = ["-O1", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]
    status, said = checked(compiler, exported, *sanitized)
    assert status == 0, said
    assert "3000 states: 0 differ" in said
    about = json.loads((exported / "about.json").read_text())
    assert f"in {about['states']['rounding decides']} it decides" in said
    assert about["states"]["rounding decides"] < 300
    _, inputs, outputs = np.fromfile(exported / "states.bin", "<u4", 4)[1:]
    rows = np.fromfile(exported / "states.bin", "<f4", offset=20).reshape(3000, inputs + outputs + 1)
    statuses = set(rows[:, inputs + 4])
    assert statuses == {0.0, 1.0, 2.0, 3.0}


def test_another_program_is_told_apart(compiler, exported, tmp_path):
    for name in ("sidestep.h", "sidestep.c", "check.c", "states.bin"):
        (tmp_path / name).write_bytes((exported / name).read_bytes())
    code = (tmp_path / "sidestep.c").read_text()
    assert "0.1574f" in code
    (tmp_path / "sidestep.c").write_text(code.replace("0.1574f", "0.157f"))
    status, said = checked(compiler, tmp_path)
    assert status == 1
    assert "3000 states: 0 differ" not in said
    (tmp_path / "states.bin").write_bytes(b"something else")
    assert checked(compiler, tmp_path)[0] == 2


def test_the_example_of_the_page_compiles(compiler, exported, tmp_path):
    page = (ROOT / "docs" / "export.md").read_text()
    (example,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    include, rest = example.split("\n", 1)
    source = tmp_path / "main.c"
    source.write_text(f"{include}\nint main(void)\n{{\n{rest}    return answer.status;\n}}\n")
    sources = [source, exported / "sidestep.c", "-I", exported]
    subprocess.run([compiler, *STRICT, *sources, "-o", tmp_path / "main", "-lm"], check=True)
    # All robots in one place: the least violation.
    assert subprocess.run([tmp_path / "main"], check=False).returncode == 2


def test_the_python_check_says_the_same(exported):
    done = subprocess.run(
        [sys.executable, exported / "check.py"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "3000 states: 0 differ" in done.stdout


@pytest.fixture(scope="module")
def by_table(tmp_path_factory):
    """The shield `joint:table`, 1,000 states."""
    folder, scenario = tmp_path_factory.mktemp("table"), load_scenario("paper")
    shield = make_shield("joint:table", scenario)
    export_c(folder, scenario, None, what="filter", shield=shield, shield_name="joint:table", states=1000)
    return folder


def test_joint_by_its_table_answers_as_in_jax(compiler, by_table):
    status, said = checked(compiler, by_table, "-O0")
    assert status == 0, said
    assert "1000 states: 0 differ" in said
    # Constants in 16 bits, as the table has them.
    code = (by_table / "sidestep.c").read_text()
    assert "static const uint16_t" in code
    assert "malloc" not in code


def test_the_app_of_a_crazyflie_arrives_past_pursuer_and_obstacle(compiler, by_table, tmp_path):
    example = ROOT / "examples" / "crazyflie"
    sources = [example / "src" / "evader.c", example / "rehearsal" / "rehearsal.c", by_table / "sidestep.c"]
    folders = ["-I", example / "rehearsal", "-I", by_table]
    flags = ["-std=gnu99", "-Wall", "-Wextra", "-Werror", "-O1"]
    subprocess.run([compiler, *flags, *folders, *sources, "-o", tmp_path / "fly", "-lm"], check=True)
    done = subprocess.run([tmp_path / "fly"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert done.stdout.startswith("arrived after")
    # Without poses for half a second it stops.
    blind = subprocess.run([tmp_path / "fly", "blind"], capture_output=True, text=True, check=False)
    assert "at most 0.0000 m/s while unseen" in blind.stdout


@pytest.mark.slow
def test_an_onnx_graph_of_joint_by_its_table_answers_as_in_jax(by_table, tmp_path):
    scenario = load_scenario("paper")
    shield = make_shield("joint:table", scenario)
    ort = pytest.importorskip("onnxruntime")
    path = tmp_path / "filter.onnx"
    export_onnx(path, scenario, None, what="filter", shield=shield, shield_name="joint:table")
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    _, inputs, outputs = np.fromfile(by_table / "states.bin", "<u4", 4)[1:]
    rows = np.fromfile(by_table / "states.bin", "<f4", offset=20).reshape(1000, inputs + outputs + 1)
    state, at = {}, 0
    for given in session.get_inputs():
        shape = given.shape[1:]
        size = int(np.prod(shape))
        state[given.name] = rows[:, at : at + size].reshape(-1, *shape)
        at += size
    assert at == inputs
    found = [part.reshape(1000, -1).astype(np.float32) for part in session.run(None, state)]
    found, wanted, allowed = np.concatenate(found, 1), rows[:, inputs:-1], rows[:, -1]
    clear = np.isfinite(allowed)
    np.testing.assert_array_equal(found[clear, 2:], wanted[clear, 2:])
    off = np.max(np.abs(found - wanted)[clear, :2], 1) - allowed[clear]
    assert np.max(off) <= 3e-3
    assert np.mean(off > 0.0) <= 3e-3


def ours(x):
    """One of each kind of operation, on a vector of six numbers."""
    long = jnp.sin(x[0] + 0.1 * jnp.arange(LONG + 8.0))
    grid = jnp.asarray(np.linspace(-1.0, 1.0, 60, dtype=np.float32).reshape(12, 5))
    count = jnp.clip((4.0 * x[1]).astype(jnp.int32), -3, 20)
    chosen = grid.at[count, jnp.argmin(x) % 5].get(mode="clip")
    joined = jnp.concatenate([long, 2.0 * long[:3], x])
    best = jnp.argmax(joined)
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(6, 40)).astype(np.float32))
    hidden = jnp.maximum(x @ matrix, 0.0)

    def heavy(y):
        many = jax.vmap(lambda z: jnp.min(jnp.stack([z * y, z - y])))(long)
        return jnp.where(jnp.any(many > 0.9), jnp.max(many), jnp.sum(many))

    decided = jax.lax.cond(x[2] > x[3], heavy, lambda y: -y, x[4])
    order = jnp.argsort(x)
    return (
        jnp.stack([chosen, joined[best], jnp.min(long), long[jnp.clip(count, 0, 5)], decided]),
        jnp.stack([jnp.max(x), jnp.min(x), jnp.sign(x[5]), x[0] ** 3, jnp.arctan2(x[0], x[1])]),
        jnp.sum(hidden @ matrix.T) * 0.01,
        x[order],
        jnp.cumprod(jnp.sign(x)),
        jnp.stack([best, order[0], jnp.argmax(long), jnp.argmin(x)]),
        jnp.isfinite(x),
        jnp.sum((long * x[1] > 0.2).astype(jnp.int32)),
    )


def random_inputs():
    """Of `ours`. XLA's reductions do not say what becomes of a NaN."""
    rng = np.random.default_rng(1)
    states = rng.normal(size=(2000, 6)).astype(np.float32)
    states[:40] = np.round(states[:40])
    states[np.arange(40, 80), rng.integers(2, 6, 40)] = rng.choice([1e30, -1e30, 0.0], 40)
    return states


def test_every_kind_of_operation_is_that_of_jax(compiler, tmp_path):
    program = Program()
    given = np.array([program.given(f"in[{k}]", "f") for k in range(6)], object)
    nodes = [node for part in translate(program, ours, [given]) for node in part.reshape(-1)]
    body = CBody(program, [(f"out[{k}]", node) for k, node in enumerate(nodes)])
    tables = [
        line for number in body.tables for line in table(f"table{number}", program.tables.arrays[number])
    ]
    head = "void f(const float *in, float *out)"
    lines = ["#include <math.h>", "#include <stdbool.h>", "#include <stdint.h>", HELPERS, *tables]
    source, library = tmp_path / "f.c", tmp_path / "f.so"
    source.write_text("\n".join([*lines, f"{head};", head, "{", *body.lines(), "}", ""]))
    options = ["-std=c99", "-O1", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, "-o", library, source, "-lm"], check=True)
    f = ctypes.CDLL(str(library)).f
    f.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    states = random_inputs()
    wanted = [np.asarray(part, np.float32).reshape(2000, -1) for part in jax.jit(jax.vmap(ours))(states)]
    wanted = np.concatenate(wanted, 1)
    found = np.empty_like(wanted)
    for state, out in zip(states, found, strict=True):
        f(state.ctypes.data, out.ctypes.data)
    np.testing.assert_allclose(found, wanted, rtol=2e-5, atol=2e-6)


def test_every_kind_of_operation_is_that_of_jax_in_onnx():
    ort = pytest.importorskip("onnxruntime")
    program, graph, given = Program(), Graph(), Field("x", (6,), "f")
    results = translate(program, ours, [given.given(program)])
    fields = [Field(f"o{k}", part.shape, part.reshape(-1)[0].kind) for k, part in enumerate(results)]
    write_numbers(graph, program, [given], list(zip(fields, results, strict=True)))
    session = ort.InferenceSession(graph.model("ours", "", {}), providers=["CPUExecutionProvider"])
    states = random_inputs()
    for found, wanted in zip(session.run(None, {"x": states}), jax.jit(jax.vmap(ours))(states), strict=True):
        assert found.shape == wanted.shape
        # An angle of half a turn has either sign.
        same = np.isclose(found, wanted, rtol=2e-5, atol=2e-6) | np.isclose(np.abs(found), np.pi)
        assert np.all(same | (np.asarray(wanted) == -np.float32(np.pi)))


def test_what_cannot_be_translated_is_named_with_its_line():
    program = Program()
    given = np.array([program.given(f"in[{k}]", "f") for k in range(3)], object)

    def loops(x):
        return jax.lax.fori_loop(0, x[0].astype(jnp.int32), lambda _, y: 2.0 * y, x)

    with pytest.raises(NotTranslatable, match=r"primitive 'while' of .*test_export_c.py"):
        translate(program, loops, [given])


def refused(capsys, *arguments):
    assert main(["export", "pretrained", "--format", "c", *arguments]) == 2
    return capsys.readouterr().err


def test_refusals_come_before_anything_is_written(capsys, tmp_path):
    out = tmp_path / "robot"
    said = refused(capsys, "--out", str(out), "--shield", "joint")
    assert "looks ahead here" in said
    assert "'joint:table'" in said
    assert not out.exists()
    out.mkdir()
    (out / "sidestep.c").write_text("mine")
    said = refused(capsys, "--out", str(out), "--shield", "game")
    assert "exists already" in said
    assert (out / "sidestep.c").read_text() == "mine"
    assert [path.name for path in out.iterdir()] == ["sidestep.c"]
    said = refused(capsys, "--out", str(out / "sidestep.c"), "--shield", "game")
    assert "is a file, not a folder" in said
