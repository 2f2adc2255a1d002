"""Ctrl-C: handle it without losing data.

Python raises `KeyboardInterrupt` between any two instructions of the main thread. That may become an
`ImportError` (during the import of an extension module), be lost (in a finalizer or a callback), or leave
only one of two related actions done. So a command handles SIGINT itself. After `claim`, Ctrl-C

- ends the process at once with status 130, outside `held`. Nothing is lost, because files are written whole
  or not at all;
- takes effect at the next call of `check` within `held`, between two steps of the work. A second Ctrl-C ends
  the process at once.

Ending at once skips Python's shutdown, which would free memory that threads of XLA still use. Library
functions use `held` too; without `claim` they raise `KeyboardInterrupt` at `check`.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

STATUS = 130
"""Exit status of a command ended by Ctrl-C: 128 plus the number of SIGINT, as in shells."""
_SHOW_CURSOR = "\x1b[?25h"

_claimed = False
_depth = 0
_asked = False
_answered = False
_actions: list[Callable[[], object]] = []


def claim() -> None:
    """Make Ctrl-C end this process at once, outside `held`.

    For a program's entry point, before heavy imports. Does nothing if SIGINT is ignored, as in background
    jobs of a shell, or already handled.
    """
    global _claimed
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _heard)
        _claimed = True


@contextlib.contextmanager
def held() -> Iterator[None]:
    """A context in which the first Ctrl-C waits for `check`; a second one ends the process at once.

    If no `check` follows the first one, `KeyboardInterrupt` is raised at the end. Does nothing outside the
    main thread, and if the program handles SIGINT in another way.
    """
    global _depth, _asked, _answered
    ours = signal.getsignal(signal.SIGINT) in (_heard, signal.default_int_handler)
    if threading.current_thread() is not threading.main_thread() or not ours:
        yield
        return
    before = signal.signal(signal.SIGINT, _heard)
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1
        signal.signal(signal.SIGINT, before)
        if _depth == 0:
            unanswered = _asked and not _answered
            _asked = _answered = False
            if unanswered:
                raise KeyboardInterrupt


def check() -> None:
    """**Raises** `KeyboardInterrupt`, once, if Ctrl-C was pressed since the outermost `held` began."""
    global _answered
    if _asked and not _answered:
        _answered = True
        raise KeyboardInterrupt


@contextlib.contextmanager
def before_leaving(action: Callable[[], object]) -> Iterator[None]:
    """A context in which `action()` is called before Ctrl-C ends a command at once, the latest `action`
    first.

    It runs in a signal handler: it must be short and must not wait for a lock. Its exceptions are ignored.
    """
    _actions.append(action)
    try:
        yield
    finally:
        _actions.remove(action)


def say(line: str) -> None:
    """Print a line from a signal handler, in which Python's streams may be in use."""
    with contextlib.suppress(Exception):
        sys.stdout.flush()
    with contextlib.suppress(OSError):
        os.write(1, f"{line}\n".encode())


def _heard(signal_number: int, frame: FrameType | None) -> None:
    global _asked
    if _depth and not _asked:
        _asked = True
        with contextlib.suppress(OSError):
            os.write(2, b"\nStopping after this step. Ctrl-C again stops at once.\n")
    elif _claimed:
        _leave()
    else:
        signal.default_int_handler(signal_number, frame)


def _leave() -> NoReturn:
    # Another Ctrl-C must not wait for the reader of the output flushed below.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with contextlib.suppress(Exception):
        if sys.stderr.isatty():
            # A progress bar hides it.
            os.write(2, f"{_SHOW_CURSOR}\n".encode())
    for action in reversed(_actions):
        with contextlib.suppress(Exception):
            action()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    os._exit(STATUS)
