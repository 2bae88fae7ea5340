"""SIRT's weights from half of a symmetric rig are those of all of it."""

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import ExplicitRays
from mvrecon.geometry.cameras.rigs import circular, dcspect80, dome, parallel
from mvrecon.geometry.grid import Grid
from mvrecon.methods.classical import sirt as iterative
from mvrecon.methods.classical.sirt import sirt_weights
from mvrecon.operators.drr import Drr
from mvrecon.operators.ray_transform import RayTransform

GRID = Grid.centred(size=(8, 5, 6), spacing=(11.0, 9.0, 7.0))
DETECTOR = {"pixels": [5, 9], "pixel_mm": [14.0, 9.0]}
RIGS = {  # and how many of their views need projecting
    "dcspect80": (dcspect80(pixels=[5, 4]), 40),
    "full circle": (circular(8, 400.0, 800.0, DETECTOR), 5),
    "full circle, no camera on an axis": (
        circular(8, 400.0, 800.0, DETECTOR, start_degrees=22.5),
        4,
    ),
    "half a circle": (
        circular(8, 400.0, 800.0, DETECTOR, 180.0),
        None,
    ),  # all in the plane z = 0: nothing to save
    "dome": (dome(6, 200.0, 70.0, 180.0, {"pixels": 6, "pixel_mm": 5.0}), None),
    "parallel, full circle": (parallel(4, DETECTOR, depth_mm=300.0, arc_degrees=360.0), 3),
}


@pytest.fixture
def halves(monkeypatch):
    """The views of every part of a rig that is projected on its own."""
    made = []

    class Spy(iterative.selection.ViewSelection):
        def __init__(self, shape, views):
            made.append(views)
            super().__init__(shape, views)

    monkeypatch.setattr(iterative.selection, "ViewSelection", Spy)
    return made


def direct(A):
    rows = A(torch.ones(1, 1, *A.grid.shape, dtype=torch.float64))
    return rows, A.T(torch.ones_like(rows))


def assert_invert(A, weights):
    for weight, sums in zip(weights, direct(A), strict=True):
        assert torch.equal(weight > 0, sums > 1e-6 * sums.max())
        inverse = torch.where(weight > 0, 1 / weight, 0)
        torch.testing.assert_close(
            inverse, sums.where(weight > 0, 0), rtol=1e-9, atol=1e-12 * sums.max().item()
        )


@pytest.mark.pairwise(name=RIGS, rays=[1, 2])
def test_half_of_a_symmetric_rig_determines_all_weights(name, rays, halves):
    rig, views = RIGS[name]
    A = RayTransform(GRID, rig, backend="reference", rays_per_pixel=rays)
    assert_invert(A, sirt_weights(A, torch.float64))
    assert [len(chosen) for chosen in halves] == ([views] if views else [])


@pytest.mark.parametrize("symmetric", [True, False])
def test_a_symmetric_support_is_exploited_too(symmetric, halves):
    mask = torch.ones(GRID.shape, dtype=torch.bool)
    mask[0] = False
    if symmetric:
        mask[-1] = False
    A = PROJECTORS.build(
        "drr", grid=GRID, cameras=RIGS["dcspect80"][0], backend="reference", support=mask
    )
    weights = sirt_weights(A, torch.float64)
    assert_invert(A, weights)
    assert not weights[1][..., ~mask].any() and len(halves) == symmetric


def test_faces_between_voxels_break_the_symmetry_of_exact_lengths(halves):
    grid = Grid.centred((4, 4, 4), 10.0)
    rig = circular(
        4, 400.0, 800.0, {"pixels": [4, 5], "pixel_mm": 12.0}
    )  # the middle columns run in the face x = 0
    A = PROJECTORS.build("drr", grid=grid, cameras=rig, backend="reference", method="siddon")
    assert_invert(A, sirt_weights(A, torch.float64))
    columns = direct(A)[1]
    assert not torch.allclose(columns, columns.flip(-1)) or not torch.allclose(
        columns, columns.flip(-2)
    )
    assert not halves


def test_weights_of_a_custom_projector_use_the_projector_itself(halves):
    class Attenuated(Drr):
        def forward(self, volume):
            return super().forward(
                volume * torch.linspace(1, 2, GRID.shape[0], dtype=volume.dtype)[:, None, None]
            )

    A = Attenuated(GRID, RIGS["dcspect80"][0], backend="reference")
    assert_invert(A, sirt_weights(A, torch.float64))
    assert not halves


def test_explicit_rays_have_no_mirror_plane(halves):
    cameras = RIGS["dcspect80"][0][:3]
    A = PROJECTORS.build(
        "drr", grid=GRID, cameras=ExplicitRays(*cameras.rays()), backend="reference"
    )
    assert_invert(A, sirt_weights(A, torch.float64))
    assert not halves
