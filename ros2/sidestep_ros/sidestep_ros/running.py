"""Start, run and stop a node."""

import gc
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from sidestep._compiled import keep_compiled_programs, thread_limits
from sidestep_ros.parameters import ConfigurationError

_LOOK_AROUND = 0.1


def tune_jax() -> None:
    """Set up JAX for single small decisions; environment variables of the user have priority. Call it before
    JAX is imported.

    JAX uses one thread, because one decision is too small to parallelise, and computes in the calling thread,
    because waking another takes longer than most decisions. Compiled programs are cached on disk.
    """
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    for name, value in thread_limits(1).items():
        os.environ.setdefault(name, value)
    keep_compiled_programs()
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def run(make: Callable[[], Any], arguments: list[str] | None = None) -> int:
    """Run the node that `make` builds until a signal or the middleware ends it; returns the exit status.

    The node has `get_ready()` for all slow work, and `leave_safe()`, which is called at the end, also after
    an exception, while the node can still publish.
    """
    # The middleware's handlers would close all publishers before a stop can be sent.
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    node: Any = None
    try:
        # During compilation a signal ends the process at once; in the loop, after the running callback.
        _on_signals(_leave)
        node = make()
        node.get_ready()
        _spin(node)
    except ConfigurationError as error:
        print(f"The parameters cannot be used:\n{error}", file=sys.stderr)
        return 2
    except ExternalShutdownException:
        pass
    finally:
        if node is not None:
            node.leave_safe()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _on_signals(handler: Callable[..., None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def _leave(number: int, _frame: Any) -> None:
    # No command has been sent yet, so no stop is needed, and a compiler does not let exceptions through.
    os._exit(128 + number)


def _spin(node: Any) -> None:
    asked: list[int] = []
    _on_signals(lambda number, _frame: asked.append(number))
    # Exclude all present objects: with JAX loaded a full garbage collection takes 128 ms.
    gc.collect()
    gc.freeze()
    # rclpy's events executor takes half the time, but fails after some seconds.
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok() and not asked:
        executor.spin_once(timeout_sec=_LOOK_AROUND)
