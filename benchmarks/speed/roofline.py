"""How close the update comes to what the machine's matrix products allow.

The products of one TD3 update are counted from the layer sizes: every layer forward (inputs times weights,
NN), the gradient of its weights (inputs transposed, TN) and that of its inputs (weights transposed, NT).
Each shape is timed by itself; the rate of the whole is their operations over the sum of their times, as
often as an update needs each. Nothing else of an update is counted as work: neither activations, Adam and
the targets' averages, nor outer products (inner length 1), which a compiler makes part of what follows.
Every side runs with one thread and with one per core; its faster run counts.
"""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

import numpy as np

from sidestep._compiled import cores
from speed.children import Case
from speed.learning import BATCH, HIDDEN, training
from speed.timing import durations, spread

Product = tuple[str, int, int, int]
"""Kind (NN, NT or TN) and rows, inner length and columns of a product."""

ACTIONS, DELAY = 2, 2


def products(observations: int, hidden: list[int], batch: int) -> dict[Product, float]:
    """How often an update needs each product; those of the delayed actor update count as their share."""
    actor = list(pairwise([observations, *hidden, ACTIONS]))
    critic = list(pairwise([observations + ACTIONS, *hidden, 1]))
    counts: dict[Product, float] = {}

    def add(kind: str, layers: list[tuple[int, int]], times: float | int) -> None:
        for inputs, outputs in layers:
            shape = {
                "NN": (batch, inputs, outputs), "TN": (inputs, batch, outputs), "NT": (batch, outputs,
                inputs),
            }[kind]  # fmt: skip
            if shape[1] > 1:
                counts[kind, *shape] = counts.get((kind, *shape), 0.0) + times

    add("NN", actor, 1)  # target action
    add("NN", critic, 2 + 2)  # target values; values
    add("TN", critic, 2)
    add("NT", critic[1:], 2)  # nothing needs the gradient of the critics' inputs
    often = 1.0 / DELAY
    add("NN", actor, often)
    add("NN", critic, often)
    # To the action, and no further: the first layer's product gives its columns alone.
    add("NT", critic[1:], often)
    add("NT", [(ACTIONS, critic[0][1])], often)
    add("TN", actor, often)
    add("NT", actor[1:], often)
    return counts


def operations(product: Product) -> int:
    """Floating-point operations of a product: a multiplication and an addition per term."""
    return 2 * product[1] * product[2] * product[3]


