"""The truths that errors are measured against are themselves facts."""

from dataclasses import replace

import pytest
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.data.scenes.solids import Phantom, Solids, voxelise
from mvrecon.geometry.cameras.camera import VECTORS
from mvrecon.geometry.rigid import euler_rotation
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.testing import gap
from mvrecon_bench.benchmarks import truth
from mvrecon_bench.benchmarks.cases import RIGS, Workload, boxes, expand


def test_the_pixel_average_of_a_box_that_half_covers_a_pixel():
    half = torch.tensor(
        [[20.0, 6.0, 30.0]]
    )  # along x the ray; its face y = 6 cuts the pixel from 4 to 8 in half
    phantom = Phantom(
        (Solids("box", torch.zeros(1, 3), torch.eye(3)[None], half, torch.tensor([0.5])),)
    )
    rig = RIGS["axis_parallel"](Workload(n=64, camera="axis_parallel"))[0]
    thin, mean = phantom.views(rig), phantom.views(rig, 4)
    row = mean[0, 32]  # inside the box along z
    assert sorted(set(row.tolist())) == pytest.approx(
        [0.0, 10.0, 20.0]
    )  # 40 mm of 0.5: none, half, all of a pixel
    assert (row - 10).abs().lt(1e-9).sum() == 2 and thin[0, 32].unique().tolist() == pytest.approx(
        [0, 20]
    )


@pytest.mark.parametrize("camera", ["circular", "parallel", "dcspect80"])
def test_binning_reverts_the_splitting_of_pixels(camera):
    rig = Workload(n=16, camera=camera, views=2).cameras()
    back = rig.refined(3).binned(3)
    assert back.shape == rig.shape
    for name in VECTORS:
        assert torch.allclose(getattr(back, name), getattr(rig, name), rtol=0, atol=1e-9)


@pytest.mark.parametrize("camera", RIGS)
def test_the_pixel_size_follows_from_the_ratio(camera):
    case = Workload(n=32, camera=camera, views=3, ratio=0.5)
    rig = case.cameras()
    reach = (rig.origin - rig.source).norm(dim=-1) if rig.parallel else rig.distance
    zoom = torch.ones(len(rig)) if rig.parallel else rig.source.norm(dim=-1) / reach
    assert len(rig) == case.views
    assert (rig.u.norm(dim=-1) * zoom).mean().item() == pytest.approx(case.pixel, rel=0.02)


def test_axis_aligned_rays_have_a_single_component():
    for camera, centre in (("axis_parallel", 5), ("axis_aligned", 8)):
        rig = Workload(n=16, camera=camera).cameras()
        start, end = rig.rays()
        middle = (end - start)[:, centre, centre]
        assert ((middle == 0).sum(dim=1) == 2).all()


def test_siddon_is_exact_for_voxel_aligned_boxes():
    case = Workload(n=32, scene="box", camera="circular", views=2)
    grid, rig = case.grid(), case.cameras()
    volume = voxelise(boxes(case.field), grid).double()
    assert len(volume.unique().tolist()) <= 6
    views = PROJECTORS.build("drr", grid=grid, cameras=rig, method="siddon", backend="reference")(
        volume[None, None]
    )
    assert gap(views[0, 0], case.phantom().views(rig)) < 1e-6


@pytest.fixture(params=["circular", "parallel"])
def posed(request):
    """A rig, a projector that differentiates by its four vectors, weights, and an ellipsoid with
    its voxels.
    """
    case = Workload(n=24, camera=request.param, views=2)
    grid = case.grid()
    rig = case.cameras().moved(
        euler_rotation((3.0, 5.0, 8.0)), torch.tensor([1.3, -2.1, 0.7])
    )  # no ray on a kink
    places = (
        torch.tensor([[9.0, -17.0, 25.0]]),
        torch.eye(3)[None],
        torch.tensor([[80.0, 40.0, 60.0]]),
    )
    phantom = Phantom((Solids("ellipsoid", *places, torch.ones(1)),))
    coarse = torch.randn(
        1, len(rig), 5, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    weights = torch.nn.functional.interpolate(coarse, rig.shape, mode="bicubic")[0]

    def views(cameras):
        A = RayTransform(grid, cameras, backend="reference")
        return A(voxelise(phantom, grid).double()[None, None])[0, 0]

    leaves = [getattr(rig, name).clone().requires_grad_() for name in VECTORS]
    moving = replace(rig, **dict(zip(VECTORS, leaves, strict=True)))
    gradient = truth.rigid(torch.autograd.grad((views(moving) * weights).sum(), leaves), rig, grid)
    return grid, rig, phantom, weights, views, gradient


def test_vector_gradients_convert_to_rotations_and_translations(posed):
    grid, rig, _, weights, views, gradient = posed
    step = 1e-5
    for k in range(6):
        ahead, behind = (views(truth.moved(rig, k, way, grid)) for way in (step, -step))
        differences = (weights * (ahead - behind)).sum(dim=(1, 2)) / (2 * step)
        assert torch.allclose(
            gradient[:, k], differences, rtol=1e-4, atol=1e-4 * gradient.abs().max().item()
        )


def test_pose_derivatives_of_closed_form_and_fine_voxels_agree(posed):
    grid, rig, phantom, weights, _, gradient = posed
    exact = truth.pose_gradient(phantom, rig, weights, grid)
    assert exact.shape == (2, 6)
    for part in (slice(0, 3), slice(3, 6)):  # turns, shifts
        assert truth.cosine(gradient[:, part], exact[:, part]) > 0.95
    assert gradient.norm().item() == pytest.approx(exact.norm().item(), rel=0.1)


def test_a_plan_varies_one_parameter_at_a_time_small_first():
    cases = expand(
        {"n": 64, "views": 4},
        {
            "sizes": {"vary": {"n": [16, 32]}},
            "rest": {"about": {"n": 16}, "vary": {"ratio": [2.0], "n": [64]}},
        },
    )
    assert [(case.n, case.ratio, settings["block"]) for case, settings in cases] == [
        (16, 1.0, "sizes"),
        (32, 1.0, "sizes"),
        (64, 1.0, "sizes"),
        (16, 2.0, "rest"),
    ]
    with pytest.raises(ValueError, match="camera must be one of circular.*got 'spiral'"):
        Workload(camera="spiral")
