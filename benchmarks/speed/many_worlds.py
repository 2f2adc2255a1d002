"""The training loop with many worlds at once, one update per step of all of them, against the same peers.

As in `learning`, but with one thread per core only.
"""

from __future__ import annotations

from typing import Any

from speed.children import Case
from speed.learning import PEERS, SIDES, run

__all__ = ["cases", "run", "summary"]

COUNTS = (1, 64, 1024)
OURS = "ours, game shield"


def cases(quick: bool) -> list[Case]:
    """Ours behind `game` and every peer, for each number of worlds."""
    counts, amount = (
        ((2,), {"seconds": 0.5, "chunk": 10}) if quick else (COUNTS, {"seconds": 6.0, "chunk": 20})
    )
    return [
        Case("many_worlds", f"{name}, {count} worlds", {"side": SIDES[name], "worlds": count, **amount})
        for count in counts
        for name in (OURS, *PEERS)
    ]


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Control periods and updates per second of each side, and ours against each peer's."""
    steps = {one["name"]: one["throughput"]["value"] for one in results if "throughput" in one}
    updates = {
        one["name"]: one["throughput"]["value"] / one["settings"]["worlds"]
        for one in results
        if "throughput" in one
    }
    ratios = {
        f"{OURS} / {name}": steps[f"{OURS}, {name.rpartition(', ')[2]}"] / value
        for name, value in steps.items()
        if name.startswith(PEERS) and f"{OURS}, {name.rpartition(', ')[2]}" in steps
    }
    return {"steps_per_second": steps, "updates_per_second": updates, "ratios": ratios}
