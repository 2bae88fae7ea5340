"""Tables of figures as CSV files."""

import csv
from contextlib import nullcontext

import pytest

from mvrecon.core.files.runs import check_inputs, read_rows, write_rows


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


@pytest.mark.parametrize(
    ("value", "written"),
    [
        ("rig.json", True),
        ("./other/../rig.json", True),
        ("link.json", True),
        (["a.nii", "rig.json"], True),
        ([{"views": {"path": "rig.json"}}], True),
        ("a.nii * rig.json", True),
        ("rig.json:views", True),
        ("other/rig.json", False),
        (["a.nii", 3, None], False),
        ("", False),
        ("https://x/rig.json", False),
    ],
)
def test_an_input_that_a_run_would_write_is_refused(value, written, tmp_path, monkeypatch):
    """Lists, products and data sets of a file were overwritten. Also tried: absolute paths, links
    to folders, patterns, the run's folder itself, `~`, numbers, texts of 5000 letters.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.json").symlink_to("rig.json")
    with pytest.raises(ValueError, match="camera.path") if written else nullcontext():
        check_inputs({"camera": {"path": value}}, [tmp_path / "rig.json", tmp_path / "out.h5"])
