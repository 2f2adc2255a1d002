"""One visitor's connection: messages in, frames out, neither waiting for the other."""

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
"""s between the end of an episode and the next."""
_SETTLE = 0.25
"""s without another number before what takes a while is found out about the last."""
_IDLE = 0.1
"""s between two looks at a world that stands still."""
_LATE = 0.25
"""s by which a period may be late before the clock stops trying to make up for it."""
_FLOOD_PAUSE = 0.02
"""s for which a visitor is not listened to after every 50 messages too many."""


class Gone(Exception):
    """The visitor has gone."""


@final
class Allowance:
    """A bucket that fills with `rate` tokens per second up to `burst`; each message takes one."""

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
    """What is to be sent: a few notes in order, and the latest frame, which replaces the one before it.

    A frame waits while `ahead` of them have been sent and not been acknowledged: so what a slow connection
    carries is at most that old, however slow it is. A visitor that never acknowledges any is sent all that
    the connection takes.
    """

    def __init__(self, ahead: int, notes: int = 32):
        self._ahead = ahead
        self._frame: dict[str, Any] | None = None
        self._notes: deque[dict[str, Any]] = deque(maxlen=notes)
        self._sent: deque[int] = deque(maxlen=4 * ahead)
        self._seen = -1
        self._changed = asyncio.Event()

    def put(self, frame: dict[str, Any]) -> None:
        """The latest frame. A break in time and a target reached are not lost with the one before."""
        if self._frame is not None:
            frame["cut"] = frame["cut"] or self._frame["cut"]
            if self._frame.get("reached"):
                frame["reached"] = True
        self._frame = frame
        self._changed.set()

    def note(self, note: dict[str, Any]) -> None:
        """Something else; one setup replaces another, and of too many notes the oldest go."""
        if note["type"] == "setup":
            others = [other for other in self._notes if other["type"] != "setup"]
            self._notes.clear()
            self._notes.extend(others)
        self._notes.append(note)
        self._changed.set()

    def acknowledge(self, frame: int) -> None:
        """The visitor has this frame."""
        if self._sent:
            self._seen = max(self._seen, min(frame, self._sent[-1]))
        while len(self._sent) > 1 and self._sent[0] <= self._seen:
            self._sent.popleft()
        self._changed.set()

    @property
    def acknowledged(self) -> bool:
        """Whether the visitor acknowledges at all."""
        return self._seen >= 0

    async def take(self) -> dict[str, Any]:
        """What to send next, once there is something."""
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
        """Whether as many frames as allowed are on their way."""
        if self._seen < 0:
            return False
        return sum(number > self._seen for number in self._sent) >= self._ahead


@final
class Visitor:
    """Runs a session at its pace until the connection ends.

    All that computes runs in `workers`, never in the event loop. Messages that come too fast are dropped
    unread; edits wait for the next period, a few at most; what the visitor drives at takes effect at once.

    **Arguments:** `receive` the next text message, raising `Gone` when there is none any more; `send` one.
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
        self._allowance = Allowance(limits.message_rate, limits.message_burst)
        self._complaints = Allowance(2.0, 5)
        self._edits: deque[Message] = deque()
        self._asked = asyncio.Event()
        self._outbox = Outbox(limits.frames_ahead)
        self._heard = time.monotonic()
        self._told_setup: dict[str, Any] | None = None

    async def run(self, greeting: dict[str, Any]) -> None:
        """Greet, and go on until the connection ends or one of the parts fails."""
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
                    # Who floods is heard less: the connection fills up, and only theirs.
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
        """The clock: what was asked, then one period, and so on."""
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
        """Until then, or until something is asked."""
        self._asked.clear()
        if self._edits:
            return
        # Not wait_for: before Python 3.12 it drops a cancellation that comes with what it waits for.
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._asked.wait()

    def _say(self, frame: dict[str, Any]) -> None:
        self._outbox.put(frame)

    def _say_setup(self) -> None:
        setup = self.session.setup()
        if setup != self._told_setup:
            self._told_setup = setup
            self._outbox.note(setup)

    def _watch_silence(self) -> None:
        silent = time.monotonic() - self._heard > self._limits.silence
        if silent and self._outbox.acknowledged and self.session.moving:
            raise Gone("nothing was heard for too long")
