"""The commands that measure volumes."""

import csv
import math
from pathlib import Path

import pytest
import torch

from mvrecon.data.volume_files import save_volume
from mvrecon.geometry.grid import Grid, voxel_centres
from mvrecon_spect.apps import mtf, polarmap
from mvrecon_spect.metrics.edge import plane_mtf
from mvrecon_spect.metrics.polar_map import LongAxis, polar_map

SIGMA = {"x": 2.0, "y": 3.0, "z": 2.5}


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def blurred_balls(grid: Grid) -> torch.Tensor:
    """Two balls of 40 mm whose edges are blurred by another Gaussian along each axis, in a
    background, beside a rod, which is no ball.
    """
    points, volume = voxel_centres(grid), torch.ones(grid.shape).double()
    for centre in ((-30.0, 0.0, 4.0), (32.0, 5.0, -3.0)):
        offset = points - torch.tensor(centre).double()
        r = offset.norm(dim=-1)
        share = (offset / r[..., None].clamp_min(1e-9)).square()
        width = (share @ torch.tensor([s**2 for s in SIGMA.values()]).double()).sqrt()
        volume += 4 * torch.special.ndtr((20 - r) / width.clamp_min(1))
    volume[2:6, 2:6, 4:70] = 5.0
    return volume


def test_balls_are_found_and_measured_along_each_axis(tmp_path, monkeypatch, capsys):
    """The MTF of a Gaussian of the standard deviation s falls to a half at 0.187 / s."""
    monkeypatch.chdir(tmp_path)
    grid = Grid.centred(size=(90, 48, 48), spacing=1.5)
    save_volume("balls.nii.gz", blurred_balls(grid).float(), grid)
    mtf.main(["balls.nii.gz"])
    rows = read(tmp_path / "balls.mtf.csv")
    assert [row["axis"] for row in rows] == ["x", "y", "z"] * 2
    for row in rows:
        half = math.sqrt(math.log(2) / 2) / math.pi / SIGMA[row["axis"]]
        assert float(row["mtf50_per_mm"]) == pytest.approx(half, rel=0.06)
        assert float(row["diameter_mm"]) == pytest.approx(40, rel=0.02)
    places = sorted(tuple(float(row[f"{axis}_mm"]) for axis in "xyz") for row in rows[::3])
    expected = [(-30.0, 0.0, 4.0), (32.0, 5.0, -3.0)]
    torch.testing.assert_close(torch.tensor(places), torch.tensor(expected), atol=0.2, rtol=0)
    curves = read(tmp_path / "balls.mtf_curves.csv")
    assert len(curves) == 6 * 64 and float(curves[0]["mtf"]) == 1
    assert (tmp_path / "balls.mtf.png").stat().st_size > 10000
    assert "along z: 0.5 at" in capsys.readouterr().out


def test_a_tilted_plane_is_measured_along_its_normal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    grid = Grid.centred(40, spacing=1.0)
    normal = torch.tensor([1.0, 0.1, 0.06]).double()
    beyond = voxel_centres(grid) @ normal / normal.norm()
    save_volume("edge.nii.gz", (2 - torch.special.ndtr(beyond / 1.7)).float(), grid)
    mtf.main(["edge.nii.gz", "--plane", "0", "0", "0", "1", "0.1", "0.06", "--out", "e"])
    (row,) = read(tmp_path / "e.mtf.csv")
    half = math.sqrt(math.log(2) / 2) / math.pi / 1.7
    assert float(row["mtf50_per_mm"]) == pytest.approx(half, rel=0.03)
    for wrong, message in (
        ("--plane 0 0 0 1 0 0", "tilt the plane"),
        ("", "expected hot balls"),
        ("--ball 0 0 0 5", "8 voxels"),
    ):
        with pytest.raises(SystemExit):
            mtf.main(["edge.nii.gz", *wrong.split()])
        assert message in capsys.readouterr().err


def test_the_17_segments_are_named_and_in_percent(tmp_path, monkeypatch, capsys):
    """A wall of 2 + cos(angle from the anterior wall), the apex along +z, the septum along -x."""
    monkeypatch.chdir(tmp_path)
    grid = Grid.centred(size=(40, 36, 32), spacing=2.0)
    x, y, z = voxel_centres(grid).unbind(dim=-1)
    radius = (x.square() + y.square() + (z - 12).clamp_min(0).square()).sqrt()
    wall = torch.where((radius > 12) & (radius < 22), 2 + torch.cos(torch.atan2(-x, y)), 0.0)
    save_volume("heart.nii.gz", wall.float(), grid)
    ends = {"base": (0, 0, -24), "apex": (0, 0, 30), "septum": (-1, 0, 0)}
    texts = [t for name, at in ends.items() for t in (f"--{name}", *map(str, at))]
    polarmap.main(["heart.nii.gz", *texts, "--reach", "30"])
    rows = {
        row["name"]: float(row["percent_of_maximum"]) for row in read(Path("heart.segments.csv"))
    }
    assert len(rows) == 17
    assert rows["mid anterior"] == pytest.approx(97, abs=3)
    assert rows["mid inferior"] == pytest.approx(35, abs=3)
    assert rows["apical septal"] == pytest.approx(rows["apical lateral"], abs=0.01)
    assert Path("heart.polarmap.png").stat().st_size > 10000
    assert "17 apex" in capsys.readouterr().out


def test_noise_has_no_edge_and_a_heart_is_in_the_grid():
    """Noise gave a frequency; a volume without activity, and an axis in voxels or elsewhere, low
    segments.
    """
    grid = Grid.centred(48, spacing=2.0)
    noise = torch.randn(grid.shape, generator=torch.Generator().manual_seed(0))
    for volume in (noise, 5 + noise, torch.zeros(grid.shape), noise * math.nan):
        with pytest.raises(ValueError, match="between two uniform parts"):
            plane_mtf(volume, grid, (0, 0, 0), (0.1, 0.06, 1), 20)
    for base in ((4000.0, 0, 0), (49.0, 0, 0), (math.nan, 0, 0)):
        with pytest.raises(ValueError, match="base and apex in the grid"):
            polar_map(noise, grid, LongAxis(base, (0, 0, 30), (1, 0, 0)), 20)
    with pytest.raises(ValueError, match="finite mm"):
        plane_mtf(noise, grid, (math.nan, 0, 0), (0.1, 0.06, 1), 20)
