"""`sidestep play`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep._bounds import SEED, VISITORS, bounded
from sidestep.commands.common import (
    Overrides,
    PolicyName,
    PursuerName,
    ShieldName,
    given,
    policy_and_scenario,
    say,
    unless_given,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console

    from sidestep.world import Scenario


@dataclass(frozen=True)
class Play:
    """Serve a page in which you drive the pursuer and try to capture the shielded robot, or write it as a
    folder of files (`--static`)."""

    run: PolicyName = unless_given("pretrained")
    """Run folder whose policy drives the robot, pretrained, or goal-seeking for the untrained one. Where the
    pretrained one does not fit the scenario, goal-seeking is the default."""
    scenario: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Preset or file; the run's own scenario, or paper, by default."""
    shield: ShieldName = "joint"
    """Initial shield: none, paper, game or joint."""
    pursuer: PursuerName = "you"
    """Initial pursuer: you, or a strategy such as nash."""
    set: Overrides = ()
    """Scenario fields to change, such as obstacle_count=2."""
    seed: int = bounded(unless_given(0), SEED)
    """Seed of the first visitor's starts and targets."""
    static: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Write the page as a folder that any static web host serves, without Python, and end."""
    host: str = unless_given("127.0.0.1")
    """Address to listen on; 0.0.0.0 allows access from other machines."""
    port: int = bounded(unless_given(8765), least=0, most=65535)
    """Port to listen on; 0 selects a free one."""
    allow_host: tuple[str, ...] = ()
    """Host names under which others reach this machine, besides its addresses."""
    visitors: int = bounded(unless_given(8), VISITORS)
    """Largest number of visitors at once."""
    open: bool = False
    """Also open the page in the browser."""


def _policy_and_scenario(command: Play) -> tuple[Any, Scenario]:
    """What was asked for; without a policy's name goal-seeking where the pretrained one does not fit."""
    from sidestep.learning import PRETRAINED_SCENARIO
    from sidestep.world import Scenario, observation_names

    policy, scenario, _ = policy_and_scenario(command.run, command.scenario, command.set)
    trained_for = Scenario(observation=PRETRAINED_SCENARIO["observation"])
    fits = scenario.built_in and observation_names(scenario) == observation_names(trained_for)
    if not fits and not given(command, "run"):
        policy, scenario, _ = policy_and_scenario("goal-seeking", command.scenario, command.set)
    return policy, scenario


def run(command: Play, console: Console) -> int:
    """Run `sidestep play` until Ctrl-C; returns the exit status."""
    from sidestep.views.play import Hosting, Limits, serve

    if command.static is not None:
        served = given(command, "seed", "host", "port", "allow_host", "visitors")
        names = [*served, *(["open"] if command.open else [])]
        if names:
            option = "--" + names[0].replace("_", "-")
            raise ValueError(f"{option} is about the page that is served; leave it out with --static")
    policy, scenario = _policy_and_scenario(command)
    hosting = Hosting(
        scenario,
        policy,
        command.shield,
        command.pursuer,
        command.seed,
        Limits(visitors=command.visitors),
        command.allow_host,
        _savers(),
    )

    if command.static is not None:
        return _write(command.static, hosting, console)

    def announce(address: str) -> None:
        console.print(f"The page: {address}", highlight=False)
        console.print("Ctrl-C ends it.", highlight=False)
        if command.open:
            import webbrowser

            webbrowser.open(address)

    serve(hosting, command.host, command.port, announce=announce)
    return 0


def _write(folder: Path, hosting: Any, console: Console) -> int:
    """Write the page without a server."""
    from sidestep.bridges.static_page import write_page

    written = write_page(folder, hosting, progress=lambda text: say(console, text))
    say(console, f"{written.folder}: {written.size / 1e6:.2f} MB, for any static web host")
    if written.shield != hosting.shield:
        say(console, "No clearance table serves this scenario: the page begins with game in place of joint.")
    say(console, f"Look at it: python -m http.server --directory {shlex.quote(str(written.folder))} 8000")
    return 0


def _savers() -> dict[str, Any]:
    """Functions that save an episode in other formats, by suffix: mcap if that package is installed."""
    try:
        import mcap  # noqa: F401
    except ModuleNotFoundError:
        return {}
    from sidestep.bridges.logs import save_log

    def save(path: Path, trajectory: Any, scenario: Any, about: Mapping[str, Any]) -> None:
        save_log(trajectory, scenario, path, about=about)

    return {"mcap": save}
