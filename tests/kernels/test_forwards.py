"""Derivatives forwards: of the compiled operators in their values, of the reference in the
geometry.
"""

from dataclasses import replace

import pytest
import torch
from torch.autograd import forward_ad

from mvrecon.geometry.lattice import NO_SECOND_DERIVATIVE, lifted_maps
from mvrecon.kernels.warps import warp
from mvrecon.operators.voxel_driven import backproject
from mvrecon.testing import gap
from tests.kernels.warps.scenes import OTHER, SMALL, generic
from tests.operators.cases import DIFFERENTIABLE, METHODS, noise


@pytest.mark.pairwise(method=METHODS, backend=["auto", "cpu", "reference"])
def test_the_derivative_by_volume_and_views_is_the_operator(method, backend):
    A = DIFFERENTIABLE["cone"].build(method=method, backend=backend)
    for act, given in zip((A, A.T), noise(DIFFERENTIABLE["cone"]), strict=True):
        tangent = given.roll(1, dims=-1)
        value, slope = torch.func.jvp(act, (given,), (tangent,))
        assert A.last_backend == ("reference" if backend == "reference" else "cpu")
        assert gap(value, act(given)) < 1e-12
        assert act(tangent).norm() > 1 and gap(slope, act(tangent)) < 1e-12
        with forward_ad.dual_level():
            dual = forward_ad.unpack_dual(act(forward_ad.make_dual(given, tangent)))
            assert gap(dual.primal, value) < 1e-12 and gap(dual.tangent, slope) < 1e-12


@pytest.mark.pairwise(1, method=METHODS, backend=["auto", "cpu", "reference"])
def test_the_pose_derivative_equals_finite_differences(method, backend):
    case = DIFFERENTIABLE["cone"]
    x, way = (
        noise(case)[0],
        torch.randn(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)),
    )

    def views(source):
        return replace(case, rays=replace(case.rays, source=source)).build(
            method=method, backend=backend
        )(x)

    slope = torch.func.jvp(views, (case.rays.source,), (way,))[1]
    more, less = (views(case.rays.source + step * way) for step in (1e-5, -1e-5))
    assert slope.norm() > 0.1 and gap(slope, (more - less) / 2e-5) < 1e-7
    with forward_ad.dual_level():
        dual = forward_ad.unpack_dual(views(forward_ad.make_dual(case.rays.source, way)))
        assert gap(dual.tangent, slope) < 1e-12


def test_the_derivative_of_voxel_driven_backprojection_and_warps_is_the_operator():
    case = DIFFERENTIABLE["cone"]
    y = noise(case)[1]
    ahead = torch.func.jvp(lambda y: backproject(y, case.rays, case.grid), (y,), (y.roll(1, -1),))[
        1
    ]
    assert ahead.norm() > 1 and gap(ahead, backproject(y.roll(1, -1), case.rays, case.grid)) < 1e-12
    maps, x = lifted_maps(generic()), torch.randn(1, 2, 1, *SMALL, dtype=torch.float64)
    ahead = torch.func.jvp(lambda x: warp(x, maps, OTHER), (x,), (x.roll(1, -1),))[1]
    assert ahead.norm() > 1 and gap(ahead, warp(x.roll(1, -1), maps, OTHER)) < 1e-12


@pytest.mark.skipif(
    NO_SECOND_DERIVATIVE, reason="before torch 2.13 the reference interpolates by gather"
)
def test_interpolation_by_torch_raises_an_error():
    """The reference of warps and of voxel-driven back-projection, which has none in three
    dimensions.
    """
    case = DIFFERENTIABLE["cone"]
    y = noise(case)[1]
    with pytest.raises(NotImplementedError, match="grid_sampler_3d"):
        torch.func.jvp(
            lambda y: backproject(y, case.rays, case.grid, "none", "reference"), (y,), (y,)
        )
    maps, x = lifted_maps(generic()), torch.randn(1, 2, 1, *SMALL, dtype=torch.float64)
    with pytest.raises(NotImplementedError, match="grid_sampler_3d"):
        torch.func.jvp(lambda x: warp(x, maps, OTHER, "reference"), (x,), (x,))
