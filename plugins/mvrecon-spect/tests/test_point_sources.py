"""Poses and widths are recovered from views of point sources."""

from dataclasses import replace

import pytest
import torch

from mvrecon.geometry.cameras.rigs import dcspect80
from mvrecon.geometry.grid import Grid
from mvrecon_spect.methods.point_sources import fit_point_sources
from mvrecon_spect.operators.hole import Hole
from mvrecon_spect.operators.projector import Spect

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
    assert fit.blurring_mm == pytest.approx(2.6, rel=0.02)
    assert fit.intrinsic_mm == pytest.approx(1.8, rel=0.05)
    images = [cameras.project(POINTS.double())[..., :2] for cameras in (fit.cameras, true)]
    assert (images[0] - images[1]).abs().max() < 0.02  # pixels
    assert (fit.activity / fit.activity.mean() - 1).abs().max() < 0.01


def test_impossible_views_are_refused():
    rig = dcspect80(pixels=8)[[0]]
    with pytest.raises(ValueError, match="views of sizes"):
        fit_point_sources(torch.ones(2, 1, 8, 8), POINTS, rig, Hole(2.0))
    with pytest.raises(ValueError, match="each source has some"):
        fit_point_sources(torch.zeros(6, 1, 8, 8), POINTS, rig, Hole(2.0))
