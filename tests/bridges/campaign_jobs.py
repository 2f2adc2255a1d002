"""Stand-ins for jobs: cheap, and as troublesome as they are told to be. Workers import this file."""

import os
import signal
import sys
import time
from pathlib import Path

from sidestep.trials.campaign import Campaign, Job


def make_campaign(log: Path, jobs: int, **trouble) -> Campaign:
    """`jobs` stand-ins; `trouble` numbers them by what they do: `dies=[1], dies_once=[2], raises=[3]`."""

    def what(number):
        return next((word for word, numbers in trouble.items() if number in numbers), "works")

    stand_ins = (
        Job({"seed": i}, {"kind": "stand-in", "seed": i, "does": what(i), "log": str(log)})
        for i in range(jobs)
    )
    return Campaign("stand-ins", "evaluate", tuple(stand_ins))


def runs(log: Path) -> list[int]:
    """Numbers of the jobs in the order in which they were begun."""
    return [int(line) for line in log.read_text().split()] if log.exists() else []


class Fatal(str):
    """Words that can be written down, but that nobody can hand over and live."""

    __slots__ = ()

    def __reduce__(self):
        os.kill(os.getpid(), signal.SIGKILL)


def stand_in(task, folder):
    """Each run appends a line to a log, then does what it is told."""
    settings = task.settings
    log = Path(settings["log"])
    before = runs(log).count(settings["seed"])
    with open(log, "a") as file:
        file.write(f"{settings['seed']}\n")
    does = settings["does"]
    if does == "dies" or (does == "dies_once" and not before):
        os.kill(os.getpid(), signal.SIGKILL)
    if does == "raises":
        raise ArithmeticError("two and two")
    if does == "lasts":
        time.sleep(0.25)
    if does == "dies_handing_over":
        return {"said": Fatal("farewell")}
    return {"seed_squared": settings["seed"] ** 2, "pair": {"a": 1.5, "b": None}}


if __name__ == "__main__":
    from sidestep.bridges.campaigns import run_campaign

    folder, log, jobs = sys.argv[1:]
    run_campaign(make_campaign(Path(log), int(jobs), lasts=range(int(jobs))), folder, workers=1, run=stand_in)
