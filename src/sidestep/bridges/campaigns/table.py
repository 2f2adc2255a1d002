"""The results of a campaign as one Parquet file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sidestep._packages import needed


def write_table(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write rows as a Parquet file, whole or not at all, with one column per name.

    Missing values are null, a column without values has type float, lists and dicts become JSON text.

    **Raises** `ValueError` when pyarrow (extra `cluster`) is missing.
    """
    from sidestep.store.files import whole_file

    arrow: Any = needed("pyarrow", "cluster", "campaign tables need")
    parquet: Any = needed("pyarrow.parquet", "cluster", "campaign tables need")
    path = Path(path)
    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: _column(arrow, [_plain(row.get(name)) for row in rows]) for name in names}
    with whole_file(path) as beside:
        parquet.write_table(arrow.table(columns), beside)
    return path


def _plain(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, (list, tuple, Mapping)) else value


def _column(arrow: Any, values: list[Any]) -> Any:
    if all(value is None for value in values):
        return arrow.array(values, arrow.float64())
    if {type(value) for value in values} - {type(None)} == {int, float}:
        values = [None if value is None else float(value) for value in values]
    return arrow.array(values)
