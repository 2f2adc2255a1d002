"""Hazard: compiled C decides otherwise than JAX, or a file that is broken or foreign is trusted."""

import logging
import math
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.bridges.compiled import CompiledAnswering, as_tree
from sidestep.bridges.export import agreement as checks
from sidestep.bridges.export import library
from sidestep.loop.policies import as_policy
from sidestep.robot import Onboard
from sidestep.robot.answering import Answering, Estimate
from sidestep.safety import GameShield, Shield, Status, make_shield
from sidestep.store import programs
from sidestep.world import Scenario, load_scenario

SCENARIO = load_scenario("paper", capture_distance=0.15)
GAME = make_shield("game", SCENARIO)
SEEN = Estimate(
    np.zeros(2), np.array([[1.0, 0.5, 0.0]]), np.array([[-1.0, 2.0, 0.0, 0.0]]), np.array([2.0, 0.0]),
    np.zeros(2), np.zeros((1, 2)), 0.0,
)  # fmt: skip
NOMINAL = np.array([0.1, 0.05])


_codes = []


@pytest.fixture(scope="module")
def built(tmp_path_factory, need_program):
    """A cache folder with the library of `game`, and what was kept beside it."""
    need_program("cc", package="gcc")
    folder = tmp_path_factory.mktemp("cache") / "sidestep"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "folder", lambda: folder)
        patch.setattr(checks, "_STATES", 150)
        translated = library.c_code
        patch.setattr(library, "c_code", lambda *given: (_codes.append(translated(*given)), _codes[-1])[1])
        answering, _ = decided()
    assert answering.compiled
    return folder


@pytest.fixture
def cache(built, tmp_path, monkeypatch):
    """A copy of that folder, as the cache of this process, and no compiler to build anything with."""
    folder = tmp_path / "sidestep"
    shutil.copytree(built, folder)
    monkeypatch.setattr(programs, "folder", lambda: folder)
    monkeypatch.setenv("CC", "no-such-compiler")
    return folder


def decided():
    """The first answer of a core behind `game`."""
    answering = CompiledAnswering(GAME, None)
    return answering, answering(SEEN, NOMINAL, False, False, 0.0, answering.start(SEEN))[0]


def notes(caplog):
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def only(folder, ending):
    (path,) = folder.glob(f"*{ending}")
    return path


def test_it_answers_as_jax_on_thousands_of_states_that_can_be_and_that_cannot(cache, monkeypatch):
    monkeypatch.setattr(checks, "_STATES", 2000)
    answering, _ = decided()
    assert answering.compiled
    ours = Answering(GAME, None)
    leaves, structure = jax.tree.flatten(ours.start(SEEN))
    numbers, before = checks._states(ours, [np.asarray(leaf) for leaf in leaves])
    off, statuses = [], set()
    for i, given in enumerate(numbers):
        memory = jax.tree.unflatten(structure, [leaf[i] for leaf in before])
        found, at_once, after = answering._native(given, memory)
        wanted, kept = (jax.device_get(part) for part in ours.answer(given, memory))
        assert at_once
        assert np.all(np.isfinite(found[2:4])), given
        assert math.hypot(*found[2:4]) <= 0.1574 * (1.0 + 1e-5)
        same = found[4] == wanted[4] and all(
            map(np.array_equal, jax.tree.leaves(as_tree(after)), jax.tree.leaves(kept))
        )
        off.append(np.max(np.abs(found[2:4] - wanted[2:4])) if same else np.inf)
        statuses.add(int(found[4]))
    assert not np.all(np.isfinite(numbers))
    assert statuses == {Status.OK, Status.CORRECTED, Status.INFEASIBLE, Status.INVALID}
    # In the others rounding decides: `agreement` tells them apart, and is tested below.
    assert np.mean(np.array(off) <= 1e-5) > 0.98


def test_a_second_start_neither_traces_nor_builds(cache, monkeypatch, caplog):
    for name in ("_start", "_answer", "at_once"):
        monkeypatch.setattr(Answering, name, lambda *given: pytest.fail("it was traced"))
    answering, answer = decided()
    assert answering.compiled
    assert not notes(caplog)
    np.testing.assert_array_equal(answer.action, np.float32(NOMINAL))
    assert (answer.status, answer.intervention) == (Status.OK, 0.0)


