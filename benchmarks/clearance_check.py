"""In how many small boxes of states is a clearance table proved to keep its set for a period?

    python benchmarks/clearance_check.py TABLE.npz --drift 0.02 --boxes 500 --size 5e-5 --angle 5e-4 \
        --shard 0/4 --json check-0.json
    python benchmarks/clearance_check.py --merge check-0.json check-1.json ... --json check.json

Draws boxes around random states on the boundary, where the obstacle matters (h' in 0 to 0.1 m, R > d +
0.5 mm), `--size` (m) wide in z and `--angle` (rad) in the direction of p. `sidestep.safety.clearance.check`
says which of them hold against every motion of the pursuer and every drift of the obstacle up to `--drift`
(m/s). The share is that of verified boxes, with 95 % bounds of Clopper and Pearson. It says nothing about the
states between the boxes: they are a sample, not a cover.

Box number k is the same in every shard and run with the same arguments. A result is written every
some boxes. The same command again goes on from there, and with other arguments or another table it refuses.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from sidestep.safety.clearance.check import Box, Checker
from sidestep.safety.clearance.stored import ARC, COMMITTED, OPEN, StoredTable
from sidestep.store.files import read_json, write_json

_EVERY = 20
_COMPARED = ("table", "drift", "boxes", "size", "angle", "depth", "parts", "seed")


def draw(table: StoredTable, number: int, seed: int, size: float, angle: float) -> Box:
    """Box `number`: around a state drawn as `boundary` in benchmarks/clearance.py draws them."""
    generator = np.random.default_rng([seed, number])
    while True:
        height = 0.1 * generator.random() ** 2
        bearing = math.pi / 2.0 * generator.random() ** (1.0 if generator.random() < 0.5 else 3.0)
        phi = generator.uniform(-math.pi, math.pi)
        distance = (table.level + height) / math.cos(max(table.angle - bearing, 0.0))
        z = distance * np.array([math.cos(bearing), math.sin(bearing)])
        _, clearance = table.lookup(z[None], np.array([phi]))
        if clearance[0] > table.game["collision_distance"] + 5e-4:
            break
    heights = (max(height - size / 2.0, 0.0), height + size / 2.0)
    directions = (phi - angle / 2.0, phi + angle / 2.0)
    if bearing >= table.angle:
        half = size / 2.0 / distance
        along = (max(bearing - half, table.angle), min(bearing + half, math.pi / 2.0))
        return Box(ARC, heights, along, directions)
    other = float(z @ [math.cos(table.angle), -math.sin(table.angle)]) - table.level
    if other >= 0.0:
        return Box(OPEN, heights, (max(other - size / 2.0, 0.0), other + size / 2.0), directions)
    return Box(COMMITTED, heights, (other - size / 2.0, min(other + size / 2.0, 0.0)), directions)


def clopper_pearson(count: int, total: int, level: float = 0.95) -> tuple[float, float]:
    """Exact bounds of a binomial share."""

    def tail(share: float, least: int) -> float:
        """Probability of at least so many."""
        logs = [
            math.lgamma(total + 1) - math.lgamma(k + 1) - math.lgamma(total - k + 1)
            + k * math.log(share) + (total - k) * math.log1p(-share)
            for k in range(least, total + 1)
        ]  # fmt: skip
        return sum(math.exp(one) for one in logs)

    def root(least: int, wanted: float) -> float:
        low, high = 0.0, 1.0
        for _ in range(50):
            middle = (low + high) / 2.0
            low, high = (middle, high) if tail(middle, least) < wanted else (low, middle)
        return (low + high) / 2.0

    rest = (1.0 - level) / 2.0
    return (
        0.0 if count == 0 else root(count, rest),
        1.0 if count == total else root(count + 1, 1.0 - rest),
    )


def summary(
    asked: dict[str, Any], shards: list[str], failed: list[dict[str, Any]], done: dict[str, Any]
) -> Any:
    """What the JSON holds."""
    total = done["boxes"]
    verified = total - len(failed)
    low, high = clopper_pearson(verified, total) if total else (0.0, 1.0)
    return {
        "asked": asked,
        "shards": shards,
        "boxes": total,
        "verified": verified,
        "share": verified / max(total, 1),
        "share at least": low,
        "share at most": high,
        "refuted": sum(one["refuted"] for one in failed),
        "worst shortfall, m": max((one["shortfall, m"] for one in failed), default=0.0),
        "dip, m": done["dip, m"],
        "parts": done["parts"],
        "seconds": done["seconds"],
        "failed": failed,
    }


def campaign(table: Path, options: argparse.Namespace) -> dict[str, Any]:
    """One shard, from where it stands."""
    stored = StoredTable(table)
    asked = {
        "table": hashlib.sha256(table.read_bytes()).hexdigest(),
        **{name: getattr(options, name) for name in _COMPARED[1:]},
    }
    index, count = (int(part) for part in options.shard.split("/"))
    if not 0 <= index < count:
        raise SystemExit(f"--shard {options.shard}: it must be I/N with 0 <= I < N")
    done, failed = {"boxes": 0, "dip, m": 0.0, "parts": 0, "seconds": 0.0}, []
    if options.json is not None and options.json.exists():
        kept = read_json(options.json)
        if kept["asked"] != asked or kept["shards"] != [options.shard]:
            raise SystemExit(f"{options.json} is of another table or of other arguments; remove it first")
        done, failed = {name: kept[name] for name in done}, kept["failed"]
    checker, begun, before = Checker(stored, options.drift), time.perf_counter(), done["seconds"]
    numbers = range(index, options.boxes, count)
    for number in numbers[done["boxes"] :]:
        box = draw(stored, number, options.seed, options.size, options.angle)
        verdict = checker.check(box, options.depth, options.parts)
        if not verdict.verified:
            failed.append({
                "number": number, "box": list(box), "shortfall, m": verdict.shortfall,
                "refuted": verdict.refuted, "parts": verdict.parts,
            })  # fmt: skip
        done["dip, m"] = max(done["dip, m"], verdict.dip)
        done["boxes"], done["parts"] = done["boxes"] + 1, done["parts"] + verdict.parts
        done["seconds"] = before + time.perf_counter() - begun
        if done["boxes"] % _EVERY == 0 or done["boxes"] == len(numbers):
            print(
                f"{done['boxes']} of {len(numbers)}: {done['boxes'] - len(failed)} verified, "
                f"{done['seconds']:.0f} s",
                file=sys.stderr,
                flush=True,
            )
            if options.json is not None:
                write_json(options.json, summary(asked, [options.shard], failed, done))
    return summary(asked, [options.shard], failed, done)


def merged(paths: list[Path]) -> dict[str, Any]:
    """The results of several shards as one."""
    parts = [read_json(path) for path in paths]
    shards = [shard for part in parts for shard in part["shards"]]
    if any(part["asked"] != parts[0]["asked"] for part in parts[1:]):
        raise SystemExit("these are results of several tables or of different arguments")
    if len(set(shards)) < len(shards) or len({shard.split("/")[1] for shard in shards}) > 1:
        raise SystemExit(f"these shards do not fit together: {', '.join(shards)}")
    done = {name: sum(part[name] for part in parts) for name in ("boxes", "parts", "seconds")}
    done["dip, m"] = max(part["dip, m"] for part in parts)
    failed = sorted((one for part in parts for one in part["failed"]), key=lambda one: one["number"])
    return summary(parts[0]["asked"], shards, failed, done)


def main() -> None:
    """Check or merge, print, and write JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("table", type=Path, nargs="?")
    parser.add_argument("--drift", type=float, default=0.02)
    parser.add_argument("--boxes", type=int, default=500)
    parser.add_argument("--size", type=float, default=5e-5)
    parser.add_argument("--angle", type=float, default=5e-4)
    parser.add_argument("--depth", type=int, default=9)
    parser.add_argument("--parts", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shard", default="0/1")
    parser.add_argument("--merge", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if (options.table is None) == (options.merge is None):
        parser.error("name either a table or results to --merge")
    if options.merge is None:
        result = campaign(options.table, options)
    else:
        result = merged(options.merge)
        if options.json is not None:
            write_json(options.json, result)
    print(", ".join(f"{key} {value:.6g}" for key, value in result.items() if isinstance(value, int | float)))


if __name__ == "__main__":
    main()
