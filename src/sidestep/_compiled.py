"""Threads and the cache of compiled programs."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_LARGEST = 1 << 30
"""Size of the cache in bytes; beyond it JAX deletes the least recently used programs."""


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_limits(threads: int) -> dict[str, str]:
    """Environment variables that limit JAX, and the libraries of NumPy, to this many threads.

    They have an effect until JAX is first used. Otherwise XLA uses one thread per core, independent of its
    flags for Eigen, for small programs too: a decision of `joint` then takes 1.4 times as long.
    """
    pools = "PJRT_NPROC", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"
    return dict.fromkeys(pools, str(threads))


def cache_folder() -> Path | None:
    """`$SIDESTEP_CACHE`, else `sidestep` in the user's cache folder; None for `SIDESTEP_CACHE=off`."""
    named = os.environ.get("SIDESTEP_CACHE", "")
    if named.lower() == "off":
        return None
    if named:
        return Path(named)
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base) / "sidestep"
    caches = "Library/Caches" if sys.platform == "darwin" else ".cache"
    return Path.home() / caches / "sidestep"


def keep_compiled_programs() -> None:
    """Enable JAX's compilation cache on disk, for programs that take more than 0.3 s to compile.

    Programs must call this before JAX is imported; afterwards it does nothing, so that settings of a
    library's user are kept. JAX's environment variables have priority. A folder that cannot be created is not
    used.
    """
    folder = cache_folder()
    if "jax" in sys.modules or folder is None or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
    os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(_LARGEST))
