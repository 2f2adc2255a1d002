"""The whole training loop - act, shield, move, store, learn - against three implementations of TD3.

Same task (scenario `paper`, pursuer `turn-then-drive`), two hidden layers of 256 with ReLU, batch 256,
Adam, one update per step of all worlds. A side runs with one thread and with one per core; its faster run
counts.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from sidestep._compiled import cores
from speed.children import Case
from speed.timing import durations, first_call, spread

BATCH, HIDDEN, WARMUP, BUFFER = 256, [256, 256], 256, 10_000
PURSUER = "turn-then-drive"
SIDES = {
    "ours, no shield": "ours-none",
    "ours, game shield": "ours-game",
    "Stable-Baselines3 TD3": "sb3",
    "SBX TD3": "sbx",
    "rejax TD3": "rejax",
}
PEERS = ("Stable-Baselines3 TD3", "SBX TD3", "rejax TD3")


def cases(quick: bool) -> list[Case]:
    """Every side, with one thread and with one per core."""
    amount = {"seconds": 0.5, "chunk": 10} if quick else {"seconds": 6.0, "chunk": 100}
    counts = [1] if quick else sorted({1, cores()})
    return [
        Case("learning", name, {"side": side, **amount}, threads=threads)
        for threads in counts
        for name, side in SIDES.items()
    ]


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Milliseconds per step of one side, in chunks of steps, for `seconds` after all has compiled; `worlds`
    are stepped at once, one by default."""
    side, chunk, budget = settings["side"], settings["chunk"], settings["seconds"]
    worlds = settings.get("worlds", 1)
    if side in ("sb3", "sbx"):
        first, seconds = _stable_baselines(side, chunk, budget, worlds)
    else:
        shield = side.partition("-")[2]
        advance = _rejax(chunk, worlds) if side == "rejax" else _ours(shield, chunk, worlds)
        _, first = first_call(advance)
        seconds = durations(lambda _: advance(), budget, least=3, warm_up=-(-WARMUP // (chunk * worlds)))
    per_step = [spent / chunk for spent in seconds]
    return {
        "latency": spread(per_step, "ms"),
        "throughput": {"value": worlds / float(np.mean(per_step)), "unit": "steps/s"},
        "compile_seconds": max(0.0, first - chunk * float(np.median(per_step))) if side != "sb3" else 0.0,
    }


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """The faster run of each side, and ours against each peer's."""
    best: dict[str, float] = {}
    for result in results:
        if "throughput" in result:
            best[result["name"]] = max(best.get(result["name"], 0.0), result["throughput"]["value"])
    ratios = {
        f"{ours} / {name}": best[ours] / best[name]
        for ours in ("ours, no shield", "ours, game shield")
        for name in PEERS
        if ours in best and name in best
    }
    return {"steps_per_second": best, "ratios": ratios}


def training(shield: str, worlds: int = 1) -> tuple[Callable[[Any, int], Any], Callable[[int], Any]]:
    """`advance(state, length) -> state` and `begin(seed) -> state` of our training loop."""
    import jax
    import jax.numpy as jnp

    from sidestep.learning import make_options, run_chunk, start
    from sidestep.pursuit import make_pursuer
    from sidestep.safety import make_shield
    from sidestep.world import load_scenario

    scenario = load_scenario("paper")
    options = make_options(
        decision_steps=1,
        updates_per_decision=1,
        batch_size=BATCH,
        hidden=HIDDEN,
        warmup_decisions=WARMUP,
        worlds=worlds,
    )
    guard, pursuer = make_shield(shield, scenario), make_pursuer(PURSUER)
    forever = jnp.asarray(2**30)

    def begin(seed: int) -> Any:
        return start(scenario, guard, options, jax.random.key(seed), capacity=BUFFER)

    def advance(state: Any, length: int) -> Any:
        state, _ = jax.block_until_ready(run_chunk(scenario, guard, pursuer, options, state, forever, length))
        return state

    return advance, begin


def _ours(shield: str, chunk: int, worlds: int) -> Callable[[], None]:
    step, begin = training(shield, worlds)
    state = begin(0)

    def advance() -> None:
        nonlocal state
        state = step(state, chunk)

    return advance


def _rejax(chunk: int, worlds: int) -> Callable[[], None]:
    """rejax's `train`, compiled whole as its authors do, `chunk` steps a call, and no evaluation in it."""
    import jax

    from speed.peers import peer
    from speed.rejax_task import PursuedInJax

    rejax, networks, linen = peer("rejax"), peer("rejax.networks"), peer("flax.linen")
    task = PursuedInJax(PURSUER)
    algorithm = rejax.get_algo("td3").create(
        env=task.environment,
        env_params=task.environment.default_params,
        num_envs=worlds,
        num_epochs=1,
        policy_delay=2,
        batch_size=BATCH,
        buffer_size=BUFFER,
        fill_buffer=WARMUP,
        total_timesteps=chunk * worlds,
        eval_freq=chunk * worlds,
        learning_rate=3e-4,
        gamma=0.99,
        polyak=0.995,
        exploration_noise=0.1,
        skip_initial_evaluation=True,
    )
    # `actor_kwargs` cannot name layer sizes in this release: its constructor passes them twice.
    algorithm = algorithm.replace(
        actor=networks.DeterministicPolicy(
            2, (-1.0, 1.0), hidden_layer_sizes=tuple(HIDDEN), activation=linen.relu
        ),
        critic=networks.QNetwork(hidden_layer_sizes=tuple(HIDDEN), activation=linen.relu),
        eval_callback=lambda algorithm, state, key: (),
    )
    # The optimiser inside the state holds the learning rate, so the state is made outside of `jit`.
    state = algorithm.init_state(jax.random.PRNGKey(0))
    train = jax.jit(lambda state: algorithm.train(train_state=state)[0])

    def advance() -> None:
        nonlocal state
        state = jax.block_until_ready(train(state))

    return advance


def _stable_baselines(side: str, chunk: int, budget: float, worlds: int) -> tuple[float, list[float]]:
    """Seconds of the first chunk after the random steps, and of those after it, told by a callback."""
    from speed.gymnasium_task import make_environment
    from speed.peers import peer

    callbacks, noises = peer("stable_baselines3.common.callbacks"), peer("stable_baselines3.common.noise")
    vectors = peer("stable_baselines3.common.vec_env")
    threads = int(os.environ.get("OMP_NUM_THREADS", cores()))
    peer("torch").set_num_threads(threads)
    times: list[float] = []

    class Clock(callbacks.BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps >= WARMUP and (self.num_timesteps - WARMUP) // worlds % chunk == 0:
                times.append(time.perf_counter())
            return len(times) < 5 or times[-1] - times[1] < budget

    model = peer("stable_baselines3" if side == "sb3" else "sbx").TD3(
        "MlpPolicy",
        vectors.DummyVecEnv([make_environment] * worlds),
        learning_rate=3e-4,
        buffer_size=BUFFER,
        learning_starts=WARMUP,
        batch_size=BATCH,
        tau=0.005,
        gamma=0.99,
        train_freq=1,
        gradient_steps=1,
        action_noise=noises.VectorizedActionNoise(
            noises.NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)), worlds
        ),
        policy_delay=2,
        target_policy_noise=0.2,
        target_noise_clip=0.5,
        policy_kwargs={"net_arch": HIDDEN},
        device="cpu",
        seed=0,
    )
    model.learn(10_000_000, callback=Clock())
    between = np.diff(times)
    # The first chunk after the random steps compiles (SBX) and warms up caches, as ours does.
    return float(between[0]), between[1:].tolist()
