"""How do compiled programs run: in how many threads, and kept where for the next process?"""

from __future__ import annotations

import os
import sys
from pathlib import Path

_LARGEST = 1 << 30
"""Bytes; beyond that JAX deletes what was used longest ago."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_limits(threads: int) -> dict[str, str]:
    """Environment variables with which JAX, and the libraries that NumPy calls, compute in so many threads.

    They count until JAX is first used. XLA takes a thread for every core whatever its flags for Eigen say,
    and hands even small programs round among them: a decision of `joint` takes 1.4 times as long then.
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
    """Have JAX keep on disk what takes it more than 0.3 s to compile.

    For programs to call before JAX is imported; afterwards it does nothing, so that a library's user keeps
    what they have set. JAX's own environment variables go first. A folder that cannot be made is not used.
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
