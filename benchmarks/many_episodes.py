"""Does a shield let anything happen? Many episodes against every built-in pursuer, counted.

    python benchmarks/many_episodes.py game --out benchmarks/results/game_captures.json
    python benchmarks/many_episodes.py joint --out benchmarks/results/joint_episodes.json
    python benchmarks/many_episodes.py three-obstacles --out benchmarks/results/joint_three_obstacles.json
    python benchmarks/many_episodes.py joint --policies runs/reproduce/joint --pursuers nash --out FILE
    python benchmarks/many_episodes.py attacked --out benchmarks/results/joint_attacked.json

- `game`: captures behind the `game` shield without obstacles, a million episodes of 60 s. Two policies never
  finish, so that an episode ends in a capture or not at all: `stay` heads for the target and then holds
  still there, while the pursuer comes again and again; `reckless` always heads straight at the pursuer, so
  that only the shield keeps it free. Starts are uniform in the scenario's square, outside the capture set.
- `joint`: the shield `joint` with one obstacle and the untrained policy that heads for the target, or a run
  folder's; 20,000 episodes of at most 120 s against `nash`, 5,000 against every other pursuer.
- `attacked`: the same, 10,000 episodes against each pursuer of `attack_pursuers`.
- `three-obstacles`: the same with three obstacles, 5,000 episodes against `nash`.
- `2-pursuers-game`, `2-pursuers-joint`, and so with 3: several `nash` at once, no obstacle, 500 each.

Work is done in blocks, each with a random key of its own (the same for every pursuer and policy: `fold_in` of
the seed with the block's number), and written down block by block: a run that was interrupted goes on where
it stopped, and one that is asked for more blocks adds them. It uses an accelerator where JAX has one.
"""

import argparse
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import study_blocks
from machine import machine, versions
from sidestep.store.files import write_json

STOP_SHORT = 0.02
"""Distance (m) from the target at which `stay` holds still."""


@dataclass(frozen=True)
class Study:
    """`fields` differ from the preset `paper`; `blocks` per pursuer, `other` for pursuers not named there."""

    shield: str
    policies: tuple[str, ...]
    fields: dict[str, Any]
    block: int
    batch: int
    other: int
    blocks: dict[str, int] = field(default_factory=dict)


STUDIES = {
    "game": Study(
        "game",
        ("stay", "reckless"),
        {
            "obstacle_count": 0,
            "episode_steps": 1200,
            # Nothing ends an episode but capture and time: no start is too close, no target is ever reached.
            "initial_separation": 0.0,
            "reach_distance": 1e-9,
        },
        block=2500,
        batch=2500,
        other=29,
    ),
    "joint": Study(
        "joint",
        ("goal-seeking",),
        {"episode_steps": 2400},
        block=500,
        batch=64,
        other=10,
        blocks={"nash": 40},
    ),
    "attacked": Study("joint", ("goal-seeking",), {"episode_steps": 2400}, block=500, batch=250, other=20),
    "three-obstacles": Study(
        "joint",
        ("goal-seeking",),
        {"episode_steps": 2400, "obstacle_count": 3},
        block=500,
        batch=64,
        other=0,
        blocks={"nash": 10},
    ),
    **{
        f"{count}-pursuers-{shield}": Study(
            shield,
            ("goal-seeking",),
            {"episode_steps": 2400, "obstacle_count": 0, "pursuer_count": count},
            block=250,
            batch=64,
            other=0,
            blocks={"nash": 2},
        )
        for count in (2, 3)
        for shield in ("game", "joint")
    },
}


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

    if name == "goal-seeking":
        return name
    if name in ("stay", "reckless"):
        return {"stay": stay, "reckless": reckless}[name]
    from sidestep.learning import load_policy

    return load_policy(name)


_policies: dict[str, Any] = {}
_pursuers: dict[str, Any] = {}


def run_block(job: tuple[str, str, str, int, int, int, dict[str, Any]]) -> dict[str, Any]:
    """A block of episodes: (study, pursuer, policy, seed, block, episodes, scenario fields) to its counts."""
    study, pursuer, policy, seed, block, episodes, fields = job
    import jax
    import numpy as np

    from attack_pursuers import pursuer_named
    from sidestep.trials import evaluate
    from sidestep.world import load_scenario

    scenario = load_scenario("paper", **fields)
    # The same function object every time, or JAX would compile anew.
    if policy not in _policies:
        _policies[policy] = _policy(policy)
    begun = time.perf_counter()
    key = jax.random.fold_in(jax.random.key(seed), block)
    batch = episodes if jax.default_backend() != "cpu" else min(episodes, STUDIES[study].batch)
    if pursuer not in _pursuers:
        _pursuers[pursuer] = pursuer_named(pursuer)
    against = _pursuers[pursuer]
    result = evaluate(scenario, _policies[policy], STUDIES[study].shield, against, episodes, key, batch=batch)

    def happened(outcome: str) -> list[int]:
        return [int(number) for number in result.numbers_of(outcome)]

    def least(clearances: Any, distance: Any) -> float | None:
        smallest = float(np.min(clearances)) + float(distance)
        return smallest if np.isfinite(smallest) else None

    return {
        "pursuer": pursuer,
        "policy": policy,
        "block": block,
        "episodes": result.episodes,
        "captured": result.captured,
        "collided": result.collided,
        "reached": result.reached,
        "timed_out": result.timed_out,
        "env_steps": int(result.steps.sum()),
        "smallest_distance": least(result.min_pursuer_clearance, scenario.capture_distance),
        "smallest_obstacle_distance": least(result.min_obstacle_clearance, scenario.collision_distance),
        "corrected_steps": int(result.interventions.sum()),
        "corrections": float(np.sum(result.mean_correction * result.steps)),
        "infeasible_steps": int(result.infeasible.sum()),
        "lost": {name: happened(name) for name in ("captured", "collided")},
        "seconds": time.perf_counter() - begun,
    }


