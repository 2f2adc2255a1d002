"""A process that runs the decision core in real time, for a test that stops it and sets its clock.

It is `python onboard_loop.py BOARD SAID`: poses come over the file BOARD, decisions go to the file SAID.
"""

import json
import mmap
import struct
import sys
import time
from pathlib import Path

_FORMAT = struct.Struct("<Q7dQ")


class Board:
    """Seven numbers that one process writes and another reads, never half of them."""

    def __init__(self, path, *, create=False):
        if create:
            Path(path).write_bytes(bytes(_FORMAT.size))
        with open(path, "r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _FORMAT.size)
        self._count = 0

    def write(self, *numbers):
        self._count += 1
        struct.pack_into("<Q", self._memory, _FORMAT.size - 8, self._count)
        struct.pack_into("<7d", self._memory, 8, *numbers)
        struct.pack_into("<Q", self._memory, 0, self._count)

    def read(self):
        """The numbers written last, or None before that or in the midst of it."""
        first, *numbers, last = _FORMAT.unpack_from(self._memory, 0)
        return numbers if first == last != 0 else None


def main(board, said):
    from sidestep.robot import Onboard, OnboardSettings
    from sidestep.world import load_scenario

    scenario = load_scenario("paper", capture_distance=0.15, evader_speed=0.05, pursuer_speed=0.06)
    core = Onboard(scenario, "game", settings=OnboardSettings(stale_after=0.5))
    core.warm_up()
    shared, newest, period = Board(board), None, float(scenario.control_period)
    with open(said, "a", buffering=1) as file:
        due = time.monotonic()
        while True:
            due = max(due + period, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))
            newest = shared.read() or newest
            if newest is None:
                continue
            stamp, ahead, x, y, *pursuer = newest
            core.see("evader", stamp, (x, y, 0.0))
            core.see("pursuer", stamp, pursuer)
            core.see("obstacle", stamp, (0.0, 5.0))
            core.nominal(stamp, (0.0, 0.0))
            now = time.monotonic() + ahead
            decision = core.decide(now)
            said_now = {
                "age": now - stamp,
                "level": decision.level,
                "reactions": decision.reactions,
                "velocity": decision.velocity.tolist(),
            }
            file.write(json.dumps(said_now) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
