"""Is an evader behind `joint` lost to any pursuer? Many chases from starts in the set that its table keeps.

    python benchmarks/joint_promise.py paper-0.15 --obstacles 1 2 3 --chases 2000 --json promise.json

The scenes are crowded: all within a square of 1.6 m, obstacles drifting at the scenario's speed, in random
directions or (`--adversarial`) towards the evader, their centres at the start at least as far apart as is
needed for one at a time to matter. A tenth of the starts lie within 5 mm of the set's boundary. The evader
drives at its target and stays there, so that every chase lasts `--seconds`. Pursuers: every built-in
strategy, herders, sideswipers, the trained `hunter`, random switching, and two that know the velocity chosen:
the table's own worst case (`joint-saddle`) and the same two steps deep. Counted are captures and collisions;
a chase is lost once.
`--shield` takes another one, and `--closer` obstacles or a `--faster` drift than the table was solved for: it
must then be lost now and then, or the attacks are too weak to say anything.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import sidestep
from sidestep.learning import load_pursuer
from sidestep.safety import make_shield
from sidestep.safety.clearance import shipped_table
from sidestep.safety.shields import TableShield
from sidestep.store.files import write_json
from sidestep.store.runs import OUTCOMES
from sidestep.trials.falsification.attackers import (
    JointSaddle,
    bang_bang,
    built_in,
    herder,
    script,
    sideswiper,
)
from sidestep.trials.falsification.chases import Target, run_from

NAMES = ("built-in", "herder", "sideswipe", "hunter", "bang-bang", "joint-saddle", "two-step")
LIMIT = {"two-step": 20}
"""Share of the chases that slow attacks get: one in so many."""


def starts(shield: TableShield, scenario: Any, count: int, gap: float, seed: int) -> Any:
    """Worlds in the set, a tenth of them within 5 mm of its boundary; obstacles at least `gap` (m) apart."""
    margin = jax.jit(jax.vmap(lambda world: shield.margin(world)))
    draw = eqx.filter_jit(jax.vmap(scenario.reset))
    kept: list[Any] = []
    edges, inside, tries = count // 10, count - count // 10, 0

    @jax.jit
    @jax.vmap
    def nearer(world: Any, key: Any) -> Any:
        """The obstacle or the pursuer moved along its line of sight until the margin is small."""
        low, high = jnp.zeros(()), jnp.ones(())
        which = jax.random.bernoulli(key, 0.7)

        def at(share: Any) -> Any:
            towards_obstacle = world.evader - world.obstacles[0, :2]
            towards_pursuer = world.evader - world.pursuers[0, :2]
            obstacles = world.obstacles.at[0, :2].add(jnp.where(which, share, 0.0) * towards_obstacle)
            pursuers = world.pursuers.at[0, :2].add(jnp.where(which, 0.0, share) * towards_pursuer)
            return eqx.tree_at(lambda w: (w.obstacles, w.pursuers), world, (obstacles, pursuers))

        for _ in range(12):
            middle = (low + high) / 2.0
            good = shield.margin(at(middle)) >= 0.0
            low, high = jnp.where(good, middle, low), jnp.where(good, high, middle)
        return at(low)

    @jax.jit
    @jax.vmap
    def crowded(world: Any, key: Any) -> Any:
        """Half of them with pursuer and obstacle close to the evader, and half with a target at the
        obstacle."""
        keys = jax.random.split(key, 8)

        def beside(point: Any, least: float, most: float, first: Any, second: Any) -> Any:
            angle = jax.random.uniform(first, dtype=float, minval=-jnp.pi, maxval=jnp.pi)
            distance = jax.random.uniform(second, dtype=float, minval=least, maxval=most)
            return point + distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)])

        level = float(scenario.capture_distance)
        close, aimed = jax.random.bernoulli(keys[0]), jax.random.bernoulli(keys[1])
        pursuer = beside(world.evader, level, level + 0.3, keys[2], keys[3])
        obstacle = beside(world.evader, 0.2, 0.6, keys[4], keys[5])
        obstacle = jnp.where(close, obstacle, world.obstacles[0, :2])
        target = beside(obstacle, 0.0, 0.5, keys[6], keys[7])
        return eqx.tree_at(
            lambda w: (w.pursuers, w.obstacles, w.target),
            world,
            (
                world.pursuers.at[0, :2].set(jnp.where(close, pursuer, world.pursuers[0, :2])),
                world.obstacles.at[0, :2].set(obstacle),
                jnp.where(aimed, target, world.target),
            ),
        )

    while sum(len(part.time) for part in kept) < count:
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), tries), 4096)
        worlds = crowded(draw(keys), keys)
        near_edge = edges > 0
        if near_edge:
            worlds = nearer(worlds, keys)
        least = np.asarray(margin(worlds))
        good = (least >= 0.0) & ((least < 0.005) | (not near_edge))
        places = np.asarray(worlds.obstacles[..., :2])
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
        apart += 1e3 * np.eye(places.shape[1])
        good &= apart.min(axis=(1, 2)) >= gap
        some = np.flatnonzero(good)[: edges if near_edge else inside]
        kept.append(jax.tree.map(lambda leaf, some=some: leaf[some], worlds))
        if near_edge:
            edges -= len(some)
        else:
            inside -= len(some)
        tries += 1
        if tries > 2000:
            raise SystemExit(f"no such starts: obstacles {gap:.2f} m apart do not fit")
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *kept)


def pursuers(name: str, table: Any, scenario: Any, count: int, periods: int, key: Any) -> tuple[Any, Any]:
    """The strategy of an attack, and the part of it for every chase."""
    first, second = jax.random.split(key)
    if name == "built-in":
        roster = built_in()
        return roster, jnp.arange(count, dtype=jnp.int32) % len(roster.strategies)
    if name == "herder":
        return herder, (
            jax.random.bernoulli(first, 0.3, (count,)),
            jax.random.uniform(second, (count,), dtype=float, minval=0.2, maxval=1.2),
        )
    if name == "sideswipe":
        return sideswiper, (
            jax.random.uniform(first, (count,), dtype=float, minval=0.1, maxval=1.2),
            jax.random.uniform(second, (count,), dtype=float, minval=-1.3, maxval=1.3),
        )
    if name == "hunter":
        hunter = load_pursuer(name)
        return (lambda _: hunter), jnp.zeros(count)
    if name == "bang-bang":
        plans = eqx.filter_jit(jax.vmap(lambda key: bang_bang(scenario, key, periods, jnp.asarray(40.0))))
        return script, (plans(jax.random.split(first, count)), jnp.zeros(count, jnp.int32))
    pull = jax.random.uniform(first, (count, 2), dtype=float) * jnp.array([0.1, 0.02])
    return (lambda pull: JointSaddle(table, pull, name == "two-step")), pull


def main() -> None:
    """Chase, count, print, and write JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario")
    parser.add_argument("--obstacles", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--attacks", nargs="+", choices=NAMES, default=list(NAMES))
    parser.add_argument("--shield", default="joint")
    parser.add_argument("--adversarial", action="store_true")
    parser.add_argument("--closer", type=float, default=1.0, help="share of the gap between obstacles (1)")
    parser.add_argument("--faster", type=float, default=1.0, help="factor on the obstacles' drift (1)")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--chases", type=int, default=2000, help="for each attack and number of obstacles")
    parser.add_argument("--batch", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    total: dict[str, Any] = {"asked": {k: str(v) for k, v in vars(asked).items()}, "chases": []}
    for obstacles in asked.obstacles:
        named = sidestep.load_scenario(asked.scenario)
        table = shipped_table(named)
        assert table is not None, "no table comes with sidestep for this scenario"
        periods = round(asked.seconds / float(named.control_period))
        scenario = sidestep.load_scenario(
            asked.scenario,
            obstacle_count=obstacles,
            obstacle_directions="random",
            obstacle_motion="adversarial" if asked.adversarial else "steady",
            arena_side=1.6,
            initial_separation=0.0,
            obstacle_separation=0.0,
            target_separation=0.1,
            episode_steps=periods,
        )
        # Whatever happens at the target, the chase goes on.
        scenario = eqx.tree_at(lambda s: s.reach_distance, scenario, jnp.asarray(-1.0))
        inside, shield = TableShield(scenario, table), make_shield(asked.shield, scenario)
        # Behind the shield's back.
        scenario = eqx.tree_at(
            lambda s: s.obstacle_velocity, scenario, asked.faster * scenario.obstacle_velocity
        )
        gap = asked.closer * table.smallest_gap
        target = Target(scenario, sidestep.goal_seeking, shield)
        for name in asked.attacks:
            wanted = max(1, asked.chases // LIMIT.get(name, 1))
            row = {"obstacles": obstacles, "attack": name, "chases": 0, "captured": 0, "collided": 0}
            row |= {"least pursuer clearance, mm": np.inf, "least obstacle clearance, mm": np.inf}
            row |= {"seconds": 0.0, "gap, m": gap, "lost": []}
            total["chases"].append(row)
            for batch in range(-(-wanted // asked.batch)):
                count = min(asked.batch, wanted)
                seed = asked.seed + 1000 * batch
                begun = time.perf_counter()
                worlds = starts(inside, scenario, count, gap, seed)
                strategy, parts = pursuers(name, table, scenario, count, periods, jax.random.key(seed + 7))
                keys = jax.random.split(jax.random.key(seed + 3), count)
                chases, _ = run_from(target, strategy, parts, worlds, periods, keys)
                outcome = np.asarray(chases.outcome)
                captured = outcome == OUTCOMES.index("captured")
                collided = outcome == OUTCOMES.index("collided")
                row["chases"] += count
                row["captured"] += int(captured.sum())
                row["collided"] += int(collided.sum())
                row["lost"] += [[seed, int(i)] for i in np.flatnonzero(captured | collided)[:20]]
                for key, least in (
                    ("least pursuer clearance, mm", chases.tally.pursuer_clearance),
                    ("least obstacle clearance, mm", chases.tally.obstacle_clearance),
                ):
                    row[key] = min(row[key], 1e3 * float(np.min(np.asarray(least))))
                row["seconds"] += time.perf_counter() - begun
                if asked.json is not None:
                    write_json(asked.json, total)
            print({key: round(v, 3) if isinstance(v, float) else v for key, v in row.items()}, flush=True)


if __name__ == "__main__":
    main()
