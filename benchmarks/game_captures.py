"""Does the `game` shield let anybody be captured? A million episodes of 60 s without obstacles.

    python benchmarks/game_captures.py --out benchmarks/results/game_captures.json

Every built-in pursuer against two policies that never finish, so that an episode lasts 60 s unless it ends
in a capture: `stay` heads for the target and then holds still there, while the pursuer comes again and again;
`reckless` always heads straight at the pursuer, so that only the shield keeps it free. Starts are uniform in
the scenario's square, anywhere outside the capture set, as close to it as chance has it.

Work is done in blocks, each with a random key of its own (the same for every pursuer and policy: `fold_in` of
the seed with the block's number), and written down block by block: a run that was interrupted goes on where
it stopped, and one that is asked for more blocks adds them. It uses an accelerator where JAX has one.
"""

import argparse
import importlib.metadata
import json
import multiprocessing
import os
import platform
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

STOP_SHORT = 0.02
"""Distance (m) from the target at which `stay` holds still."""
POLICIES = ("stay", "reckless")
SCENARIO: dict[str, Any] = {
    "obstacle_count": 0,
    "episode_steps": 1200,
    # Nothing ends an episode but capture and time: no start is too close, and no target is ever reached.
    "initial_separation": 0.0,
    "reach_distance": 1e-9,
}
"""Fields that differ from the preset `paper`."""


def _policy(name: str) -> Any:
    import jax.numpy as jnp

    def stay(observation: Any) -> Any:
        """Full speed at the target, along x; entry 1 is exp(-d/0.25) for its distance d (m)."""
        ahead = jnp.zeros_like(observation[:2]).at[0].set(1.0)
        return jnp.where(observation[1] < jnp.exp(jnp.float32(-STOP_SHORT / 0.25)), ahead, 0.0)

    def reckless(observation: Any) -> Any:
        """Full speed at the pursuer; entries 2 and 3 are its position, squashed along its direction."""
        toward = observation[2:4]
        squared = jnp.sum(toward**2)
        apart = squared > 0.0
        return jnp.where(apart, toward / jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)

    return {"stay": stay, "reckless": reckless}[name]


_policies: dict[str, Any] = {}


def run_block(job: tuple[str, str, int, int, int, dict[str, Any]]) -> dict[str, Any]:
    """One block of episodes: (pursuer, policy, seed, block, episodes, scenario fields) to its counts."""
    pursuer, policy, seed, block, episodes, fields = job
    import jax
    import numpy as np

    from sidestep.trials import evaluate
    from sidestep.world import load_scenario

    scenario = load_scenario("paper", **fields)
    # The same function object every time, or JAX would compile anew.
    act = _policies.setdefault(policy, _policy(policy))
    begun = time.perf_counter()
    key = jax.random.fold_in(jax.random.key(seed), block)
    result = evaluate(scenario, act, "game", pursuer, episodes, key, batch=episodes)
    clearances = np.sort(result.min_pursuer_clearance)
    return {
        "pursuer": pursuer,
        "policy": policy,
        "block": block,
        "episodes": result.episodes,
        "captured": result.captured,
        "reached": result.reached,
        "env_steps": int(result.steps.sum()),
        "smallest_distance": float(clearances[0]) + float(scenario.capture_distance),
        "corrected_steps": int(result.interventions.sum()),
        "infeasible_steps": int(result.infeasible.sum()),
        "captures": [{"block": block, "episode": int(i)} for i in result.numbers_of("captured")],
        "seconds": time.perf_counter() - begun,
    }


_SUMS = ("episodes", "captured", "reached", "env_steps", "corrected_steps", "infeasible_steps", "seconds")


