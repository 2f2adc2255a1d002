"""What does the live page cost, how soon does it answer, and what does it put up with?

    .venv/bin/python benchmarks/page.py --json FILE

The server runs as a process of its own, `sidestep play`; visitors are sockets that drive all the time and
acknowledge every frame, as the page does. What an input takes to the screen is measured in Chromium, by the
browser's own Event Timing: from the time stamp of a key to the picture that shows what it did. Chromium comes
from `playwright install chromium`, or from `--chromium PATH`. Linux only: CPU and memory are read in /proc.
"""

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from machine import conditions, load
from sidestep.store.files import write_json

SCREENS = {"laptop": (1280, 760, 1), "projector": (1920, 1080, 1), "phone": (390, 844, 2)}
"""Width and height in CSS pixels, and how many real ones each is wide."""
_TICK = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_DRIVES = ({"wheels": [1, 1]}, {"wheels": [-1, 1]}, {"wheels": [1, -1]}, {"wheels": [0.5, 1]})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rate", type=float, default=30.0, help="control periods, and frames, per second")
    parser.add_argument("--shield", default="joint", choices=("none", "paper", "game", "joint"))
    parser.add_argument("--seconds", type=float, default=60.0, help="of each number of visitors")
    parser.add_argument("--keys", type=int, default=300, help="pressed in each size of the page")
    parser.add_argument("--browsers", type=int, default=3, help="started for each size, one after the other")
    parser.add_argument("--chromium", help="executable")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    before = load()
    with served(options) as server:
        figures: dict[str, Any] = {"visitors": {}}
        for count in (1, 8):
            figures["visitors"][str(count)] = asyncio.run(visited(server, count, options.seconds))
        figures["disturbed"] = asyncio.run(disturbed(server))
        figures["screens"] = seen_in_chromium(server, options)
        figures["memory_mib_at_the_end"] = server.memory_mib()
    settings = {"rate": options.rate, "shield": options.shield, "seconds": options.seconds}
    result = {**conditions(before), "options": settings, **figures}
    print(json.dumps(figures, indent=2))
    if options.json is not None:
        write_json(options.json, result)


@dataclass(frozen=True)
class Server:
    """A running `sidestep play`."""

    process: subprocess.Popen[str]
    address: str

    @property
    def socket(self) -> str:
        """The address of its sockets."""
        return self.address.replace("http", "ws", 1) + "live"

    def cpu_seconds(self) -> float:
        """CPU time that it has used, of all its threads."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICK

    def memory_mib(self) -> float:
        """Memory that it holds now."""
        pages = Path(f"/proc/{self.process.pid}/statm").read_text(encoding="ascii").split()[1]
        return round(int(pages) * _PAGE / 2**20, 1)


@contextlib.contextmanager
def served(options: argparse.Namespace) -> Iterator[Server]:
    """The server, until the block ends."""
    command = [
        sys.executable, "-u", "-m", "sidestep", "play", "--port", "0", "--shield", options.shield,
        "--set", f"control_period={1.0 / options.rate}",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = re.search(r"http\S+", process.stdout.readline())
        if address is None:
            raise SystemExit("the server did not start; it says above why")
        yield Server(process, address.group())
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30.0)


@dataclass
class Guest:
    """A visitor that plays: acknowledges every frame and drives this way and that."""

    socket: ClientConnection
    arrivals: list[float] = field(default_factory=list)
    answers: list[float] = field(default_factory=list)
    ended: str | None = None

    async def play(self) -> None:
        """Until cancelled, or until the server ends it."""
        ways = itertools.cycle(_DRIVES)
        asked, wheels = None, None
        try:
            async for text in self.socket:
                message = json.loads(text)
                if message["type"] != "frame":
                    continue
                now = time.perf_counter()
                await self.say(type="seen", frame=message["frame"])
                if message["pace"] > 0.0:
                    self.arrivals.append(now)
                told = message.get("wheels", [None])[0]
                if message["over"] or message["cut"]:
                    asked = None
                if asked is not None and told != wheels:
                    self.answers.append(now - asked)
                    asked = None
                if len(self.arrivals) % 11 == 0 and asked is None and told is not None:
                    # At any moment of a period, as people do.
                    await asyncio.sleep(np.random.default_rng(len(self.arrivals)).uniform(0.0, 0.02))
                    asked, wheels = time.perf_counter(), told
                    await self.say(type="drive", **next(ways))
            self.ended = "the server closed the connection"
        except ConnectionClosed as closed:
            self.ended = str(closed)

    async def say(self, **message: Any) -> None:
        await self.socket.send(json.dumps(message))

    def summary(self) -> dict[str, Any]:
        """Frames that came while the world moved; an episode's end holds them up for a second or two."""
        gaps = 1000.0 * np.diff(self.arrivals)
        gaps = gaps[gaps < 1000.0]
        return {
            "frames": len(self.arrivals), "gap_ms_p50": _of(gaps, 50), "gap_ms_p99": _of(gaps, 99),
            "drive_to_frame_ms_p50": _of(1000.0 * np.array(self.answers), 50),
            "drive_to_frame_ms_p99": _of(1000.0 * np.array(self.answers), 99),
            "dropped": self.ended is not None,
        }  # fmt: skip


