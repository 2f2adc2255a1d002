"""Hazards of campaigns: workers and schedulers that die, jobs run twice or never, results lost or doubled."""

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import distributed
import pyarrow.parquet
import pytest

from sidestep.bridges.campaigns import campaign as campaign_module
from sidestep.bridges.campaigns import cluster as cluster_module
from sidestep.bridges.campaigns import run_campaign, worker
from sidestep.bridges.campaigns.campaign import _Waiting
from sidestep.bridges.campaigns.cluster import local_size
from sidestep.cli import main
from sidestep.store.damage import DamageWarning
from sidestep.store.lock import FolderInUseError
from sidestep.trials.campaign import Job, Store

HERE = Path(__file__).parent
# Dask's own threads close their sockets in an order of their own.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture
def stand_ins(monkeypatch):
    """The module `campaign_jobs`, as workers import it."""
    monkeypatch.syspath_prepend(str(HERE))
    return importlib.import_module("campaign_jobs")


def cluster_of_threads(workers):
    """A cluster whose workers are threads of this process: cheap, but none can be killed."""
    return distributed.LocalCluster(
        n_workers=workers, threads_per_worker=2, processes=False, protocol="tcp://",
        scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def threads():
    with cluster_of_threads(2) as local:
        yield local


def records_in(folder):
    return {path.stem: json.loads(path.read_text())["record"] for path in (folder / "results").glob("*.json")}


def test_killed_worker_costs_no_result_and_no_job_a_second_result(stand_ins, tmp_path):
    log, out = tmp_path / "log", tmp_path / "out"
    campaign = stand_ins.make_campaign(log, 10, dies_once=[3])
    outcome = run_campaign(campaign, out, workers=1, run=stand_ins.stand_in)
    assert outcome.complete
    assert outcome.failed == []
    assert set(records_in(out)) == {job.id for job in campaign.jobs}
    begun = stand_ins.runs(log)
    # Only the job under which the worker died was begun again.
    assert sorted(begun) == sorted([*range(10), 3])
    table = pyarrow.parquet.read_table(out / "results.parquet").to_pylist()
    assert [row["seed"] for row in table] == list(range(10))
    assert [row["seed_squared"] for row in table] == [i * i for i in range(10)]
    assert len({row["process"] for row in table} - {os.getpid()}) >= 2


def test_result_that_a_worker_wrote_but_never_handed_over_counts(stand_ins, tmp_path):
    """Dask says that the job is finished, and then waits for a dead worker's answer without end."""
    log, out, outcomes = tmp_path / "log", tmp_path / "out", []
    campaign = stand_ins.make_campaign(log, 3, dies_handing_over=[1])

    def call():
        outcomes.append(run_campaign(campaign, out, workers=1, run=stand_ins.stand_in))

    caller = threading.Thread(target=call, daemon=True)
    caller.start()
    caller.join(60.0)
    assert outcomes, "it still waits"
    assert outcomes[0].complete
    assert sorted(stand_ins.runs(log)) == [0, 1, 2]


def test_result_that_nobody_hands_over_is_made_again(stand_ins, tmp_path):
    campaign, store = stand_ins.make_campaign(tmp_path / "log", 1), Store(tmp_path / "out")
    store.begin("stand-ins", "")
    (job,) = campaign.jobs
    outcome = campaign_module.CampaignOutcome(1, 0)
    dispatch = campaign_module._Dispatch(None, store, outcome, campaign_module._quiet, None)

    class Silent:
        status = "finished"

        def result(self, timeout):
            raise TimeoutError

        def cancel(self):
            pass

    for left in (2, 1, 0):
        assert not dispatch.waiting
        future = Silent()
        dispatch.at_work[future] = (job, "tcp://gone")
        dispatch.take(future)
        assert not dispatch.at_work
        if left:
            assert dispatch.waiting.next_for("tcp://other") == job
    assert [failure.job for failure in outcome.failed] == [job]


def test_job_that_kills_every_worker_fails_alone(stand_ins, tmp_path, monkeypatch):
    monkeypatch.setattr(campaign_module, "_MOST_DEATHS", 2)
    log, out = tmp_path / "log", tmp_path / "out"
    campaign = stand_ins.make_campaign(log, 8, dies=[2], raises=[5])
    outcome = run_campaign(campaign, out, workers=1, run=stand_ins.stand_in)
    reasons = {failure.job.labels["seed"]: failure.reason for failure in outcome.failed}
    assert set(reasons) == {2, 5}
    assert reasons[2] == "2 workers died while they ran it"
    assert reasons[5] == "ArithmeticError: two and two"
    assert outcome.done == 6
    assert outcome.lost_workers >= 1
    assert stand_ins.runs(log).count(2) == 2
    assert stand_ins.runs(log)[-1] == 2
    assert stand_ins.runs(log).count(5) == 1


def test_after_the_command_and_its_scheduler_are_killed_it_goes_on_and_runs_nothing_twice(
    stand_ins, threads, tmp_path
):
    log, out = tmp_path / "log", tmp_path / "out"
    arguments = [sys.executable, str(HERE / "campaign_jobs.py"), str(out), str(log), "16"]
    with subprocess.Popen(arguments, stderr=subprocess.DEVNULL) as child:
        while child.poll() is None and len(list((out / "results").glob("*.json"))) < 4:
            time.sleep(0.01)
        child.send_signal(signal.SIGKILL)
    assert child.returncode == -signal.SIGKILL
    done = set(records_in(out))
    assert 4 <= len(done) < 16
    first = {name: (out / "results" / f"{name}.json").stat().st_mtime_ns for name in done}
    campaign = stand_ins.make_campaign(log, 16, lasts=range(16))
    outcome = run_campaign(campaign, out, scheduler=threads, run=stand_ins.stand_in)
    assert outcome.complete
    assert set(records_in(out)) == {job.id for job in campaign.jobs}
    begun = stand_ins.runs(log)
    for job in campaign.jobs:
        if job.id in done:
            assert begun.count(job.labels["seed"]) == 1
    # What was at work at that moment, one job for one worker, is all that was begun again.
    assert 16 <= len(begun) <= 17
    assert {name: (out / "results" / f"{name}.json").stat().st_mtime_ns for name in done} == first


def test_lost_scheduler_is_said_and_the_same_call_goes_on(stand_ins, threads, tmp_path):
    log, out = tmp_path / "log", tmp_path / "out"
    campaign = stand_ins.make_campaign(log, 12, lasts=range(12))
    local = cluster_of_threads(1)
    closing = threading.Thread(target=local.close)

    def close_after_three(done, jobs, note):
        if done == 3 and closing.ident is None:
            closing.start()

    with contextlib.closing(local):
        outcome = run_campaign(
            campaign,
            out,
            scheduler=local.scheduler_address,
            run=stand_ins.stand_in,
            progress=close_after_three,
        )
        closing.join()
    assert "is gone" in outcome.stopped
    assert not outcome.complete
    assert outcome.done >= 3
    again = run_campaign(campaign, out, scheduler=threads, run=stand_ins.stand_in)
    assert again.complete
    assert again.earlier >= outcome.done
    assert len(stand_ins.runs(log)) <= 12 + 1


def test_longer_campaign_runs_only_what_is_new(stand_ins, threads, tmp_path):
    log, out = tmp_path / "log", tmp_path / "out"
    run_campaign(stand_ins.make_campaign(log, 3), out, scheduler=threads, run=stand_ins.stand_in)
    # A torn file is found, its job run again; nothing else is.
    torn = sorted((out / "results").glob("*.json"))[0]
    torn.write_bytes(torn.read_bytes()[:-20])
    with pytest.warns(DamageWarning, match=torn.name):
        outcome = run_campaign(
            stand_ins.make_campaign(log, 5), out, scheduler=threads.scheduler_address, run=stand_ins.stand_in
        )
    assert (outcome.earlier, outcome.ran, outcome.damaged) == (2, 3, 1)
    assert len(stand_ins.runs(log)) == 6
    again = run_campaign(
        stand_ins.make_campaign(log, 5), out, scheduler="tcp://127.0.0.1:1", run=stand_ins.stand_in
    )
    # Nothing to do: no scheduler is asked.
    assert again.complete
    assert len(stand_ins.runs(log)) == 6


def test_worker_that_does_not_see_the_folder_answers_all_the_same(stand_ins, tmp_path):
    log = tmp_path / "log"
    (job,) = stand_ins.make_campaign(log, 1).jobs
    other = tmp_path / "elsewhere"
    record = worker.run_once(job.task, str(other), "a token", stand_ins.stand_in)
    assert record["figures"]["seed_squared"] == 0
    assert not other.exists()
    # A folder of that name that is another campaign's is not written to either.
    store = Store(other)
    store.begin("another", "")
    worker.run_once(job.task, str(other), "a token", stand_ins.stand_in)
    assert store.jobs() == set()


def test_worker_taken_for_dead_is_waited_for_and_its_result_is_the_one(stand_ins, tmp_path):
    log = tmp_path / "log"
    (job,) = stand_ins.make_campaign(log, 1).jobs
    store = Store(tmp_path / "out")
    store.begin("one", "")
    arguments = (job.task, str(store.folder), store.token)
    begun, finish = threading.Event(), threading.Event()
    records = {}

    def slow(task, folder):
        begun.set()
        finish.wait()
        return {"by": "slow"}

    first = threading.Thread(target=lambda: records.update(a=worker.run_once(*arguments, slow)))
    second = threading.Thread(
        target=lambda: records.update(b=worker.run_once(*arguments, stand_ins.stand_in))
    )
    first.start()
    assert begun.wait(10)
    second.start()
    second.join(0.1)
    assert second.is_alive()
    finish.set()
    first.join()
    second.join()
    assert records["a"] == records["b"] == store.read(job.id)
    assert records["b"]["figures"] == {"by": "slow"}
    assert stand_ins.runs(log) == []


def test_two_commands_do_not_work_on_one_folder(stand_ins, threads, tmp_path):
    out = tmp_path / "out"
    campaign = stand_ins.make_campaign(tmp_path / "log", 1)
    held, finish = threading.Event(), threading.Event()

    def other():
        with Store(out).alone():
            held.set()
            finish.wait(60)

    thread = threading.Thread(target=other)
    thread.start()
    assert held.wait(60)
    with pytest.raises(FolderInUseError, match=rf"{out} is in use by process {os.getpid()}"):
        run_campaign(campaign, out, scheduler=threads, run=stand_ins.stand_in)
    assert not (out / "campaign.json").exists()
    finish.set()
    thread.join()
    assert run_campaign(campaign, out, scheduler=threads, run=stand_ins.stand_in).complete


def test_folder_of_something_else_is_left_alone(stand_ins, tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ValueError, match="holds other files"):
        run_campaign(stand_ins.make_campaign(tmp_path / "log", 1), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_workers_of_another_version_are_refused(stand_ins, tmp_path):
    (job,) = stand_ins.make_campaign(tmp_path / "log", 1).jobs
    with pytest.raises(RuntimeError, match="the worker has sidestep"):
        worker.run_on_worker(job.task, str(tmp_path), "t", "0.0.0", stand_ins.stand_in)


def test_bad_addresses_and_sizes_are_named(stand_ins, tmp_path):
    campaign = stand_ins.make_campaign(tmp_path / "log", 1)
    for options, named in (
        ({"scheduler": "nowhere"}, "local or an address"),
        ({"scheduler": "tcp://127.0.0.1:1", "workers": 2}, "--scheduler local"),
        ({"scheduler": "tcp://127.0.0.1:1"}, "no scheduler answers at tcp://127.0.0.1:1"),
        ({"scheduler": "tcp://nowhere"}, "no scheduler answers at tcp://nowhere"),
        ({"scheduler": "tls://127.0.0.1:1"}, "needs certificates"),
        ({"workers": 0}, "workers = 0"),
        ({"threads_per_worker": -1}, "threads_per_worker = -1"),
    ):
        with pytest.raises(ValueError, match=named):
            run_campaign(campaign, tmp_path / "out", **options)


def test_workers_do_not_all_compile_the_same_program(stand_ins):
    jobs = [
        Job({"shield": shield, "seed": seed}, {"shield": shield, "seed": seed})
        for shield in ("none", "paper", "game")
        for seed in range(3)
    ]
    waiting, given = _Waiting(jobs), {"first": [], "second": []}
    for turn in range(9):
        worker_name = "first" if turn % 2 == 0 else "second"
        given[worker_name].append(waiting.next_for(worker_name))
    assert not waiting
    assert sorted(job.id for jobs in given.values() for job in jobs) == sorted(job.id for job in jobs)
    shields = {name: [job.labels["shield"] for job in jobs] for name, jobs in given.items()}
    assert shields == {
        "first": ["none", "none", "none", "game", "game"],
        "second": ["paper", "paper", "paper", "game"],
    }


def test_workers_share_the_cores(monkeypatch):
    monkeypatch.setattr(cluster_module, "cores", lambda: 8)
    assert local_size(None, None) == (8, 1)
    assert local_size(2, None) == (2, 4)
    assert local_size(None, 4) == (2, 4)
    assert local_size(16, None) == (16, 1)
    assert local_size(3, 1) == (3, 1)


def test_cores_are_taken_before_jax_is_there_and_never_after():
    code = (
        "import os, sys\n"
        "from sidestep.bridges.campaigns.worker import take_cores\n"
        "assert 'jax' not in sys.modules\n"
        "take_cores(3); first = os.environ['PJRT_NPROC']\n"
        "sys.modules['jax'] = os\n"
        "take_cores(1); print(first, os.environ['PJRT_NPROC'])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["3", "3"], done.stderr


FILE = """
[grid]
seed = [0, 1]
scenario = ["slow", "short"]
shield = "none"
pursuer = "still"

[scenarios.short]
episode_steps = 40
obstacle_count = 0

[scenarios.slow]
episode_steps = 40
obstacle_count = 0
evader_speed = 0.05

[settings]
episodes = 4

[compare]
by = ["scenario"]
figures = ["mean_return"]
"""


def test_campaign_from_the_command_line(tmp_path, capsys):
    file, out = tmp_path / "four.toml", tmp_path / "out"
    file.write_text(FILE)
    arguments = ["campaign", str(file), "--out", str(out)]
    assert main([*arguments, "--dry-run"]) == 0
    assert main([*arguments, "--dry-run", "--workers", "0"]) == 2
    assert "4 jobs, 0 of them done" in capsys.readouterr().out
    assert not out.exists()
    report = tmp_path / "deep" / "report.json"
    assert main([*arguments, "--workers", "1", "--json", str(report)]) == 0
    assert "4 of 4 jobs have a result" in capsys.readouterr().out
    figures = json.loads(report.read_text())
    assert (figures["jobs"], figures["ran"], figures["failed"]) == (4, 4, [])
    (comparison,) = figures["comparisons"]
    # The faster gets nearer to its target.
    (pair,) = comparison["pairs"]
    assert (pair["first"], pair["second"]) == ({"scenario": "short"}, {"scenario": "slow"})
    assert pair["probability"]["estimate"] > 0.5
    table = pyarrow.parquet.read_table(out / "results.parquet").to_pylist()
    assert [(row["scenario"], row["seed"], row["episodes"]) for row in table] == [
        (scenario, seed, 4) for scenario in ("slow", "short") for seed in (0, 1)
    ]
    assert main([*arguments, "--workers", "1"]) == 0
    assert "0 ran now, 4 before" in capsys.readouterr().out
