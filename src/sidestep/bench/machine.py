"""On what was it measured: processor, versions, threads, load, memory."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import sys
from pathlib import Path
from typing import Any

from sidestep._compiled import cores, thread_limits

PACKAGES = (
    "sidestep", "jax", "jaxlib", "equinox", "optax", "numpy", "scipy", "torch", "stable-baselines3", "sbx-rl",
    "flax", "rejax", "gymnax", "gymnasium", "cbfpy", "qpax", "elastiqp", "osqp", "clarabel",
)  # fmt: skip
"""Packages whose versions are written down."""
THREAD_SETTINGS = (
    "PJRT_NPROC", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "XLA_FLAGS",
    "JAX_PLATFORMS", "JAX_ENABLE_X64",
)  # fmt: skip
"""Environment variables that decide how many threads there are, and which precision."""


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


def versions() -> dict[str, str | None]:
    """Python's version and those of all packages that take part."""
    from sidestep import __version__

    # A source folder on the path has no metadata of its own.
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
        "sidestep": __version__,
    }


def thread_environment(threads: int, **more: str) -> dict[str, str]:
    """Environment for a child with `threads` threads, on the CPU unless the caller's says otherwise."""
    settings = {**os.environ, "JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS", "cpu")}
    # What the caller's shell sets must not slow one side down.
    for name in ("XLA_FLAGS", "JAX_ENABLE_X64", "JAX_COMPILATION_CACHE_DIR", "JAX_NUMPY_DTYPE_PROMOTION"):
        settings.pop(name, None)
    return {**settings, **thread_limits(threads), **more}


def synchronous_dispatch() -> None:
    """From now on JAX computes on the CPU in the thread that asks, which is what single calls should do.

    By default it hands the work to another thread, and waking that one takes longer than a small program.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def peak_memory_mib() -> float:
    """The most memory that this process has held, MiB."""
    try:
        # Unlike getrusage, this does not begin with what the parent held before the exec.
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    except OSError:
        pass
    return _most_memory_mib(of_children=False)


def peak_memory_of_children_mib() -> float:
    """The most memory that any child process which has ended had held, MiB."""
    return _most_memory_mib(of_children=True)


def _most_memory_mib(*, of_children: bool) -> float:
    import resource

    scale = 2**20 if sys.platform == "darwin" else 2**10
    who = resource.RUSAGE_CHILDREN if of_children else resource.RUSAGE_SELF
    return resource.getrusage(who).ru_maxrss / scale


def forget_peak_memory() -> None:
    """From now on `peak_memory_mib` tells the most since now, where the system can do that (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
