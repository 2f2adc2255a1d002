"""The pursuit barrier against a grid solution of the game that it claims to solve.

    python benchmarks/pursuit_barrier_grid.py --out benchmarks/results/pursuit_barrier_grid.json \
        --figure docs/images/pursuit-barrier-grid.png

The game of the smallest distance over all time is solved by dynamic programming in the pursuer's frame,
knowing how the robots move and nothing of the closed form. Its value is the fixed point of

    W(z) = min(|z|, best over one time step of W(where z then is)).

The step is computed twice: with the pursuer moving in knowledge of what the evader does, and the other way
round. Both hold their choice for one step, which shrinks with the grid, and both values tend to that of the
continuous game; how far they are apart tells how near they are. The value does not depend on the capture
distance l, and W - l is to be compared with min(h, h_max), where h is the barrier and h_max = l_max - l.
Where l > l_max the pursuer wins, and the time at which the distance on the grid sinks to l is compared with
`CaptureGame.time_to_capture`.

Inside, lengths are in units of b and times in b/V, so that rho = v_e/V alone is a game. By symmetry one
quarter of the plane is enough.
"""

import argparse
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import study_blocks
from machine import machine, versions
from sidestep.store.files import write_json

CASES: dict[str, tuple[float, float, float, float]] = {
    "paper": (0.1574, 0.2, 0.2, 0.2),
    "well below the largest capture distance": (0.1574, 0.2, 0.2, 0.1),
    "small wheelbase": (0.18, 0.22, 0.08, 0.09),
    "small wheelbase, larger capture distance": (0.18, 0.22, 0.08, 0.12),
    "larger capture distance": (0.1574, 0.2, 0.2, 0.25),
    "slow evader": (0.1, 0.2, 0.2, 0.2),
}
"""Evader and pursuer speed (m/s), half axle, capture distance (m). The evader escapes in the first three."""

REACH = 3.2
"""Side of the quarter plane that the grid covers, in units of b."""
STEP_CELLS = 3.0
"""How far a pursuer drives in one time step, in cells: the time step shrinks with the grid."""


@dataclass(frozen=True)
class Solution:
    """A value on the nodes of a grid over the quarter plane x, y >= 0, in units of b and b/V.

    `values[i, j]` is the smallest distance that the pursuer can force from (i, j) times `spacing`;
    `arrivals[k][i, j]` the time at which that distance first sinks to `levels[k]`, infinite if never.
    """

    spacing: float
    values: np.ndarray
    levels: tuple[float, ...]
    arrivals: np.ndarray
    duration: float
    sweeps: int

    @property
    def nodes(self) -> np.ndarray:
        """Positions (n, n, 2) of the nodes, in units of b."""
        axis = self.spacing * np.arange(len(self.values))
        return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)


