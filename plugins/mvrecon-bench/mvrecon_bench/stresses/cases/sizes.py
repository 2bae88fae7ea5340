"""Sizes: empty batches, equal and very different axes, many cameras, large detectors, 2^31
values.
"""

import math
import mmap
import tempfile
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras, ExplicitRays
from mvrecon.geometry.cameras.rigs import circular, dome, parallel
from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.rays import ops
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.operators.selection import RaySelection, ViewSelection, ordered_subsets
from mvrecon.testing.measures import bits, gap, greatest
from mvrecon_bench.stresses.case import Case, DoesNotApply
from mvrecon_bench.stresses.refusals import refusal
from mvrecon_bench.stresses.subject import (
    BEAMS,
    DETECTOR,
    GRID,
    ProjectorSubject,
    Subject,
    rig_about,
)

#: Tolerance of sums of few terms in another order.
ROUNDING = {torch.float64: 1e-13, torch.float32: 1e-6}
#: More pixels than 32-bit indices support, and a subset of them.
LONG, FEW = 46400, 8
SPARSE = (torch.float32,)


def no_volumes(subject: ProjectorSubject) -> float:
    """Empty batches and channels: empty results of the correct shape, with gradients."""
    A, violations = subject.projector(GRID, rig := subject.rig()), 0.0
    for lead in ((0, 1), (2, 0), (0, 0)):
        x = subject.random(*lead, *GRID.shape).requires_grad_()
        y = subject.random(*lead, len(rig), *rig.shape).requires_grad_()
        for act, operand, expected in ((A, x, y), (A.T, y, x)):
            try:
                out = act(operand)
            except ValueError:
                continue
            (gradient,) = torch.autograd.grad(out.sum(), operand)
            violations += (out.shape != expected.shape) + (gradient.shape != operand.shape)
    return violations


def no_geometry(subject: Subject) -> float:
    """Zero voxels, views, rows, rays, samples or subsets raise ValueError before any
    computation.
    """
    rig, none = rig_about(GRID), torch.zeros(0, 3)
    A = PROJECTORS.build("drr", grid=GRID, cameras=rig)
    calls: list[Callable[[], object]] = [
        lambda n=n: Grid.centred(shape=n, spacing=1.0) for n in ((0, 2, 3), (2, 0, 3), (2, 3, 0))
    ]
    calls += [lambda n=n: replace(rig, shape=n) for n in ((0, 4), (4, 0))]
    calls += [
        lambda: Cameras(none, none, none, none, (2, 3)),
        lambda: rig[[]],
        lambda: ExplicitRays(none[None, None], none[None, None]),
        lambda: circular(0, 40.0, 70.0, dict(DETECTOR)),
        lambda: parallel(0, dict(DETECTOR), 60.0),
        lambda: dome(0, 30.0, 20.0, 120.0, dict(DETECTOR)),
        lambda: ordered_subsets(4, 0),
        lambda: PROJECTORS.build("drr", grid=GRID, cameras=rig, method="trilinear:0"),
        lambda: PROJECTORS.build("drr", grid=GRID, cameras=rig, rays_per_pixel=0),
        lambda: A(torch.zeros(1, 1, 0, 6, 7)),
    ]
    return float(sum(bool(refusal(call)) for call in calls))


def three_of_all(subject: ProjectorSubject) -> float:
    """Three cases, channels, views, rows, columns and voxels per axis: results equal those of each
    case, channel and view separately.
    """
    grid = Grid.centred((3, 3, 3), (1.0, 1.2, 0.9), (3.0, -2.0, 4.0))
    rig = subject.rig(grid, {"pixels": [3, 3], "pixel_mm": 3.0, "offset_mm": [0.4, -0.3]})
    x, y = subject.random(3, 3, 3, 3, 3), subject.random(3, 3, 3, 3, 3, seed=1)
    A = subject.projector(grid, rig)
    single = [subject.projector(grid, rig[m : m + 1]) for m in range(3)]
    views, volume = torch.empty_like(y), torch.zeros_like(x)
    for b in range(3):
        for c in range(3):
            for m, B in enumerate(single):
                views[b, c, m] = B(x[b : b + 1, c : c + 1])[0, 0, 0]
                volume[b, c] += B.T(y[b : b + 1, c : c + 1, m : m + 1])[0, 0]
    return greatest([gap(A(x), views), gap(A.T(y), volume)])


