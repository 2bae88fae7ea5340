import csv
from pathlib import Path

import pytest
import torch

from mvrecon.geometry.cameras import rigs as module
from mvrecon.geometry.cameras.rigs import dcspect80, modules
from tests.geometry.cameras.rigs import same


def table():
    lines = Path(module.__file__).with_name("dcspect80.csv").read_text().splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def column(name):
    return torch.tensor([float(row[name]) for row in table()], dtype=torch.float64)


def test_the_table_is_consistent():
    """Positions, distances and angles were transcribed apart, so their agreement proves each."""
    azimuth, elevation = column("azimuth_rad"), column("elevation_rad")
    unit = torch.stack(
        [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], dim=-1
    )
    pinhole = dcspect80().source
    torch.testing.assert_close(
        pinhole / pinhole.norm(dim=-1, keepdim=True), unit, rtol=0, atol=1e-7
    )
    torch.testing.assert_close(
        pinhole.norm(dim=-1), column("b_pinhole_to_heart_mm"), rtol=0, atol=1e-3
    )
    assert [int(row["module"]) for row in table()] == list(range(80))
    assert all(int(row["module"]) == 20 * int(row["row"]) + int(row["col"]) for row in table())


def test_collimator_lengths_obey_the_fit_and_the_mirror_symmetry():
    length, source = (
        column("collimator_length_mm"),
        [row["collimator_length_source"] for row in table()],
    )
    assert {kind: source.count(kind) for kind in set(source)} == {
        "published": 8,
        "mirrored": 8,
        "fitted": 64,
    }
    error = length - (0.3294 * column("b_pinhole_to_heart_mm") - 7.784)
    fitted = torch.tensor([kind == "fitted" for kind in source])
    assert error.abs().max() < 0.13 and error[fitted].abs().max() < 0.01
    rows = length.reshape(4, 20)
    torch.testing.assert_close(rows, rows.flip(0), rtol=0, atol=1e-9)


def test_pinholes_and_detectors_have_their_positions_from_the_table():
    cameras = dcspect80(pixels=[10, 20])
    assert len(cameras) == 80 and cameras.shape == (10, 20) and cameras.extent == "behind"
    expected = torch.stack([column("x_mm"), column("y_mm"), column("z_mm")], dim=-1)
    torch.testing.assert_close(cameras.source, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(cameras.distance, column("collimator_length_mm"), rtol=0, atol=1e-9)
    for step, pixels in ((cameras.v, 10), (cameras.u, 20)):
        torch.testing.assert_close(
            step.norm(dim=-1) * pixels, torch.full((80,), 50.0, dtype=torch.float64)
        )
    middle = cameras.origin + 9.5 * cameras.u + 4.5 * cameras.v
    along = middle / middle.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(
        along, expected / expected.norm(dim=-1, keepdim=True), rtol=0, atol=1e-12
    )


def test_pixel_rows_run_downwards_perpendicular_to_the_axis():
    cameras = dcspect80()
    assert (cameras.v[:, 2] < 0).all() and cameras.u[:, 2].abs().max() < 1e-12
    assert (cameras.u * cameras.source).sum(-1).abs().max() < 1e-9
    assert (cameras.v * cameras.source).sum(-1).abs().max() < 1e-9


def test_a_subset_contains_the_modules_of_its_rows_and_columns():
    whole, part = dcspect80(), dcspect80(rows=[2, 1], columns=[0, 19])
    assert same(part, whole[[40, 59, 20, 39]], 0)
    assert same(dcspect80(rows=[1]), whole[20:40], 0) and same(
        dcspect80(columns=[3]), whole[3::20], 0
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rows": [4]}, r"rows 0 to 3, got \[4\]"),
        ({"columns": [-1]}, r"columns 0 to 19, got \[-1\]"),
        ({"rows": []}, r"rows 0 to 3, got \[\]"),
        ({"pixels": 0}, "positive whole pixels"),
    ],
)
def test_a_subset_that_does_not_exist_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        dcspect80(**options)


def test_the_table_is_a_part_of_the_package():
    assert len(modules()) == 80 and modules()[0] == (277.002, 70.37124, -70.0363, 89.07020616)


def test_a_field_of_two_doubles_the_detector_width_about_the_same_axes():
    plain, wide = dcspect80(pixels=8), dcspect80(pixels=8, field=2)
    torch.testing.assert_close(wide.u, 2 * plain.u)
    torch.testing.assert_close(wide.v, 2 * plain.v)
    middle = [c.origin + 3.5 * (c.u + c.v) for c in (plain, wide)]
    torch.testing.assert_close(*middle)
    with pytest.raises(ValueError, match="positive factor"):
        dcspect80(field=0)