@contextlib.asynccontextmanager
async def guests(server: Server, count: int) -> AsyncIterator[list[Guest]]:
    """So many visitors, playing, once the shield is compiled."""
    async with contextlib.AsyncExitStack() as stack:
        all_of_them = [
            Guest(await stack.enter_async_context(connect(server.socket, compression=None)))
            for _ in range(count)
        ]
        tasks = [asyncio.create_task(guest.play()) for guest in all_of_them]
        try:
            while any(len(guest.arrivals) < 60 and guest.ended is None for guest in all_of_them):
                await asyncio.sleep(0.1)
            yield all_of_them
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def visited(server: Server, count: int, seconds: float) -> dict[str, Any]:
    """What so many visitors cost the server, and what each gets."""
    async with guests(server, count) as all_of_them:
        for guest in all_of_them:
            guest.arrivals.clear()
            guest.answers.clear()
        began, used = time.perf_counter(), server.cpu_seconds()
        await asyncio.sleep(seconds)
        share = (server.cpu_seconds() - used) / (time.perf_counter() - began)
        each = [guest.summary() for guest in all_of_them]
    return {
        "cpu_share_of_one_core": round(share, 4), "cpu_share_per_visitor": round(share / count, 4),
        "memory_mib": server.memory_mib(),
        "dropped": sum(guest["dropped"] for guest in each),
        "frames_fewest": min(guest["frames"] for guest in each),
        **{name: max(guest[name] for guest in each) for name in each[0] if name.endswith(("p50", "p99"))},
    }  # fmt: skip


async def disturbed(server: Server) -> dict[str, Any]:
    """One visitor plays on while others send nonsense, too much, or nothing any more."""
    async with guests(server, 1) as (bystander,):
        memory = {"before": server.memory_mib()}
        bystander.arrivals.clear()
        bystander.answers.clear()
        refused: dict[str, Any] = {}
        async with connect(server.socket, compression=None) as socket:
            heard = asyncio.create_task(_heard(socket))
            for number in range(10_000):
                await socket.send(_nonsense(number))
                if number % 50 == 49:
                    await asyncio.sleep(0.2)
            await socket.send('{"type":"pause","paused":true}')
            refused |= await asyncio.wait_for(heard, 60.0)
        memory["after 10,000 malformed messages"] = server.memory_mib()
        async with connect(server.socket, compression=None) as socket:
            with contextlib.suppress(ConnectionClosed):
                await socket.send("x" * 10_000_000)
            with contextlib.suppress(ConnectionClosed):
                async for _ in socket:
                    pass
            refused["10 MB end that connection"] = socket.close_code is not None
        try:
            async with connect(server.socket, origin="http://elsewhere.example"):  # pyright: ignore[reportArgumentType]
                refused["socket of another origin"] = "let in"
        except InvalidStatus as answer:
            refused["socket of another origin"] = answer.response.status_code
        for _ in range(50):
            socket = await connect(server.socket, compression=None)
            await socket.recv()
            socket.transport.abort()
        memory["after 10 MB and 50 torn connections"] = server.memory_mib()
        await asyncio.sleep(2.0)
        result = bystander.summary()
    return {"bystander": result, "memory_mib": memory, **refused}


