"""The process that measures: its threads, its precision, its memory."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

from sidestep._compiled import thread_limits

THREAD_SETTINGS = (
    "PJRT_NPROC", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "XLA_FLAGS",
    "JAX_PLATFORMS", "JAX_ENABLE_X64",
)  # fmt: skip
"""Environment variables that decide how many threads there are, and which precision."""


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
