"""The compiled operators of CUDA devices: the same three as those of the CPU, on torch's current
stream.

Forward and derivative by the geometry are the same to the last bit in every run. So is the adjoint
where it gathers, voxel by voxel, see `gather.py`; where it scatters, ray by ray, the order of
additions, and so the last digits, vary; under `torch.use_deterministic_algorithms` it never does.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from numba import cuda
from torch import Tensor

from mvrecon.kernels.padding import INNER, PAD, padded_shape
from mvrecon.kernels.precision import wide
from mvrecon.kernels.rays.cuda import loops
from mvrecon.kernels.rays.cuda.loops import BLOCK, GROUP, TILE, Scene
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.kernels.rays.trace import numbered

#: Pixels per voxel, by area, up to which a voxel asks all pixels of its picture.
GATHER = 4.0
#: Pixels whose rays are kept at a time for the gather, and threads of a derivative: 32 and 36 MB in
#: single precision.
RAYS, THREADS = 2**20, 2**17
#: Voxels from which on a volume needs indices of 64 bits.
WIDE = 2**32
#: Stands for infinity: the compiler may take it that there is none.
FAR = 1e200


def project(
    volume: Float[Tensor, "n d h w"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    occupancy: Occupancy,
    detector: Sequence[int],
    method: str,
) -> Float[Tensor, "n m v u"]:
    """Line integrals of volumes, in mm times their unit; see `reference.project`. `volume` is the
    occupied box.
    """
    x = wide(volume)
    scene = scene_of(window, occupancy, detector, method)
    views = x.new_empty(len(x), len(lines), *detector)
    kernel = loops.project_kernel(numbered(method)[0], *_shares(len(x), scene))
    launch(
        kernel,
        (_blocks(scene, len(lines)), _groups(len(x))),
        padded(x, occupancy),
        maps(lines),
        scene,
        views,
    )
    return views


def backproject(
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    occupancy: Occupancy,
    method: str,
) -> Float[Tensor, "n d h w"]:
    """The exact transpose of `project`."""
    if gathers(occupancy.shape, views.shape[2:], lines.shape[3], method):
        return gather(views, lines, window, occupancy, method)
    return scatter(views, lines, window, occupancy, method)


def gathers(shape: Sequence[int], detector: Sequence[int], columns: int, method: str) -> bool:
    """Whether the adjoint goes by voxels: for Joseph's method, where few pixels lie on the picture
    of a voxel.

    The detector is taken to show the whole volume: to know better would mean to wait for the
    device.

    Raises:
        RuntimeError: torch is to use deterministic algorithms alone, and there is none.
    """
    possible = method == "joseph" and columns == 3
    if not torch.are_deterministic_algorithms_enabled():
        return possible and math.prod(detector) <= GATHER * math.prod(shape) ** (2 / 3)
    if not possible:
        what = f"method {method!r}" if columns == 3 else "explicit rays"
        raise RuntimeError(
            f"The adjoint of {what} adds up in no fixed order on a GPU, and "
            f"torch.use_deterministic_algorithms was "
            "called; it needs a camera's rays by method 'joseph', or backend 'reference'"
        )
    return True


def gather(
    views: Tensor, lines: Tensor, window: Sequence[float], occupancy: Occupancy, method: str
) -> Float[Tensor, "n d h w"]:
    """`backproject` of Joseph's method by voxels, the same to the last bit in every run."""
    y, numbers = wide(views).contiguous(), maps(lines)
    scene = scene_of(window, occupancy, views.shape[2:], method)
    around = occupancy.read
    volume = y.new_zeros(len(y), *around.shape)
    pixels, blocks = math.prod(scene.detector), (-(-around.size // BLOCK), _groups(len(y)))
    record, collect = loops.record_kernel(), loops.gather_kernel(_group(len(y)))
    at_once = max(1, RAYS // pixels)
    for first in range(0, len(lines), at_once):
        count = min(at_once, len(lines) - first)
        rays, frames = y.new_empty(8, count * pixels), y.new_empty(count, 3, 4)
        axes = torch.zeros(count, 3, dtype=torch.int32, device=y.device)
        launch(record, (-(-count * pixels // BLOCK),), numbers, scene, first, rays, frames, axes)
        launch(collect, blocks, y.flatten(1), rays, frames, axes, scene, first, volume)
    return volume[:, *occupancy.box.within(around)]


def scatter(
    views: Tensor, lines: Tensor, window: Sequence[float], occupancy: Occupancy, method: str
) -> Float[Tensor, "n d h w"]:
    """`backproject` of any method by rays, with atomic additions."""
    y = wide(views).contiguous()
    scene = scene_of(window, occupancy, views.shape[2:], method)
    flat = y.new_zeros(len(y) * scene.size)
    kernel = loops.scatter_kernel(numbered(method)[0], *_shares(len(y), scene))
    launch(kernel, (_blocks(scene, len(lines)), _groups(len(y))), y, maps(lines), scene, flat)
    around = occupancy.read
    volume = flat.view(len(y), *padded_shape(around.shape))[:, INNER, INNER, INNER]
    return volume[:, *occupancy.box.within(around)].contiguous()


def lines_vjp(
    volume: Float[Tensor, "n d h w"],
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    occupancy: Occupancy,
    method: str,
) -> Float[Tensor, "m 4 3 k"]:
    """The derivative of <views, project(volume, lines)> by the lines; float64."""
    x, y = wide(volume), wide(views).contiguous()
    scene = scene_of(window, occupancy, views.shape[2:], method)
    threads = min(math.prod(scene.detector), max(1, THREADS // max(1, len(lines))))
    change = lines.new_zeros(4, 3, lines.shape[3], len(lines), threads, dtype=torch.float64)
    kernel = loops.vary_kernel(numbered(method)[0])
    blocks = (-(-len(lines) * threads // BLOCK),)
    launch(kernel, blocks, padded(x, occupancy), y, maps(lines), scene, change)
    return change.sum(dim=4).permute(3, 0, 1, 2).contiguous()


def launch(kernel: Any, blocks: tuple[int, ...], *arguments: Any) -> None:
    """Start a kernel on torch's current stream; under numba's simulator, run it on tensors in main
    memory.
    """
    if 0 in blocks:
        return
    device = next(argument.device for argument in arguments if isinstance(argument, Tensor))
    if device.type == "cpu":
        kernel[blocks, BLOCK](*(_shared(argument, Tensor.numpy) for argument in arguments))
        return
    index = torch.cuda.current_device() if device.index is None else device.index
    with torch.cuda.device(index), cuda.gpus[index]:
        stream = cuda.external_stream(torch.cuda.current_stream(index).cuda_stream)
        kernel[blocks, BLOCK, stream](
            *(_shared(argument, partial(cuda.as_cuda_array, sync=False)) for argument in arguments)
        )


def _shared(argument: Any, array_of: Callable[[Tensor], Any]) -> Any:
    """A tensor as an array on the same memory, any other argument as it is."""
    return array_of(argument.detach()) if isinstance(argument, Tensor) else argument


def scene_of(
    window: Sequence[float], occupancy: Occupancy, detector: Sequence[int], method: str
) -> Scene:
    """The numbers of a scene."""
    around = occupancy.read
    depth, height, width = padded_shape(around.shape)
    rows, columns = (int(size) for size in detector)
    low, high = (min(max(float(end), -FAR), FAR) for end in window)
    z, y, x = around.low
    return Scene(
        sizes=occupancy.shape[::-1],
        strides=(1, width, width * height),
        size=width * height * depth,
        detector=(rows, columns),
        tile=TILE if columns >= TILE[0] and rows >= TILE[1] else (1, 1),
        window=(low, high),
        samples=numbered(method)[1],
        box=(*around.low[::-1], *around.high[::-1]),
        origin=x + width * (y + height * z),
    )


def padded(volume: Float[Tensor, "n d h w"], occupancy: Occupancy) -> Float[Tensor, " p"]:
    """Volumes, of which only the occupied box exists, in the box that is read, with their border of
    nothing, in one row.
    """
    margins = occupancy.box.margins(occupancy.read)
    return F.pad(volume, [n + border for n, border in zip(margins, PAD * 3, strict=True)]).flatten()


def maps(lines: Float[Tensor, "m 4 3 k"]) -> Float[Tensor, "m 4 3 k"]:
    """The rays' maps as the kernels read them."""
    return lines.detach().double().contiguous()


def _group(volumes: int) -> int:
    return 1 if volumes == 1 else GROUP


def _groups(volumes: int) -> int:
    return -(-volumes // _group(volumes))


def _shares(volumes: int, scene: Scene) -> tuple[int, type]:
    """How many volumes share a thread, and the type of flat indices in one of them."""
    return _group(volumes), np.uint64 if scene.size >= WIDE else np.uint32


def _blocks(scene: Scene, views: int) -> int:
    rows, columns = scene.detector
    wide, high = scene.tile
    return -(-views * (-(-columns // wide)) * (-(-rows // high)) * wide * high // BLOCK)