def _nonsense(number: int) -> str | bytes:
    kinds = (
        "", "{", "null", "[]", '{"type":"drive","wheels":["a"]}', '{"type":"drive","wheels":[1e999,0]}',
        '{"type":"move","what":"moon","index":-1,"to":[0,0]}',
        '{"type":"numbers","values":{"pursuer_speed":-1}}', b"\x00\xff\xfe", "[" * 2000,
        '{"type":"seen","frame":99999999999999999999}', '{"type":"pick","shield":"\\ud800"}',
    )  # fmt: skip
    return kinds[number % len(kinds)]


async def _heard(socket: ClientConnection) -> dict[str, Any]:
    """What the sender of nonsense hears, until a pause that it asks for afterwards is granted."""
    complaints = 0
    try:
        async for text in socket:
            message = json.loads(text)
            complaints += message["type"] == "error"
            if message["type"] == "setup" and message["paused"]:
                return {"complaints of 10,000 malformed messages": complaints, "and it is served on": True}
    except ConnectionClosed:
        pass
    return {"complaints of 10,000 malformed messages": complaints, "and it is served on": False}


_WATCH = """() => {
  window.seen = { inputs: [], gaps: [], drawn: [] };
  new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) if (entry.name === "keydown") seen.inputs.push(entry.duration);
  }).observe({ type: "event", durationThreshold: 16 });
  let pressed = null;
  let before = null;
  addEventListener("keydown", (event) => { pressed = event.timeStamp; }, true);
  const picture = (now) => {
    requestAnimationFrame(picture);
    if (before !== null) seen.gaps.push(now - before);
    before = now;
    if (pressed === null) return;
    const key = pressed;
    pressed = null;
    const { port1, port2 } = new MessageChannel();
    port1.onmessage = () => seen.drawn.push(performance.now() - key);
    port2.postMessage(0);
  };
  requestAnimationFrame(picture);
}"""


def seen_in_chromium(server: Server, options: argparse.Namespace) -> dict[str, Any]:
    """Milliseconds from a key to the end of drawing and to the screen, and between pictures."""
    from playwright.sync_api import sync_playwright

    figures = {}
    with sync_playwright() as playwright:
        for name, (width, height, ratio) in SCREENS.items():
            inputs: list[float] = []
            gaps: list[float] = []
            drawn: list[float] = []
            browsers = []
            pressed = 0
            for number in range(options.browsers):
                browser = playwright.chromium.launch(executable_path=options.chromium, args=["--no-sandbox"])
                page = browser.new_context(
                    viewport={"width": width, "height": height}, device_scale_factor=ratio
                ).new_page()
                page.goto(server.address)
                page.wait_for_selector('body[data-connected="yes"][data-ready="yes"]', timeout=300_000)
                page.wait_for_timeout(1500)
                page.evaluate(_WATCH)
                random = np.random.default_rng(number)
                for _ in range(options.keys // options.browsers):
                    key = str(random.choice(["KeyW", "KeyA", "KeyS", "KeyD"]))
                    page.keyboard.down(key)
                    page.wait_for_timeout(100.0 + random.uniform(0.0, 50.0))
                    page.keyboard.up(key)
                    page.wait_for_timeout(30.0 + random.uniform(0.0, 50.0))
                    pressed += 1
                seen = page.evaluate("seen")
                inputs += seen["inputs"]
                gaps += seen["gaps"]
                drawn += seen["drawn"]
                browsers.append(_of(np.array(seen["inputs"]), 50))
                browser.close()
            # The browser keeps silent of what took less than 16 ms; and counts in steps of 8.
            inputs += [16.0] * max(pressed - len(inputs), 0)
            figures[name] = {
                "width": width, "height": height, "device_pixel_ratio": ratio, "keys": pressed,
                "input_to_screen_ms_p50": _of(np.array(inputs), 50),
                "input_to_screen_ms_p99": _of(np.array(inputs), 99),
                "input_to_screen_ms_p50_of_each_browser": browsers,
                "input_to_drawn_ms_p50": _of(np.array(drawn), 50),
                "pictures_per_second": round(1000.0 / float(np.mean(gaps)), 1),
                "gap_ms_p99": _of(np.array(gaps), 99),
            }  # fmt: skip
    return figures


def _of(values: np.ndarray, percentile: float) -> float:
    return round(float(np.percentile(values, percentile)), 2) if len(values) else float("nan")


if __name__ == "__main__":
    main()
