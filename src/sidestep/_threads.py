"""Several threads for one computation.

On a CPU, JAX runs what a thread asks for one after the other, and a program of many small loops in one core.
What different threads ask for runs side by side.
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
    """One for each core that this process may use; fewer where `PJRT_NPROC` allows JAX fewer."""
    told = os.environ.get("PJRT_NPROC", "")
    return min(cores(), int(told)) if told.isdigit() and int(told) > 0 else cores()


def useful_threads(most: int) -> int:
    """How many threads, at most so many, one computation is best shared among.

    One where an accelerator computes, and where JAX's settings hold for this thread only, as those of
    `with jax.enable_x64(True)` do.
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
    """Go through all iterables, each in a thread of its own; `tell` gets in this thread what they yield.

    As soon as one of them, or `tell`, raises, or Ctrl-C is pressed, the others end after what they are at.
    A single one is gone through in this thread.
    """
    if len(works) == 1:
        for one in works[0]:
            tell(one)
        return
    stop, told = threading.Event(), queue.SimpleQueue[tuple[T] | None]()

    def go_through(work: Iterable[T]) -> None:
        try:
            for one in work:
                told.put((one,))
                if stop.is_set():
                    break
        except BaseException:
            stop.set()
            raise
        finally:
            told.put(None)

    with ThreadPoolExecutor(len(works)) as pool:
        threads = [pool.submit(go_through, work) for work in works]
        try:
            running = len(works)
            while running:
                if (one := told.get()) is None:
                    running -= 1
                else:
                    tell(*one)
        finally:
            stop.set()
    for thread in threads:
        thread.result()
