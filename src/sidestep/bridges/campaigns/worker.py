"""What a worker does with a job: take its cores, run it once, keep the result.

Imports nothing heavy: how many threads JAX may have is decided before JAX is.
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

from sidestep._compiled import keep_compiled_programs

if TYPE_CHECKING:
    from sidestep.trials.campaign import Task

_ONE_AT_A_TIME = threading.Lock()
"""A worker's threads are the cores of one job, not so many jobs."""


def dask_setup(worker: Any) -> None:
    """Called in a new local worker: Ctrl-C reaches every process of a terminal, but is the command's."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def take_cores(threads: int) -> None:
    """Have JAX, which must not be imported yet, compute in this many threads and keep compiled programs."""
    if "jax" in sys.modules:
        return
    keep_compiled_programs()
    # As many as XLA makes for its computations; it would take every core of the machine.
    os.environ["NPROC"] = str(threads)
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = str(threads)
    if threads == 1:
        flags = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
    # Several workers share an accelerator: none takes all its memory.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def run_on_worker(
    task: Any, folder: str, token: str, version: str, run: Callable[[Task, Path | None], Any] | None
) -> dict[str, Any]:
    """`run_once` on the cores of the Dask worker that this is called on.

    **Raises** what the job raises; `RuntimeError` where another version of sidestep is installed than there.
    """
    from distributed import get_worker

    import sidestep

    if sidestep.__version__ != version:
        raise RuntimeError(f"the worker has sidestep {sidestep.__version__}, the command {version}")
    with _ONE_AT_A_TIME:
        take_cores(get_worker().state.nthreads)
        return run_once(task, folder, token, run)


def run_once(
    task: Any, folder: str, token: str, run: Callable[[Task, Path | None], Any] | None
) -> dict[str, Any]:
    """The record of a job, from the campaign's folder if it is there already.

    Where this process sees the folder it puts the result there itself, so that nothing is lost with the
    scheduler, and waits while another one runs the same job; elsewhere the command alone keeps it.
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