def combine(blocks: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts over blocks, with 95 % bounds of the share of captures."""
    from sidestep.trials import wilson_interval, zero_event_bound

    total: dict[str, Any] = {name: sum(block[name] for block in blocks) for name in _SUMS}
    total["smallest_distance"] = min(block["smallest_distance"] for block in blocks)
    low, high = wilson_interval(total["captured"], total["episodes"])
    total |= {"captured_rate_low": low, "captured_rate_high": high}
    if total["captured"] == 0:
        total["captured_rate_one_sided_95"] = zero_event_bound(total["episodes"])
    return total


def summary(blocks: list[dict[str, Any]]) -> dict[str, Any]:
    """`combine` over everything, and per pursuer and policy."""
    pairs = dict.fromkeys((block["pursuer"], block["policy"]) for block in blocks)
    return {
        "total": combine(blocks),
        "each": [
            {"pursuer": pursuer, "policy": policy}
            | combine([b for b in blocks if (b["pursuer"], b["policy"]) == (pursuer, policy)])
            for pursuer, policy in pairs
        ],
    }


def _write(path: Path, settings: dict[str, Any], blocks: list[dict[str, Any]]) -> None:
    import jax

    report = {
        "what": "episodes behind the game shield without obstacles: captures",
        "settings": settings,
        "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count(),
                    "device": jax.devices()[0].device_kind},
        "versions": {name: importlib.metadata.version(name) for name in ("sidestep", "jax", "numpy")},
        **summary(blocks),
        "blocks": sorted(blocks, key=lambda b: (b["pursuer"], b["policy"], b["block"])),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".tmp")
    beside.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    os.replace(beside, path)


def _alone() -> None:
    """A worker leaves Ctrl-C to its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _results(jobs: list[Any], processes: int) -> Iterator[dict[str, Any]]:
    if processes == 1:
        yield from map(run_block, jobs)
        return
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    with multiprocessing.get_context("spawn").Pool(processes, _alone) as pool:
        yield from pool.imap_unordered(run_block, jobs)


def main() -> None:
    import jax

    from sidestep.pursuit import PURSUERS

    on_cpu = jax.default_backend() == "cpu"
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/game_captures.json"))
    parser.add_argument("--pursuers", nargs="*", default=list(PURSUERS), choices=list(PURSUERS))
    parser.add_argument("--policies", nargs="*", default=list(POLICIES), choices=POLICIES)
    parser.add_argument("--blocks", type=int, default=29, help="blocks for each pursuer and policy")
    parser.add_argument("--block", type=int, default=2500 if on_cpu else 72500, help="episodes in a block")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=NUMBER", help="other scenario fields")
    arguments = parser.parse_args()

    fields = SCENARIO | {name: json.loads(value) for name, value in (f.split("=", 1) for f in arguments.set)}
    settings = {
        "scenario": "paper", "fields": fields, "shield": "game", "seed": arguments.seed,
        "episodes_per_block": arguments.block,
    }  # fmt: skip
    blocks: list[dict[str, Any]] = []
    if arguments.out.exists():
        earlier = json.loads(arguments.out.read_text(encoding="utf-8"))
        if earlier["settings"] != settings:
            raise SystemExit(f"{arguments.out} was made with other settings, {earlier['settings']}")
        blocks = earlier["blocks"]
    done = {(b["pursuer"], b["policy"], b["block"]) for b in blocks}
    jobs = [
        (pursuer, policy, arguments.seed, block, arguments.block, fields)
        for block in range(arguments.blocks)
        for pursuer in arguments.pursuers
        for policy in arguments.policies
        if (pursuer, policy, block) not in done
    ]
    print(f"{len(done)} blocks are done, {len(jobs)} to do, {arguments.block} episodes each", flush=True)
    begun = time.perf_counter()
    try:
        for count, result in enumerate(_results(jobs, arguments.processes), 1):
            blocks.append(result)
            _write(arguments.out, settings, blocks)
            left = (time.perf_counter() - begun) / count * (len(jobs) - count)
            speed = result["env_steps"] / result["seconds"]
            print(
                f"{result['policy']:>8} against {result['pursuer']:<18} block {result['block']}: "
                f"{result['captured']} captured of {result['episodes']}, smallest distance "
                f"{result['smallest_distance']:.5f} m, {speed:,.0f} steps/s, {left / 60:.0f} min left",
                flush=True,
            )
    except KeyboardInterrupt:
        print(f"interrupted; the same command goes on after the {len(blocks)} blocks in {arguments.out}")
    if blocks:
        total = combine(blocks)
        bound = total.get("captured_rate_one_sided_95", total["captured_rate_high"])
        print(
            f"{total['captured']} captures in {total['episodes']:,} episodes (95 % bound of the share: "
            f"{bound:.2g}), smallest distance {total['smallest_distance']:.5f} m"
        )


if __name__ == "__main__":
    main()
