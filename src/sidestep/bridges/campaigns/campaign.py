"""Run a campaign on Dask workers, one job per worker at a time. Jobs that have a result are not run again."""

from __future__ import annotations

import queue
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sidestep import _interrupts
from sidestep._packages import needed
from sidestep.bridges.campaigns.cluster import LOCAL, check_main_guard, check_options, connected, name_of
from sidestep.bridges.campaigns.worker import run_on_worker
from sidestep.store.files import OutputError

if TYPE_CHECKING:
    from sidestep.trials.campaign import Campaign, Job, Task

_LOOK_SECONDS = 1.0
"""Seconds between two checks for new and lost workers while no job ends."""
_RESULT_SECONDS = 60.0
"""Seconds a worker may take to send a finished result."""
_MOST_DEATHS = 3
"""A job fails when this many workers have died while running it."""
Show = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Failure:
    """A job without a result, and why."""

    job: Job
    reason: str


@dataclass
class CampaignOutcome:
    """The outcome of a campaign's jobs.

    **Attributes:**

    - `jobs` of the campaign; `earlier`: those that already had a result; `ran`: those that got one now
    - `failed` jobs, with the reason
    - `damaged` result files, set aside since the folder was created
    - `lost_workers`: workers that disappeared
    - `stopped`: why the call ended early; None if it did not
    - `seconds` from the first worker to the last result
    - `rows` of all results, see `campaign_rows`
    """

    jobs: int
    earlier: int
    ran: int = 0
    failed: list[Failure] = field(default_factory=list)
    damaged: int = 0
    lost_workers: int = 0
    workers: int = 0
    stopped: str | None = None
    seconds: float = 0.0
    rows: list[dict[str, Any]] = field(default_factory=list)

    @property
    def done(self) -> int:
        """Jobs with a result."""
        return self.earlier + self.ran

    @property
    def complete(self) -> bool:
        """Whether every job has a result."""
        return self.done == self.jobs


def _quiet(done: int, jobs: int, note: str) -> None:
    pass


@_interrupts.held()
def run_campaign(
    campaign: Campaign,
    folder: str | Path,
    *,
    scheduler: Any = LOCAL,
    workers: int | None = None,
    threads_per_worker: int | None = None,
    progress: Show = _quiet,
    run: Callable[[Task, Path | None], Any] | None = None,
) -> CampaignOutcome:
    """Run the jobs of a campaign that have no result in `folder` yet, and write `results.parquet` there.

    A job whose worker dies is run again on another worker, after the others of its group. It fails when three
    workers have died while running it; other jobs go on. A job that raises is run again by the next call
    only. `KeyboardInterrupt` and a lost scheduler end the call with `stopped` set; the next call continues.

    **Arguments:**

    - `scheduler`: `local`, the address of a running scheduler, or a Dask cluster object
    - `workers` and `threads_per_worker`: for `local` only
    - `progress(done, jobs, note)`: called as jobs end
    - `run`: replaces `run_task`

    **Raises** `ValueError` for bad options, when the script has no `if __name__ == "__main__"`, when another
    call works on the folder, when the folder holds something else, when no scheduler answers, and when the
    extra `cluster` is missing. `OutputError` when the folder's disk is full; its results stay, and the next
    call continues.
    """
    from sidestep.bridges.campaigns.table import write_table
    from sidestep.trials.campaign import Store, campaign_rows

    for package in ("distributed", "pyarrow"):
        needed(package, "cluster", "campaigns need")
    check_options(scheduler, workers, threads_per_worker)
    if scheduler == LOCAL:
        check_main_guard()
    store = Store(folder)
    with store.alone():
        store.begin(campaign.name, campaign.text)
        todo = [job for job in campaign.jobs if store.read(job.id) is None]
        outcome = CampaignOutcome(len(campaign.jobs), len(campaign.jobs) - len(todo))
        begun = time.monotonic()
        problem: OutputError | None = None
        try:
            if todo:
                with connected(scheduler, workers, threads_per_worker) as client:
                    begun = time.monotonic()
                    _Dispatch(client, store, outcome, progress, run).all(todo)
        except KeyboardInterrupt:
            outcome.stopped = "interrupted"
        except SchedulerLostError:
            outcome.stopped = f"the scheduler at {name_of(scheduler)} is gone"
        except OutputError as error:
            problem = error
        finally:
            outcome.seconds = time.monotonic() - begun
            outcome.damaged = store.damaged()
            outcome.rows = campaign_rows(campaign.jobs, store)
            # Includes results that workers wrote after the command had lost them.
            outcome.ran = len(outcome.rows) - outcome.earlier
            try:
                write_table(store.folder / "results.parquet", outcome.rows)
            except OutputError as error:
                problem = problem or error
        if problem is not None:
            kept = f"Kept: the results of {outcome.done} of {outcome.jobs} jobs in {store.folder}"
            raise problem.and_kept(kept) from problem.__cause__
    return outcome