_SUMS = (
    "episodes", "captured", "collided", "reached", "timed_out", "env_steps", "corrected_steps",
    "corrections", "infeasible_steps", "seconds",
)  # fmt: skip
_LEAST = ("smallest_distance", "smallest_obstacle_distance")


def combine(blocks: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts over blocks, with 95 % bounds of the shares."""
    from sidestep.trials import wilson_interval, zero_event_bound

    def added(name: str) -> Any:
        values = [block[name] for block in blocks]
        return None if None in values else sum(values)

    total: dict[str, Any] = {name: added(name) for name in _SUMS}
    for name in _LEAST:
        known = [block[name] for block in blocks if block[name] is not None]
        total[name] = min(known) if known else None
    for name in ("captured", "collided", "reached"):
        total[f"{name}_rate_low"], total[f"{name}_rate_high"] = wilson_interval(
            total[name], total["episodes"]
        )
        if name != "reached" and total[name] == 0:
            total[f"{name}_rate_one_sided_95"] = zero_event_bound(total["episodes"])
    total["corrected_share"] = total["corrected_steps"] / total["env_steps"]
    corrections = total["corrections"]
    total["mean_correction"] = None if corrections is None else corrections / total["env_steps"]
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
        "what": f"episodes behind the {settings['shield']} shield: captures and collisions",
        "settings": settings,
        "machine": machine() | {"device": jax.devices()[0].device_kind},
        "versions": versions(),
        **summary(blocks),
        "blocks": sorted(blocks, key=lambda b: (b["pursuer"], b["policy"], b["block"])),
    }  # fmt: skip
    write_json(path, report)


def main() -> None:
    import jax

    from attack_pursuers import ATTACKS
    from sidestep.pursuit import PURSUERS

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=list(STUDIES))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pursuers", nargs="*", choices=[*PURSUERS, *ATTACKS], help="the study's by default")
    parser.add_argument("--policies", nargs="*", help="stay, reckless, goal-seeking or a run folder")
    parser.add_argument(
        "--blocks", type=int, help="blocks for each pursuer and policy; the study's by default"
    )
    parser.add_argument("--block", type=int, help="episodes in a block; the study's by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=NUMBER", help="other scenario fields")
    arguments = parser.parse_args()

    study = STUDIES[arguments.study]
    pursuers = arguments.pursuers or list(ATTACKS if arguments.study == "attacked" else PURSUERS)
    changes = {name: json.loads(value) for name, value in (f.split("=", 1) for f in arguments.set)}
    fields = study.fields | changes
    size = arguments.block or study.block * (1 if jax.default_backend() == "cpu" else 29)
    settings = {
        "study": arguments.study, "scenario": "paper", "fields": fields, "shield": study.shield,
        "seed": arguments.seed, "episodes_per_block": size,
    }  # fmt: skip
    blocks: list[dict[str, Any]] = study_blocks.earlier(arguments.out, settings).get("blocks", [])
    done = {(b["pursuer"], b["policy"], b["block"]) for b in blocks}
    wanted = {
        pursuer: study.blocks.get(pursuer, study.other) if arguments.blocks is None else arguments.blocks
        for pursuer in pursuers
    }
    jobs = [
        (arguments.study, pursuer, policy, arguments.seed, block, size, fields)
        for block in range(max(wanted.values(), default=0))
        for pursuer in pursuers
        for policy in arguments.policies or study.policies
        if block < wanted[pursuer] and (pursuer, policy, block) not in done
    ]
    print(f"{len(done)} blocks are done, {len(jobs)} to do, {size} episodes each", flush=True)
    begun = time.perf_counter()
    try:
        for count, result in enumerate(study_blocks.results(run_block, jobs, arguments.processes), 1):
            blocks.append(result)
            _write(arguments.out, settings, blocks)
            left = (time.perf_counter() - begun) / count * (len(jobs) - count)
            print(
                f"{result['policy']:>8} against {result['pursuer']:<18} block {result['block']}: "
                f"{result['captured']} captured, {result['collided']} collided, {result['reached']} reached "
                f"of {result['episodes']}, smallest distance {result['smallest_distance']:.5f} m, "
                f"{result['env_steps'] / result['seconds']:,.0f} steps/s, {left / 60:.0f} min left",
                flush=True,
            )
    except KeyboardInterrupt:
        print(f"interrupted; the same command goes on after the {len(blocks)} blocks in {arguments.out}")
    if blocks:
        total = combine(blocks)
        print(
            f"{total['captured']} captures and {total['collided']} collisions in {total['episodes']:,} "
            f"episodes (95 % bounds of the shares: {_upper(total, 'captured'):.2g} and "
            f"{_upper(total, 'collided'):.2g}), smallest distance {total['smallest_distance']:.5f} m"
        )


def _upper(total: dict[str, Any], name: str) -> float:
    return total.get(f"{name}_rate_one_sided_95", total[f"{name}_rate_high"])


if __name__ == "__main__":
    main()
