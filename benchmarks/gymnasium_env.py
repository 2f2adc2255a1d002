"""How many steps per second has the native vector environment, beside the same task in plain Python?

    python benchmarks/gymnasium_env.py --json benchmarks/results/gymnasium_env.json

The plain environment (`speed/gymnasium_task.py`) is what a user of Gymnasium would write with NumPy
and math: one world, the pursuer `turn-then-drive`, no shield. Ours steps `--worlds` of them through
`make_vec`, with observations, rewards, flags, infos and automatic resets, as a learner gets them; behind
shields too, which the plain one does not have. All are told to head straight for the target. They take turns
within each round, so that whatever else the machine does slows all of them down alike; the figures are
medians over the rounds.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np

import sidestep.bridges.gym
from machine import conditions, load
from sidestep.store.files import write_json
from speed.gymnasium_task import make_environment

PURSUER = "turn-then-drive"


def rate_of(step: Callable[[], int], seconds: float) -> float:
    """Steps of worlds per second."""
    done, began = 0, time.perf_counter()
    while (passed := time.perf_counter() - began) < seconds:
        done += step()
    return done / passed


def plain(hold: int) -> Callable[[], int]:
    environment, action = make_environment(hold), np.array([1.0, 0.0], np.float32)
    environment.reset(seed=0)

    def step() -> int:
        for _ in range(200):
            _, _, terminated, truncated, _ = environment.step(action)
            if terminated or truncated:
                environment.reset()
        return 200

    return step


def ours(worlds: int, hold: int, shield: str) -> tuple[Any, Callable[[], int]]:
    environment = gymnasium.make_vec(
        sidestep.bridges.gym.ID, worlds, shield=shield, pursuer=PURSUER, decision_steps=hold
    )
    environment.reset(seed=0)
    actions = np.tile(np.array([1.0, 0.0], np.float32), (worlds, 1))

    def step() -> int:
        environment.step(actions)
        return worlds

    return environment, step


def compiled_share(environment: Any, worlds: int, rounds: int = 200) -> dict[str, float]:
    """Microseconds of a whole step, and of the compiled program in it (medians)."""
    inner, actions = environment.unwrapped, np.tile(np.array([1.0, 0.0], np.float32), (worlds, 1))
    whole, program = [], []
    for _ in range(rounds):
        began = time.perf_counter()
        environment.step(actions)
        whole.append(time.perf_counter() - began)
        began = time.perf_counter()
        jax.block_until_ready(inner.program(actions))
        program.append(time.perf_counter() - began)
    return {"step_us": 1e6 * float(np.median(whole)), "program_us": 1e6 * float(np.median(program))}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--holds", type=int, nargs="+", default=[1, 10], help="control periods per step")
    parser.add_argument("--shields", nargs="+", default=["none", "game"])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=1.0, help="that each gets in each round")
    options = parser.parse_args()
    before, cases = load(), []
    for hold in options.holds:
        sides: dict[str, Callable[[], int]] = {"plain": plain(hold)}
        environments: dict[str, Any] = {}
        for shield in options.shields:
            environments[shield], sides[shield] = ours(options.worlds, hold, shield)
        rates: dict[str, list[float]] = {name: [] for name in sides}
        for step in sides.values():
            # Compilation, and the first starts that are drawn.
            rate_of(step, options.seconds)
        for _ in range(options.rounds):
            for name, step in sides.items():
                rates[name].append(rate_of(step, options.seconds))
        middle = {name: float(np.median(values)) for name, values in rates.items()}
        for name in sides:
            ratios = np.array(rates[name]) / np.array(rates["plain"])
            case = {
                "hold": hold,
                "side": name if name == "plain" else f"ours, shield {name}",
                "steps_per_second": middle[name],
                "rounds": rates[name],
                "ratio": float(np.median(ratios)),
                "ratio_least": float(ratios.min()),
                "ratio_most": float(ratios.max()),
            }
            if name != "plain":
                case |= compiled_share(environments[name], options.worlds)
            cases.append(case)
            speed = f"{middle[name]:12,.0f} steps/s, {case['ratio']:5.1f} times plain"
            times = "{program_us:.0f} of {step_us:.0f} us compiled"
            spent = "" if name == "plain" else times.format(**case)
            print(
                f"hold {hold:2}, {case['side']:19}: {speed} "
                f"({case['ratio_least']:.1f} to {case['ratio_most']:.1f}) {spent}",
                flush=True,
            )
    if options.json is not None:
        result = {
            **conditions(before),
            "worlds": options.worlds,
            "rounds": options.rounds,
            "seconds": options.seconds,
            "pursuer": PURSUER,
            "cases": cases,
        }
        write_json(options.json, result)


if __name__ == "__main__":
    main()