class _Waiting:
    """Waiting jobs, in groups that differ only in the seed and so share their compiled programs.

    A worker takes jobs of one group until the group is empty, then of the group with the fewest workers.
    Workers thus compile different programs in parallel.
    """

    def __init__(self, jobs: Iterable[Job]):
        self.groups: dict[str, deque[Job]] = {}
        self.at: dict[str, str] = {}
        for job in jobs:
            self.put(job)

    def put(self, job: Job) -> None:
        """Append the job to its group."""
        group = repr({name: label for name, label in job.labels.items() if name != "seed"})
        self.groups.setdefault(group, deque()).append(job)

    def __bool__(self) -> bool:
        return bool(self.groups)

    def next_for(self, address: str) -> Job:
        """The next job for this worker; there must be one."""
        group = self.at.get(address)
        if group not in self.groups:
            others = [at for worker, at in self.at.items() if worker != address]
            group = min(self.groups, key=lambda name: (others.count(name), -len(self.groups[name])))
            self.at[address] = group
        job = self.groups[group].popleft()
        if not self.groups[group]:
            del self.groups[group]
        return job


class SchedulerLostError(Exception):
    """The connection to the scheduler broke."""


class _Dispatch:
    """Submits jobs to workers and collects the results; one job per worker, so a death affects one job.

    Each job is bound to its worker. Dask never reassigns a task that only prefers a worker if that worker
    dies while no other is alive.
    """

    def __init__(self, client: Any, store: Any, outcome: CampaignOutcome, progress: Show, run: Any):
        from sidestep import __version__

        self.client, self.store, self.outcome, self.progress = client, store, outcome, progress
        # Keys are unique per call: another call's job of the same name has another key.
        self.call = uuid.uuid4().hex
        self.about = (str(store.folder.absolute()), store.token, __version__, run)
        self.ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.at_work: dict[Any, tuple[Job, str]] = {}
        self.waiting = _Waiting([])
        self.deaths: Counter[str] = Counter()
        self.done: set[str] = set()
        self.known: set[str] = set()
        self.submitted = 0

    def all(self, jobs: Iterable[Job]) -> None:
        """Run all jobs to their end. **Raises** `SchedulerLostError`."""
        self.waiting = _Waiting(jobs)
        while self.waiting or self.at_work:
            _interrupts.check()
            alive = self.workers()
            for future, (job, address) in list(self.at_work.items()):
                if address not in alive:
                    self.died(future, job)
            for address in sorted(alive - {address for _, address in self.at_work.values()}):
                if self.waiting:
                    self.submit(self.waiting.next_for(address), address)
            self.show(alive)
            try:
                self.take(self.ended.get(timeout=_LOOK_SECONDS))
            except queue.Empty:
                continue
        self.show(self.known)

    def workers(self) -> set[str]:
        """Addresses of the live workers."""
        if self.client.status != "running":
            raise SchedulerLostError
        try:
            alive = set(self.client.nthreads())
        except (OSError, RuntimeError, TimeoutError) as error:
            raise SchedulerLostError from error
        self.outcome.lost_workers += len(self.known - alive)
        self.outcome.workers = max(self.outcome.workers, len(alive))
        self.known = alive
        return alive

    def submit(self, job: Job, address: str) -> None:
        self.submitted += 1
        future = self.client.submit(
            run_on_worker, job.task, *self.about,
            key=("sidestep-job", job.id, self.call, self.submitted), pure=False, workers=[address],
        )  # fmt: skip
        self.at_work[future] = (job, address)
        future.add_done_callback(self.ended.put)

    def died(self, future: Any, job: Job) -> None:
        """Queue the job of a dead worker again, or fail it after too many deaths."""
        del self.at_work[future]
        future.cancel()
        self.deaths[job.id] += 1
        if self.deaths[job.id] < _MOST_DEATHS:
            self.waiting.put(job)
        else:
            self.outcome.failed.append(Failure(job, f"{_MOST_DEATHS} workers died while they ran it"))

    def take(self, future: Any) -> None:
        """Record the outcome of a job that ended."""
        from distributed import KilledWorker

        if future not in self.at_work:
            # The worker was considered dead but finished the job; its result is in the folder.
            return
        job, _ = self.at_work[future]
        if future.status in ("cancelled", "lost"):
            raise SchedulerLostError
        if future.status == "finished":
            # Most workers wrote the result themselves. Waiting for a worker that died with an unsaved result
            # would never end, because no other worker may run its task.
            if self.store.read(job.id) is None:
                try:
                    self.store.keep(future.result(timeout=_RESULT_SECONDS))
                except TimeoutError:
                    self.died(future, job)
                    return
            del self.at_work[future]
            self.done.add(job.id)
            self.outcome.ran = len(self.done)
            return
        error = future.exception()
        if isinstance(error, KilledWorker):
            self.died(future, job)
            return
        if isinstance(error, OutputError) and error.full:
            # All write into the same folder.
            raise error
        del self.at_work[future]
        self.outcome.failed.append(Failure(job, f"{type(error).__name__}: {error}"))

    def show(self, alive: set[str]) -> None:
        outcome = self.outcome
        notes = [f"{len(alive)} workers" if len(alive) != 1 else "1 worker"]
        if outcome.lost_workers:
            notes.append(f"{outcome.lost_workers} lost")
        if outcome.failed:
            notes.append(f"{len(outcome.failed)} failed")
        self.progress(outcome.done, outcome.jobs, ", ".join(notes))
