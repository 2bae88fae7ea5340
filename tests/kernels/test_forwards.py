"""Derivatives forwards: the compiled operators have none, and must not give zeros in silence."""

from dataclasses import replace

import pytest
import torch

from mvrecon.kernels.warps.warp import warp
from mvrecon.projectors.voxel_driven import backproject
from tests.projectors.cases import DIFFERENTIABLE, METHODS, gap, noise


@pytest.mark.parametrize("method", METHODS)
def test_the_derivative_by_volume_and_views_is_the_operator(method):
    A = DIFFERENTIABLE["cone"].build(method=method, backend="auto")
    for act, given in zip((A, A.T), noise(DIFFERENTIABLE["cone"]), strict=True):
        tangent = given.roll(1, dims=-1)
        value, slope = torch.func.jvp(act, (given,), (tangent,))
        assert A.last_backend == "reference" and gap(value, act(given)) < 1e-12
        assert act(tangent).norm() > 1 and gap(slope, act(tangent)) < 1e-12


@pytest.mark.parametrize("method", METHODS)
def test_the_derivative_by_the_pose_is_that_of_differences(method):
    case = DIFFERENTIABLE["cone"]
    x, way = (
        noise(case)[0],
        torch.randn(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)),
    )

    def views(source):
        return replace(case, rays=replace(case.rays, source=source)).build(
            method=method, backend="auto"
        )(x)

    slope = torch.func.jvp(views, (case.rays.source,), (way,))[1]
    more, less = (views(case.rays.source + step * way) for step in (1e-5, -1e-5))
    assert slope.norm() > 0.1 and gap(slope, (more - less) / 2e-5) < 1e-7


def test_voxel_driven_backprojection_and_warps_refuse():
    """Their reference is torch's own interpolation, which has none in three dimensions."""
    case = DIFFERENTIABLE["cone"]
    y = noise(case)[1]
    with pytest.raises(NotImplementedError, match="grid_sampler_3d"):
        torch.func.jvp(lambda y: backproject(y, case.rays, case.grid), (y,), (y,))
    maps = torch.zeros(1, 1, 5, 2, 3, dtype=torch.float64)
    maps[..., :3, 1, :] = torch.eye(3, dtype=torch.float64)
    maps[..., 3:, 0, 0] = 1
    x = torch.rand(1, 1, 1, 3, 4, 3, dtype=torch.float64)
    with pytest.raises(NotImplementedError, match="grid_sampler_3d"):
        torch.func.jvp(lambda x: warp(x, maps, (3, 4, 3)), (x,), (x,))


def test_a_compiled_back_end_that_was_asked_for_refuses():
    with pytest.raises(
        NotImplementedError, match="'cpu' has no derivatives forwards; use 'auto' or 'reference'"
    ):
        torch.func.jvp(
            DIFFERENTIABLE["cone"].build(backend="cpu"), *[noise(DIFFERENTIABLE["cone"])[:1]] * 2
        )
