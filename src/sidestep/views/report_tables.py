"""The tables of a report: a card per shield, and a comparison with the paper's results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sidestep.loop import Trajectory
from sidestep.store.runs import converged_episode, stays_converged_from
from sidestep.views.html import shown_number
from sidestep.views.runs import Run
from sidestep.views.style import OUTCOME_WORDS, shield_words
from sidestep.views.training_figures import PAPER_CONVERGED, safety_rows


def percent(value: float | int | None, digits: int = 1) -> str:
    """A share in per cent; a dash for None."""
    return "–" if value is None else f"{100 * value:.{digits}f}\u00a0%"


def convergence(group: Sequence[Run]) -> str:
    """The episodes at which a shield's runs first converged, and from which they stayed converged, in
    words."""
    returns = [[float(e["return"]) for e in run.metrics] for run in group]
    firsts, stays = [converged_episode(r) for r in returns], [stays_converged_from(r) for r in returns]
    if len(group) > 1:
        found = sorted(episode for episode in firsts if episode is not None)
        at = f", first at {', '.join(map(str, found))}" if found else ""
        stayed = f"; {sum(stay is not None for stay in stays)} stayed" if found else ""
        return f"{len(found)} of {len(group)} seeds{at}{stayed}"
    (first,), (stay,) = firsts, stays
    if first is None:
        return "never"
    then = "and stayed" if stay == first else f"stayed from {stay}" if stay else "not at the end"
    return f"at {first}, {then}"


def card(shield: str, group: Sequence[Run], scenes: Mapping[str, tuple[Run, Trajectory]]) -> dict[str, Any]:
    """Safety of the training with one shield, its convergence, and the outcome of its test scene."""
    row = next(row for row in safety_rows(group) if row["shield"] == shield)
    scene = scenes.get(shield)
    return {
        "shield": shield,
        "safe": row["safe"],
        "episodes": row["episodes"],
        "captured": row["captured"],
        "collided": row["collided"],
        "converged": convergence(group),
        "scene": OUTCOME_WORDS[scene[1].outcome] if scene else None,
    }


def _pooled(group: Sequence[Run], key: str) -> list[float]:
    return [float(episode[key]) for run in group for episode in run.metrics if episode.get(key) is not None]


def comparison(
    groups: Mapping[str, Sequence[Run]],
    scenes: Mapping[str, Trajectory],
    untrained_scenes: Mapping[str, Trajectory],
) -> dict[str, Any]:
    """The comparison with the paper's results: names of the columns, and rows of cells."""
    safety = {row["shield"]: row for row in safety_rows([run for group in groups.values() for run in group])}
    paper = safety.pop(None)
    rows: list[tuple[str, list[str]]] = [
        ("training episodes", [str(paper["episodes"]), *(str(row["episodes"]) for row in safety.values())]),
        ("safe episodes", [str(paper["safe"]), *(str(row["safe"]) for row in safety.values())]),
        *((name, ["0", *(str(row[name]) for row in safety.values())]) for name in ("captured", "collided")),
        ("safety ratio", [percent(row["ratio"]) for row in (paper, *safety.values())]),
        (
            "its 95 % bounds",
            [f"{percent(row['low'])[:-2]} to {percent(row['high'])}" for row in (paper, *safety.values())],
        ),
        (
            "first converged",
            [f"within {PAPER_CONVERGED} episodes", *(convergence(g) for g in groups.values())],
        ),
    ]

    def add(name: str, reported: str, cells: Sequence[str]) -> None:
        rows.append((name, [reported, *cells]))

    finals = [
        np.mean([r for run in g for r in _pooled([run], "return")[-20:]] or [np.nan]) for g in groups.values()
    ]
    add(
        "mean return of the last 20",
        "1000",
        [shown_number(None if np.isnan(f) else float(f), 0) for f in finals],
    )
    steps = [sum(_pooled(group, "steps")) for group in groups.values()]
    for key, name in (
        ("interventions", "periods corrected"),
        ("infeasible", "periods infeasible"),
        ("invalid", "periods invalid"),
    ):
        if key == "invalid" and not any(any(_pooled(group, key)) for group in groups.values()):
            continue
        shares = [
            sum(_pooled(g, key)) / s if s else None for g, s in zip(groups.values(), steps, strict=True)
        ]
        add(name, "–", [percent(share) for share in shares])
    still = [sum(_pooled(group, "pursuer_invalid")) for group in groups.values()]
    if any(still):
        add("periods in which a pursuer stood still", "–", [str(count) for count in still])
    corrections = [
        sum(float(e["mean_correction"]) * int(e["steps"]) for run in group for e in run.metrics) / periods
        if periods
        else None
        for group, periods in zip(groups.values(), steps, strict=True)
    ]
    add("mean correction, m/s", "–", [shown_number(value, 4) for value in corrections])
    closest = [min(_pooled(group, "min_pursuer_clearance"), default=None) for group in groups.values()]
    add("closest to capture", "–", [shown_number(value, 4, " m") for value in closest])
    for policy, found, reported in (
        ("learned policy", scenes, "reached the target"),
        ("straight for the target", untrained_scenes, "–"),
    ):
        ends = [OUTCOME_WORDS[found[shield].outcome] if shield in found else "not run" for shield in groups]
        add(f"test scene, {policy}", reported, ends)
    return {"columns": ["the paper reports", *(shield_words(shield) for shield in groups)], "rows": rows}
