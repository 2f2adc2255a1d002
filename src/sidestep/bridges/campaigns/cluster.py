"""Where do the jobs run? On workers that this machine starts, or those of a scheduler that runs already."""

from __future__ import annotations

import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sidestep._compiled import cores
from sidestep._packages import needed

LOCAL = "local"
_CONNECT_SECONDS = 10
_LOCAL_CONFIG = {"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}
"""Dask's web servers have nothing to tell: nobody asks them here."""


def local_size(workers: int | None, threads: int | None) -> tuple[int, int]:
    """Workers, and threads for each: together as many as there are cores, unless told otherwise.

    **Raises** `ValueError` for a number below 1.
    """
    for name, value in (("workers", workers), ("threads_per_worker", threads)):
        if value is not None and value < 1:
            raise ValueError(f"{name} = {value}: at least 1 is needed")
    if workers is None:
        return max(1, cores() // (threads or 1)), threads or 1
    return workers, threads or max(1, cores() // workers)


def check_options(scheduler: Any, workers: int | None, threads: int | None) -> None:
    """**Raises** `ValueError` for options that are wrong or do not go together; asks nobody."""
    if scheduler == LOCAL:
        local_size(workers, threads)
        return
    if isinstance(scheduler, str) and "://" not in scheduler:
        raise ValueError(f"scheduler = '{scheduler}': it must be local or an address such as tcp://host:8786")
    if workers is not None or threads is not None:
        raise ValueError(
            "--workers and --threads-per-worker are for --scheduler local; a cluster has its own"
        )


def name_of(scheduler: Any) -> str:
    """The address of a scheduler or cluster, for messages."""
    return (
        scheduler if isinstance(scheduler, str) else str(getattr(scheduler, "scheduler_address", scheduler))
    )


@contextmanager
def connected(scheduler: Any, workers: int | None, threads: int | None) -> Iterator[Any]:
    """A Dask client: of workers on this machine for `local`, else of the scheduler at that address, or of a
    cluster that one of Dask's deployers has started.

    Local workers and their scheduler listen on 127.0.0.1 only, without a dashboard, and end with the command.

    The options are those that `check_options` lets through. **Raises** `ValueError` when nothing answers at
    the address.
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
    # Dask tells of a lost connection in many words; the command says it in one line.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        yield client
    finally:
        client.close()


def _check_reachable(address: str) -> None:
    """What Dask would find out too, after long, and tell at length."""
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
            # Jobs hold little of their own: a limit would only pause workers beside a large neighbour.
            memory_limit=0,
            preload="sidestep.bridges.campaigns.worker",
            silence_logs=logging.CRITICAL,
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client
