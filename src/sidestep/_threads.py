"""Several threads for one computation.

On a CPU, JAX runs the programs of one thread in sequence, and a program of many small loops on one core. The
programs of different threads run in parallel.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax

from sidestep._compiled import cores

_SETTINGS = (
    "jax_enable_x64",
    "jax_disable_jit",
    "jax_default_device",
    "jax_default_matmul_precision",
    "jax_debug_nans",
)

T = TypeVar("T")


def allowed_threads() -> int:
    """One thread per core that this process may use; fewer if `PJRT_NPROC` limits JAX."""
    limit = os.environ.get("PJRT_NPROC", "")
    return min(cores(), int(limit)) if limit.isdigit() and int(limit) > 0 else cores()


def useful_threads(most: int) -> int:
    """The best number of threads for one computation, at most `most`.

    One on an accelerator, and if JAX's settings hold for this thread only, such as those of
    `with jax.enable_x64(True)`.
    """
    count = min(allowed_threads(), most)
    if count <= 1 or jax.default_backend() != "cpu":
        return 1
    with ThreadPoolExecutor(1) as pool:
        elsewhere = pool.submit(_settings).result()
    return count if elsewhere == _settings() else 1


def _settings() -> tuple[object, ...]:
    return tuple(getattr(jax.config, name) for name in _SETTINGS)


def side_by_side(works: Sequence[Iterable[T]], tell: Callable[[T], None]) -> None:
    """Iterate over all iterables, each in a separate thread; `tell` is called in this thread with their
    items.

    When one of them or `tell` raises, or Ctrl-C is pressed, the others end after their current item. A single
    iterable runs in this thread.
    """
    if len(works) == 1:
        for one in works[0]:
            tell(one)
        return
    stop, items = threading.Event(), queue.SimpleQueue[tuple[T] | None]()

    def go_through(work: Iterable[T]) -> None:
        try:
            for one in work:
                items.put((one,))
                if stop.is_set():
                    break
        except BaseException:
            stop.set()
            raise
        finally:
            items.put(None)

    with ThreadPoolExecutor(len(works)) as pool:
        threads = [pool.submit(go_through, work) for work in works]
        try:
            running = len(works)
            while running:
                if (one := items.get()) is None:
                    running -= 1
                else:
                    tell(*one)
        finally:
            stop.set()
    for thread in threads:
        thread.result()
