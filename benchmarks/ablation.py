"""What single choices in the learner contribute: trainings with and without them, several seeds each.

    python benchmarks/ablation.py                          what each addition to plain TD3 contributes
    python benchmarks/ablation.py --study replay-action    which action should go into the replay

The trained policies of the second study are evaluated too, behind the shield of their training and without
any, in the same episodes for all of them.

Finished trainings are kept in the output file and skipped when it is run again. Each training uses one
core, so that several run side by side without disturbing one another.
"""

import argparse
import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machine import machine, versions
from sidestep._compiled import thread_limits

EVALUATION_SEED = 1000
"""Of the episodes in which trained policies are compared; trainings use small seeds of their own."""

ADDITIONS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
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

REPLAY_ACTION: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "proposed": ({}, {}),
    # What half a second of delay costs: the discount takes 1 % off the bonus of 1000 for each decision.
    "proposed, corrections priced at 10": ({"correction_penalty": 10.0}, {}),
    "executed": ({"replay_action": "executed"}, {}),
    "executed, gradients through the filter": (
        {"replay_action": "executed", "filter_gradients": True},
        {},
    ),
}
"""The same for the choice of the action that is learned from."""


@dataclass(frozen=True)
class Study:
    """Variants to compare and what is used unless told otherwise; `evaluated` episodes per trained policy."""

    variants: dict[str, tuple[dict[str, Any], dict[str, Any]]]
    file: str
    seeds: int
    episodes: int
    evaluated: int


STUDIES = {
    "additions": Study(ADDITIONS, "ablation.json", seeds=5, episodes=60, evaluated=0),
    "replay-action": Study(REPLAY_ACTION, "replay_action.json", seeds=3, episodes=200, evaluated=200),
}


def one_training(
    study: str, variant: str, seed: int, episodes: int, hidden: list[int], shield: str, evaluated: int
) -> dict[str, Any]:
    """Train once on one core and say how it went, also with the trained policy in `evaluated` episodes."""
    os.environ.update(thread_limits(1))
    from sidestep.learning import make_options, train
    from sidestep.trials import evaluate
    from sidestep.world import load_scenario

    options, fields = STUDIES[study].variants[variant]
    scenario = load_scenario("paper", **fields)
    training = train(
        scenario,
        shield=shield,
        seed=seed,
        episodes=episodes,
        options=make_options(**options, hidden=hidden),
    )
    keys = ("episodes", "safe_episodes", "reached", "captured", "collided", "timed_out", "converged_episode",
            "final_return", "intervention_rate", "mean_correction", "env_steps", "wall_seconds")  # fmt: skip
    run = {
        "variant": variant,
        "seed": seed,
        "hidden": hidden,
        "shield": shield,
        **{key: training.summary[key] for key in keys},
        "outcomes": "".join(line["outcome"][0] for line in training.metrics),
    }
    if evaluated:
        shown = ("episodes", "safe", "reached", "captured", "collided", "timed_out", "intervention_rate",
                 "mean_correction", "reach_time_median")  # fmt: skip
        for name, guard in (("evaluation", shield), ("evaluation_without_shield", "none")):
            result = evaluate(
                scenario, training.policy, guard, "nash", evaluated, EVALUATION_SEED, batch=evaluated
            ).to_dict()
            run[name] = {key: result[key] for key in shown}
    return run


