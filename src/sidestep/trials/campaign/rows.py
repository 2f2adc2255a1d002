"""The results of a campaign as rows of one table."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sidestep.store.campaign import Store
from sidestep.trials.campaign.jobs import Job, flat


def campaign_rows(jobs: Iterable[Job], store: Store) -> list[dict[str, Any]]:
    """One row for each of these jobs that has a result, in their order.

    Its labels, its figures (a table within them as one column per entry), then where, when and with what
    versions it ran, and the folder of its training, if it left one.
    """
    rows = []
    for job in jobs:
        record = store.read(job.id)
        if record is None:
            continue
        row: dict[str, Any] = {"job": job.id, **job.labels}
        # A figure never takes the place of a label.
        row |= {name: value for name, value in flat(record["figures"]).items() if name not in row}
        row |= {name: record[name] for name in ("seconds", "ended", "host", "process")}
        row |= {f"version_{name}": value for name, value in record["versions"].items()}
        folder = store.run_folder(job.id)
        row["run"] = str(folder.relative_to(store.folder)) if folder.is_dir() else None
        rows.append(row)
    return rows
