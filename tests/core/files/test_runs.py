"""Tables of figures as CSV files."""

import csv

import pytest

from mvrecon.core.files.runs import read_rows, renewed, write_rows


def test_rows_come_back_and_a_failed_write_leaves_the_earlier_file(tmp_path):
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


def test_renewed_rows_replace_those_of_the_same_keys_and_others_stay(tmp_path):
    path = tmp_path / "table.csv"
    write_rows(path, [{"arm": "a", "seed": 0, "psnr": 1.0}, {"arm": "b", "seed": 0, "psnr": 2.0}])
    rows = [{"arm": "b", "seed": 0, "psnr": 3.0}, {"arm": "b", "seed": 1, "psnr": 4.0}]
    write_rows(path, renewed(path, rows, ["arm", "seed"]))
    assert [tuple(row.values()) for row in read_rows(path)] == [
        ("a", "0", "1.0"),
        ("b", "0", "3.0"),
        ("b", "1", "4.0"),
    ]
    assert renewed(tmp_path / "none.csv", rows, ["arm", "seed"]) == rows
