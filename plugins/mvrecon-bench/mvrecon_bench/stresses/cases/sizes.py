"""Sizes: empty batches, equal and very different axes, many cameras, large detectors, 2^31 values,
in main memory and on a GPU.
"""

import math
import mmap
import tempfile
from collections.abc import Iterator

import numpy as np
import torch
from torch.nn.functional import conv3d

from mvrecon.core.parts import PROJECTORS
from mvrecon.geometry.cameras.camera import Cameras
from mvrecon.geometry.grid import Box, Grid
from mvrecon.kernels.rays import ops
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.operators.selection import RaySelection, ViewSelection
from mvrecon.testing.measures import bits, gap, greatest
from mvrecon_bench.stresses.case import DOUBLE, EXACT, SINGLE, DoesNotApply, case
from mvrecon_bench.stresses.subject import GRID, ProjectorSubject, Subject, rig_about

#: More pixels than 32-bit indices support, and a subset of them.
LONG, FEW = 46400, 8


@case("projector", 18)
def no_volumes(subject: ProjectorSubject) -> Iterator[float]:
    """Empty batch, no channels: empty result of the right shape with a gradient, or an error."""
    for batch, channels in ((0, 1), (2, 0), (0, 0)):
        A, x, y = subject.pair(batch=batch, channels=channels)
        for act, operand, expected in ((A, x.requires_grad_(), y), (A.T, y.requires_grad_(), x)):
            try:
                out = act(operand)
            except ValueError:
                continue
            (gradient,) = torch.autograd.grad(out.sum(), operand)
            yield (out.shape != expected.shape) + (gradient.shape != operand.shape)


@case("projector", 21, EXACT)
def three_of_all(subject: ProjectorSubject) -> float:
    """Three samples, channels and cameras: equal to one by one, on 3 x 3 pixels and 3^3 voxels."""
    grid = Grid.centred((3, 3, 3), (1.0, 1.2, 0.9), (3.0, -2.0, 4.0))
    rig = subject.rig(grid, {"pixels": [3, 3], "pixel_mm": 3.0, "offset_mm": [0.4, -0.3]})
    x, y = subject.random(3, 3, 3, 3, 3), subject.random(3, 3, 3, 3, 3, seed=1)
    A = subject.projector(grid, rig)
    single = [subject.projector(grid, rig[m : m + 1]) for m in range(3)]
    views, volume = torch.empty_like(y), torch.zeros_like(x)
    for b, c in torch.cartesian_prod(torch.arange(3), torch.arange(3)).tolist():
        for m, B in enumerate(single):
            views[b, c, m] = B(x[b : b + 1, c : c + 1])[0, 0, 0]
            volume[b, c] += B.T(y[b : b + 1, c : c + 1, m : m + 1])[0, 0]
    return greatest([gap(A(x), views), gap(A.T(y), volume)])


@case("projector", 28)
def many_cameras(subject: ProjectorSubject) -> float:
    """200 cameras of one pixel: equal to parts, views bitwise."""
    detector = {"pixels": [1, 1], "pixel_mm": 2.0, "offset_mm": [1.1, 0.7]}
    rig, x = subject.rig(detector=detector, n_views=200), subject.random(1, 1, *GRID.shape)
    chunks = [rig[first : first + 67] for first in range(0, 200, 67)]
    A, parts = subject.projector(GRID, rig), [subject.projector(GRID, chunk) for chunk in chunks]
    views = A(x)
    pieces = views.split([len(chunk) for chunk in chunks], dim=2)
    volume = sum((B.T(piece) for B, piece in zip(parts, pieces, strict=True)), torch.zeros_like(x))
    apart = gap(volume, A.T(views)) > EXACT[x.dtype]
    return bits(torch.cat([B(x) for B in parts], dim=2), views) + apart


@case("projector", 28, EXACT)
def large_detector(subject: ProjectorSubject) -> float:
    """A large detector: equal to bands of rows, of 200 x 190 pixels."""
    subject.need("pixelwise")
    detector = {"pixels": [200, 190], "pixel_mm": 0.09, "offset_mm": [0.04, -0.03]}
    A, x, _ = subject.pair(detector=detector, n_views=1)
    rig = subject.rig(detector=detector, n_views=1)
    bands = [rig.cropped((row, min(row + 63, 200)), (0, 190)) for row in range(0, 200, 63)]
    return gap(torch.cat([subject.projector(GRID, band)(x) for band in bands], dim=3), A(x))


@case("projector", 28, EXACT)
def subsets(subject: ProjectorSubject) -> Iterator[float]:
    """Subsets of cameras and of pixels: add up to the operator."""
    A, x, y = subject.pair(channels=2, n_views=7)
    chosen, shape = torch.rand(A.range_shape) < 0.4, A.range_shape
    for selections in (
        [ViewSelection(shape, [6, 0, 3]), ViewSelection(shape, [1, 2, 4, 5])],
        [RaySelection(shape, chosen), RaySelection(shape, ~chosen)],
    ):
        parts = [(S, A.subset(S)) for S in selections]
        yield gap(torch.stack([S.T(B(x)) for S, B in parts]).sum(dim=0), A(x))
        yield gap(torch.stack([B.T(S(y)) for S, B in parts]).sum(dim=0), A.T(y))