def _cubic(u: Any) -> tuple[Any, Any, Any, Any]:
    """Lagrange's weights of the nodes -1, 0, 1, 2 at u in [0, 1]."""
    return (
        -u * (u - 1.0) * (u - 2.0) / 6.0,
        (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
        -(u + 1.0) * u * (u - 2.0) / 2.0,
        (u + 1.0) * u * (u - 1.0) / 6.0,
    )


class _Grid:
    """Cubic interpolation on a quarter plane, reflected at its axes and continued flat at its far edges.

    What is interpolated never leaves the range of the four nodes around it, so that kinks make no waves. Next
    to the pursuer's axis, along which the value has a sharp valley, it is linear across.
    """

    margin = 8

    def __init__(self, cells: int, reach: float):
        self.cells, self.spacing = cells, reach / cells
        axis = self.spacing * np.arange(cells + 1)
        self.nodes = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)

    def padded(self, values: np.ndarray) -> np.ndarray:
        near = np.pad(values, [(self.margin, 0), (self.margin, 0)], mode="reflect")
        return np.pad(near, [(0, self.margin), (0, self.margin)], mode="edge")

    def moved(self, values: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """(k, n, n): for each of `moves` (k, 2), the same for all nodes, the values where they then are."""
        padded, n = self.padded(values), self.cells + 1
        along = np.minimum(padded[1:], padded[:-1]), np.maximum(padded[1:], padded[:-1])
        low = np.minimum(along[0][:, 1:], along[0][:, :-1])
        high = np.maximum(along[1][:, 1:], along[1][:, :-1])
        out = np.empty((len(moves), n, n))
        for result, move in zip(out, moves, strict=True):
            (i, u), (j, v) = (divmod(part / self.spacing, 1.0) for part in move)
            i, j = self.margin + int(i), self.margin + int(j)
            rows = padded[i - 1 : i + n + 2]
            columns: Any = sum(w * rows[:, j - 1 + k : j - 1 + k + n] for k, w in enumerate(_cubic(v)))
            for beside in (self.margin - 1 - j, self.margin - j):
                if 0 <= beside < n:
                    columns[:, beside] = (1.0 - v) * rows[:, j + beside] + v * rows[:, j + beside + 1]
            value = sum(w * columns[k : k + n] for k, w in enumerate(_cubic(u)))
            np.clip(value, low[i : i + n, j : j + n], high[i : i + n, j : j + n], out=result)
        return out

    def lookup(self, points: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Interpolation at fixed `points` (..., 2) in padded values."""
        where = np.minimum(np.abs(points) / self.spacing, self.cells)
        low = np.minimum(where.astype(int), self.cells - 1)
        u, v = np.moveaxis(where - low, -1, 0)
        width = self.cells + 1 + 2 * self.margin
        corner = (low[..., 0] + self.margin - 1) * width + low[..., 1] + self.margin - 1
        by_the_axis = low[..., 1] == 0
        linear = (np.zeros_like(v), 1.0 - v, v, np.zeros_like(v))
        down = _cubic(u)
        across = [np.where(by_the_axis, a, b) for a, b in zip(linear, _cubic(v), strict=True)]

        def at(padded: np.ndarray) -> np.ndarray:
            flat = padded.reshape(-1)
            taps = [[flat[i * width + j :].take(corner) for j in range(4)] for i in range(4)]
            value = sum(
                w * sum(x * tap for x, tap in zip(across, row, strict=True))
                for w, row in zip(down, taps, strict=True)
            )
            around = [taps[i][j] for i in (1, 2) for j in (1, 2)]
            return np.clip(value, np.minimum.reduce(around), np.maximum.reduce(around))

        return at


def _pursuit(nodes: np.ndarray, speed: float, turn_rate: float, period: float) -> np.ndarray:
    """Where the nodes are in the frame of a pursuer that has driven an arc for one period."""
    half = turn_rate * period / 2.0
    chord = speed * period * np.sinc(half / np.pi)
    ahead, left = np.moveaxis(nodes - chord * np.array([np.cos(half), np.sin(half)]), -1, 0)
    cosine, sine = np.cos(2.0 * half), np.sin(2.0 * half)
    return np.stack([cosine * ahead + sine * left, cosine * left - sine * ahead], axis=-1)


def solve(
    rho: float,
    cells: int,
    *,
    pursuer_knows: bool,
    levels: tuple[float, ...] = (),
    reach: float = REACH,
    headings: int = 24,
    arcs: int = 8,
    longest: float = 30.0,
    settled: float = 1e-4,
    progress: Callable[[float, float], None] | None = None,
) -> Solution:
    """Smallest distance (units of b) that a pursuer can force against an evader of speed ratio `rho`.

    **Arguments:** `cells` per side of the grid; `pursuer_knows` who moves knowing the other's choice;
    `headings` among which the evader chooses, with a parabola through the best three; `arcs` between driving
    straight and turning in place, each way, that the pursuer may drive at full wheel speed; the sweeps end
    after the game time `longest` (b/V), or when no value sinks by more than `settled` per unit of time;
    `progress(time, fastest change)` now and then.
    """
    grid = _Grid(cells, reach)
    step = STEP_CELLS * grid.spacing
    shares = np.arange(arcs + 1) / arcs
    drives = {(a * (1.0 - s), b * s) for s in shares for a in (-1.0, 1.0) for b in (-1.0, 1.0)}
    driven = [grid.lookup(_pursuit(grid.nodes, *drive, step)) for drive in sorted(drives)]
    angles = 2.0 * np.pi * np.arange(headings) / headings
    moves = rho * step * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    # A slope is at most 1, so this is the most that lies between two headings.
    between = rho * step * (1.0 - np.cos(np.pi / headings))

    def evader_best(values: np.ndarray) -> np.ndarray:
        after = grid.moved(values, moves)
        best = after.argmax(axis=0)[None]
        left, top, right = (np.take_along_axis(after, (best + k) % headings, axis=0)[0] for k in (-1, 0, 1))
        bend = 2.0 * top - left - right
        vertex = np.where(bend > 0.0, (left - right) ** 2 / (8.0 * np.where(bend > 0.0, bend, 1.0)), 0.0)
        return np.maximum(values, top + np.minimum(vertex, between))

    def pursuer_best(values: np.ndarray) -> np.ndarray:
        padded = grid.padded(values)
        best = values
        for at in driven:
            best = np.minimum(best, at(padded))
        return best

    distance = np.hypot(*np.moveaxis(grid.nodes, -1, 0))
    values = distance
    arrivals = np.where(values <= np.reshape(levels, (-1, 1, 1)), 0.0, np.inf)
    elapsed, sweeps = 0.0, 0
    while elapsed < longest:
        best = evader_best(pursuer_best(values)) if pursuer_knows else pursuer_best(evader_best(values))
        new = np.minimum(values, best)
        for arrival, level in zip(arrivals, levels, strict=True):
            crossing = np.isinf(arrival) & (new <= level)
            share = (values[crossing] - level) / (values[crossing] - new[crossing])
            arrival[crossing] = elapsed + step * share
        change = float(np.max(values - new)) / step
        values, elapsed, sweeps = new, elapsed + step, sweeps + 1
        if progress is not None and sweeps % 20 == 0:
            progress(elapsed, change)
        if change <= settled:
            break
    return Solution(grid.spacing, values, levels, arrivals, elapsed, sweeps)


def bracket(rho: float, cells: int, **options: Any) -> tuple[Solution, Solution]:
    """`solve` with the pursuer knowing the evader's choice, and the other way round, which is no lower."""
    return solve(rho, cells, pursuer_knows=True, **options), solve(rho, cells, pursuer_knows=False, **options)


@functools.cache
def _closed_form() -> Callable[[Any, Any], Any]:
    """Barrier and time to capture over many nodes; compiled once for all games."""
    import jax

    return jax.jit(jax.vmap(lambda game, z: (game.barrier(z)[0], game.time_to_capture(z)), (None, 0)))


def compare(case: tuple[float, float, float, float], bounds: tuple[Solution, Solution]) -> dict[str, Any]:
    """Barrier and time to capture of one case (see `CASES`) against its `bracket` on a grid, in SI units.

    Errors are grid less closed form, for either bound and midway between them: `smallest_distance` over all
    nodes against min(h, h_max), `barrier` over those with 0 <= h <= h_max, `capture_time` over those that
    are caught. `capture_set` compares where capture can be forced: on the grid, where the value is at most
    l, and in closed form, where `CaptureGame.time_to_capture` is finite; nodes in dispute are counted, and
    how far from the closed form's boundary the farthest of them is.
    """
    import jax.numpy as jnp

    from sidestep.pursuit import CaptureGame

    game, half_axle, size = CaptureGame(*case), case[2], case[3]
    nodes = (half_axle * bounds[0].nodes).reshape(-1, 2)
    h, times = (np.asarray(entry) for entry in _closed_form()(game, jnp.asarray(nodes, dtype=float)))
    escapes = bool(game.evader_can_escape)
    spare = float(game.largest_capture_distance) - size
    report: dict[str, Any] = {
        "evader_can_escape": escapes,
        "largest_capture_distance": float(game.largest_capture_distance),
        "grid_step": half_axle * bounds[0].spacing,
        "nodes": len(nodes),
    }
    low, high = (half_axle * solution.values.reshape(-1) - size for solution in bounds)
    ways = {"pursuer_knows": low, "evader_knows": high, "midway": (low + high) / 2.0}
    between = (h >= 0.0) & (h <= spare)
    level = bounds[0].levels.index(size / half_axle)
    early, late = (one.arrivals[level].reshape(-1) * half_axle / case[1] for one in bounds)
    arrivals = dict(zip(ways, (early, late, (early + late) / 2.0), strict=True))
    # Farther out the edge of the grid could have had a say, and at contact rounding decides.
    distance = np.hypot(*nodes.T)
    inner = (distance > (1.0 + 1e-6) * size) & np.isfinite(times) & (distance <= 0.5 * nodes.max())
    for way, grid_h in ways.items():
        disputed = (grid_h <= 0.0) != np.isfinite(times)
        error = grid_h - np.minimum(h, spare)
        report[way] = {
            "capture_set": {
                "disputed_nodes": int(disputed.sum()),
                "farthest_disputed": float(np.abs(h[disputed]).max(initial=0.0)),
            },
            "smallest_distance": _errors(error),
        }
        if escapes:
            report[way]["barrier"] = _errors(error[between])
        else:
            report[way]["capture_time"] = {
                "longest": float(times[inner].max()),
                **_errors((arrivals[way] - times)[inner]),
            }
    return report


def _errors(error: np.ndarray) -> dict[str, Any]:
    if not len(error):
        return {"nodes": 0}
    return {
        "nodes": len(error),
        "mean": float(error.mean()),
        "mean_absolute": float(np.abs(error).mean()),
        "largest_absolute": float(np.abs(error).max()),
    }


def study(
    cells: list[int],
    headings: int,
    done: list[dict[str, Any]],
    keep: Callable[[list[dict[str, Any]]], None],
) -> list[dict[str, Any]]:
    """Every case at every grid size; what is in `done` is not solved again."""
    runs = list(done)
    known = {(run["case"], run["cells"]) for run in runs}
    games: dict[float, list[str]] = {}
    for name, (evader_speed, pursuer_speed, _, _) in CASES.items():
        games.setdefault(evader_speed / pursuer_speed, []).append(name)
    for count in cells:
        for rho, names in games.items():
            if all((name, count) in known for name in names):
                continue
            begun = time.perf_counter()
            bounds = bracket(
                rho,
                count,
                levels=tuple(CASES[name][3] / CASES[name][2] for name in names),
                headings=headings,
                progress=lambda t, c: print(f"\r  time {t:6.2f} b/V, change {c:.1e}", end="", flush=True),
            )
            seconds = time.perf_counter() - begun
            print(f"\rrho = {rho:.4f}, {count} cells: {seconds:.0f} s             ", flush=True)
            effort = {"sweeps": bounds[0].sweeps + bounds[1].sweeps, "seconds": seconds}
            runs += [{"case": name, "cells": count} | compare(CASES[name], bounds) | effort for name in names]
            keep(runs)
    return runs


def draw(path: Path, cells: int, headings: int) -> None:
    """Contours of the smallest distance in the paper's game: the barrier's, and the grid's in both orders."""
    import jax.numpy as jnp

    from sidestep.pursuit import CaptureGame
    from sidestep.views.style import BLACK, SKY, VERMILION, WIDTH, house_style, new_figure, panel_titles, save

    case = CASES["paper"]
    game, half_axle = CaptureGame(*case), case[2]
    low, high = bracket(case[0] / case[1], cells, headings=headings)
    nodes = half_axle * low.nodes
    h = np.asarray(_closed_form()(game, jnp.asarray(nodes.reshape(-1, 2), dtype=float))[0])
    largest = float(game.largest_capture_distance)
    exact = np.minimum(h.reshape(low.values.shape) + case[3], largest)
    levels = [0.05, 0.1, 0.15, 0.19]
    with house_style():
        figure = new_figure(WIDTH, 0.42 * WIDTH)
        left, right = figure.subplots(1, 2)
        for values, label, look in (
            (exact, "barrier", {"colors": SKY, "linestyles": "-", "linewidths": 3.0}),
            (half_axle * low.values, "grid, the pursuer knows", {"colors": VERMILION, "linestyles": "--"}),
            (half_axle * high.values, "grid, the evader knows", {"colors": BLACK, "linestyles": ":"}),
        ):
            left.contour(*np.moveaxis(nodes, -1, 0), values, levels, **look)
            line = {name.removesuffix("s"): value for name, value in look.items()}
            right.plot(nodes[:, 0, 0], values[:, 0], label=label, **line)
        left.set(xlim=(0, 0.32), ylim=(0, 0.22), aspect="equal", yticks=[0.0, *levels])
        left.set(xlabel="ahead of the pursuer (m)", ylabel="to its left (m)")
        right.set(xlim=(0, 0.6), ylim=(0, 0.24), xlabel="ahead of the pursuer, on its axis (m)")
        right.set_ylabel("smallest distance (m)")
        right.annotate(
            f"largest: {largest:.4f} m", (0.6, largest), (0, -12), ha="right",
            textcoords="offset points",
        )  # fmt: skip
        right.legend(loc="lower right")
        panel_titles([left, right], ["Lines of equal smallest distance", "The same on the axis"])
        save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/pursuit_barrier_grid.json"))
    parser.add_argument("--cells", type=int, nargs="+", default=[48, 96, 144], help="per side")
    parser.add_argument("--headings", type=int, default=24, help="among which the evader chooses")
    parser.add_argument("--figure", type=Path, help="also draw the paper's game")
    parser.add_argument("--figure-cells", type=int, default=96)
    arguments = parser.parse_args()

    settings = {"reach": REACH, "step_cells": STEP_CELLS, "headings": arguments.headings}
    done: list[dict[str, Any]] = study_blocks.earlier(arguments.out, settings).get("runs", [])

    def keep(runs: list[dict[str, Any]]) -> None:
        report = {
            "what": "pursuit barrier and time to capture against a grid solution, errors in m and s",
            "settings": settings,
            "machine": machine(),
            "versions": versions(),
            "runs": runs,
        }
        write_json(arguments.out, report)

    try:
        study(arguments.cells, arguments.headings, done, keep)
        if arguments.figure is not None:
            draw(arguments.figure, arguments.figure_cells, arguments.headings)
    except KeyboardInterrupt:
        print(f"\ninterrupted; the same command goes on with what {arguments.out} lacks")


if __name__ == "__main__":
    main()
