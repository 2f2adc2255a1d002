"""Run one job on a worker: choose its cores, run it once, keep the result.

Imports nothing heavy, because JAX's number of threads must be set before JAX is imported.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sidestep._compiled import keep_compiled_programs, thread_limits

if TYPE_CHECKING:
    from sidestep.trials.campaign import Task

_ONE_AT_A_TIME = threading.Lock()
"""A worker's threads are the cores of one job, so jobs run one at a time."""


def dask_setup(worker: Any) -> None:
    """Called in a new local worker before it imports JAX. The worker ignores Ctrl-C, which the command
    handles."""
    take_cores(worker.state.nthreads, worker.name)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def take_cores(threads: int, number: Any = None) -> None:
    """Set the number of JAX's threads and its compilation cache. JAX must not be imported yet.

    `number`, the index of a local worker, pins the worker to separate cores if there are enough.
    """
    if "jax" in sys.modules:
        return
    keep_compiled_programs()
    _keep_to_cores(threads, number)
    os.environ.update(thread_limits(threads))
    # Workers share the accelerator: none may allocate all its memory.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def _keep_to_cores(threads: int, number: Any) -> None:
    """Pin the process to its cores. XLA's threads wait in a busy loop, which would slow another worker down
    if they shared its core. Threads started later inherit the cores."""
    if not isinstance(number, int) or not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))[number * threads : (number + 1) * threads]
    if len(cores) == threads:
        os.sched_setaffinity(0, cores)


def run_on_worker(
    task: Any, folder: str, token: str, version: str, run: Callable[[Task, Path | None], Any] | None
) -> dict[str, Any]:
    """`run_once` on the cores of the current Dask worker.

    **Raises** what the job raises, and `RuntimeError` if the worker has another version of sidestep.
    """
    from distributed import get_worker

    import sidestep
    from sidestep.store.damage import damage_on_stderr

    if sidestep.__version__ != version:
        raise RuntimeError(f"the worker has sidestep {sidestep.__version__}, the command {version}")
    with _ONE_AT_A_TIME:
        worker = get_worker()
        take_cores(worker.state.nthreads, worker.name)
        with damage_on_stderr():
            return run_once(task, folder, token, run)


def run_once(
    task: Any, folder: str, token: str, run: Callable[[Task, Path | None], Any] | None
) -> dict[str, Any]:
    """The record of a job; read from the campaign's folder if it has been run already.

    A process with access to the folder writes the result itself, so that it survives the scheduler, and waits
    while another process runs the same job. Without access, only the command writes it.
    """
    from sidestep.trials.campaign import Store, run_task
    from sidestep.trials.campaign.jobs import record_of

    store = Store(folder)
    seen = _token(store) == token
    with store.lock(task.job) if seen else contextlib.nullcontext():
        if seen and (record := store.read(task.job)) is not None:
            return record
        begun = time.monotonic()
        figures = (run or run_task)(task, store.run_folder(task.job) if seen else None)
        record = record_of(task, figures, time.monotonic() - begun)
        if seen:
            store.keep(record)
        return record


def _token(store: Any) -> str | None:
    try:
        return store.token
    except (OSError, ValueError):
        return None