def three_cameras(subject: Subject) -> float:
    """Three cameras and three points: results equal those of each camera and point separately."""
    points = torch.tensor([[3.0, -2, 4], [4, -1, 3], [2.5, -2.5, 5]], dtype=torch.float64)
    errors = []
    for beam in BEAMS:
        rig = rig_about(GRID, *beam, detector={"pixels": [3, 3], "pixel_mm": 2.0})
        uvz = rig.project(points)
        errors += [gap(rig.unproject(uvz), points.expand(3, 3, 3))]
        for m, camera in enumerate(rig):
            alone = torch.stack([camera.project(point[None])[0, 0] for point in points])
            errors += [
                gap(uvz[m], alone),
                gap(rig.matrix[m], camera.matrix[0]),
                gap(rig.rays()[1][m], camera.rays()[1][0]),
            ]
    return greatest(errors)


def many_cameras(subject: ProjectorSubject) -> float:
    """200 single-pixel cameras: results equal those of smaller rigs."""
    rig = subject.rig(
        detector={"pixels": [1, 1], "pixel_mm": 2.0, "offset_mm": [1.1, 0.7]}, n_views=200
    )
    x, chunks = (
        subject.random(1, 1, *GRID.shape),
        [rig[first : first + 67] for first in range(0, 200, 67)],
    )
    A, parts = subject.projector(GRID, rig), [subject.projector(GRID, chunk) for chunk in chunks]
    views = A(x)
    pieces = views.split([len(chunk) for chunk in chunks], dim=2)
    volume = sum((B.T(piece) for B, piece in zip(parts, pieces, strict=True)), torch.zeros_like(x))
    return bits(torch.cat([B(x) for B in parts], dim=2), views) + (
        gap(volume, A.T(views)) > ROUNDING[x.dtype]
    )


def large_detector(subject: ProjectorSubject) -> float:
    """One camera of 200 x 190 pixels: results equal those of bands of rows as separate
    detectors.
    """
    subject.need("pixelwise")
    rig = subject.rig(
        detector={"pixels": [200, 190], "pixel_mm": 0.09, "offset_mm": [0.04, -0.03]}, n_views=1
    )
    x, (rows, columns), height = subject.random(1, 1, *GRID.shape), rig.shape, 63
    views = subject.projector(GRID, rig)(x)
    bands = [
        band(rig, 0, first, (min(height, rows - first), columns))
        for first in range(0, rows, height)
    ]
    return gap(torch.cat([subject.projector(GRID, part)(x) for part in bands], dim=3), views)


def band(rig: Cameras, column: int, row: int, shape: tuple[int, int]) -> Cameras:
    """Crop of the detectors that begins at a column and a row."""
    shift = column * rig.u + row * rig.v
    source = rig.source + shift if rig.parallel else rig.source
    return replace(rig, source=source, origin=rig.origin + shift, shape=shape)


def subsets(subject: ProjectorSubject) -> float:
    """Subsets of cameras and pixels: combined results equal those of the operator and its
    adjoint.
    """
    A = subject.projector(GRID, rig := subject.rig(n_views=7))
    x, y = subject.random(1, 2, *GRID.shape), subject.random(1, 2, len(rig), *rig.shape)
    chosen, shape = torch.rand(len(rig), *rig.shape) < 0.4, A.range_shape
    errors = []
    for selections in (
        [ViewSelection(shape, [6, 0, 3]), ViewSelection(shape, [1, 2, 4, 5])],
        [RaySelection(shape, chosen), RaySelection(shape, ~chosen)],
    ):
        parts = [(S, A.subset(S)) for S in selections]
        errors += [gap(torch.stack([S.T(B(x)) for S, B in parts]).sum(dim=0), A(x))]
        errors += [gap(torch.stack([B.T(S(y)) for S, B in parts]).sum(dim=0), A.T(y))]
    return greatest(errors)


def long_strides(subject: ProjectorSubject) -> float:
    """A volume in a sparse memory-mapped file whose voxels are more than 2^31 elements apart."""
    if subject.device != "cpu":
        raise DoesNotApply("a file is in main memory")
    strides = (0, 0, 2**29, 2**23 + 5, 3)
    count = 1 + sum((n - 1) * step for n, step in zip(GRID.shape, strides[2:], strict=True))
    with tempfile.TemporaryFile() as file:
        file.truncate(count * subject.dtype.itemsize)
        memory = mmap.mmap(file.fileno(), 0)
        if hasattr(mmap, "MADV_RANDOM"):  # avoids read-ahead around each voxel
            memory.madvise(mmap.MADV_RANDOM)
        holes = torch.frombuffer(memory, dtype=subject.dtype)
        volume = holes.as_strided((1, 1, *GRID.shape), strides)
        volume.copy_(subject.random(1, 1, *GRID.shape))
        A = subject.projector(GRID, subject.rig())
        return bits(A(volume), A(volume.clone(memory_format=torch.contiguous_format)))


