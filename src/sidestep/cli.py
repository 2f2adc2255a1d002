"""The command line: parse, call, print."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from sidestep._bounds import check
from sidestep._compiled import keep_compiled_programs
from sidestep.commands import (
    campaign,
    certify,
    evaluate,
    export,
    falsify,
    fly,
    play,
    report,
    reproduce,
    train,
    twin,
)
from sidestep.store.damage import damage_on_stderr

_RUN: dict[type, Callable[..., int]] = {
    train.Train: train.run,
    evaluate.Evaluate: evaluate.run,
    reproduce.Reproduce: reproduce.run,
    certify.Certify: certify.run,
    falsify.Falsify: falsify.run,
    play.Play: play.run,
    report.Report: report.run,
    campaign.Campaign: campaign.run,
    export.Export: export.run,
    twin.Twin: twin.run,
    fly.Fly: fly.run,
}


def main(arguments: list[str] | None = None) -> int:
    """Entry point of `sidestep`. Bad input ends with a message and exit status 2, Ctrl-C with 130."""
    command: Any = tyro.cli(
        Annotated[train.Train, subcommand("train")]
        | Annotated[evaluate.Evaluate, subcommand("evaluate")]
        | Annotated[reproduce.Reproduce, subcommand("reproduce")]
        | Annotated[certify.Certify, subcommand("certify")]
        | Annotated[falsify.Falsify, subcommand("falsify")]
        | Annotated[play.Play, subcommand("play")]
        | Annotated[report.Report, subcommand("report")]
        | Annotated[campaign.Campaign, subcommand("campaign")]
        | Annotated[export.Export, subcommand("export")]
        | Annotated[twin.Twin, subcommand("twin")]
        | Annotated[fly.Fly, subcommand("fly")],
        prog="sidestep",
        description="Safe reinforcement learning for a robot that is being pursued.",
        args=arguments,
    )
    from rich.console import Console

    keep_compiled_programs()
    try:
        for part in (command, *filter(is_dataclass, vars(command).values())):
            check(part)
        with damage_on_stderr():
            return _RUN[type(command)](command, Console())
    except ValueError as error:
        print(f"sidestep: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
