"""On what was it measured: processor, versions, load. For every benchmark's JSON file."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from sidestep._compiled import cores

PACKAGES = (
    "sidestep", "jax", "jaxlib", "equinox", "optax", "numpy", "scipy", "torch", "stable-baselines3", "sbx-rl",
    "flax", "rejax", "gymnax", "gymnasium", "cbfpy", "qpax", "elastiqp", "osqp", "clarabel",
)  # fmt: skip
"""Packages whose versions are written down."""


def version(package: str) -> str | None:
    """The installed version of a package, if there is one."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def processor() -> str:
    """The processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"


def load() -> float | None:
    """How many processes wanted to run over the last minute."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def machine() -> dict[str, Any]:
    """Processor, cores, memory (MiB), system."""
    memory = None
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2**20
    return {
        "processor": processor(), "cores": cores(), "memory_mib": memory, "system": platform.platform(),
    }  # fmt: skip


def versions(*more: str) -> dict[str, str | None]:
    """Python's version and those of all packages that take part, `more` packages too."""
    from sidestep import __version__

    # A source folder on the path has no metadata of its own.
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in (*PACKAGES, *more)},
        "sidestep": __version__,
    }


def conditions(load_before: float | None) -> dict[str, Any]:
    """Machine, versions, and the load at the start and now."""
    return {
        "machine": machine(), "versions": versions(), "load before": load_before, "load after": load(),
    }  # fmt: skip
