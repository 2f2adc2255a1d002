"""Hazard: a browser decides otherwise than what was trained and tested."""

import ctypes
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.bridges.export import NotTranslatable
from sidestep.bridges.export.c_code import HELPERS, CBody, table
from sidestep.bridges.export.program import Program, kind_of
from sidestep.bridges.export.translate import LONG, translate
from sidestep.bridges.export.wasm_code import WasmLibrary
from sidestep.bridges.export.wasm_module import signed, unsigned

_NUMBERS = 6


def reals(x):
    """Operations on real numbers, in loops, conditions and tables."""
    long = jnp.sin(x[0] + 0.1 * jnp.arange(LONG + 8.0))
    grid = jnp.asarray(np.linspace(-1.0, 1.0, 60, dtype=np.float32).reshape(12, 5))
    count = jnp.clip((4.0 * x[1]).astype(jnp.int32), -3, 20)
    chosen = grid.at[count, jnp.argmin(x) % 5].get(mode="clip")
    joined = jnp.concatenate([long, 2.0 * long[:3], x])
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(6, 40)).astype(np.float32))

    def heavy(y):
        many = jax.vmap(lambda z: jnp.min(jnp.stack([z * y, z - y])))(long)
        return jnp.where(jnp.any(many > 0.9), jnp.max(many), jnp.sum(many))

    deep = x[0]
    for _ in range(90):
        deep = 0.9 * deep + x[5] * x[4]
    places = jnp.abs(x) + 0.1
    return (
        jnp.stack([chosen, jnp.min(long), jax.lax.cond(x[2] > x[3], heavy, lambda y: -y, x[4])]),
        jax.lax.switch(count, [lambda: x[0], lambda: x[1] * x[2], lambda: jnp.sum(long), lambda: long[3]]),
        jnp.stack([jnp.arctan2(x[0], x[1]), x[0] % 0.7, places[0] ** x[1], jnp.sign(x[2]), jnp.round(x)[3]]),
        jnp.stack([jnp.exp(x[0]), jnp.log(places[1]), jnp.log1p(places[2]), jnp.expm1(x[3]), jnp.tanh(x[4])]),
        jnp.stack([jnp.arcsin(jnp.tanh(x[0])), jnp.arccos(jnp.tanh(x[1])), jnp.arctan(x[2]), jnp.tan(x[3])]),
        jnp.stack([jnp.arcsinh(x[0]), jnp.sqrt(places[0]), jnp.floor(x[1]), jnp.ceil(x[2]), jnp.cos(x[3])]),
        jnp.sum(jnp.maximum(x @ matrix, 0.0) @ matrix.T) * 0.01,
        jax.lax.fori_loop(0, 20, lambda k, y: 0.7 * y + x[k % 6], x[0]),
        deep,
        x[jnp.argsort(x)],
        jnp.isfinite(x / jnp.floor(x)),
        jnp.stack([joined[jnp.argmax(joined)], jnp.max(x), jnp.min(x)]),
    )


def wholes(x):
    """Operations on whole numbers and their bits, and random numbers."""
    a, b = (40.0 * x[0]).astype(jnp.int32), (3.0 * x[1]).astype(jnp.int32)
    big = jax.lax.bitcast_convert_type(x[2], jnp.int32)
    key = jax.random.fold_in(jax.random.PRNGKey(7), a)
    one, other = jax.random.split(key)
    bits = jax.random.bits(other, (3,))
    return (
        jnp.stack([jax.lax.div(a, b), jax.lax.rem(a, b), jax.lax.rem(big, b), jnp.abs(a), jnp.sign(b), ~a]),
        jnp.stack([big * big + a, big & b, big | b, big ^ a, jnp.minimum(a, b), jnp.maximum(a, b)]),
        jnp.stack([(1e9 * x[3]).astype(jnp.int32), (x[4] / 0.0).astype(jnp.int32), -big]),
        jax.lax.bitcast_convert_type(big + 1, jnp.float32),
        (bits >> 8).astype(jnp.int32),
        jax.random.uniform(one, (2, 2), minval=-3.0, maxval=5.0),
        jnp.argmin(jnp.where(jnp.arange(LONG + 1) == a, 0, 1)),
    )


def states(count=1000):
    """Numbers of all sizes, with whole ones, infinities and NaN."""
    rng = np.random.default_rng(1)
    made = rng.normal(size=(count, _NUMBERS)).astype(np.float32)
    made[:40] = np.round(made[:40])
    # XLA's reductions do not say what becomes of a NaN.
    made[np.arange(40, 80), rng.integers(2, 6, 40)] = rng.choice([1e30, -1e30, 0.0], 40)
    return made


def flat(parts, count):
    return np.concatenate([np.asarray(part).astype(np.float32).reshape(count, -1) for part in parts], 1)


