"""How does a node start, run and stop?"""

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
    """Settings for single small decisions; the user's environment comes first. Call it before JAX is there.

    One thread: a decision is too small to share, and the other cores have robots to drive. The thread that
    asks computes: waking another takes longer than most decisions. What was compiled is kept on disk.
    """
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    for name, value in thread_limits(1).items():
        os.environ.setdefault(name, value)
    keep_compiled_programs()
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def run(make: Callable[[], Any], arguments: list[str] | None = None) -> int:
    """Run the node that `make` builds until a signal or the middleware ends it; returns the exit status.

    The node has `get_ready()`, in which everything slow happens, and `leave_safe()`. Whatever ends it, an
    exception included, `leave_safe` is called while the node can still speak.
    """
    # The middleware's own handlers would close all publishers before a stop can be sent.
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    node: Any = None
    try:
        # While something compiles a signal ends it at once; in the loop, after the callback that runs.
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
    # No command has been sent that a stop would have to follow, and no exception gets through a compiler.
    os._exit(128 + number)


def _spin(node: Any) -> None:
    asked: list[int] = []
    _on_signals(lambda number, _frame: asked.append(number))
    # What is there now stays: with JAX loaded a full collection takes 128 ms, and next to nothing after this.
    gc.collect()
    gc.freeze()
    # rclpy's events executor takes half the time, but ends with an error of its own after some seconds.
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while rclpy.ok() and not asked:
        executor.spin_once(timeout_sec=_LOOK_AROUND)
