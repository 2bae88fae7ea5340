"""Contract checks of projectors and cameras."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.core.parts import CAMERAS, PROJECTORS
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid, pixel_centres
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.operator import Projector

#: Relative to |A x| |y|.
TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}


def check_projector(
    name: str, grid: Grid, cameras: Cameras, seed: int = 0, gradients: bool = True, **options
) -> None:
    """Raise AssertionError unless the named projector satisfies its contract on this grid and rig.

    Views and volumes of the right shape and dtype, and finite; A.T the transpose of A in float32
    and float64; linear, zero for zero; samples of a batch independent, and calls bitwise
    repeatable; moving the object equals the inverse motion of the cameras; with a support M the
    operator is A diag(M), its transpose diag(M) A^T; gradients in volume and pose as by differences
    (on a small grid and rig in a generic pose; skipped by `gradients=False`), that in the volume
    being the adjoint, and second ones in volume and views.
    """
    torch.manual_seed(seed)
    A = PROJECTORS.build(name, grid=grid, cameras=cameras, **options)
    for dtype, tolerance in TOLERANCE.items():
        x = torch.randn(2, 1, *grid.shape, dtype=dtype)
        views = A(x)
        expected = (2, 1, len(cameras), *cameras.shape)
        assert views.shape == expected, f"views are {tuple(views.shape)}, expected {expected}"
        assert views.dtype == dtype, f"views of {dtype} volumes are {views.dtype}"
        assert views.isfinite().all(), (
            f"{int((~views.isfinite()).sum())} views of a finite volume are not finite"
        )
        y = torch.randn_like(views)
        volume = A.T(y)
        assert volume.shape == x.shape, (
            f"the adjoint gives {tuple(volume.shape)}, expected {tuple(x.shape)}"
        )
        assert volume.dtype == dtype, f"the adjoint gives {volume.dtype} for {dtype}"
        assert volume.isfinite().all(), (
            f"the adjoint gives {int((~volume.isfinite()).sum())} values that are not finite"
        )
        gap = (_dot(views, y) - _dot(x, volume)).abs() / (views.double().norm() * y.double().norm())
        assert gap < tolerance, f"<A x, y> and <x, A.T y> differ by {gap:.2g} in {dtype}"
        other = torch.randn_like(x)
        assert close(A(2 * x - other), 2 * views - A(other), tolerance), f"not linear in {dtype}"
        assert not A(torch.zeros_like(x)).any(), "views of nothing"
        assert torch.equal(A(x), views) and torch.equal(A.T(y), volume), "not the same twice"
        assert close(A(x[1:]), views[1:], tolerance), (
            "a volume's views depend on the others of its batch"
        )
    _check_support(A)
    _check_motion(name, grid, cameras, **options)
    if gradients:
        _check_gradients(name, grid, cameras, **options)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a.double() * b.double()).sum()


def close(a: Tensor, b: Tensor, tolerance: float) -> bool:
    """Whether a differs from b by at most a fraction of b, in the L2 norm."""
    return bool((a - b).norm() <= tolerance * b.norm())


def _check_support(A: Projector) -> None:
    """A support is part of the operator and of its adjoint."""
    M = torch.rand(A.grid.shape) < 0.3
    masked, x = A.with_support(M), torch.randn(1, 1, *A.grid.shape, dtype=torch.float64)
    views = A(x * M)
    y = torch.randn_like(views)
    assert close(masked(x), views, 1e-12), "with a support M it is not A diag(M)"
    assert close(masked.T(y), A.T(y) * M, 1e-12), "with a support M its adjoint is not diag(M) A^T"


def _check_motion(name: str, grid: Grid, cameras: Cameras, **options) -> None:
    """Views of the moved object equal views of cameras with the inverse motion."""
    R, t = (
        random_rotation(torch.Generator().manual_seed(0)),
        torch.tensor([30.0, -20.0, 10.0], dtype=torch.float64),
    )
    x = torch.rand(1, 1, *grid.shape, dtype=torch.float64)
    moved = PROJECTORS.build(name, grid=grid.moved(R, t), cameras=cameras, **options)(x)
    back = PROJECTORS.build(name, grid=grid, cameras=cameras.moved(R.mT, -R.mT @ t), **options)(x)
    assert close(moved, back, 1e-9), "moving the object is not un-moving the cameras"


def _check_gradients(name: str, grid: Grid, cameras: Cameras, **options) -> None:
    x = torch.rand(1, 1, *grid.shape, dtype=torch.float64, requires_grad=True)
    vectors = [getattr(cameras, vector).clone().requires_grad_() for vector in VECTORS]

    def project(x: Tensor, *vectors: Any) -> Tensor:
        rig = replace(cameras, **dict(zip(VECTORS, vectors, strict=True)))
        return PROJECTORS.build(name, grid=grid, cameras=rig, **options)(x)

    torch.autograd.gradcheck(project, (x, *vectors), eps=1e-6, atol=1e-5)
    A = PROJECTORS.build(name, grid=grid, cameras=cameras, **options)
    y = torch.rand(1, 1, len(cameras), *cameras.shape, dtype=torch.float64, requires_grad=True)
    (change,) = torch.autograd.grad(A(x), x, y.detach())
    assert close(change, A.T(y.detach()), 1e-12), "the gradient in the volume is not the adjoint"
    torch.autograd.gradcheck(A.T, (y,))
    torch.autograd.gradgradcheck(lambda x, y: (A(x) * y).sum(), (x, y))


def check_camera(name: str, **options: Any) -> None:
    """Raise AssertionError unless the named camera, built with these options, satisfies its
    contract.

    Repeatable; right-handed when looking at the object; pixel centres project to themselves; depth
    grows along every ray; project inverts unproject to 1e-9; a rig of M cameras equals M rigs of
    one.
    """
    cameras, again = CAMERAS.build(name, **options), CAMERAS.build(name, **options)
    assert isinstance(cameras, Cameras), f"expected Cameras, got {type(cameras).__name__}"
    for vector in VECTORS:
        assert torch.equal(getattr(cameras, vector), getattr(again, vector)), (
            f"{vector} differs from call to call"
        )
    _check_handedness(cameras)
    _check_pixels(cameras)
    uvz = _somewhere(cameras)
    xyz = cameras.unproject(uvz)
    for m, camera in enumerate(cameras):
        uv = camera.project(xyz[m])[0]
        error = ((uv - uvz[m]).abs() / (1 + uvz[m].abs())).max()
        assert error < 1e-9, (
            f"camera {m}: projecting a point that was unprojected misses by {error:.2g}"
        )
        assert torch.allclose(cameras.project(xyz[m])[m], uv, rtol=1e-12, atol=1e-9), (
            f"camera {m} differs when alone"
        )


def _check_handedness(cameras: Cameras) -> None:
    ahead = (
        cameras.source - cameras.origin
        if cameras.extent == "behind"
        else cameras.origin - cameras.source
    )
    handed = (torch.linalg.cross(cameras.u, cameras.v) * ahead).sum(-1)
    assert (handed > 0).all(), f"left-handed cameras: {(handed <= 0).nonzero().flatten().tolist()}"


def _check_pixels(cameras: Cameras) -> None:
    start, end = cameras.rays()
    pixels, depths = pixel_centres(cameras.shape), []
    for m, camera in enumerate(cameras):
        for w in (-2.0, -0.5, 0.5, 1.0, 2.0):
            uvz = camera.project(start[m] + w * (end - start)[m])[0]
            error = (uvz[..., :2] - pixels).abs().max()
            assert error < 1e-9 * max(cameras.shape), (
                f"camera {m}: pixel centres at w = {w} are missed by {error:.2g} px"
            )
            depths.append(uvz[..., 2])
    rising = torch.stack(depths).unflatten(0, (len(cameras), -1)).diff(dim=1) > 0
    assert rising.all(), "depth does not grow along the rays"


def _somewhere(cameras: Cameras, count: int = 50) -> Float[Tensor, "m n 3"]:
    """Random pixel coordinates and depths on the valid side of each camera."""
    nearest, farthest = (max(min(w, 3.0), -3.0) for w in cameras.ray_extent)
    t = torch.rand(
        len(cameras), count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    uv = t[..., :2] * t.new_tensor(cameras.shape[::-1]) - 0.5
    w = nearest + (farthest - nearest) * (0.05 + 0.9 * t[..., 2:])
    return torch.cat([uv, w * cameras.distance[:, None, None]], dim=-1)