def by_wasm(function, given, answers_of):
    library = WasmLibrary()
    shape = jax.ShapeDtypeStruct((_NUMBERS,), jnp.float32)
    inputs = [library.area("f", (_NUMBERS,))]
    outputs = [library.area(kind_of(one.dtype), one.shape) for one in jax.eval_shape(function, shape)]
    library.add("f", function, inputs, outputs)
    return answers_of(library.binary(), "f", inputs, outputs, given)


def by_c(function, given, compiler, folder):
    program = Program()
    names = np.array([program.given(f"in[{k}]", "f") for k in range(_NUMBERS)], object)
    nodes = [node for part in translate(program, function, [names]) for node in part.reshape(-1)]
    body = CBody(program, [(f"out[{k}]", node) for k, node in enumerate(nodes)])
    tables = [line for k in body.tables for line in table(f"table{k}", program.tables.arrays[k])]
    head = "void f(const float *in, float *out)"
    lines = ["#include <math.h>", "#include <stdbool.h>", "#include <stdint.h>", HELPERS, *tables]
    source, library = folder / "f.c", folder / "f.so"
    source.write_text("\n".join([*lines, head, "{", *body.lines(), "}", ""]))
    subprocess.run([compiler, "-std=c99", "-shared", "-fPIC", "-o", library, source, "-lm"], check=True)
    f = ctypes.CDLL(str(library)).f
    f.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    found = np.empty((len(given), len(nodes)), np.float32)
    for state, out in zip(given, found, strict=True):
        f(state.ctypes.data, out.ctypes.data)
    return found


def test_operations_on_real_numbers_are_those_of_jax(answers_of):
    given = states()
    wanted = flat(jax.jit(jax.vmap(reals))(given), len(given))
    np.testing.assert_allclose(by_wasm(reals, given, answers_of), wanted, rtol=2e-5, atol=2e-6)


def test_operations_on_whole_numbers_and_random_ones_are_those_of_jax_bit_by_bit(
    answers_of, need_program, tmp_path
):
    given = states()
    wanted = flat(jax.jit(jax.vmap(wholes))(given), len(given))
    np.testing.assert_array_equal(by_wasm(wholes, given, answers_of), wanted)
    compiler = need_program("cc", package="gcc")
    np.testing.assert_array_equal(by_c(wholes, given, compiler, tmp_path), wanted)


def test_a_nan_stays_one(answers_of):
    def function(x):
        return (jnp.minimum(x[0], x[1]), jnp.maximum(x[0], x[1]), jnp.clip(x[2], -1.0, 1.0), jnp.sign(x[3]))

    given = np.zeros((5, _NUMBERS), np.float32)
    given[np.arange(4), np.arange(4)] = np.nan
    found = by_wasm(function, given, answers_of)
    wanted = flat(jax.vmap(function)(given), 5)
    np.testing.assert_array_equal(found, wanted)
    assert np.sum(np.isnan(found)) == 6


def test_an_area_may_be_input_and_output(answers_of):
    library = WasmLibrary()
    pair = library.area("f", (2,))
    library.add("turn", lambda x: (x[::-1],), [pair], [pair])
    given = np.array([[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(answers_of(library.binary(), "turn", [pair], [pair], given), given[:, ::-1])


def test_results_of_another_kind_or_shape_are_refused():
    library = WasmLibrary()
    given, wanted = library.area("f", (3,)), library.area("i", ())
    with pytest.raises(ValueError, match=r"total: \(\) of \{'f'\}, not \(\) of i"):
        library.add("total", lambda x: (jnp.sum(x),), [given], [wanted])


def many_steps(x):
    return (jax.lax.fori_loop(0, 99, lambda k, y: 2.0 * y, x),)


def unknown_shift(x):
    count = x.astype(jnp.int32)
    return (jax.lax.shift_left(count, count),)


def half_words(x):
    key = jax.random.PRNGKey(x[0].astype(jnp.int32))
    return (jax.random.uniform(key, (3,), dtype=jnp.float16),)


@pytest.mark.parametrize(
    "function, words",
    [
        (many_steps, "'scan' .*: 99 steps"),
        (unknown_shift, "'shift_left' .*: a shift by a number that is not known"),
        (half_words, "'random_bits' .*: 16 random bits"),
    ],
)
def test_what_cannot_be_translated_is_named_with_its_line(function, words):
    library = WasmLibrary()
    area = library.area("f", (3,))
    with pytest.raises(NotTranslatable, match=words) as raised:
        library.add("f", function, [area], [area])
    assert "test_export_wasm.py" in str(raised.value)


def test_whole_numbers_are_written_as_the_format_wants_them():
    assert [unsigned(n) for n in (0, 127, 128, 624485)] == [b"\0", b"\x7f", b"\x80\1", b"\xe5\x8e\x26"]
    assert [signed(n) for n in (0, 63, 64, -1, -64, -65)] == [
        b"\0",
        b"\x3f",
        b"\xc0\0",
        b"\x7f",
        b"\x40",
        b"\xbf\x7f",
    ]
    assert signed(-123456) == b"\xc0\xbb\x78"
