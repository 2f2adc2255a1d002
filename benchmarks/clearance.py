"""How good is a clearance table? Solved at several resolutions, and asked whether it keeps its own promise.

    python benchmarks/clearance.py --capture-distance 0.15 --json clearance.json

For each resolution: time and memory (the peak of all tables solved so far), the largest clearance, the
share of states with evader and obstacle within 0.5 m that are safe one by one and not jointly, the
largest difference from the finest table at random states, and the share of random states on the boundary
(h' in 0 to 0.1 m, where the obstacle matters) from which one of 96 held velocities keeps the set for a
period against pursuer motions four times as dense as those solved for, with how far the worst of them
falls out of it.

The table asks for `--spare` more after every period, which absorbs the interpolation.
"""

from __future__ import annotations

import argparse
import math
import resource
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import sidestep
from sidestep.safety.clearance import SPARE, ClearanceGame, ClearanceTable, Resolution, solve
from sidestep.store.files import write_json

RESOLUTIONS = {
    "coarse": Resolution(
        height=0.002, growth=1.25, share=0.01, share_growth=1.35, bearings=12, angles=96, ridge=0.025, turns=4
    ),
    "default": Resolution(),
    "fine": Resolution(
        height=0.0005,
        growth=1.1,
        share=0.003,
        share_growth=1.22,
        angles=288,
        ridge=0.012,
        headings=64,
        turns=8,
    ),
}
BATCH = 512


def boundary(table: ClearanceTable, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States z and offsets p (m) on the boundary, where the obstacle matters."""
    game, generator = table.game, np.random.default_rng(seed)
    height = 0.1 * generator.random(count) ** 2
    bearing = math.pi / 2.0 * generator.random(count) ** np.where(generator.random(count) < 0.5, 1.0, 3.0)
    distance = (game.capture_distance + height) / np.cos(np.maximum(game.angle - bearing, 0.0))
    z = distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    phi = generator.uniform(-math.pi, math.pi, count)
    towards = np.stack([np.cos(phi), np.sin(phi)], -1)
    clearance = np.asarray(jax.jit(jax.vmap(table))(z, towards)[1])
    matters = clearance > game.collision_distance + 5e-4
    return z[matters], (clearance[:, None] * towards)[matters]


def best_margins(table: ClearanceTable, z: np.ndarray, p: np.ndarray, drift: float) -> np.ndarray:
    """The best margin (m) after a period that one of the evader's velocities has against every motion."""
    game = table.game
    moves = jnp.asarray(game.velocities(96) * game.control_period)
    poses = jnp.asarray(game.motions(24, 3))
    after = drift * game.control_period

    @jax.jit
    def best(z: Any, p: Any) -> Any:
        return jax.lax.map(
            lambda state: jnp.max(
                jax.vmap(lambda move: table.margin_after(state[0], state[1], move, poses, after))(moves)
            ),
            (z, p),
        )

    return np.concatenate(
        [np.asarray(best(z[i : i + BATCH], p[i : i + BATCH])) for i in range(0, len(z), BATCH)]
    )


def near(
    table: ClearanceTable, count: int = 200_000, seed: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """h', R and |p| (m) at states with evader and obstacle within 0.5 m."""
    generator = np.random.default_rng(seed)

    def disc() -> np.ndarray:
        angle, distance = generator.uniform(-math.pi, math.pi, count), 0.5 * np.sqrt(generator.random(count))
        return distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)

    z, p = disc(), disc()
    height, clearance = (np.asarray(part) for part in jax.jit(jax.vmap(table))(z, p))
    return height, clearance, np.linalg.norm(p, axis=-1)


def study(
    game: ClearanceGame, resolution: Resolution, states: int, drift: float
) -> tuple[dict[str, Any], Any]:
    """The figures of one table, and what `near` found with it."""
    begun = time.perf_counter()
    table = ClearanceTable.of(game, solve(game, resolution))
    seconds = time.perf_counter() - begun
    z, p = boundary(table, states, seed=0)
    margins = best_margins(table, z, p, drift)
    height, clearance, distance = seen = near(table)
    alone = (height >= 0.0) & (distance >= game.collision_distance)
    return {
        "nodes": int(table.clearance.size),
        "sweeps": table.sweeps,
        "seconds": seconds,
        "largest clearance, m": table.farthest,
        "lost share": float(np.mean(distance[alone] < clearance[alone])),
        "boundary states": len(margins),
        "kept share": float(np.mean(margins >= 0.0)),
        "worst margin, m": float(np.min(margins)),
        "median margin, m": float(np.median(margins)),
        "peak memory, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }, seen


def main() -> None:
    """Solve, ask, print, and write JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--capture-distance", type=float, default=0.15)
    parser.add_argument("--spare", type=float, default=SPARE)
    parser.add_argument("--drift", type=float, default=0.02)
    parser.add_argument("--states", type=int, default=20_000)
    parser.add_argument("--resolutions", nargs="*", choices=RESOLUTIONS, default=list(RESOLUTIONS))
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    scenario = sidestep.load_scenario("paper", capture_distance=asked.capture_distance)
    game = ClearanceGame.of(scenario, spare=asked.spare)
    results: dict[str, Any] = {"game": game.as_dict, "true drift, m/s": asked.drift, "tables": {}}
    finest = None
    for name in reversed(asked.resolutions):
        figures, seen = study(game, RESOLUTIONS[name], asked.states, asked.drift)
        if finest is None:
            finest = seen
        outside = seen[0] >= 0.0
        figures["largest difference from the finest, m"] = float(np.max(np.abs(seen[1] - finest[1])[outside]))
        results["tables"][name] = figures
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in figures.items()), flush=True)
        if asked.json is not None:
            write_json(asked.json, results)


if __name__ == "__main__":
    main()
