"""The results of a campaign as rows of one table."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sidestep.store.campaign import Store
from sidestep.trials.campaign.jobs import Job, flat


def campaign_rows(jobs: Iterable[Job], store: Store) -> list[dict[str, Any]]:
    """One row per job with a result, in the order of the jobs.

    Columns: labels, figures (nested tables flattened), host, time, versions, and the run folder of a
    training.
    """
    rows = []
    for job in jobs:
        record = store.read(job.id)
        if record is None:
            continue
        row: dict[str, Any] = {"job": job.id, **job.labels}
        # A label takes precedence over a figure of the same name.
        row |= {name: value for name, value in flat(record["figures"]).items() if name not in row}
        row |= {name: record[name] for name in ("seconds", "ended", "host", "process")}
        row |= {f"version_{name}": value for name, value in record["versions"].items()}
        folder = store.run_folder(job.id)
        row["run"] = str(folder.relative_to(store.folder)) if folder.is_dir() else None
        rows.append(row)
    return rows
