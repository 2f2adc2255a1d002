"""One visitor's connection: receives messages and sends frames, independently of each other."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor
from typing import Any, final

from sidestep.views.play.limits import Limits
from sidestep.views.play.messages import Drive, Message, MessageError, Seen
from sidestep.views.play.session import Session

_ENDING = 1.8
"""Time (s) between the end of an episode and the next."""
_SETTLE = 0.25
"""Time (s) without a new number after which the slow part of the verdict is computed."""
_IDLE = 0.1
"""Time (s) between two frames of a world that stands still."""
_LATE = 0.25
"""Lateness (s) of a period beyond which the clock does not catch up."""
_FLOOD_PAUSE = 0.02
"""Time (s) for which no messages are received after every 50 excess messages."""


class Gone(Exception):
    """The connection has ended."""


@final
class TokenBucket:
    """Rate limiter: fills with `rate` tokens per second up to `burst`; each message takes one."""

    def __init__(self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic):
        self._rate, self._burst, self._clock = rate, float(burst), clock
        self._tokens, self._then = float(burst), clock()

    def take(self) -> bool:
        """Whether there was a token."""
        now = self._clock()
        self._tokens = min(self._tokens + self._rate * (now - self._then), self._burst)
        self._then = now
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


@final
class Outbox:
    """Outgoing data: a few notes in order, and the latest frame, which replaces the one before it.

    A frame waits while `ahead` frames are not acknowledged, which bounds the latency of a slow connection. A
    visitor that never acknowledges gets as many frames as the connection can carry.
    """

    def __init__(self, ahead: int, notes: int = 32):
        self._ahead = ahead
        self._frame: dict[str, Any] | None = None
        self._notes: deque[dict[str, Any]] = deque(maxlen=notes)
        self._sent: deque[int] = deque(maxlen=4 * ahead)
        self._seen = -1
        self._changed = asyncio.Event()

    def put(self, frame: dict[str, Any]) -> None:
        """Set the latest frame. The flags of the replaced frame (a discontinuity, a reached target) are
        kept."""
        if self._frame is not None:
            frame["cut"] = frame["cut"] or self._frame["cut"]
            if self._frame.get("reached"):
                frame["reached"] = True
        self._frame = frame
        self._changed.set()

    def note(self, note: dict[str, Any]) -> None:
        """Add a note. A setup replaces a waiting setup, and of too many notes the oldest are dropped."""
        if note["type"] == "setup":
            others = [other for other in self._notes if other["type"] != "setup"]
            self._notes.clear()
            self._notes.extend(others)
        self._notes.append(note)
        self._changed.set()

    def acknowledge(self, frame: int) -> None:
        """Register that the visitor has this frame."""
        if self._sent:
            self._seen = max(self._seen, min(frame, self._sent[-1]))
        while len(self._sent) > 1 and self._sent[0] <= self._seen:
            self._sent.popleft()
        self._changed.set()

    @property
    def acknowledged(self) -> bool:
        """Whether the visitor acknowledges frames."""
        return self._seen >= 0

    async def take(self) -> dict[str, Any]:
        """Wait for the next data to send."""
        while True:
            if self._notes:
                return self._notes.popleft()
            if self._frame is not None and not self._behind:
                frame, self._frame = self._frame, None
                self._sent.append(frame["frame"])
                return frame
            self._changed.clear()
            await self._changed.wait()

    @property
    def _behind(self) -> bool:
        """Whether the number of unacknowledged frames is at its limit."""
        if self._seen < 0:
            return False
        return sum(number > self._seen for number in self._sent) >= self._ahead


@final
class Visitor:
    """Runs a session at its pace until the connection ends.

    Computations run in `workers`, never in the event loop. Messages that arrive too fast are dropped unread;
    edits wait for the next period, with a limit; drive commands take effect at once.

    **Arguments:** `receive` returns the next text message, and raises `Gone` at the end; `send` sends one.
    """

    def __init__(
        self,
        session: Session,
        limits: Limits,
        workers: Executor,
        receive: Callable[[], Awaitable[str | bytes | None]],
        send: Callable[[str], Awaitable[None]],
    ):
        self.session, self._limits, self._workers = session, limits, workers
        self._receive, self._send = receive, send
        self._allowance = TokenBucket(limits.message_rate, limits.message_burst)
        self._complaints = TokenBucket(2.0, 5)
        self._edits: deque[Message] = deque()
        self._asked = asyncio.Event()
        self._outbox = Outbox(limits.frames_ahead)
        self._heard = time.monotonic()
        self._last_setup: dict[str, Any] | None = None

    async def run(self, greeting: dict[str, Any]) -> None:
        """Run until the connection ends or a task fails."""
        self._outbox.note(greeting)
        parts = [asyncio.ensure_future(part()) for part in (self._listen, self._live, self._speak)]
        try:
            done, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
            for part in done:
                part.result()
        except Gone:
            pass
        finally:
            for part in parts:
                part.cancel()
            await asyncio.gather(*parts, return_exceptions=True)

    async def _listen(self) -> None:
        dropped = 0
        while True:
            text = await self._receive()
            self._heard = time.monotonic()
            if not self._allowance.take():
                dropped += 1
                if dropped % 50 == 0:
                    # Slow down a flooding visitor: only their connection fills up.
                    await asyncio.sleep(_FLOOD_PAUSE)
                continue
            try:
                self._take(self.session.reader.read(text))
            except MessageError as error:
                self._complain(str(error))

    def _take(self, message: Message) -> None:
        match message:
            case Seen(frame):
                self._outbox.acknowledge(frame)
                return
            case Drive() if self.session.pursuer == "you" or message == Drive():
                self.session.apply(message)
                return
        if len(self._edits) >= self._limits.pending:
            raise MessageError("too much at once")
        self._edits.append(message)
        self._asked.set()

    def _complain(self, text: str) -> None:
        if self._complaints.take():
            self._outbox.note({"type": "error", "text": text})

    async def _speak(self) -> None:
        while True:
            note = await self._outbox.take()
            await self._send(json.dumps(note, separators=(",", ":"), allow_nan=False))

    async def _live(self) -> None:
        """The clock: apply edits, then advance by one period, repeatedly."""
        session, loop = self.session, asyncio.get_running_loop()
        due, settle_at, ended = loop.time(), loop.time() + _SETTLE, None
        self._say(session.frame())
        while True:
            now = loop.time()
            wait = (due - now) if session.moving else _IDLE
            if wait > 0.0 and not self._edits:
                await self._wait(wait)
                now = loop.time()
            edits = [self._edits.popleft() for _ in range(len(self._edits))]
            if edits:
                frame, complaints = await loop.run_in_executor(self._workers, self._edit, edits)
                for complaint in complaints:
                    self._complain(complaint)
                self._say(frame)
                settle_at = loop.time() + _SETTLE
            elif not session.settled and now >= settle_at:
                await loop.run_in_executor(self._workers, session.settle)
            self._say_setup()
            if session.outcome is None:
                ended = None
            elif ended is None:
                ended = now
                self._say(session.frame())
            elif now - ended >= _ENDING and not session.paused:
                await loop.run_in_executor(self._workers, session.restart)
                self._say(session.frame())
            if not session.moving:
                due = loop.time()
                self._watch_silence()
                continue
            if loop.time() >= due:
                self._say(await loop.run_in_executor(self._workers, session.advance))
                due = max(due + session.period / session.pace, loop.time() - _LATE)
                self._watch_silence()

    def _edit(self, edits: list[Message]) -> tuple[dict[str, Any], list[str]]:
        complaints = []
        for edit in edits:
            try:
                self.session.apply(edit)
            except MessageError as error:
                complaints.append(str(error))
        return self.session.frame(), complaints

    async def _wait(self, seconds: float) -> None:
        """Wait until that time, or until an edit arrives."""
        self._asked.clear()
        if self._edits:
            return
        # Not wait_for: before Python 3.12 it may lose a cancellation.
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._asked.wait()

    def _say(self, frame: dict[str, Any]) -> None:
        self._outbox.put(frame)

    def _say_setup(self) -> None:
        setup = self.session.setup()
        if setup != self._last_setup:
            self._last_setup = setup
            self._outbox.note(setup)

    def _watch_silence(self) -> None:
        silent = time.monotonic() - self._heard > self._limits.silence
        if silent and self._outbox.acknowledged and self.session.moving:
            raise Gone("nothing was heard for too long")
