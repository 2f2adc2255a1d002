"""Hazards of the results table: a column lost because the first row lacks it, numbers that become text."""

import pyarrow.parquet
import pytest

from sidestep.bridges.campaigns import write_table
from sidestep.store.files import OutputError

ROWS = [
    {"job": "a", "count": 1, "mixed": 1, "never": None, "starts": [[0.0, 1.0]]},
    {"job": "b", "count": None, "mixed": 2.5, "never": None, "late": True},
]


def test_every_column_of_every_row_is_there_with_its_type(tmp_path):
    table = pyarrow.parquet.read_table(write_table(tmp_path / "deep" / "t.parquet", ROWS))
    types = {field.name: str(field.type) for field in table.schema}
    assert types == {
        "job": "string", "count": "int64", "mixed": "double", "never": "double", "starts": "string",
        "late": "bool",
    }  # fmt: skip
    assert table.to_pylist()[1] == {
        "job": "b", "count": None, "mixed": 2.5, "never": None, "starts": None, "late": True,
    }  # fmt: skip


def test_failed_write_leaves_the_table_before(tmp_path, monkeypatch):
    path = write_table(tmp_path / "t.parquet", ROWS)
    before = path.read_bytes()

    def fail(table, where):
        where.write_bytes(b"half")
        raise OSError("full")

    monkeypatch.setattr(pyarrow.parquet, "write_table", fail)
    with pytest.raises(OutputError, match=r"t\.parquet could not be written: full"):
        write_table(path, ROWS[:1])
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_no_results_are_a_table_too(tmp_path):
    assert pyarrow.parquet.read_table(write_table(tmp_path / "t.parquet", [])).num_rows == 0


def test_missing_package_is_named_with_the_command_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(ValueError, match=r"pip install .*\[cluster\]"):
        write_table(tmp_path / "t.parquet", ROWS)
