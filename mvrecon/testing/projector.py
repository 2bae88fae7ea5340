"""Contract check of projectors."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import VECTORS, Cameras
from mvrecon.geometry.grid import Grid
from mvrecon.geometry.rigid import random_rotation
from mvrecon.operators.operator import LinearOperator, Projector
from mvrecon.testing.measures import (
    adjoint_gap,
    batch_gap,
    derivative_gap,
    gradient_gap,
    linearity_gap,
    motion_gap,
    noise,
    support_gap,
)

#: Relative to |A x| |y|.
ADJOINT_TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}


def check_projector(
    name: str, grid: Grid, cameras: Cameras, seed: int = 0, gradients: bool = True, **options
) -> None:
    """Raise AssertionError unless the named projector satisfies its contract on this grid and rig.

    Views and volumes of the right shape and dtype, and finite; A.T the transpose of A in float32
    and float64; linear, zero for zero; samples of a batch independent, and calls bitwise
    repeatable; one motion of object and cameras together changes no view; with a support M the
    operator is A diag(M), its transpose diag(M) A^T; gradients in volume and pose as by differences
    (on a small grid and rig in a generic pose; skipped by `gradients=False`), that in the volume
    being the adjoint, and second ones in volume and views.

    `mvrecon.testing.measures` has each of these laws as a function that returns the deviation.
    """

    def build(grid: Grid, cameras: Cameras) -> Projector:
        return PROJECTORS.build(name, grid=grid, cameras=cameras, **options)

    A = build(grid, cameras)
    assert isinstance(A, LinearOperator), f"expected a LinearOperator, got {type(A).__name__}"
    for dtype, tolerance in ADJOINT_TOLERANCE.items():
        _check_values(A, *noise(A, dtype, batch=2, seed=seed), tolerance)
    _check_support(A, seed)
    rng = torch.Generator().manual_seed(seed)
    R, t = random_rotation(rng), torch.tensor([30.0, -20.0, 10.0], dtype=torch.float64)
    x = torch.rand(1, 1, *grid.shape, generator=rng, dtype=torch.float64)
    assert motion_gap(build, grid, cameras, x, R, t) < 1e-9, (
        "a motion of object and cameras together changes the views"
    )
    if gradients:
        vectors = [getattr(cameras, vector).clone().requires_grad_() for vector in VECTORS]

        def project(x: Tensor, *vectors: Any) -> Tensor:
            rig = replace(cameras, **dict(zip(VECTORS, vectors, strict=True)))
            return build(grid, rig)(x)

        _, y = noise(A, seed=seed)
        apart = gradient_gap(project, x.requires_grad_(), *vectors)
        assert apart < 1e-6, f"gradients in volume and pose differ from differences by {apart:.2g}"
        apart = derivative_gap(A, x, y)
        assert apart < 1e-12, f"gradients in volume and views differ from A.T and A by {apart:.2g}"


def _check_values(A: Projector, x: Tensor, y: Tensor, tolerance: float) -> None:
    dtype, views, volume = x.dtype, A(x), A.T(y)
    for what, given, found, like in (
        ("views", "volumes", views, y),
        ("volumes by the adjoint", "views", volume, x),
    ):
        got, expected = tuple(found.shape), tuple(like.shape)
        assert got == expected, f"{what} are {got}, expected {expected}"
        assert found.dtype == dtype, f"{what} of {dtype} {given} are {found.dtype}"
        bad = int((~found.isfinite()).sum())
        assert not bad, f"{bad} {what} of finite {given} are not finite"
    apart = adjoint_gap(A, x, y)
    assert apart < tolerance, f"<A x, y> and <x, A.T y> differ by {apart:.2g} in {dtype}"
    assert linearity_gap(A, x[:1], x[1:]) <= tolerance, f"not linear in {dtype}"
    assert not A(torch.zeros_like(x)).any(), "views of nothing"
    assert torch.equal(A(x), views) and torch.equal(A.T(y), volume), "not the same twice"
    assert batch_gap(A, x) <= tolerance, "a volume's views depend on the others of its batch"


def _check_support(A: Projector, seed: int) -> None:
    rng, (x, y) = torch.Generator().manual_seed(seed), noise(A, seed=seed)
    M = torch.rand(A.grid.shape, generator=rng) < 0.3
    assert support_gap(A, M, x, y) <= 1e-12, (
        "with a support M it is not A diag(M), or its adjoint not diag(M) A^T"
    )
