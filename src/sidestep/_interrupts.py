"""Ctrl-C: where may it end the work, and what has to happen first?

Python raises `KeyboardInterrupt` between any two instructions of the main thread. There it can turn into an
`ImportError` (while an extension module is imported), be lost (in a finalizer or a callback), or leave one
of two things done that belong together. So a command handles SIGINT itself. From `claim` on, Ctrl-C

- ends the process at once with status 130, where nothing can be lost: files are written whole or not at all;
- within `held` is acted on where the work calls `check`: between two steps, when nothing is being computed.
  A second Ctrl-C ends the process at once there too.

Leaving at once skips Python's shutdown, which would take away memory that threads of XLA still work on.
Library functions use `held` too; in a program that is not ours they raise `KeyboardInterrupt` at `check`.
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
"""Exit status of a command that Ctrl-C ended: 128 plus the number of SIGINT, as shells have it."""
_SHOW_CURSOR = "\x1b[?25h"

_claimed = False
_depth = 0
_asked = False
_answered = False
_actions: list[Callable[[], object]] = []


def claim() -> None:
    """From here on Ctrl-C ends this process at once, outside `held`.

    For a program's entry point, before it imports anything heavy. Does nothing where SIGINT is ignored, as in
    a shell's background jobs, or handled already.
    """
    global _claimed
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _heard)
        _claimed = True


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Within, the first Ctrl-C waits for `check`; a second one acts at once.

    A first one that no `check` has answered raises `KeyboardInterrupt` at the end. Does nothing outside the
    main thread, and where the program handles SIGINT in another way.
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
    """Within, `action()` is called before Ctrl-C ends a command at once, the latest `action` first.

    It runs inside a signal handler: it must be short and wait for no lock. What it raises is ignored.
    """
    _actions.append(action)
    try:
        yield
    finally:
        _actions.remove(action)


def say(line: str) -> None:
    """Print a line from inside a signal handler, where Python's own streams may be in use."""
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
    # One more is not to wait for whoever reads what is flushed below.
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