def _of(variant: str, runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted((run for run in runs if run["variant"] == variant), key=lambda run: run["seed"])


def _converged(runs: list[dict[str, Any]]) -> str:
    return ", ".join(str(run["converged_episode"] or "never") for run in runs)


def additions_table(runs: list[dict[str, Any]]) -> str:
    """Results as a Markdown table, one row per variant."""
    lines = [
        "| training | converged by episode (per seed) | reached | collided | timed out |",
        "|---|---|---|---|---|",
    ]
    for variant in ADDITIONS:
        mine = _of(variant, runs)
        if not mine:
            continue
        episodes = sum(run["episodes"] for run in mine)
        closed = _converged(mine)
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


def replay_action_table(runs: list[dict[str, Any]]) -> str:
    """Results as two Markdown tables, of the trainings and of the policies that they left."""
    first = runs[0]
    seeds, shield = len({run["seed"] for run in runs}), first["shield"]

    def each(mine: list[dict[str, Any]], show: Any) -> str:
        return ", ".join(show(run) for run in mine)

    training = [
        f"Training: {seeds} seeds, {first['episodes']} episodes each, `{shield}` shield, `nash` pursuer, "
        f"layers of {' and '.join(map(str, first['hidden']))}; one figure per seed.",
        "",
        "| learned from | converged by episode | safe | reached | collided | periods corrected "
        "| mean correction, mm/s |",
        "|---|---|---|---|---|---|---|",
    ]
    trained = [
        f"The trained policies in the same {first['evaluation']['episodes']} episodes, greedy.",
        "",
        "| learned from | reached | captured + collided | periods corrected | mean correction, mm/s "
        "| reached without shield |",
        "|---|---|---|---|---|---|",
    ]
    for variant in REPLAY_ACTION:
        mine = _of(variant, runs)
        if not mine:
            continue
        cells = [
            _converged(mine),
            *(each(mine, lambda run, k=k: str(run[k])) for k in ("safe_episodes", "reached", "collided")),
            each(mine, lambda run: f"{run['intervention_rate']:.0%}"),
            each(mine, lambda run: f"{1e3 * run['mean_correction']:.1f}"),
        ]
        training.append(f"| {variant} | {' | '.join(cells)} |")
        cells = [
            each(mine, lambda run: str(run["evaluation"]["reached"])),
            each(mine, lambda run: f"{run['evaluation']['captured']} + {run['evaluation']['collided']}"),
            each(mine, lambda run: f"{run['evaluation']['intervention_rate']:.0%}"),
            each(mine, lambda run: f"{1e3 * run['evaluation']['mean_correction']:.1f}"),
            each(mine, lambda run: str(run["evaluation_without_shield"]["reached"])),
        ]
        trained.append(f"| {variant} | {' | '.join(cells)} |")
    return "\n".join([*training, "", *trained, ""])


def main() -> None:
    # Not at the top: NumPy comes with it, and a training limits its threads first.
    from sidestep.store.files import write_json

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--study", choices=list(STUDIES), default="additions")
    parser.add_argument("--out", type=Path, help="default: benchmarks/results/, a file for each study")
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--episodes", type=int, help="to train for")
    parser.add_argument("--variants", nargs="*", help="default: all of the study")
    parser.add_argument("--hidden", type=int, nargs="*", default=[64, 64], help="layer widths")
    parser.add_argument(
        "--shield", default="game", help="in training and evaluation: none, paper, game, joint"
    )
    parser.add_argument("--evaluate", type=int, help="episodes in which each trained policy is evaluated")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--table", type=Path, help="also write the results as Markdown tables")
    arguments = parser.parse_args()
    study, hidden = arguments.study, arguments.hidden
    usual = STUDIES[study]
    variants = list(usual.variants) if arguments.variants is None else arguments.variants
    if unknown := set(variants) - set(usual.variants):
        parser.error(f"--variants: {sorted(unknown)} are not among {list(usual.variants)}")
    seeds = usual.seeds if arguments.seeds is None else arguments.seeds
    episodes = usual.episodes if arguments.episodes is None else arguments.episodes
    evaluated = usual.evaluated if arguments.evaluate is None else arguments.evaluate
    if study == "replay-action" and evaluated < 1:
        parser.error("--evaluate: this study compares trained policies; give it at least 1 episode")
    out = arguments.out or Path("benchmarks/results") / usual.file

    done: list[dict[str, Any]] = []
    if out.exists():
        earlier = json.loads(out.read_text(encoding="utf-8"))
        done = earlier["runs"] if isinstance(earlier, dict) else earlier

    def settings(run: dict[str, Any]) -> tuple[Any, ...]:
        evaluation = run.get("evaluation", {"episodes": 0})
        return run["episodes"], run["hidden"], run.get("shield", "game"), evaluation["episodes"]

    if any(settings(run) != (episodes, hidden, arguments.shield, evaluated) for run in done):
        parser.error(f"{out} holds trainings with other settings; choose another --out")
    known = {(run["variant"], run["seed"]) for run in done}
    wanted = [
        (study, variant, seed, episodes, hidden, arguments.shield, evaluated)
        for seed in range(seeds)
        for variant in variants
        if (variant, seed) not in known
    ]
    # Spawned and never reused, so that every training starts from the same clean process.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.processes, mp_context=context, max_tasks_per_child=1) as pool:
        for future in as_completed([pool.submit(one_training, *job) for job in wanted]):
            run = future.result()
            done.append(run)
            print(
                f"{run['variant']}, seed {run['seed']}: {run['outcomes']}, {run['converged_episode']}, "
                f"{run['wall_seconds']:.0f} s",
                flush=True,
            )
            order = list(usual.variants)
            report = {
                "study": study,
                "machine": {**machine(), "threads": 1},
                "versions": versions(),
                "runs": sorted(done, key=lambda r: (order.index(r["variant"]), r["seed"])),
            }
            write_json(out, report)
    if arguments.table is not None and done:
        make = additions_table if study == "additions" else replay_action_table
        arguments.table.write_text(make(done), encoding="utf-8")


if __name__ == "__main__":
    main()
