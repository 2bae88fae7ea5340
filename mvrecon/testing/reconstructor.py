"""Checks that every reconstructor must pass."""

from typing import Any

import torch
from torch import Tensor

from mvrecon.parts import METHODS
from mvrecon.projectors.operator import Projector
from mvrecon.testing.method import check_refusals
from mvrecon.testing.projector import close

#: Relative, of float32 sums of some thousand products a voxel.
TOLERANCE = 1e-4


def check_reconstructor(name: str, A: Projector, seed: int = 0, **options: Any) -> None:
    """Raise AssertionError unless the named reconstructor keeps its promises with this operator.

    A finite volume of the grid's shape and of the views' dtype (float32 and float64), the same bits
    when it is called twice; it explains views better than no volume does, and views of zero by a
    volume of (nearly) zero; a sample's volume depends neither on the other samples of its batch nor
    on their order; views of another shape, or with a value that is not finite, are refused by a
    ValueError that speaks of views.

    Args:
        name: of the reconstructor.
        A: the operator; at least two cameras.
        seed: of the volumes that are seen.
        options: of the reconstructor.
    """
    rng = torch.Generator().manual_seed(seed)
    x = torch.rand(2, 1, *A.grid.shape, generator=rng, dtype=torch.float64)

    def solve(views: Tensor) -> Tensor:
        return METHODS.build(name, A, views, **options)

    for dtype in (torch.float64, torch.float32):
        views = A(x.to(dtype))
        volume = solve(views)
        assert volume.shape == x.shape, (
            f"the volume is {tuple(volume.shape)}, expected {tuple(x.shape)}"
        )
        assert volume.dtype == dtype, f"the volume of {dtype} views is {volume.dtype}"
        assert volume.isfinite().all(), "the volume is not finite"
    assert torch.equal(solve(views), volume), "not the same bits when called twice"
    misfit = ((A(volume) - views).norm() / views.norm()).item()
    assert misfit < 1, f"the volume explains the views no better than zero does: {misfit:.3g}"
    nothing = solve(torch.zeros_like(views)).norm()
    assert nothing <= TOLERANCE * volume.norm(), "views of zero do not give a volume of zero"
    assert close(solve(views.flip(0)).flip(0), volume, TOLERANCE), (
        "the order of a batch changes its volumes"
    )
    assert close(solve(views[1:]), volume[1:], TOLERANCE), (
        "a volume depends on the others of its batch"
    )
    # several channels are as good as one for an operator
    check_refusals(solve, views, ("no batch", "a camera less", "a row less", "NaN", "inf"))
