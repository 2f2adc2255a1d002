"""`sidestep campaign`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from sidestep._bounds import WORKERS, bounded
from sidestep._program import command as command_line
from sidestep.commands.common import CampaignBar, going_on, say, stood_still, write_json_file

if TYPE_CHECKING:
    from rich.console import Console

    from sidestep.bridges.campaigns import CampaignOutcome
    from sidestep.trials.campaign import Campaign as Plan
    from sidestep.trials.campaign import Comparison

_FAILURES_SHOWN = 5


@dataclass(frozen=True)
class Campaign:
    """Run a grid of trainings or evaluations on many cores or machines; the same command resumes it."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")]
    """Campaign file: what to run, for which seeds, scenarios, shields and pursuers."""
    out: Path | None = None
    """Folder for the results, a new one or this campaign's; by default runs/ plus the file's name."""
    scheduler: Annotated[str, tyro.conf.arg(metavar="local|tcp://HOST:PORT")] = "local"
    """local for workers on this machine, or the address of a running Dask scheduler."""
    workers: int | None = bounded(None, WORKERS)
    """Local workers, one job each at a time; one per core by default."""
    threads_per_worker: int | None = bounded(None, WORKERS)
    """Cores for each local worker's job; an equal share of all by default."""
    dry_run: bool = False
    """Only check the file and print its number of jobs."""
    json: Path | None = None
    """Also write counts, failures and comparisons to this file."""


def run(command: Campaign, console: Console) -> int:
    """Run `sidestep campaign`; returns the exit status: 1 when a job failed or the scheduler was lost."""
    from sidestep.store.outputs import try_outputs
    from sidestep.trials.campaign import Store, load_campaign

    folder = command.out or Path("runs") / command.file.stem
    if not command.dry_run:
        try_outputs(files=[command.json], folders=[folder])
    plan = load_campaign(command.file)
    if command.dry_run:
        from sidestep.bridges.campaigns.cluster import check_options

        check_options(command.scheduler, command.workers, command.threads_per_worker)
        done = sum(Store(folder).read(job.id) is not None for job in plan.jobs)
        console.print(f"{plan.name}: {len(plan.jobs)} jobs, {done} of them done in {folder}", highlight=False)
        return 0
    from sidestep.bridges.campaigns import run_campaign

    going = going_on(console, folder, *_again(command, folder))
    with going, CampaignBar(console, plan.name) as show:
        outcome = run_campaign(
            plan, folder, scheduler=command.scheduler, workers=command.workers,
            threads_per_worker=command.threads_per_worker, progress=show,
        )  # fmt: skip
    comparisons, without = _comparisons(plan, outcome.rows)
    for table in comparison_tables(comparisons):
        console.print(table)
    for words in without:
        console.print(f"Not compared: {words}", highlight=False, soft_wrap=True)
    _say(command, folder, outcome, console)
    write_json_file(command.json, _report(plan, outcome, comparisons))
    if outcome.stopped == "interrupted":
        return 130
    return 0 if outcome.complete else 1


def _comparisons(plan: Plan, rows: list[dict[str, Any]]) -> tuple[list[Comparison], list[str]]:
    """The comparisons that the file requests, and reasons for those that are not possible."""
    from sidestep.trials.campaign import compare

    asked, found, without = plan.compare, [], []
    for figure in asked.figures if asked is not None and rows else ():
        assert asked is not None
        try:
            found.append(compare(rows, asked.by, figure, lower_is_better=figure in asked.lower_is_better))
        except ValueError as error:
            # For example a time to reach the target if no episode reached it.
            without.append(str(error))
    return found, without


def _report(plan: Plan, outcome: CampaignOutcome, comparisons: Sequence[Comparison]) -> dict[str, Any]:
    names = ("jobs", "done", "earlier", "ran", "damaged", "workers", "lost_workers", "stopped", "seconds")
    return {
        "campaign": plan.name,
        "kind": plan.kind,
        **{name: getattr(outcome, name) for name in names},
        "failed": [
            {"job": failure.job.id, **failure.job.labels, "reason": failure.reason}
            for failure in outcome.failed
        ],
        "comparisons": [comparison.to_dict() for comparison in comparisons],
    }


def _say(command: Campaign, folder: Path, outcome: CampaignOutcome, console: Console) -> None:
    """Print the finished and failed jobs, and how to continue."""
    say(
        console,
        f"{outcome.done} of {outcome.jobs} jobs have a result: "
        f"{outcome.ran} ran now, {outcome.earlier} before. Table: {folder / 'results.parquet'}",
    )
    if outcome.damaged:
        say(console, f"Damaged result files that were set aside, and their jobs run again: {outcome.damaged}")
    still = sum(row.get("pursuer_invalid") or 0 for row in outcome.rows)
    if still:
        say(console, f"Warning: {stood_still(still)}")
    used = {row["version_sidestep"] for row in outcome.rows}
    if len(used) > 1:
        say(console, f"Results come from different versions of sidestep: {', '.join(sorted(used))}")
    for failure in outcome.failed[:_FAILURES_SHOWN]:
        labels = ", ".join(f"{name} {label}" for name, label in failure.job.labels.items())
        say(console, f"Failed: {labels}: {failure.reason}")
    if len(outcome.failed) > _FAILURES_SHOWN:
        say(console, f"and {len(outcome.failed) - _FAILURES_SHOWN} more failed; --json lists all")
    if outcome.complete:
        return
    reason = "Jobs failed" if outcome.stopped is None else outcome.stopped[0].upper() + outcome.stopped[1:]
    again = command_line(*_again(command, folder))
    say(console, f"{reason}. Results are kept; continue with: {again}")


def _again(command: Campaign, folder: Path) -> list[object]:
    """The words after `sidestep` that continue the campaign."""
    words: list[object] = ["campaign", command.file, "--out", folder]
    if command.scheduler != "local":
        words += ["--scheduler", command.scheduler]
    for option in ("workers", "threads_per_worker", "json"):
        value = getattr(command, option)
        words += [] if value is None else [f"--{option.replace('_', '-')}", value]
    return words


def comparison_tables(comparisons: Sequence[Comparison]) -> list[Any]:
    """Per figure, a table of the groups with their interquartile means, then one of the pairs."""
    from rich.table import Table

    tables = []
    for comparison in comparisons:
        title = comparison.figure.replace("_", " ") + (
            " (less is better)" if comparison.lower_is_better else ""
        )
        table = Table("group", "runs", "interquartile mean", "95 % interval", title=title)
        for group in comparison.groups:
            estimate, low, high = group.interquartile_mean
            # With one run per stratum there is nothing to resample.
            interval = f"{low:.4g} to {high:.4g}" if group.fewest > 1 else "-"
            table.add_row(_words(group.labels), str(group.values), f"{estimate:.4g}", interval)
        if comparison.left_out:
            table.caption = f"{comparison.left_out} results without a value of it are left out"
        tables.append(table)
        if comparison.pairs:
            pairs = Table("better", "than", "probability", "95 % interval", title=f"{title}, in pairs")
            for pair in comparison.pairs:
                chance, low, high = pair.probability
                pairs.add_row(
                    _words(pair.first), _words(pair.second), f"{chance:.1%}", f"{low:.1%} to {high:.1%}"
                )
            tables.append(pairs)
    return tables


def _words(labels: dict[str, Any]) -> str:
    return ", ".join(str(label) for label in labels.values())
