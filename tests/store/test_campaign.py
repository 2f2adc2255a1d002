"""Hazards of a results folder: torn, doubled and foreign files, two writers, a kill at any moment."""

import errno
import json
import os
import subprocess
import threading

import pytest

from sidestep.store import campaign as store_module
from sidestep.store.damage import DamageWarning
from sidestep.store.files import OutputError
from sidestep.trials.campaign import Job, Store, campaign_rows
from sidestep.trials.campaign.jobs import record_of

JOBS = [Job({"seed": i, "shield": "none"}, {"kind": "stand-in", "seed": i}) for i in range(3)]


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "campaign")
    store.begin("mine", "name = 'mine'")
    return store


@pytest.fixture
def gone():
    """The number of a process that has ended."""
    with subprocess.Popen(["true"]) as process:
        pass
    return process.pid


def record(job, value=1.0):
    return record_of(job.task, {"value": value, "quantiles": {"0.5": value, "0.9": None}}, 0.5)


def test_first_complete_result_stays_whoever_comes_next(store):
    kept = []

    def keep(value):
        barrier.wait()
        kept.append(store.keep(record(JOBS[0], value)))

    barrier = threading.Barrier(8)
    writers = [threading.Thread(target=keep, args=(float(i),)) for i in range(8)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert sorted(kept) == [False] * 7 + [True]
    first = store.read(JOBS[0].id)
    assert not store.keep(record(JOBS[0], 99.0))
    assert store.read(JOBS[0].id) == first
    assert store.jobs() == {JOBS[0].id}
    assert not list(store.folder.glob("results/.*"))


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[: len(content) // 2],
        lambda content: b"",
        lambda content: content.replace(b"1.0", b"2.0"),
        lambda content: b"\xff" * 40,
        lambda content: b"[]",
    ],
    ids=["torn", "empty", "changed", "noise", "other JSON"],
)
def test_damaged_result_is_no_result_and_gives_way_to_a_new_one(store, damage):
    store.keep(record(JOBS[0]))
    path = store.path(JOBS[0].id)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(DamageWarning, match=rf"{path} is damaged.*run again"):
        assert store.keep(record(JOBS[0], 3.0))
    assert store.read(JOBS[0].id)["figures"]["value"] == 3.0
    assert store.damaged() == 1


def test_result_under_another_jobs_name_is_not_believed(store):
    store.keep(record(JOBS[0]))
    os.rename(store.path(JOBS[0].id), store.path(JOBS[1].id))
    with pytest.warns(DamageWarning, match=JOBS[1].id):
        assert store.read(JOBS[1].id) is None


def test_kill_while_writing_leaves_nothing_that_counts(store, monkeypatch):
    def killed(beside, path):
        raise KeyboardInterrupt

    monkeypatch.setattr(store_module, "_link", killed)
    with pytest.raises(KeyboardInterrupt):
        store.keep(record(JOBS[0]))
    assert store.read(JOBS[0].id) is None
    assert store.jobs() == set()


def test_disk_without_hard_links_keeps_the_first_result_too(store, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr(os, "link", refuse)
    assert store.keep(record(JOBS[0]))
    assert not store.keep(record(JOBS[0], 2.0))
    assert store.read(JOBS[0].id)["figures"]["value"] == 1.0


def test_full_disk_is_an_error_and_no_result(store, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "link", refuse)
    with pytest.raises(OutputError, match="could not be written: full"):
        store.keep(record(JOBS[0]))
    assert store.read(JOBS[0].id) is None


def test_folder_is_known_again_and_no_other_is_taken_for_it(store, tmp_path):
    token = store.token
    store.begin("mine", "again")
    assert store.token == token
    other = Store(tmp_path / "other")
    other.begin("mine", "")
    assert other.token != token
    assert Store(tmp_path / "nothing").token is None


def test_folder_of_another_program_is_refused_and_not_written_to(tmp_path):
    (tmp_path / "campaign.json").write_text('{"electoral": true}')
    for attempt in (lambda: Store(tmp_path).begin("x", ""), lambda: Store(tmp_path).alone().__enter__()):
        with pytest.raises(ValueError, match="choose another --out"):
            attempt()
    assert [path.name for path in tmp_path.iterdir()] == ["campaign.json"]
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(ValueError, match="is a file"):
        Store(file).begin("x", "")


def test_begin_removes_what_a_killed_command_left_and_nothing_of_the_workers(store, gone):
    left = [store.folder / f".sidestep-{gone}-x", store.folder / f".campaign.toml.{gone}.tmp"]
    theirs = store.run_folder("job") / f".summary.json.{gone}.tmp"
    for path in (left[0] / f".probe.{gone}.tmp", left[1], theirs):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    store.begin("mine", "name = 'mine'")
    assert not any(path.exists() for path in left)
    assert theirs.exists()


def test_begin_goes_on_where_a_kill_left_it(tmp_path):
    (tmp_path / "campaign.lock").touch()
    (tmp_path / ".campaign.json.123.tmp").touch()
    (tmp_path / ".sidestep-123-x").mkdir()
    Store(tmp_path).begin("x", "")
    assert Store(tmp_path).token is not None


def test_rows_come_in_the_order_of_the_grid_with_labels_of_today(store):
    for job in reversed(JOBS[:2]):
        store.keep(record(job, float(job.labels["seed"])))
    renamed = [Job({"seed": job.labels["seed"], "shield": "nothing"}, job.settings) for job in JOBS]
    rows = campaign_rows(renamed, store)
    assert [row["seed"] for row in rows] == [0, 1]
    assert {row["shield"] for row in rows} == {"nothing"}
    assert rows[1]["value"] == rows[1]["quantiles_0.5"] == 1.0
    assert rows[0]["quantiles_0.9"] is None
    assert rows[0]["version_sidestep"]
    assert rows[0]["run"] is None
    store.run_folder(JOBS[0].id).mkdir()
    assert campaign_rows(JOBS, store)[0]["run"] == f"runs/{JOBS[0].id}"


def test_numbers_that_are_not_finite_are_null_and_no_json_is_broken(store):
    store.keep(record(JOBS[0], float("inf")))
    assert store.read(JOBS[0].id)["figures"]["value"] is None
    json.loads(store.path(JOBS[0].id).read_text())
