"""How well does a campaign use two workers, and does it lose or repeat anything when they are killed?

    python benchmarks/campaign.py --out benchmarks/results/campaign.json

runs 200 short evaluations as one campaign on two local workers, kills a worker with SIGKILL, later the
command itself, in which the scheduler is, starts the command again, and counts results. Then it times the
same campaign, by turns on one and on two workers of one thread each. Programs are compiled before, in a
campaign of one job. Needs the extra `cluster`, and Linux.
"""

import argparse
import collections
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from machine import load, machine
from sidestep.store.files import write_json

FILE = """
[grid]
seed = {{ first = {first}, count = {count} }}
shield = "{shield}"
[settings]
episodes = {episodes}
batch = {episodes}
"""


def command(folder: Path, name: str, workers: int) -> list[str]:
    sidestep = [sys.executable, "-m", "sidestep.cli", "campaign", str(folder / f"{name}.toml")]
    return [
        *sidestep, "--out", str(folder / f"{name}-{workers}"), "--workers", str(workers),
        "--threads-per-worker", "1", "--json", str(folder / "report.json"),
    ]  # fmt: skip


def plan(folder: Path, name: str, **values: Any) -> None:
    (folder / f"{name}.toml").write_text(FILE.format(**values), encoding="utf-8")


def measured(folder: Path, name: str, workers: int) -> dict[str, Any]:
    """Seconds from the first worker to the last result, and processor seconds of all processes together."""
    before = load()
    with subprocess.Popen(
        command(folder, name, workers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"the campaign ended with exit status {child.returncode}")
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return {
        "workers": workers,
        "seconds": report["seconds"],
        "jobs": report["ran"],
        "cpu_seconds": usage.ru_utime + usage.ru_stime,
        "load_before": before,
        "load_after": load(),
    }


def scaling(folder: Path, rounds: int) -> dict[str, Any]:
    runs = []
    for number in range(rounds):
        for workers in (1, 2):
            name = f"round-{number}"
            (folder / f"{name}.toml").write_bytes((folder / "all.toml").read_bytes())
            runs.append(measured(folder, name, workers))
            print(json.dumps(runs[-1]), flush=True)
    of = {n: [run["seconds"] for run in runs if run["workers"] == n] for n in (1, 2)}
    ratios = [one / two for one, two in zip(of[1], of[2], strict=True)]
    return {
        "runs": runs,
        "ratio_each_round": ratios,
        "ratio_median": statistics.median(ratios),
        "ratio_of_fastest": min(of[1]) / min(of[2]),
        "cpu_ratio": statistics.median(run["cpu_seconds"] for run in runs if run["workers"] == 1)
        / statistics.median(run["cpu_seconds"] for run in runs if run["workers"] == 2),
    }


def results(out: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_bytes())["record"] for path in (out / "results").glob("*.json")]


def wait_for(out: Path, count: int, child: subprocess.Popen[bytes]) -> None:
    while child.poll() is None and len(list((out / "results").glob("*.json"))) < count:
        time.sleep(0.01)
    if child.poll() is not None:
        raise SystemExit("the campaign ended before it could be killed")


def worker_processes(parent: int) -> list[int]:
    """Children of a process that Dask spawned, on Linux."""
    lists = Path(f"/proc/{parent}/task").glob("*/children")
    children = [child for one in lists for child in one.read_text(encoding="ascii").split()]
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def drill(folder: Path, count: int) -> dict[str, Any]:
    """A worker is killed after a quarter of the jobs, the command after half; then it is begun again."""
    (folder / "drill.toml").write_bytes((folder / "all.toml").read_bytes())
    out = folder / "drill-2"
    with subprocess.Popen(
        command(folder, "drill", 2), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as child:
        wait_for(out, count // 4, child)
        os.kill(worker_processes(child.pid)[0], signal.SIGKILL)
        at_worker = len(results(out))
        wait_for(out, count // 2, child)
        child.send_signal(signal.SIGKILL)
    time.sleep(2.0)
    kept = {record["job"]: record for record in results(out)}
    again = subprocess.run(command(folder, "drill", 2), capture_output=True, text=True)
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    after = results(out)
    times = collections.Counter(record["job"] for record in after)
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(out / "results.parquet")
    return {
        "jobs": count,
        "results_when_a_worker_was_killed": at_worker,
        "results_when_the_command_was_killed": len(kept),
        "exit_status_of_the_second_command": again.returncode,
        "ran_in_the_second_command": report["ran"],
        "results": len(after),
        "jobs_with_more_than_one_result": sum(number > 1 for number in times.values()),
        "rows_of_the_table": table.num_rows,
        "seeds_in_the_table": len(set(table["seed"].to_pylist())),
        "results_changed_after_the_kill": sum(
            record != kept[record["job"]] for record in after if record["job"] in kept
        ),
        "worker_processes": len({record["process"] for record in after}),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--shield", default="game")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("campaign.json"))
    options = parser.parse_args()
    settings = {name: getattr(options, name) for name in ("jobs", "episodes", "shield", "rounds")}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        about = {"episodes": options.episodes, "shield": options.shield}
        plan(folder, "all", first=0, count=options.jobs, **about)
        plan(folder, "first", first=10**6, count=1, **about)
        begun = measured(folder, "first", 1)
        print(json.dumps({"first": begun}), flush=True)
        report = {
            "settings": settings,
            "machine": machine(),
            "compiling_and_first_job_seconds": begun["seconds"],
            "drill": drill(folder, options.jobs),
        }
        print(json.dumps(report["drill"], indent=1), flush=True)
        report["scaling"] = scaling(folder, options.rounds)
    write_json(options.out, report)
    print(json.dumps(report["scaling"], indent=1))


if __name__ == "__main__":
    main()