@pytest.mark.parametrize("ending", [".so", ".json", ".xla"])
@pytest.mark.parametrize("spoil", [lambda content: content[: len(content) // 2], lambda content: b""])
def test_a_broken_file_is_not_loaded(cache, caplog, ending, spoil):
    for path in cache.glob(f"*{ending}"):
        path.write_bytes(spoil(path.read_bytes()))
    answering, answer = decided()
    assert answer.status == Status.OK
    np.testing.assert_allclose(answer.action, NOMINAL, atol=1e-7)
    # Without a compiler nothing could be built anew.
    assert answering.compiled == (ending == ".xla")
    assert len(notes(caplog)) == (ending != ".xla")


def test_a_file_of_another_user_is_not_loaded(cache, monkeypatch):
    assert decided()[0].compiled
    monkeypatch.setattr(programs.os, "getuid", lambda: 4711)
    owner = only(cache, ".so").stat().st_uid
    assert decided()[0].compiled == (owner == 0)


@pytest.mark.parametrize("compiler, words", [("no-such-compiler", "no C compiler"), ("false", "failed with")])
def test_without_a_compiler_jax_decides_and_a_line_says_so(tmp_path, monkeypatch, caplog, compiler, words):
    monkeypatch.setattr(programs, "folder", lambda: tmp_path / "new")
    monkeypatch.setattr(library, "c_code", lambda *given: "int one;")
    monkeypatch.setenv("CC", compiler)
    answering, answer = decided()
    assert not answering.compiled
    (note,) = notes(caplog)
    assert words in note
    assert "\n" not in note
    np.testing.assert_allclose(answer.action, NOMINAL, atol=1e-7)
    assert not list((tmp_path / "new").glob("*.so"))


def test_a_library_that_answers_otherwise_is_never_used(built, tmp_path, monkeypatch, caplog):
    folder = tmp_path / "sidestep"
    shutil.copytree(built, folder)
    for ending in (".so", ".json"):
        only(folder, ending).unlink()
    monkeypatch.setattr(programs, "folder", lambda: folder)
    monkeypatch.setattr(checks, "_STATES", 150)
    assert "0.1574f" in _codes[0]
    monkeypatch.setattr(library, "c_code", lambda *given: _codes[0].replace("0.1574f", "0.157f"))
    answering, answer = decided()
    assert not answering.compiled
    assert "is answered otherwise than by JAX" in notes(caplog)[0]
    np.testing.assert_allclose(answer.action, NOMINAL, atol=1e-7)
    # The verdict is kept, so the next process builds nothing.
    monkeypatch.setattr(library, "c_code", lambda *given: pytest.fail("it was built again"))
    assert not decided()[0].compiled
    assert notes(caplog)[1] == notes(caplog)[0]
    assert not list(folder.glob("*.so"))


def test_an_error_of_any_kind_while_it_is_built_is_said_and_leaves_it_to_jax(cache, monkeypatch, caplog):
    only(cache, ".json").unlink()
    monkeypatch.setenv("CC", "cc")
    monkeypatch.setattr(library, "c_code", lambda *given: {}["a bug"])
    answering, answer = decided()
    assert not answering.compiled
    assert "KeyError: 'a bug'" in notes(caplog)[0]
    np.testing.assert_allclose(answer.action, NOMINAL, atol=1e-7)


def test_a_cache_that_cannot_be_written_costs_only_time(cache, tmp_path, monkeypatch, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setattr(programs, "folder", lambda: tmp_path / "file" / "sidestep")
    monkeypatch.setenv("CC", "cc")
    monkeypatch.setattr(library, "c_code", lambda *given: _codes[0])
    monkeypatch.setattr(checks, "_STATES", 150)
    caplog.set_level(logging.INFO, "sidestep")
    assert decided()[0].compiled
    assert "and not kept" in caplog.messages[-1]


def test_what_cannot_be_translated_is_left_to_jax(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(programs, "folder", lambda: tmp_path / "sidestep")
    policy = as_policy(lambda observation: np.asarray(observation)[:2] * 0.0, SCENARIO)
    answering = CompiledAnswering(make_shield("none", SCENARIO), policy)
    answer, _ = answering(SEEN, NOMINAL, True, False, 0.0, answering.start(SEEN))
    assert not answering.compiled
    assert "pure_callback" in notes(caplog)[0]
    np.testing.assert_array_equal(answer.nominal, 0.0)


class Ahead(Shield):
    """Does not know beforehand whether it looks ahead."""

    scenario: Scenario

    @property
    def rows_only(self):
        return GameShield(self.scenario)

    def init(self, world):
        return self.rows_only.init(world)

    def __call__(self, world, nominal, memory):
        return self.rows_only(world, nominal, memory)


def test_a_shield_that_has_to_look_ahead_is_left_to_jax(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(programs, "folder", lambda: tmp_path / "sidestep")
    answering = CompiledAnswering(Ahead(SCENARIO), None)
    answer, _ = answering(SEEN, NOMINAL, False, False, 0.0, answering.start(SEEN))
    assert not answering.compiled
    assert "has to look ahead" in notes(caplog)[0]
    np.testing.assert_allclose(answer.action, NOMINAL, atol=1e-7)


def test_in_double_precision_jax_decides(x64, caplog):
    answering = CompiledAnswering(make_shield("none", load_scenario("paper")), None)
    answering(SEEN, NOMINAL, False, False, 0.0, answering.start(SEEN))
    assert not answering.compiled
    assert "double precision" in notes(caplog)[0]


def chase(core):
    """Decisions while a pursuer drives up beside an obstacle, with faults on the way."""
    core.reset()
    decisions = []
    for count in range(60):
        now = 0.05 * count
        core.see("evader", now, (0.0, 0.0, 0.0))
        if not 20 <= count < 30:
            core.see("pursuer", now, (1.5 - 0.02 * count, 0.02, math.pi))
        core.see("obstacle", now, (-0.6, 0.1))
        if count >= 5:
            core.nominal(now, (0.1, -0.02) if count != 40 else (math.nan, 0.0))
        # Late in the end, so that it falls behind.
        decisions.append(core.decide(now if count < 50 else now + 0.05 * (count - 49)))
    return decisions


class Turning(Shield):
    """As `game`, and where a pursuer is near it asks a "look-ahead" that says: along y."""

    scenario: Scenario

    @property
    def rows_only(self):
        return GameShield(self.scenario)

    def init(self, world):
        return self.rows_only.init(world)

    def __call__(self, world, nominal, memory):
        result, after, decided = self.at_once(world, nominal, memory)
        aside, turned = self.rows_only(world, jnp.array([0.0, 0.1]), memory)
        pick = lambda one, other: jnp.where(decided, one, other)  # noqa: E731
        return jax.tree.map(pick, result, aside), jax.tree.map(pick, after, turned)

    def filter_by_rows(self, world, nominal, memory):
        return self.rows_only(world, nominal, memory)

    def at_once(self, world, nominal, memory):
        result, after = self.rows_only(world, nominal, memory)
        return result, after, (result.barriers[0] > 0.5) | (result.status == Status.INVALID)


def test_the_decision_core_decides_the_same_with_and_without_it(tmp_path, monkeypatch, need_program):
    need_program("cc", package="gcc")
    monkeypatch.setattr(programs, "folder", lambda: tmp_path / "sidestep")
    monkeypatch.setattr(checks, "_STATES", 100)
    monkeypatch.setattr(checks, "_FEWEST", 20)
    shield = Turning(SCENARIO)
    with_c = Onboard(SCENARIO, shield, answering=CompiledAnswering)
    without = Onboard(SCENARIO, shield)
    with_c.warm_up()
    assert with_c._whole.compiled
    assert with_c._rows.compiled
    asked = []
    whole = with_c._whole._jax.answer
    monkeypatch.setattr(with_c._whole._jax, "answer", lambda *given: (asked.append(1), whole(*given))[1])
    ours, theirs = chase(with_c), chase(without)
    # C decided some periods, JAX looked ahead in others, and sometimes the rows decided alone.
    assert 3 <= len(asked) <= 50
    assert any("no look-ahead" in words for one in theirs for words in one.reactions)
    assert {one.level for one in theirs} == {"stop", "normal", "degraded", "evade"}
    for mine, other in zip(ours, theirs, strict=True):
        assert (mine.level, mine.status) == (other.level, other.status)
        assert [words for words in mine.reactions if "ms" not in words] == [
            words for words in other.reactions if "ms" not in words
        ]
        np.testing.assert_allclose(mine.velocity, other.velocity, atol=1e-5)
        np.testing.assert_allclose(mine.nominal, other.nominal, atol=1e-6)
        np.testing.assert_allclose(mine.barriers, other.barriers, atol=1e-5)
        for name in ("slack", "intervention", "clearance"):
            assert getattr(mine, name) == pytest.approx(getattr(other, name), abs=1e-4, nan_ok=True)
    assert any(one.velocity[1] > 0.09 for one in ours)
