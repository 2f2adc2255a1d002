"""The sections of `benchmarks/bench.py`, by name."""

from __future__ import annotations

import importlib
from typing import Any

SECTIONS = {
    "learning": "the whole training loop against Stable-Baselines3, SBX and rejax",
    "many_worlds": "the same loop with many worlds at once",
    "filter": "the filter against cbfpy, qpax, OSQP and Clarabel",
    "simulation": "many worlds at once against a loop over a Gymnasium environment",
    "joint": "how long one decision of the shield joint takes",
    "decision": "one decision of a robot's core, in JAX and by compiled C",
    "roofline": "arithmetic of one update against the machine's rate for its matrix products",
    "scaling": "how seconds and memory grow with worlds, obstacles, pursuers, rows, episodes, seeds",
    "gpu": "what an accelerator does per second",
    "startup": "import, --help, and the first result of commands",
}
"""Name and what it measures."""


def section(name: str) -> Any:
    """The module of a section: `cases(quick) -> list[Case]`, `run(settings) -> figures`, `summary(results)`.

    **Raises** `ValueError` naming the sections.
    """
    if name not in SECTIONS:
        raise ValueError(f"no section '{name}'; there are {', '.join(SECTIONS)}")
    return importlib.import_module(f"speed.{name}")
