"""Can the evader stay free of two pursuers that work together? One keeps a line, the other herds.

    python benchmarks/two_pursuers.py --json benchmarks/results/two-pursuers.json

The second pursuer never turns. It drives to and fro on the line along its heading and keeps its place on it
equal to the evader's, which it can from some time on, being faster. To the evader its line is then a wall at
capture distance. The first one overtakes the evader, away from that line, and then plays the game of pursuer
and wall: it makes the motion after which the wall must be farthest away (see `clearance_wall.py`).

From random starts the evader plays one of several strategies, all of which keep it out of the first one's
capture set for a period where some velocity does: `table` (what leaves it the most by that table), `away`
(from the line), `gap` (the largest least distance to both capture sets), and `random` headings, one a second.
It knows both pursuers' poses. Pursuers either know the velocity that it has chosen, or take the one before.
For comparison the second pursuer stays away (`alone`). A run that is stopped goes on with the cases that its
JSON lacks.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import sidestep
from clearance_wall import GRIDS
from sidestep.safety.clearance import ClearanceGame, ClearanceTable, clearance_table
from sidestep.store.files import write_json
from sidestep.world.capture_geometry import to_pursuer_axes, to_pursuer_frame

EVADERS = ("table", "away", "gap", "random")
ASIDE, LEAD, LOST, AHEAD = 0.3, 0.7, -0.2, 0.4
"""How far (m) beside the evader the first pursuer passes it; the lead over it, away from the line, at which
it turns back to herd, and at which it has lost that; how far beyond it to drive where the table asks for
little."""
INSIDE = 1e-3
"""By how much (m) nearer than the capture distance a pursuer must be at the end of a period."""
HORIZONS = {0.10: 400, 0.15: 200}
"""Periods of the table at each capture distance (m)."""


class Chase:
    """Episodes of some seconds; the second pursuer's line is the x axis. Poses in m and rad."""

    def __init__(self, table: ClearanceTable, seconds: float):
        game = table.game
        self.table, self.game, self.steps = table, game, round(seconds / game.control_period)
        self.moves = jnp.asarray(game.velocities(48) * game.control_period, jnp.float32)
        self.poses = jnp.asarray(game.motions(6, 3), jnp.float32)
        self.reach = game.pursuer_speed * game.control_period

    def evader(self, strategy: str, state: Any, key: Array) -> Float[Array, "2"]:
        """Its move (m) in a period."""
        place, first, second, heading = state
        turned = jax.vmap(lambda move: to_pursuer_axes(move, first[2]))(self.moves)
        z, side = to_pursuer_frame(place, first), jnp.where(place[1] < 0.0, -1.0, 1.0)
        normal = side * to_pursuer_axes(jnp.array([0.0, 1.0]), first[2])
        height = jax.vmap(lambda move: jnp.min(self.heights(z + move)))(turned)
        moved = place + self.moves
        line = side * moved[:, 1]
        if strategy == "table":
            value = jax.vmap(lambda move: self.table.spare_after(z, jnp.abs(place[1]) * normal, move, 0.0))(
                turned
            )
        elif strategy == "away":
            value = line
        elif strategy == "gap":
            apart = jnp.stack([moved[:, 0] - second, moved[:, 1]], -1)
            other = jax.vmap(lambda seen: self.table.grid.height(jnp, seen[0], seen[1]))(apart)
            value = jnp.minimum(height, other)
        else:
            value = self.moves @ jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        value = jnp.where(height >= 0.0, value, -jnp.inf)
        return self.moves[jnp.where(jnp.any(height >= 0.0), jnp.argmax(value), jnp.argmax(height))]

    def heights(self, z: Float[Array, "2"]) -> Float[Array, "n"]:
        """h' (m) after each of the first pursuer's motions."""
        return jax.vmap(lambda pose: self.table.grid.height(jnp, *to_pursuer_frame(z, pose)))(self.poses)

    def first(self, place: Any, pose: Float[Array, "3"], leads: Any) -> tuple[Float[Array, "3"], Any]:
        """The first pursuer's pose after a period at whose end it takes the evader to be at `place` (m), and
        whether it leads."""
        z, side = to_pursuer_frame(place, pose), jnp.where(place[1] < 0.0, -1.0, 1.0)
        normal = side * to_pursuer_axes(jnp.array([0.0, 1.0]), pose[2])

        def deficit(motion: Float[Array, "3"]) -> Any:
            _, clearance = self.table(to_pursuer_frame(z, motion), to_pursuer_axes(normal, motion[2]))
            return clearance

        along = jnp.stack([-normal[1], normal[0]])
        lead, beside = -jnp.dot(z, normal), -jnp.dot(z, along)
        leads = jnp.where(leads, lead > LOST, lead > LEAD)
        passing = (LEAD + 0.2) * normal + jnp.where(beside < 0.0, -ASIDE, ASIDE) * along
        target = z + jnp.where(leads, AHEAD * normal, passing)

        def off(motion: Float[Array, "3"]) -> Any:
            to = to_pursuer_frame(target, motion)
            bearing = jnp.arctan2(to[1], to[0])
            return -jnp.hypot(to[0], to[1]) - 0.2 * jnp.minimum(jnp.abs(bearing), math.pi - jnp.abs(bearing))

        herds = leads & (self.table(z, normal)[1] > self.game.collision_distance + 0.01)
        value = jnp.where(herds, jax.vmap(deficit)(self.poses), jax.vmap(off)(self.poses))
        caught = jax.vmap(lambda motion: jnp.hypot(*to_pursuer_frame(z, motion)))(self.poses)
        value = jnp.where(caught < self.game.capture_distance, jnp.inf, value)
        ahead, left, turn = self.poses[jnp.argmax(value)]
        cosine, sine = jnp.cos(pose[2]), jnp.sin(pose[2])
        return pose + jnp.stack([cosine * ahead - sine * left, sine * ahead + cosine * left, turn]), leads

    def run(self, starts: Any, strategy: str, *, known: bool, alone: bool, seed: int) -> dict[str, Any]:
        """How many are captured, and when."""
        level = self.game.capture_distance

        def step(carry: Any, key: Array) -> Any:
            (place, first, leads, second, heading, before), (captured, since) = carry
            turn, draw = jax.random.split(key)
            fresh = jax.random.uniform(draw, (), minval=-math.pi, maxval=math.pi)
            heading = jnp.where(jax.random.uniform(turn) < self.game.control_period, fresh, heading)
            move = self.evader(strategy, (place, first, second, heading), key)
            guess = place + (move if known else before)
            first, leads = self.first(guess, first, leads)
            if not alone:
                second = second + jnp.clip(guess[0] - second, -self.reach, self.reach)
            place = place + move
            apart = jnp.stack([place - first[:2], place - jnp.stack([second, jnp.zeros(())])])
            near = jnp.hypot(apart[:, 0], apart[:, 1]) < level - INSIDE
            captured = captured | near
            since = since + jnp.where(jnp.any(captured), 0.0, self.game.control_period)
            stay = (place, first, leads, second, heading, move)
            return (stay, (captured, since)), None

        @jax.jit
        @jax.vmap
        def episode(start: Any, key: Array) -> Any:
            place, first, second = start
            stay = place, first, jnp.zeros((), bool), second, jnp.zeros(()), jnp.zeros(2)
            begin = stay, (jnp.zeros(2, bool), jnp.zeros(()))

            def more(carry: Any) -> Any:
                return (carry[1] < self.steps) & ~jnp.any(carry[0][1][0])

            def body(carry: Any) -> Any:
                return step(carry[0], jax.random.fold_in(key, carry[1]))[0], carry[1] + 1

            return jax.lax.while_loop(more, body, (begin, jnp.zeros((), int)))[0][1]

        captured, since = episode(starts, jax.random.split(jax.random.key(seed), len(starts[0])))
        captured, since = np.asarray(captured), np.asarray(since)
        caught = np.any(captured, 1)
        return {
            "episodes": len(caught),
            "captured": int(np.sum(caught)),
            "by the first, the second": np.sum(captured, 0).tolist(),
            "median, longest time to capture, s": (
                [float(np.median(since[caught])), float(np.max(since[caught]))] if caught.any() else None
            ),
        }


