"""Training curves as TensorBoard events, in the run's `curves/` folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sidestep.learning.training import Report


class Curves:
    """Scalars over episodes: return, steps, clearances, interventions, losses."""

    def __init__(self, folder: str | Path, purge_step: int):
        # Imported here because it is needed by trainings only and takes a while.
        from tensorboardX import SummaryWriter

        place = Path(folder) / "curves"
        # Files are named by the second; the count keeps a resume within it from overwriting what is there.
        count = len(list(place.glob("events.out.tfevents.*")))
        self._writer = SummaryWriter(str(place), purge_step=purge_step, filename_suffix=f".{count:06d}")

    def write(self, lines: list[dict[str, Any]], report: Report) -> None:
        """Add the episodes of a chunk, and the mean losses of the chunk at its last episode."""
        for line in lines:
            for name, value in line.items():
                if name not in ("episode", "outcome") and value is not None:
                    self._writer.add_scalar(f"episode/{name}", value, line["episode"])
            self._writer.add_scalar("episode/reached", float(line["outcome"] == "reached"), line["episode"])
        if lines:
            for name in ("critic", "actor", "value"):
                self._writer.add_scalar(
                    f"loss/{name}", float(np.mean(getattr(report.losses, name))), lines[-1]["episode"]
                )

    def close(self) -> None:
        self._writer.close()
