"""Values: zeros of either sign, NaN, infinity, negative ones."""

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from mvrecon.geometry.grid import Box, Grid
from mvrecon.operators.ray_transform import RayTransform
from mvrecon.operators.selection import SKIPS
from mvrecon.testing.measures import bits, gap
from mvrecon_bench.stresses.analytic import box_lengths
from mvrecon_bench.stresses.case import PRECISE, Case, DoesNotApply
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject

EVERY = (torch.float64, torch.float32, torch.bfloat16, torch.float16)
#: More than one brick along each axis, and a detector that sees only some of them.
BRICKS = Grid.centred(size=(10, 17, 9), spacing=(1.0, 1.2, 0.9), centre=(3.0, -2.0, 4.0))
NARROW = {"pixels": [5, 4], "pixel_mm": 0.9, "offset_mm": [0.13, -0.21]}


def skips(A: Callable[[Tensor], Tensor]) -> Iterator[None]:
    """Iterate over the operator's modes of skipping zeros."""
    if not isinstance(A, RayTransform):
        yield
        return
    for A.skip in SKIPS:
        yield


def zeros(subject: ProjectorSubject) -> float:
    """Volumes and views of positive and negative zeros."""
    rig = subject.rig()
    A, violations = subject.projector(GRID, rig), 0.0
    for zero in (0.0, -0.0):
        x = torch.full(
            (1, 1, *GRID.shape),
            zero,
            dtype=subject.dtype,
            device=subject.device,
            requires_grad=True,
        )
        y = torch.full(
            (1, 1, len(rig), *rig.shape), zero, dtype=subject.dtype, device=subject.device
        )
        violations += float((A.T(y) != 0).sum())
        for _ in skips(A):
            (gradient,) = torch.autograd.grad((views := A(x)).sum(), x)
            expected = A.T(torch.ones_like(views)).to(x.dtype)
            violations += float((views != 0).sum()) + (not gap(gradient, expected) <= 1e-5)
    return violations


def negative(subject: ProjectorSubject) -> float:
    """Negative values: exact sign symmetry, and linearity for mixed signs."""
    A, x = subject.projector(BRICKS, subject.rig(BRICKS)), subject.random(1, 1, *BRICKS.shape)
    y = torch.rand((views := A(x)).shape, dtype=torch.float64).to(views)
    mirrored = bits(A.T(-y), -A.T(y)) + sum(bits(A(-x), -views) for _ in skips(A))
    mixed = x.clone()
    mixed[..., 4:12, 2:9] -= 2
    return mirrored + gap(A(mixed), A(mixed.clamp_min(0)) - A((-mixed).clamp_min(0)))


def bad_voxels(subject: ProjectorSubject) -> float:
    """One NaN or infinity, among finite values or zeros, at a voxel met by many, few or no rays."""
    subject.need("local")
    A = subject.projector(BRICKS, rig := subject.rig(BRICKS, NARROW))
    x, violations = subject.random(1, 1, *BRICKS.shape), 0.0
    met = A.T(torch.ones(1, 1, len(rig), *rig.shape, dtype=x.dtype, device=x.device)).flatten()
    for voxel in (met.argmax(), torch.where(met > 0, met, torch.inf).argmin(), met.argmin()):
        chosen = torch.zeros_like(x).flatten().index_fill(0, voxel, 1).view_as(x)
        hits = A(chosen) != 0
        if bool(hits.any()) != bool(met[voxel] > 0):
            raise AssertionError(
                f"the adjoint reports {met[voxel]} at voxel {int(voxel)}, the views do not"
            )
        for bad in (torch.nan, torch.inf):
            for background in (x, torch.zeros_like(x)):
                spoilt = torch.where(chosen > 0, bad, background)
                violations += sum(float((A(spoilt).isfinite() == hits).sum()) for _ in skips(A))
    return violations if float(met.min()) == 0 else torch.nan


