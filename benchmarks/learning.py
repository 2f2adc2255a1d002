"""Times the whole training loop against Stable-Baselines3's TD3 on the CPU: same task, networks and batch.

    make bench
    python benchmarks/learning.py --steps 5000 --out benchmarks/results/learning.json

Every side runs in a process of its own, one after the other, with the same number of threads. One step is one
decision of the policy, followed by one update. Compilation, and the random steps before the first update, are
timed apart; what counts are the chunks of steps after them.
"""

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

BATCH, HIDDEN, WARMUP = 256, [256, 256], 256
PURSUER = "turn-then-drive"
PACKAGES = ("sidestep", "jax", "jaxlib", "equinox", "numpy", "torch", "stable-baselines3", "gymnasium")


def ours(shield: str, hold: int, steps: int, chunk: int) -> dict[str, Any]:
    """Seconds per chunk of our loop, all of it compiled: act, shield, move, store, learn."""
    import jax
    import jax.numpy as jnp

    from sidestep.learning.options import make_options
    from sidestep.learning.training import run_chunk, start
    from sidestep.pursuit import make_pursuer
    from sidestep.safety import make_shield
    from sidestep.world import load_scenario

    scenario = load_scenario("paper")
    options = make_options(
        decision_steps=hold, updates_per_decision=1, batch_size=BATCH, hidden=HIDDEN, warmup_decisions=WARMUP
    )
    guard, pursuer = make_shield(shield, scenario), make_pursuer(PURSUER)
    state = start(scenario, guard, options, jax.random.key(0), capacity=max(10_000, 2 * steps))
    forever = jnp.asarray(2**30)

    def advance(state: Any) -> tuple[Any, float]:
        begun = time.perf_counter()
        state, _ = jax.block_until_ready(run_chunk(scenario, guard, pursuer, options, state, forever, chunk))
        return state, time.perf_counter() - begun

    state, first = advance(state)
    for _ in range(-(-WARMUP // chunk)):
        state, _ = advance(state)
    seconds = []
    for _ in range(steps // chunk):
        state, spent = advance(state)
        seconds.append(spent)
    return {"first_chunk_seconds": first, "chunk_seconds": seconds, "episodes": int(state.episodes)}


def peer(hold: int, steps: int, chunk: int) -> dict[str, Any]:
    """The same for Stable-Baselines3, timed by its callback at every `chunk` steps after the random ones."""
    import gymnasium
    import numpy as np
    import torch
    from peer_task import PeerTask
    from stable_baselines3 import TD3
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise

    from sidestep.world import load_scenario, scenario_to_dict

    class Pursued(gymnasium.Env):
        def __init__(self):
            self.task = PeerTask(scenario_to_dict(load_scenario("paper")), hold)
            size = self.task.observation_size
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
            self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed=seed)
            return self.task.reset(), {}

        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated = self.task.act(action)
            return observation, 0.01 * reward, terminated, truncated, {}

    class Clock(BaseCallback):
        def __init__(self):
            super().__init__()
            self.times: list[float] = []
            self.ended = 0

        def _on_step(self) -> bool:
            self.ended += int(self.locals["dones"][0])
            if self.num_timesteps >= WARMUP and (self.num_timesteps - WARMUP) % chunk == 0:
                self.times.append(time.perf_counter())
            return True

    torch.set_num_threads(int(os.environ["BENCH_THREADS"]))
    model = TD3(
        "MlpPolicy",
        Pursued(),
        learning_rate=3e-4,
        buffer_size=max(10_000, 2 * steps),
        learning_starts=WARMUP,
        batch_size=BATCH,
        tau=0.005,
        gamma=0.99,
        train_freq=1,
        gradient_steps=1,
        action_noise=NormalActionNoise(np.zeros(2), 0.1 * np.ones(2)),
        policy_delay=2,
        target_policy_noise=0.2,
        target_noise_clip=0.5,
        policy_kwargs={"net_arch": HIDDEN},
        device="cpu",
        seed=0,
    )
    clock = Clock()
    model.learn(WARMUP + 2 * chunk + steps, callback=clock)
    between = np.diff(clock.times)
    # The first chunk after the random steps warms up caches, as ours does.
    return {
        "first_chunk_seconds": float(between[0]),
        "chunk_seconds": [float(seconds) for seconds in between[1 : 1 + steps // chunk]],
        "episodes": clock.ended,
    }


def version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def run_apart(side: str, threads: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """One side in a process of its own, with `threads` threads, and its figures."""
    environment = {
        **os.environ,
        "BENCH_THREADS": str(threads),
        "OMP_NUM_THREADS": str(threads),
        "MKL_NUM_THREADS": str(threads),
        "JAX_PLATFORMS": "cpu",
    }
    if threads == 1:
        environment["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    command = [
        sys.executable, __file__, "--side", side, "--hold", str(arguments.hold),
        "--steps", str(arguments.steps), "--chunk", str(arguments.chunk),
    ]  # fmt: skip
    print(f"{side}, {threads} thread{'s' if threads > 1 else ''} ...", file=sys.stderr, flush=True)
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    raw = json.loads(done.stdout.splitlines()[-1])
    per_step = sorted(1000.0 * seconds / arguments.chunk for seconds in raw["chunk_seconds"])
    at = lambda share: per_step[min(len(per_step) - 1, int(share * len(per_step)))]  # noqa: E731
    median = at(0.5)
    figures = {
        "side": side,
        "threads": threads,
        "steps_per_second": 1000.0 * len(per_step) / sum(per_step),
        "milliseconds_per_step": {"p50": median, "p99": at(0.99), "worst": per_step[-1]},
        "first_chunk_seconds": raw["first_chunk_seconds"],
        "compile_seconds": max(0.0, raw["first_chunk_seconds"] - median * arguments.chunk / 1000.0)
        if side != "peer"
        else 0.0,
        "chunks": len(per_step),
        "episodes": raw["episodes"],
    }
    print(f"  {figures['steps_per_second']:.0f} steps/s", file=sys.stderr, flush=True)
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/learning.json"))
    parser.add_argument("--steps", type=int, default=4000, help="timed steps of each side")
    parser.add_argument("--chunk", type=int, default=100, help="steps per timed chunk")
    parser.add_argument("--hold", type=int, default=1, help="control periods per step")
    parser.add_argument(
        "--threads",
        type=int,
        nargs="+",
        default=sorted({1, os.cpu_count() or 1}),
        help="thread counts to run",
    )
    parser.add_argument("--side", choices=["ours-none", "ours-game", "peer"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.steps < arguments.chunk or min(arguments.chunk, arguments.hold, *arguments.threads) < 1:
        parser.error("--steps must be at least --chunk, and everything at least 1")
    if arguments.side == "peer":
        print(json.dumps(peer(arguments.hold, arguments.steps, arguments.chunk)))
        return
    if arguments.side:
        shield = arguments.side.partition("-")[2]
        print(json.dumps(ours(shield, arguments.hold, arguments.steps, arguments.chunk)))
        return

    load = os.getloadavg()[0]
    if load > 0.5:
        print(
            f"Something else runs here (load {load:.1f}): these figures will not mean much.", file=sys.stderr
        )
    runs = [
        run_apart(side, threads, arguments)
        for threads in arguments.threads
        for side in ("peer", "ours-none", "ours-game")
    ]
    best = {
        side: max((run for run in runs if run["side"] == side), key=lambda run: run["steps_per_second"])
        for side in ("peer", "ours-none", "ours-game")
    }
    fastest_peer = best["peer"]["steps_per_second"]
    result = {
        "what": "training loop, one update per step, against Stable-Baselines3 TD3 on the CPU",
        "settings": {
            "scenario": "paper", "pursuer": PURSUER, "hidden": HIDDEN, "batch": BATCH, "warmup": WARMUP,
            "control_periods_per_step": arguments.hold, "timed_steps": arguments.steps,
            "chunk": arguments.chunk,
        },
        "machine": {
            "processor": processor(), "cores": os.cpu_count(), "system": platform.platform(),
            "load_before": load,
        },
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in PACKAGES},
        },
        "runs": runs,
        "ratio_like_for_like": best["ours-none"]["steps_per_second"] / fastest_peer,
        "ratio_with_our_shield": best["ours-game"]["steps_per_second"] / fastest_peer,
    }  # fmt: skip
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(
        f"ours {result['ratio_like_for_like']:.2f} times the peer's speed, "
        f"{result['ratio_with_our_shield']:.2f} times with our shield and the peer without; {arguments.out}"
    )


if __name__ == "__main__":
    main()