def starts(table: ClearanceTable, count: int, alone: bool, seed: int) -> Any:
    """Evader, first pursuer and the second one's place on its line: outside both capture sets, within
    half a metre of the origin each way."""
    generator, found = np.random.default_rng(seed), []
    while len(found) < count:
        place = generator.uniform([-0.5, 0.0], [0.5, 0.5])
        first = generator.uniform([-0.5, -0.5, -math.pi], [0.5, 0.5, math.pi])
        z = np.asarray(to_pursuer_frame(jnp.asarray(place), jnp.asarray(first)))
        if min(table.grid.height(np, *z), table.grid.height(np, *place)) > 0.0:
            found.append((place, first, 1e3 if alone else 0.0))
    return tuple(jnp.asarray(np.array(part), jnp.float32) for part in zip(*found, strict=True))


def main() -> None:
    """Chase after chase, print, and write JSON after each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--json", type=Path, required=True)
    asked = parser.parse_args()
    results: dict[str, Any] = json.loads(asked.json.read_text()) if asked.json.exists() else {}
    cases = [(0.10, name, True, False) for name in EVADERS] + [(0.10, "table", False, False)]
    cases += [(0.10, "table", True, True), (0.15, "table", True, False), (0.15, "table", True, True)]
    for level, name, known, alone in cases:
        knows = "knowing" if known else "not knowing"
        key = f"l {level:g} m, {'one' if alone else 'two'} {knows} the velocity, evader {name}"
        if key in results:
            continue
        begun = time.perf_counter()
        game = ClearanceGame.of(sidestep.load_scenario("paper", capture_distance=level))
        game = replace(game, collision_distance=level, obstacle_speed=0.0, wall=True)
        table = clearance_table(game, GRIDS["rough"], periods=HORIZONS[level])
        chase = Chase(table, asked.seconds)
        places = starts(table, asked.episodes, alone, seed=0)
        figures = chase.run(places, name, known=known, alone=alone, seed=1)
        results[key] = {**figures, "seconds": time.perf_counter() - begun}
        print(f"{key}: {results[key]}", flush=True)
        write_json(asked.json, results)


if __name__ == "__main__":
    main()