def cases(quick: bool) -> list[Case]:
    """The products in JAX and in NumPy, the update alone, and the whole training loop."""
    seconds = 0.01 if quick else 0.3
    sides = ["JAX products", "NumPy products", "update", "training loop"]
    counts = [1] if quick else sorted({1, cores()})
    return [
        Case("roofline", side, {"side": side, "seconds": seconds}, threads=threads)
        for threads in counts
        for side in sides
    ]


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Rates of products, or seconds per update."""
    side, seconds = settings["side"], settings["seconds"]
    if side.endswith("products"):
        return _rates(side.partition(" ")[0], seconds)
    return _update(seconds) if side == "update" else _training_loop(20.0 * seconds)


def _counts() -> dict[Product, float]:
    from sidestep.world import load_scenario, observation_size

    return products(observation_size(load_scenario("paper")), HIDDEN, BATCH)


def _rates(library: str, budget: float) -> dict[str, Any]:
    counts, timed = _counts(), []
    for product, times in sorted(counts.items()):
        spent = (_jax_product if library == "JAX" else _numpy_product)(product, budget)
        timed.append(
            {
                "kind": product[0], "shape": list(product[1:]), "times_per_update": times,
                "microseconds": 1e6 * spent, "gflops": operations(product) / spent / 1e9,
            }
        )  # fmt: skip
    total = sum(operations(product) * times for product, times in counts.items())
    needed = sum(one["microseconds"] * one["times_per_update"] for one in timed) / 1e6
    return {
        "flops_per_update": total,
        "seconds_for_products": needed,
        "gflops": total / needed / 1e9,
        "throughput": {"value": 1.0 / needed, "unit": "updates/s"},
        "products": timed,
    }


def _operands(product: Product) -> tuple[np.ndarray, np.ndarray]:
    kind, rows, inner, columns = product
    random = np.random.default_rng(0)
    a = random.normal(size=(inner, rows) if kind == "TN" else (rows, inner)).astype(np.float32)
    b = random.normal(size=(columns, inner) if kind == "NT" else (inner, columns)).astype(np.float32)
    return a, b


def _numpy_product(product: Product, budget: float) -> float:
    a, b = _operands(product)
    left, right = (a.T if product[0] == "TN" else a), (b.T if product[0] == "NT" else b)
    out = np.empty((product[1], product[3]), np.float32)
    return float(np.median(durations(lambda _: np.matmul(left, right, out=out), budget, least=50)))


def _jax_product(product: Product, budget: float) -> float:
    """Seconds of one product within a compiled loop, as it is in an update: no call per product."""
    import jax
    import jax.numpy as jnp

    a, b = (jnp.asarray(operand) for operand in _operands(product))
    contract = {"NN": ((1,), (0,)), "NT": ((1,), (1,)), "TN": ((0,), (0,))}[product[0]]
    repeats = int(max(10, 3e7 // operations(product)))

    @jax.jit
    def loop(a: Any, b: Any) -> Any:
        def once(_: Any, carry: Any) -> Any:
            a, kept = carry
            # The barriers keep the compiler from seeing that one entry would do, or that nothing changes.
            c = jax.lax.optimization_barrier(jax.lax.dot_general(a, b, (contract, ((), ()))))
            a = a.at[0, 0].set(1e-6 * c[0, 0])
            return jax.lax.optimization_barrier((a, kept + c[0, 0]))

        return jax.lax.fori_loop(0, repeats, once, (a, jnp.zeros((), a.dtype)))[1]

    seconds = durations(lambda _: jax.block_until_ready(loop(a, b)), budget, least=5, warm_up=2)
    return float(np.median(seconds)) / repeats


def _update(budget: float) -> dict[str, Any]:
    """`sidestep.learning.update` alone, on one batch, a compiled loop of them."""
    import jax
    import jax.numpy as jnp

    from sidestep.learning import TD3, Batch, update
    from sidestep.world import load_scenario, observation_size

    size, random = observation_size(load_scenario("paper")), np.random.default_rng(0)
    draw = lambda *shape: jnp.asarray(random.normal(size=shape), dtype=float)  # noqa: E731
    batch = Batch(draw(BATCH, size), draw(BATCH, 2), draw(BATCH), draw(BATCH, size), jnp.zeros(BATCH))
    algorithm = TD3(hidden=tuple(HIDDEN))
    learner, repeats = algorithm.init(size, ACTIONS, jax.random.key(0)), 20

    @jax.jit
    def loop(algorithm: Any, learner: Any, key: Any) -> Any:
        return jax.lax.scan(
            lambda learner, key: (update(algorithm, learner, batch, key)[0], None),
            learner,
            jax.random.split(key, repeats),
        )[0]

    def advance(i: int) -> None:
        nonlocal learner
        learner = jax.block_until_ready(loop(algorithm, learner, jax.random.key(i)))

    begun = time.perf_counter()
    advance(0)
    compiling = time.perf_counter() - begun
    seconds = [spent / repeats for spent in durations(advance, 10.0 * budget)]
    return {
        "latency": spread(seconds, "ms"),
        "throughput": {"value": 1.0 / float(np.median(seconds)), "unit": "updates/s"},
        "compile_seconds": compiling,
    }


def _training_loop(budget: float) -> dict[str, Any]:
    """Steps per second of the loop behind the shield `game`; each is one update."""
    step, begin = training("game")
    state, chunk = begin(0), 50
    for _ in range(8):
        state = step(state, chunk)

    def advance(_: int) -> None:
        nonlocal state
        state = step(state, chunk)

    seconds = [spent / chunk for spent in durations(advance, budget, least=3)]
    return {
        "latency": spread(seconds, "ms"),
        "throughput": {"value": 1.0 / float(np.median(seconds)), "unit": "updates/s"},
    }


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """The roofline, updates per second if only the faster library's products took time, and shares of it."""
    found: dict[str, dict[str, Any]] = {}
    for one in results:
        if "throughput" in one:
            before = found.get(one["name"], one)
            faster = one["throughput"]["value"] > before["throughput"]["value"]
            found[one["name"]] = one if faster else before
    rates = {name: found[name]["gflops"] for name in ("JAX products", "NumPy products") if name in found}
    if not rates:
        return {}
    best = found[max(rates, key=lambda name: rates[name])]
    ceiling = best["throughput"]["value"]
    # The fastest known way of each shape: no library is the best at all of them.
    fastest = sum(
        min(one["microseconds"] for one in same) * same[0]["times_per_update"] / 1e6
        for same in zip(*(found[name]["products"] for name in rates), strict=True)
    )
    shares = {
        name: found[name]["throughput"]["value"] / ceiling
        for name in ("update", "training loop")
        if name in found
    }
    return {
        "megaflops_per_update": best["flops_per_update"] / 1e6,
        "gflops": rates,
        "gflops_best_of_each_shape": best["flops_per_update"] / fastest / 1e9,
        "roofline_updates_per_second": ceiling,
        "share_of_roofline": shares,
        "share_of_best_of_each_shape": {name: share * ceiling * fastest for name, share in shares.items()},
    }
