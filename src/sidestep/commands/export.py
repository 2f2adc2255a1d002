"""`sidestep export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from sidestep._bounds import DELAY, DISTANCE, HEADING_ERROR, TRACKING_ERROR, bounded
from sidestep.commands.common import Overrides, scenario_of_run, write_json_file

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Export:
    """Export a trained policy, the filter, or both for a small computer: C, ONNX or jax.export."""

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder, or a policy.npz, whose policy to export."""
    out: Path
    """File to write, for c a folder; never overwritten silently."""
    format: Literal["onnx", "c", "jax"] = "onnx"
    """onnx: runs with onnxruntime only; c: C99 for a microcontroller; both for any shield that does not look
    ahead; jax: runs with jax, any shield."""
    what: str = "policy+filter"
    """policy+filter as one program, policy (observation to action) or filter (nominal to safe velocity)."""
    shield: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Shield: game for onnx, the run's own for c and jax by default. c and onnx take joint:table, which does
    not look ahead, in place of joint."""
    scenario: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Preset or file; the run's own scenario, or paper, by default."""
    set: Overrides = ()
    """Scenario fields to change, such as evader_speed=0.18 capture_distance=0.15."""
    position_error: float = bounded(0.0, DISTANCE)
    """Budget: largest error of a measured relative position, m."""
    heading_error: float = bounded(0.0, HEADING_ERROR)
    """Budget: largest error of a measured heading of a pursuer, rad."""
    delay: float = bounded(0.0, DELAY)
    """Budget: time from a pose to the command based on it, s; the evader's own motion counts as predicted."""
    tracking_error: float = bounded(0.0, TRACKING_ERROR)
    """Budget: largest error of the driven velocity with respect to the commanded velocity, m/s."""
    states: int = bounded(10_000, least=1, most=10_000_000, whole=True)
    """For c: number of states with answers by which to check it."""
    overwrite: bool = False
    """Replace --out where it exists."""
    json: Path | None = None
    """Also write the metadata to this file."""


def run(command: Export, console: Console) -> int:
    """Run `sidestep export`; returns the exit status."""
    from sidestep.learning import load_policy
    from sidestep.safety import Budget, make_shield
    from sidestep.store.files import is_stream
    from sidestep.store.outputs import try_outputs

    if command.run == "goal-seeking":
        raise ValueError("goal-seeking is built in and has nothing to export; name the run of a training")
    in_folder = command.format == "c"
    if not in_folder and command.out.exists() and not command.overwrite and not is_stream(command.out):
        raise ValueError(f"{command.out} exists already; give another file, or --overwrite to replace it")
    outs = [command.out]
    try_outputs(files=[*([] if in_folder else outs), command.json], folders=outs if in_folder else [])
    policy = load_policy(command.run)
    scenario, config = scenario_of_run(command.run, command.scenario, command.set)
    name = command.shield or ("game" if command.format == "onnx" else config.get("shield", "joint"))
    if command.what != "policy":
        from sidestep.bridges.export import ALONE

        scenario.check_built_in("an exported filter", ALONE)
    names = ("position_error", "heading_error", "delay", "tracking_error")
    errors = {error: getattr(command, error) for error in names}
    shield: Any = make_shield(name, scenario, Budget(**errors) if any(errors.values()) else None)
    about: dict[str, Any]
    options = {"what": command.what, "run": command.run, "overwrite": command.overwrite}
    if command.format == "onnx":
        from sidestep.bridges.export import export_onnx

        about = export_onnx(command.out, scenario, policy, shield=shield, shield_name=name, **options)
    elif command.format == "jax":
        from sidestep.bridges.export import export_jax

        about = export_jax(command.out, scenario, policy, shield=shield, shield_name=name, **options)
    else:
        from sidestep.bridges.export import export_c

        options["states"] = command.states
        about = export_c(command.out, scenario, policy, shield=shield, shield_name=name, **options)
    write_json_file(command.json, about)
    written = command.out / "sidestep.c" if in_folder else command.out
    size = written.stat().st_size
    kept = "" if command.what == "policy" else f", shield {name}"
    console.print(
        f"{command.what}{kept} as {command.format}: {written}, {size / 1000:.0f} kB", highlight=False
    )
    return 0
