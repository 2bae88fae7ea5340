"""Tables of figures as CSV files."""

import csv

import pytest

from mvrecon.core.files.runs import read_rows, write_rows


def test_rows_round_trip_and_a_failed_write_keeps_the_earlier_file(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [{"method": "sirt", "psnr": 31.5}, {"method": "a, b", "psnr": ""}])
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows == [{"method": "sirt", "psnr": "31.5"}, {"method": "a, b", "psnr": ""}]
    assert read_rows(path) == rows and read_rows(tmp_path / "none.csv") == []
    before = path.read_bytes()
    with pytest.raises(ValueError, match="other"):
        write_rows(path, [{"method": "sirt"}, {"other": 1}])
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["rows.csv"]