def last_voxels(subject: Subject) -> float:
    """The last voxels of a volume of 1300^3 (more than 2^31), the only nonzero ones: results equal
    those of a separate volume.
    """
    side, errors = 1300, []
    grid, box = (
        Grid.centred((side, side, side), 1.0),
        Box((side - 5, side - 6, side - 7), (side, side, side)),
    )
    alone = grid.cropped(box)
    occupancy, x = Occupancy(grid.shape, box).encoded(), subject.random(1, 1, *box.shape)
    for name, is_parallel in (("drr", False), ("radon", True)):
        rig = rig_about(alone, is_parallel)
        for method in ("joseph", "siddon"):
            A, B = (
                PROJECTORS.build(name, grid=voxels, cameras=rig, method=method)
                for voxels in (grid, alone)
            )
            rays = A.lines, A.ray_extent
            views = ops.project(x[0], *rays, A.detector, method, occupancy)
            volume = ops.backproject(views, *rays, list(box.shape), method, occupancy)
            errors += [gap(views, B(x)[0]), gap(volume, B.T(views[None])[0])]
    return greatest(errors)


def last_pixels(subject: Subject) -> float:
    """The last of more than 2^31 pixels, the only ones that see the volume: results equal those of
    a separate detector.
    """
    inside = torch.zeros(GRID.shape, dtype=torch.bool)
    inside[1:-1, 1:-1, 1:-1] = True
    x, errors = subject.random(1, 1, *GRID.shape), []
    detector = {
        "pixels": [LONG, LONG],
        "pixel_mm": 1.0,
        "offset_mm": [3.0 - (LONG - 1) / 2, 2.5 - (LONG - 1) / 2],
    }
    for name, is_parallel in (("drr", False), ("radon", True)):
        rig = rig_about(GRID, is_parallel, detector=detector, n_views=1)
        few = band(rig, LONG - FEW, LONG - FEW, (FEW, FEW))
        for method in ("joseph", "siddon", "trilinear"):
            options = {"grid": GRID, "method": method, "support": inside}
            A, B = (PROJECTORS.build(name, cameras=cameras, **options) for cameras in (rig, few))
            try:
                last = A(x)[..., -FEW:, -FEW:].clone()
                views = torch.from_numpy(np.zeros((1, 1, 1, LONG, LONG), np.float32))
            except MemoryError as error:
                raise DoesNotApply(
                    f"this machine promises no {4 * LONG**2 / 2**30:.0f} GB"
                ) from error
            views[..., -FEW:, -FEW:] = last
            errors += [
                gap(last, B(x)),
                gap(A.T(views), B.T(last)),
                math.nan if not last.any() else 0.0,
            ]
    return greatest(errors)


CASES = (
    Case(
        18,
        "empty batch, no channels",
        "empty result of the right shape with a gradient, or an error",
        "projector",
        no_volumes,
    ),
    Case(18, "no voxels, views or rows", "an error", "mvrecon", no_geometry, dtypes=SPARSE),
    Case(
        21,
        "three samples, channels and cameras",
        "equal to one by one",
        "projector",
        three_of_all,
        ROUNDING,
    ),
    Case(
        21,
        "three cameras, three points",
        "equal to one by one",
        "mvrecon",
        three_cameras,
        1e-12,
        (torch.float64,),
    ),
    Case(
        28, "200 cameras of one pixel", "equal to parts, views bitwise", "projector", many_cameras
    ),
    Case(28, "a large detector", "equal to bands of rows", "projector", large_detector, ROUNDING),
    Case(
        28,
        "subsets of cameras and of pixels",
        "add up to the operator",
        "projector",
        subsets,
        ROUNDING,
    ),
    Case(
        46, "strides beyond 2^31", "bitwise equal to contiguous memory", "projector", long_strides
    ),
    Case(
        46,
        "the last of 2^31 voxels",
        "equal to a small volume's",
        "mvrecon",
        last_voxels,
        1e-11,
        (torch.float64,),
    ),
    Case(
        46,
        "the last of 2^31 pixels",
        "equal to a small detector's",
        "mvrecon",
        last_pixels,
        1e-6,
        SPARSE,
    ),
)
