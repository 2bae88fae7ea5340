"""Poses and widths are recovered from views of point sources."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mvrecon.core.files.runs import read_rows
from mvrecon.geometry.cameras import files
from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon_spect.apps import psf
from mvrecon_spect.methods.point_sources import fit_point_sources
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.projector import Spect
from mvrecon_spect.operators.response import FWHM

POINTS = torch.tensor(
    [[0.0, 0, 0], [40, 10, 5], [-35, 20, -20], [10, -45, 25], [-5, 30, 30], [25, 25, -35]]
)


def measured(cameras, hole, intrinsic):
    """Views of points, each 3 x 3 x 3 voxels of 0.02 mm, of 1e9 decays."""
    views = []
    for point in POINTS:
        grid = Grid.centred(3, spacing=0.02, centre=point.tolist())
        A = Spect(grid, cameras, hole, blur=True, intrinsic_mm=intrinsic)
        views.append(A(torch.full((1, 1, 3, 3, 3), 1e9 / (27 * 0.02**3)).double())[0, 0])
    return torch.stack(views)


def test_poses_and_widths_are_found_together():
    torch.manual_seed(0)
    rig = dcspect80(pixels=32)[[0, 24]]
    shift, plane = 0.6 * torch.randn(2, 3).double(), 0.5 * torch.randn(2, 1).double()
    pitch = rig.u.norm(dim=1, keepdim=True)
    true = replace(rig, source=rig.source + shift, origin=rig.origin + plane * rig.u / pitch)
    views = measured(true, 2.6, 1.8)
    fit = fit_point_sources(views, POINTS, rig, Hole(2.0), 1.0)
    assert fit.blurring_mm == pytest.approx(2.6, rel=0.001)
    assert fit.intrinsic_mm == pytest.approx(1.8, rel=0.001)
    images = [cameras.project(POINTS.double())[..., :2] for cameras in (fit.cameras, true)]
    assert (images[0] - images[1]).abs().max() < 0.02  # pixels
    assert (fit.activity / fit.activity.mean() - 1).abs().max() < 0.01


def test_the_command_writes_a_response_that_the_projector_reads(tmp_path, capsys):
    """Widths of the law, sqrt(FWHM^2 d^2 (1 + l / h)^2 / 16 + intrinsic^2), efficiencies of one,
    and a rig; views by the table have the variances of the true ones, at depths between.
    """
    rig = dcspect80(pixels=64)[[0, 24, 50]]
    views, out = measured(rig, 2.6, 1.8), tmp_path / "psf.csv"
    for k, counts in enumerate(views):
        np.save(tmp_path / f"p{k}.npy", counts.numpy())
    names = ("x_mm", "y_mm", "z_mm", "views", "photons")
    texts = [[*map(str, p), f"p{k}.npy", "1e9"] for k, p in enumerate(POINTS.tolist())]
    table = "\n".join(",".join(row) for row in [names, *texts])
    (tmp_path / "sources.csv").write_text(table)
    files.save(rig, tmp_path / "rig.json")
    words = f"{tmp_path}/sources.csv --camera {tmp_path}/rig.json --diameter 2.6 --iterations 0"
    psf.main([*words.split(), "--out", str(out)])
    assert "images are whole" in capsys.readouterr().out
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    (tmp_path / "link.csv").symlink_to(tmp_path / "sources.csv")
    files.save(rig, tmp_path / "again.cameras.json")
    again = words.replace("rig.json", "again.cameras.json")
    for command, place in ((words, "sources.csv"), (words, "link.csv"), (again, "again.csv")):
        with pytest.raises(SystemExit):
            psf.main([*command.split(), "--out", str(tmp_path / place)])
        assert "is an input; expected another --out" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        psf.main([*words.split(), "--out", str(tmp_path / "p0.npy")])
    assert all(path.read_bytes() == content for path, content in before.items())
    with pytest.warns(UserWarning, match="not converged after 2 iterations"):
        psf.main([*words.split()[:-1], "2", "--out", str(tmp_path / "fitted.csv")])
    assert (
        "pinholes moved by" in capsys.readouterr().out
        and (tmp_path / "fitted.cameras.json").exists()
    )
    rows = [{k: float(v) for k, v in row.items()} for row in read_rows(out)]
    assert len(rows) > 9
    for row in rows:
        image = 2.6 * (1 + row["distance_mm"] / row["depth_mm"]) * FWHM / 4
        for name in ("fwhm_radial_mm", "fwhm_tangential_mm"):
            assert row[name] == pytest.approx(math.hypot(image, 1.8), rel=0.02)
        assert row["efficiency"] == pytest.approx(1, rel=0.01)
    assert torch.equal(files.from_file(tmp_path / "psf.cameras.json").source, rig.source)
    grid = Grid.centred(1, spacing=0.1, centre=(12.0, -8.0, 3.0))
    x = torch.ones(1, 1, 1, 1, 1).double()
    true = Spect(grid, rig, 2.6, blur=True, intrinsic_mm=1.8)(x)[0, 0]
    made = Spect(grid, rig, 2.6, blur=True, response=str(out))(x)[0, 0]
    across = torch.arange(64).double()
    for one, other in zip(true, made, strict=True):
        assert other.sum() == pytest.approx(one.sum().item(), rel=0.01)
        spreads = []
        for view in (one, other):
            line = view.sum(dim=0) / view.sum()
            spreads.append((line * (across - (line * across).sum()).square()).sum().item())
        assert spreads[1] == pytest.approx(spreads[0], rel=0.02)


def test_impossible_views_are_refused():
    rig = dcspect80(pixels=8)[[0]]
    with pytest.raises(ValueError, match="views of sizes"):
        fit_point_sources(torch.ones(2, 1, 8, 8), POINTS, rig, Hole(2.0))
    with pytest.raises(ValueError, match="each source has some"):
        fit_point_sources(torch.zeros(6, 1, 8, 8), POINTS, rig, Hole(2.0))
