"""Derivatives by `torch.func`, to any depth: those of the compiled operators are those of the
reference.
"""

import weakref
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vjp, vmap

from mvrecon.geometry.lattice import lifted_maps
from mvrecon.kernels.warps import warp
from mvrecon.operators.voxel_driven import backproject
from mvrecon.testing import gap
from tests.kernels.warps.scenes import OTHER, SMALL, generic
from tests.operators.cases import DIFFERENTIABLE, METHODS, Case, noise

Loss = Callable[[Tensor], Tensor]
CASE = DIFFERENTIABLE["cone"]
X, Y = (values[:1] for values in noise(CASE))


def way(at: Tensor) -> Tensor:
    return at.roll(1, dims=-1) + 0.3


def slope(loss: Loss, at: Tensor) -> tuple[Tensor, Tensor]:
    return loss(at), (grad(loss)(at) * way(at)).sum()


def second(loss: Loss, at: Tensor) -> Tensor:
    return jacrev(jacrev(loss))(at)


#: What is asked of the compiled operators, and the same made of derivatives backwards, which the
#: reference has.
TRANSFORMS = {
    "grad": (lambda loss, at: grad(loss)(at),) * 2,
    "vjp": (lambda loss, at: vjp(loss, at)[1](torch.ones((), dtype=at.dtype)),) * 2,
    "backwards twice": (second, second),
    "hessian": (lambda loss, at: hessian(loss)(at), second),
    "forwards twice": (lambda loss, at: jacfwd(jacfwd(loss))(at), second),
    "jvp": (lambda loss, at: jvp(loss, (at,), (way(at),)), slope),
}
#: Cameras that are mapped over cannot be checked, so these are not for poses.
MAPS = {
    "map of gradients": (lambda loss, at: vmap(grad(loss))(torch.stack([at, 1.01 * at])),) * 2,
    "gradient of a map": (
        lambda loss, at: grad(lambda several: vmap(loss)(several).sum())(
            torch.stack([at, 1.01 * at])
        ),
    )
    * 2,
}
EVERY = TRANSFORMS | MAPS
#: Torch has no derivatives forwards of interpolation, which the reference's own derivatives are
#: made of.
TWICE = "forwards twice"


def assert_same(
    transform: str, act: Callable[[str], Callable[[Tensor], Tensor]], at: Tensor
) -> None:
    """The derivatives of an act of a back end at a place; its cube's depend on the place."""
    results = []
    for backend, take in zip(("auto", "reference"), EVERY[transform], strict=True):
        one = act(backend)
        tensors = take(lambda values, one=one: one(values).pow(3).sum(), at)
        results.append(
            torch.cat([tensor.flatten() for tensor in torch.utils._pytree.tree_leaves(tensors)])
        )
    assert results[1].norm() > 0.01 and gap(*results) < 1e-12


@pytest.mark.pairwise(transform=EVERY, method=METHODS)
def test_in_volumes_and_views(transform, method):
    assert_same(transform, lambda b: CASE.build(backend=b, method=method), X)
    assert_same(transform, lambda b: CASE.build(backend=b, method=method).T, Y)


@pytest.mark.parametrize("transform", EVERY)
def test_in_volumes_and_views_with_a_support_and_four_rays_a_pixel(transform):
    support = torch.zeros(CASE.grid.shape, dtype=torch.bool)
    support[1:, :3, 1:] = True
    options = {"support": support, "rays_per_pixel": 2, "skip": "box"}
    assert_same(transform, lambda b: CASE.build(backend=b, **options), X)
    assert_same(transform, lambda b: CASE.build(backend=b, **options).T, Y)


@pytest.mark.pairwise(1, transform=TRANSFORMS, method=METHODS)
def test_in_the_pose(transform, method):
    def moved(source: Tensor) -> Case:
        return replace(CASE, rays=replace(CASE.rays, source=source))

    source = CASE.rays.source
    assert_same(
        transform, lambda b: lambda source: moved(source).build(backend=b, method=method)(X), source
    )
    assert_same(
        transform,
        lambda b: lambda source: moved(source).build(backend=b, method=method).T(Y),
        source,
    )


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_in_the_pose_with_a_support(transform):
    support = torch.zeros(CASE.grid.shape, dtype=torch.bool)
    support[1:, :3, 1:] = True

    def built(backend: str, source: Tensor):
        return replace(CASE, rays=replace(CASE.rays, source=source)).build(
            backend=backend, support=support
        )

    assert_same(transform, lambda b: lambda source: built(b, source)(X), CASE.rays.source)
    assert_same(transform, lambda b: lambda source: built(b, source).T(Y), CASE.rays.source)


@pytest.mark.parametrize("transform", EVERY)
def test_of_warps_in_values_and_maps(transform):
    x = torch.randn(
        1, 2, 1, *SMALL, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    H = generic(1)
    assert_same(transform, lambda b: lambda x: warp(x, lifted_maps(H), OTHER, b), x)
    if transform != TWICE:
        assert_same(transform, lambda b: lambda maps: warp(x, maps, OTHER, b), lifted_maps(H))


@pytest.mark.pairwise(2, transform=EVERY, weight=["none", "distance"])
def test_of_voxel_driven_backprojection_in_views(transform, weight):
    assert_same(transform, lambda b: lambda y: backproject(y, CASE.rays, CASE.grid, weight, b), Y)


@pytest.mark.parametrize("transform", [name for name in TRANSFORMS if name != TWICE])
def test_of_voxel_driven_backprojection_in_the_pose(transform):
    def seen(source: Tensor, backend: str) -> Tensor:
        return backproject(Y, replace(CASE.rays, source=source), CASE.grid, "distance", backend)

    assert_same(transform, lambda b: lambda source: seen(source, b), CASE.rays.source)


def test_skipped_voxels_are_reported_for_calls_with_derivatives():
    A = CASE.build(backend="auto", skip="box")
    x = torch.zeros_like(X)
    x[..., 1, 1, 1] = 1
    grad(lambda x: A(x).square().sum())(x)
    assert A.skipped.mode == "box" and A.skipped.box.size == 1 and A.last_backend == "cpu"


def test_forward_values_are_stored_only_for_forward_mode_derivatives():
    """A volume is not held for the derivative by the volume: the operator is linear."""
    A, x = CASE.build(), torch.rand(1, 1, *CASE.grid.shape).requires_grad_()
    inner = x * 2
    views, alive = A(inner), weakref.ref(inner)
    del inner
    assert alive() is None and views.requires_grad
