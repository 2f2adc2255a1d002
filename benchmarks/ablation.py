"""What each addition to plain TD3 contributes: trainings without it, several seeds each.

    python benchmarks/ablation.py --out benchmarks/results/ablation.json

Finished trainings are kept in the output file and skipped when it is run again. Each training uses one
core, so that several run side by side without disturbing one another.
"""

import argparse
import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "all additions": ({}, {}),
    "without hindsight targets": ({"hindsight": 0.0}, {}),
    "without target frame": ({}, {"frame": "world"}),
    "without mirror images": ({"mirror": 0.0}, {}),
    "without value bound": ({"bound_values": False}, {}),
    "without small last layer": ({"last_layer_scale": 1.0}, {}),
    "without reward scale": ({"reward_scale": 1.0}, {}),
    "without any of these": (
        {
            "hindsight": 0.0,
            "mirror": 0.0,
            "bound_values": False,
            "last_layer_scale": 1.0,
            "reward_scale": 1.0,
            "updates_per_decision": 1,
        },
        {"frame": "world"},
    ),
    "without second update per decision": ({"updates_per_decision": 1}, {}),
}
"""Name, changed training options, changed scenario fields."""


def one_training(variant: str, seed: int, episodes: int, hidden: list[int]) -> dict[str, Any]:
    """Train once on one core and say how it went."""
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    from sidestep.learning import make_options, train
    from sidestep.world import load_scenario

    options, fields = VARIANTS[variant]
    training = train(
        load_scenario("paper", **fields),
        shield="game",
        seed=seed,
        episodes=episodes,
        options=make_options(**options, hidden=hidden),
    )
    keys = ("episodes", "reached", "captured", "collided", "timed_out", "converged_episode", "final_return",
            "env_steps", "wall_seconds")  # fmt: skip
    return {
        "variant": variant,
        "seed": seed,
        "hidden": hidden,
        **{key: training.summary[key] for key in keys},
        "outcomes": "".join(line["outcome"][0] for line in training.metrics),
    }


def table(runs: list[dict[str, Any]]) -> str:
    """Results as a Markdown table, one row per variant."""
    lines = [
        "| training | converged by episode (per seed) | reached | collided | timed out |",
        "|---|---|---|---|---|",
    ]
    for variant in VARIANTS:
        mine = sorted((run for run in runs if run["variant"] == variant), key=lambda run: run["seed"])
        if not mine:
            continue
        episodes = sum(run["episodes"] for run in mine)
        closed = ", ".join(str(run["converged_episode"] or "never") for run in mine)
        shares = " | ".join(
            f"{sum(run[k] for run in mine) / episodes:.0%}" for k in ("reached", "collided", "timed_out")
        )
        lines.append(f"| {variant} | {closed} | {shares} |")
    first = runs[0]
    seeds = len({run["seed"] for run in runs})
    return "\n".join(
        [
            f"{seeds} seeds each, {first['episodes']} episodes, `game` shield, `nash` pursuer, layers of "
            f"{' and '.join(map(str, first['hidden']))}. Converged: the first episode that closes 20 with a "
            "mean return of at least 940, that is at least 19 of 20 reached; *never* means not within these "
            "episodes. Shares are of all training episodes, the first random ones included.",
            "",
            *lines,
            "",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/ablation.json"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=80)
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--hidden", type=int, nargs="*", default=[256, 256], help="layer widths")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--table", type=Path, help="also write the results as a Markdown table")
    arguments = parser.parse_args()

    done: list[dict[str, Any]] = json.loads(arguments.out.read_text()) if arguments.out.exists() else []
    known = {(run["variant"], run["seed"], run["episodes"], tuple(run["hidden"])) for run in done}
    wanted = [
        (variant, seed, arguments.episodes, arguments.hidden)
        for seed in range(arguments.seeds)
        for variant in arguments.variants
        if (variant, seed, arguments.episodes, tuple(arguments.hidden)) not in known
    ]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    # Spawned and never reused, so that every training starts from the same clean process.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.processes, mp_context=context, max_tasks_per_child=1) as pool:
        for future in as_completed([pool.submit(one_training, *job) for job in wanted]):
            run = future.result()
            done.append(run)
            print(f"{run['variant']}, seed {run['seed']}: {run['outcomes']}, {run['converged_episode']}")
            beside = arguments.out.with_suffix(".tmp")
            beside.write_text(
                json.dumps(sorted(done, key=lambda r: (r["variant"], r["seed"])), indent=1) + "\n"
            )
            os.replace(beside, arguments.out)
    if arguments.table is not None:
        arguments.table.write_text(table(done))


if __name__ == "__main__":
    main()
