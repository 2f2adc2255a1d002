"""Hazard: a program that was kept for something else, or is broken, is loaded and decides."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.safety import make_shield
from sidestep.store import programs
from sidestep.store.programs import digest_of, keep, kept_jit, kept_program
from sidestep.world import goal_seeking, load_scenario


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(programs, "folder", lambda: tmp_path / "kept")
    return tmp_path / "kept"


def traced(function):
    """The function, and how often it was traced."""
    times = []
    return lambda *given: (times.append(1), function(*given))[1], times


def test_a_kept_program_is_loaded_without_tracing_and_returns_the_same_pytree(cache):
    first, once = traced(lambda x: {"sum": jnp.sum(x), "twice": (2.0 * x, x > 1.0)})
    again, never = traced(lambda x: pytest.fail("it was traced"))
    x = np.array([1.0, 2.0, 3.0], np.float32)
    for function, times, count in ((first, once, 1), (again, never, 0)):
        program = kept_program("sums", function, x)
        found = program(x)
        assert len(times) == count
        assert jax.tree.structure(found) == jax.tree.structure({"sum": 0, "twice": (0, 0)})
        assert float(found["sum"]) == 6.0
        np.testing.assert_array_equal(found["twice"][0], 2.0 * x)
    # Another shape is another program.
    other, times = traced(lambda x: x)
    kept_program("sums", other, x[:2])
    assert len(times) == 1


@pytest.mark.parametrize("spoil", [lambda c: c[:-1], lambda c: b"", lambda c: bytes([c[0] ^ 1]) + c[1:]])
def test_a_broken_program_is_compiled_again(cache, spoil):
    x = np.float32(2.0)
    kept_program("square", lambda x: x * x, x)
    (path,) = cache.glob("*.xla")
    whole = path.read_bytes()
    path.write_bytes(spoil(whole))
    assert float(kept_program("square", lambda x: x * x, x)(x)) == 4.0
    assert len(path.read_bytes()) > len(whole) // 2


def test_what_cannot_be_kept_is_compiled_all_the_same(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    for place in (tmp_path / "file" / "kept", None):
        monkeypatch.setattr(programs, "folder", lambda: place)  # noqa: B023
        assert float(kept_program("square", lambda x: x * x, np.float32(3.0))(np.float32(3.0))) == 9.0


def test_a_digest_tells_every_number_apart_and_is_the_same_in_another_process():
    text = "from sidestep.store.programs import digest_of; from sidestep.safety import make_shield; "
    text += "from sidestep.world import load_scenario; "
    text += "print(digest_of(make_shield('game', load_scenario('paper'))))"
    elsewhere = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    scenario = load_scenario("paper")
    here = digest_of(make_shield("game", scenario))
    assert elsewhere.stdout.split() == [here]
    faster = load_scenario("paper", evader_speed=float(scenario.evader_speed) + 1e-6)
    assert len({here, digest_of(make_shield("game", faster)), digest_of(make_shield("paper", scenario))}) == 3


def test_code_that_the_digest_does_not_stand_for_has_none(monkeypatch):
    def policy(observation):
        return observation[:2]

    assert digest_of(goal_seeking) is not None
    for code in (policy, lambda observation: observation, pytest.fail, jax.jit(policy)):
        assert digest_of(code) is None, code
    before = digest_of("this")
    programs._source.cache_clear()
    monkeypatch.setattr(programs, "__file__", __file__)
    assert digest_of("this") != before
    programs._source.cache_clear()


def test_what_was_not_used_for_longest_is_deleted(cache, monkeypatch):
    monkeypatch.setattr(programs, "_MOST", 3)
    for name in "abcd":
        assert keep(cache / name, name.encode())
        if name == "c":
            # Used now: then "b" is the oldest.
            assert programs.read_own(cache / "a") == b"a"
    assert sorted(path.name for path in cache.iterdir()) == ["a", "c", "d"]


def test_a_function_kept_by_decoration_is_the_same_traced_or_not(cache):
    calls = []

    @kept_jit
    def shifted(x, by):
        calls.append(1)
        return x + by

    one = jnp.float32(1.0)
    assert [float(shifted(one, 2.0)) for _ in range(2)] == [3.0, 3.0]
    assert float(shifted(one, 5.0)) == 6.0
    assert len(calls) == 2
    assert float(jax.jit(lambda x: shifted(x, 2.0))(one)) == 3.0
