"""The compiled operators of the CPU: no compiler on the user's machine, as many threads as torch has.

Every result is the same to the last bit for any number of threads: each ray's sum belongs to one thread, and so does
each voxel of the adjoint (a thread owns a range of slabs, one main axis at a time, and meets the rays in one order).
Threads run loops that hold no lock of the interpreter; numba's own `parallel=True` aborts under concurrent calls.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.loops import Rig, backproject_slabs, project_rows, vary_rows
from mvrecon.kernels.rays import JOSEPH, SIDDON
from mvrecon.kernels.threads import share

METHODS = {"joseph": JOSEPH, "siddon": SIDDON}
#: Voxels of nothing before and behind the volume along every axis.
PAD = (1, 2)
INNER = (slice(None), *[slice(PAD[0], -PAD[1])] * 3)


def _empty(count: int, shape: Sequence[int], like: Tensor) -> np.ndarray:
    # by numpy here and below: torch would wake its threads for the smallest volume
    return np.zeros([count, *(size + sum(PAD) for size in shape)], dtype=like.numpy().dtype)


def _padded(volume: Float[Tensor, "n d h w"]) -> np.ndarray:
    padded = _empty(len(volume), volume.shape[1:], volume)
    padded[INNER] = volume.numpy()
    return padded.reshape(len(padded), math.prod(padded.shape[1:]))


def _rig(lines: Tensor, window: Sequence[float], shape: Sequence[int], detector: Sequence[int], method: str) -> Rig:
    padded = [size + sum(PAD) for size in shape]
    wide = padded[0] * padded[1] * padded[2] >= 2**31
    strides = np.array([1, padded[2], padded[1] * padded[2]], dtype=np.int64 if wide else np.int32)
    sizes = (int(shape[2]), int(shape[1]), int(shape[0]))
    maps = np.ascontiguousarray(lines.detach().numpy(), dtype=np.float64)
    ends = (float(window[0]), float(window[1]))
    return Rig(maps, ends, sizes, strides, (int(detector[0]), int(detector[1])), METHODS[method])


def project(
    volume: Float[Tensor, "n d h w"],
    lines: Float[Tensor, "m 4 3 3"],
    window: Sequence[float],
    detector: Sequence[int],
    method: str,
) -> Float[Tensor, "n m v u"]:
    """Line integrals of volumes, in mm times their unit; see `reference.project`."""
    rig = _rig(lines, window, volume.shape[1:], detector, method)
    views = volume.new_empty(len(volume), len(lines), *detector)
    flat, rows, samples = _padded(volume), len(lines) * detector[0], views.numel() * max(rig.sizes)
    share(lambda first, last: project_rows(flat, rig, views.numpy(), first, last), rows, samples, 4)
    return views


def backproject(
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 3"],
    window: Sequence[float],
    shape: Sequence[int],
    method: str,
) -> Float[Tensor, "n d h w"]:
    """The exact transpose of `project`, the same to the last bit for any number of threads."""
    rig = _rig(lines, window, shape, views.shape[2:], method)
    padded, values = _empty(len(views), shape, views), np.ascontiguousarray(views.numpy())
    flat = padded.reshape(len(padded), math.prod(padded.shape[1:]))
    samples = views.numel() * max(rig.sizes)
    for axis, size in enumerate(rig.sizes):
        share(lambda low, high, axis=axis: backproject_slabs(flat, rig, values, axis, low, high), size, samples)
    return torch.from_numpy(np.ascontiguousarray(padded[INNER]))


def lines_vjp(
    volume: Float[Tensor, "n d h w"],
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 3"],
    window: Sequence[float],
    method: str,
) -> Float[Tensor, "m 4 3 3"]:
    """The derivative of <views, project(volume, lines)> by the lines, both methods by hand; float64."""
    rig = _rig(lines, window, volume.shape[1:], views.shape[2:], method)
    rows = views.shape[2]
    change = torch.zeros(len(lines), rows, 4, 3, 3, dtype=torch.float64)
    flat, values, samples = _padded(volume), np.ascontiguousarray(views.numpy()), views.numel() * max(rig.sizes)
    share(lambda first, last: vary_rows(flat, rig, values, change.numpy(), first, last), len(lines) * rows, samples, 4)
    return change.sum(dim=1)
