"""The compiled CPU operators of footprints. Results are identical bit for bit for any number of
threads: each view, or part of a view, and each voxel is added up by one thread in a fixed order.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.threads import parallel_for
from mvrecon_spect.kernels.loops import BLOCK, NUMBERS, ROW, VALUES, adjoint, forward
from mvrecon_spect.kernels.profile import PIECES, TERMS

#: Parts of the work of `project`, by cameras and, if these are fewer, groups of slices; slices that
#: are added up in the views' type, before float64; work of a voxel and a camera, in steps along
#: rays.
PARTS, SLICES, STEPS = 16, 8, 8


def project(volume, rig, detector, transmission=None):
    """Counts of volumes; see `reference.project`."""
    return _exactly(lambda x: _project(x, rig, detector, transmission), volume)


def backproject(views, rig, size, transmission=None):
    """The exact transpose of `project`."""
    return _exactly(lambda y: _backproject(y, rig, size, transmission), views)


def _exactly(run: Callable[[torch.Tensor], torch.Tensor], values: torch.Tensor) -> torch.Tensor:
    """Run a linear operator; its results are NaN where values that are not finite reach, and only
    there, although the loops multiply others of their blocks by zero.
    """
    values = to_accumulation_dtype(values.detach())
    odd = ~values.isfinite()
    if not odd.any():
        return run(values)
    reached = run(odd.to(values)) != 0
    return run(values.masked_fill(odd, 0)).masked_fill(reached, torch.nan)


def _project(x, rig, detector, transmission):
    values, records, typed, pieces, passes = _inputs(x, rig, transmission)
    size, (batch, depth, *_) = _padded(detector), values.shape
    groups, emits = min(-(-PARTS // len(records)), depth), np.any(values, axis=(0, 2, 3))
    views = np.zeros((groups, len(records), batch, size[3] * size[2]), np.float64)

    def add(first: int, last: int) -> None:
        scratch, view = _scratch(size, values.dtype), np.zeros(views.shape[2:], values.dtype)
        for item in range(first, last):
            camera, group = divmod(item, groups)
            own = passes[camera : camera + 1]
            ends = depth * group // groups, depth * (group + 1) // groups
            for z in range(ends[0], ends[1], SLICES):
                slab = z, min(z + SLICES, ends[1])
                if not emits[slice(*slab)].any():
                    continue
                view[:] = 0
                forward(values, own, records, typed, pieces, camera, slab, size, view, scratch)
                views[group, camera] += view

    parallel_for(add, len(records) * groups, math.prod(values.shape[1:]) * len(records) * STEPS, 4)
    rows, columns, stride, _ = size
    whole = np.add.reduce(views, axis=0).astype(values.dtype)
    made = whole.reshape(len(records), batch, -1, stride)[:, :, :rows, :columns]
    return torch.from_numpy(np.ascontiguousarray(made.swapaxes(0, 1)))


def _backproject(y, rig, size, transmission):
    values, records, typed, pieces, passes = _inputs(y, rig, transmission)
    padded = _padded(values.shape[2:])
    rows, columns, stride, every = padded
    wide = np.zeros((*values.shape[:2], every, stride), values.dtype)
    wide[:, :, :rows, :columns] = values
    wide = wide.reshape(*values.shape[:2], -1)
    volumes = np.zeros((len(values), *size), values.dtype)

    def gather(first: int, last: int) -> None:
        scratch, ends = _scratch(padded, values.dtype), (first, last)
        adjoint(volumes, passes, records, typed, pieces, ends, padded, wide, scratch)

    steps = math.prod(size) * len(records) * STEPS
    parallel_for(gather, size[0] * size[1], steps, 8)
    return torch.from_numpy(volumes)


def _inputs(values: torch.Tensor, rig: torch.Tensor, transmission: Any) -> tuple[np.ndarray, ...]:
    """Arrays of values, of the records in float64 and in the values' type, of the profiles'
    constants, and of the transmission, empty if there is none.
    """
    array = np.ascontiguousarray(values.numpy())
    records = np.ascontiguousarray(rig.detach().double().numpy())
    passes = np.zeros((0, 0, 0, 0), np.float32)
    if transmission is not None:
        passes = np.ascontiguousarray(transmission.detach().numpy())
    return array, records, records.astype(array.dtype), PIECES.astype(array.dtype), passes


def _padded(detector: Sequence[int]) -> tuple[int, int, int, int]:
    """Rows and columns of a detector, length of a row in memory, and number of rows in memory: a
    block reads, times zero, pixels beyond the footprints of its smaller voxels.
    """
    rows, columns = (int(n) for n in detector)
    stride = -(-columns // ROW) * ROW + ROW
    return rows, columns, stride, 2 * rows + columns // stride + 2


def _scratch(size: Sequence[int], dtype: np.dtype) -> tuple[np.ndarray, ...]:
    """Arrays for a block, see `loops.forward`."""
    rows, columns = size[:2]
    s, cu, cv = (np.zeros(n * BLOCK, dtype) for n in (VALUES, TERMS, TERMS))
    wu, wv = (np.zeros((n, BLOCK), dtype) for n in (columns, rows))
    numbers = np.zeros(NUMBERS * BLOCK, np.int32)
    return s, numbers, cu, cv, wu, wv, np.zeros(BLOCK * (columns + ROW), dtype)