def need_gpu(subject: Subject, gigabytes: float) -> None:
    """Raise DoesNotApply unless the device is a GPU with sufficient free memory."""
    if not subject.device.startswith("cuda"):
        raise DoesNotApply("it needs a GPU; case 46 stands for it in main memory")
    free = torch.cuda.mem_get_info(subject.device)[0] / 2**30
    if free < gigabytes:
        raise DoesNotApply(f"it needs {gigabytes:.0f} GB of a GPU's memory, {free:.0f} GB are free")


@case("mvrecon", 44, 2e-2, SINGLE)
def convolution(subject: Subject) -> float:
    """conv3d in bfloat16: equal to float32 within rounding, for 16 channels of 62 x 641 x 361."""
    need_gpu(subject, 8)
    x = subject.random(1, 16, 62, 641, 361)
    weight = subject.random(16, 16, 3, 3, 3, seed=1) - 0.5
    allowed, torch.backends.cudnn.allow_tf32 = torch.backends.cudnn.allow_tf32, False
    try:
        exact = conv3d(x.bfloat16().float(), weight.bfloat16().float(), padding=1)
    finally:
        torch.backends.cudnn.allow_tf32 = allowed
    return gap(conv3d(x.bfloat16(), weight.bfloat16(), padding=1), exact)


@case("projector", 45, 1e-3, SINGLE)
def huge_volume(subject: ProjectorSubject) -> float:
    """More than 2^31 voxels: correct length in the last slab, of ones and a last voxel of three."""
    need_gpu(subject, 32)
    subject.need_lines()
    grid = Grid.centred(size=(1024, 1024, 2049), spacing=1.0)
    volume = torch.zeros(grid.shape, dtype=torch.bfloat16, device=subject.device)
    volume[-1] = 1
    volume[-1, -1, -1] = 3
    rows = torch.tensor([[-300.0, y, 2048.0] for y in (0.0, 517.0, 1023.0)], dtype=torch.float64)
    ends = rows * torch.tensor([-5.0, 1.0, 1.0], dtype=torch.float64)
    found = subject.values(grid, grid.to_world(rows), grid.to_world(ends), volume)
    return gap(found, torch.tensor([1024.0, 1024.0, 1026.0]))


@case("projector", 45, 1e-3, SINGLE)
def huge_views(subject: ProjectorSubject) -> float:
    """More than 2^31 pixels: last pixels equal to a small detector's."""
    need_gpu(subject, 48)
    return _last_pixels(subject, subject.rig(detector=_long(), n_views=1))


@case("projector", 46)
def long_strides(subject: ProjectorSubject) -> float:
    """Strides beyond 2^31: bitwise equal to contiguous memory, of a sparse memory-mapped file."""
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
        A, x, _ = subject.pair()
        volume.copy_(x)
        return bits(A(volume), A(x))


@case("mvrecon", 46, 1e-11, DOUBLE)
def last_voxels(subject: Subject) -> Iterator[float]:
    """The last of 2^31 voxels: equal to a small volume's."""
    side = 1300
    grid = Grid.centred((side, side, side), 1.0)
    box = Box((side - 5, side - 6, side - 7), (side, side, side))
    alone = grid.cropped(box)
    occupancy, x = Occupancy(grid.shape, box).encoded(), subject.random(1, 1, *box.shape)
    for name, method in (
        ("drr", "joseph"),
        ("drr", "siddon"),
        ("radon", "joseph"),
        ("radon", "siddon"),
    ):
        options = {"cameras": rig_about(alone, name == "radon"), "method": method}
        A, B = (PROJECTORS.build(name, grid=voxels, **options) for voxels in (grid, alone))
        rays = A.lines, A.ray_extent
        views = ops.project(x[0], *rays, A.detector, method, occupancy)
        volume = ops.backproject(views, *rays, list(box.shape), method, occupancy)
        yield gap(views, B(x)[0])
        yield gap(volume, B.T(views[None])[0])


@case("mvrecon", 46, 1e-6, SINGLE)
def last_pixels(subject: Subject) -> Iterator[float]:
    """The last of 2^31 pixels: equal to a small detector's."""
    support = torch.zeros(GRID.shape, dtype=torch.bool)
    support[1:-1, 1:-1, 1:-1] = True
    for name in ("drr", "radon"):
        rig = rig_about(GRID, name == "radon", detector=_long(), n_views=1)
        for method in ("joseph", "siddon", "trilinear"):
            options = {"method": method, "support": support}
            own = ProjectorSubject("projector", name, options, subject.device, subject.dtype)
            yield _last_pixels(own, rig)


def _long() -> dict:
    offset = [mm - (LONG - 1) / 2 for mm in (3.0, 2.5)]
    return {"pixels": [LONG, LONG], "pixel_mm": 1.0, "offset_mm": offset}


def _last_pixels(subject: ProjectorSubject, rig: Cameras) -> float:
    few = rig.cropped((LONG - FEW, LONG), (LONG - FEW, LONG))
    A, B = (subject.projector(GRID, cameras) for cameras in (rig, few))
    x = subject.random(1, 1, *GRID.shape)
    try:
        last = A(x)[..., -FEW:, -FEW:].clone()
        views = torch.from_numpy(np.zeros((1, 1, 1, LONG, LONG), np.float32))  # untouched memory
    except MemoryError as error:
        raise DoesNotApply(f"this machine promises no {4 * LONG**2 / 2**30:.0f} GB") from error
    views = views.to(x.device)
    views[..., -FEW:, -FEW:] = last
    seen = 0.0 if last.any() else math.nan
    return greatest([gap(last, B(x)), gap(A.T(views), B.T(last)), seen])
