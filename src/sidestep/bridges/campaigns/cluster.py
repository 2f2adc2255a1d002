"""Connect to Dask workers: of this machine, or of a running scheduler."""

from __future__ import annotations

import ast
import inspect
import logging
import multiprocessing
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sidestep._bounds import WORKERS, taken
from sidestep._compiled import cores
from sidestep._packages import needed

LOCAL = "local"
_CONNECT_SECONDS = 10
_LOCAL_CONFIG = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
"""Switches off the web servers of Dask's workers, which are not used here."""


def local_size(workers: int | None, threads: int | None) -> tuple[int, int]:
    """Number of workers and of threads per worker; by default their product is the number of cores.

    **Raises** `ValueError` for a number that is not from 1 to 1024.
    """
    for name, value in (("workers", workers), ("threads_per_worker", threads)):
        if value is not None:
            taken(name, value, WORKERS)
    if workers is None:
        return max(1, cores() // (threads or 1)), threads or 1
    return workers, threads or max(1, cores() // workers)


def check_options(scheduler: Any, workers: int | None, threads: int | None) -> None:
    """**Raises** `ValueError` for invalid options or combinations, without connecting."""
    if scheduler == LOCAL:
        local_size(workers, threads)
        return
    if isinstance(scheduler, str) and "://" not in scheduler:
        raise ValueError(f"scheduler = '{scheduler}': it must be local or an address such as tcp://host:8786")
    if workers is not None or threads is not None:
        raise ValueError(
            "--workers and --threads-per-worker are for --scheduler local; a cluster has its own"
        )


def check_main_guard() -> None:
    """**Raises** `ValueError` if local workers, which import the main script, would call the campaign
    again."""
    main = sys.modules.get("__main__")
    file, spec = getattr(main, "__file__", None), getattr(main, "__spec__", None)
    # multiprocessing does not import these in a child: a prompt, `python -c`, `python -m package`.
    if file is None or (spec is not None and spec.name.endswith(".__main__")):
        return
    if getattr(multiprocessing.current_process(), "_inheriting", False) or not _is_guarded(file):
        raise ValueError(
            f"workers on this machine import {file}, which would start the campaign again in each: put "
            'the call under `if __name__ == "__main__":`, or in a function that is called there'
        )


def _is_guarded(file: str) -> bool:
    """Whether the running statement of the main script is below a test of `__name__`."""
    frame, line = inspect.currentframe(), None
    while frame is not None:
        if frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__") == "__main__":
            line = frame.f_lineno
        frame = frame.f_back
    try:
        statements = ast.parse(Path(file).read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return True
    # Called in a thread, or from something that is not a Python file: unknown.
    here = [one for one in statements if line is not None and one.lineno <= line <= (one.end_lineno or 0)]
    return all(isinstance(one, ast.If) and "__name__" in ast.dump(one.test) for one in here)


def name_of(scheduler: Any) -> str:
    """The address of a scheduler or cluster, for messages."""
    return (
        scheduler if isinstance(scheduler, str) else str(getattr(scheduler, "scheduler_address", scheduler))
    )


@contextmanager
def connected(scheduler: Any, workers: int | None, threads: int | None) -> Iterator[Any]:
    """A Dask client: of new workers on this machine (`local`), of the scheduler at an address, or of a Dask
    cluster object.

    Local workers and their scheduler listen on 127.0.0.1 only, without a dashboard, and end with the context.

    Options must have passed `check_options`. **Raises** `ValueError` when no scheduler answers.
    """
    distributed: Any = needed("distributed", "cluster", "campaigns need")
    if scheduler == LOCAL:
        with _local(distributed, *local_size(workers, threads)) as client:
            yield client
        return
    if isinstance(scheduler, str):
        _check_reachable(scheduler)
    try:
        client = distributed.Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise ValueError(f"no scheduler answers at {name_of(scheduler)}: {error}") from None
    # Dask logs a lost connection at length; the command reports it in one line.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        yield client
    finally:
        client.close()


def _check_reachable(address: str) -> None:
    """Fail fast, with a short message, where Dask would retry for long."""
    from distributed.comm.addressing import parse_host_port
    from distributed.security import Security

    scheme, _, place = address.partition("://")
    if scheme == "tls" and Security().get_connection_args("client")["ssl_context"] is None:
        raise ValueError(
            f"{address} needs certificates: name them in Dask's configuration, distributed.comm.tls.ca-file "
            "and distributed.comm.tls.client.cert and .key"
        )
    if scheme in ("tcp", "tls"):
        try:
            host, port = parse_host_port(place)
            socket.create_connection((host, port), timeout=_CONNECT_SECONDS).close()
        except (OSError, ValueError) as error:
            raise ValueError(f"no scheduler answers at {address}: {error}") from None


@contextmanager
def _local(distributed: Any, workers: int, threads: int) -> Iterator[Any]:
    import dask.config

    with (
        dask.config.set(_LOCAL_CONFIG),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=threads,
            processes=True,
            host="127.0.0.1",
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            # Jobs need little memory: a limit would only pause workers next to a large process.
            memory_limit=0,
            preload="sidestep.bridges.campaigns.worker",
            silence_logs=logging.CRITICAL,
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client