def bad_pixel(subject: ProjectorSubject) -> float:
    """One NaN or infinite pixel in the input of the adjoint."""
    subject.need("local")
    A = subject.projector(BRICKS, rig := subject.rig(BRICKS))
    y = subject.random(1, 1, len(rig), *rig.shape)
    one, violations = torch.zeros_like(y), 0.0
    one[..., 1, 2, 3] = 1
    met = A.T(one) != 0
    for bad in (torch.nan, torch.inf):
        for background in (y, torch.zeros_like(y)):
            violations += float(
                (A.T(torch.where(one > 0, bad, background)).isfinite() == met).sum()
            )
    return violations if met.any() else torch.nan


def beyond_support(subject: ProjectorSubject) -> float:
    """NaN everywhere outside a support."""
    A = subject.projector(BRICKS, subject.rig(BRICKS))
    if not isinstance(A, RayTransform):
        raise DoesNotApply("it has no supports")
    x, inside = subject.random(1, 1, *BRICKS.shape), torch.zeros(BRICKS.shape, dtype=torch.bool)
    inside[2:7, 3:12, 1:8] = True
    inside[4:6, 5:9, 3:5] = False
    expected, mask = A(x * inside.to(x.device)), inside.to(x.device)
    masked = A.with_support(inside)
    return sum(bits(masked(torch.where(mask, x, bad)), expected) for bad in (torch.nan, torch.inf))


def touched(subject: ProjectorSubject) -> float:
    """Rays through corners and edges of voxels, and along their faces: NaN propagates exactly if
    the ray has a positive length in the voxel.

    If the ray only touches the voxel's support, with a weight of exactly zero, either result is
    valid (0 * NaN).
    """
    subject.need_exact()
    grid = Grid.centred((4, 4, 4), 1.0)
    way = torch.tensor(
        [[1.0, 1, 0], [1, -1, 0], [0, 1, 1], [2, 1, 0], [1, 1, 1]], dtype=torch.float64
    )
    middle = torch.tensor(
        [[0, 0, 0.3], [0, 0, 0.3], [0.3, 0, 0], [0, 0, 0.3], [0, 0, 0]], dtype=torch.float64
    )
    rig = subject.rays(middle - 20 * way, middle + 20 * way)
    A = subject.projector(grid, rig)
    voxels = torch.eye(64, dtype=subject.dtype, device=subject.device).reshape(64, 1, 4, 4, 4)
    alone = subject.random(1, 1, 4, 4, 4).expand(64, -1, -1, -1, -1)
    spoilt = ~A(torch.where(voxels > 0, torch.nan, alone)).isfinite().flatten(1).cpu()
    weighed = (A(voxels) != 0).flatten(1).cpu()
    reach = 1e-9 + (0.0 if subject.of_cells else 0.5)
    masks = [
        Box((z, y, x), (z + 1, y + 1, x + 1)) for z in range(4) for y in range(4) for x in range(4)
    ]
    near = torch.stack([box_lengths(rig, grid.cropped(box), reach).flatten() > 0 for box in masks])
    return float(((weighed & ~spoilt) | (spoilt & ~near)).sum())


CASES = (
    Case(
        19,
        "volumes and views of zeros",
        "exactly zero, and gradients are those of the adjoint",
        "projector",
        zeros,
        dtypes=EVERY,
    ),
    Case(
        47,
        "a voxel that is no number",
        "exactly the rays that meet it are none",
        "projector",
        bad_voxels,
        dtypes=EVERY,
    ),
    Case(
        47,
        "a pixel that is no number",
        "exactly the voxels on its ray are none",
        "projector",
        bad_pixel,
    ),
    Case(
        47, "no numbers outside of a support", "not met", "projector", beyond_support, dtypes=EVERY
    ),
    Case(
        47,
        "no number at a corner",
        "rays with a length in it are none, others not",
        "projector",
        touched,
    ),
    Case(
        49,
        "negative values",
        "mirrored to the bit, and linear",
        "projector",
        negative,
        PRECISE,
        EVERY,
    ),
)
