"""The compiled operators on the CPU, without a compiler on the user's machine, on torch's number of
threads.

Every result is bitwise independent of the number of threads: each ray's sum belongs to one thread,
and so does each voxel of the adjoint (a thread owns a range of slabs, one main axis at a time, and
processes the rays in a fixed order).

Arguments are those of the operators, see `rays/ops.py`; a support may be an `Occupancy`. Rays read
copies of the volume, see `packed_volume.py`, made piece by piece to save memory.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mvrecon.kernels.operator import to_accumulation_dtype
from mvrecon.kernels.rays.cpu.columns import backproject_columns, column_of, project_columns
from mvrecon.kernels.rays.cpu.loops import backproject_slabs, project_rows, scratch_of, vary_rows
from mvrecon.kernels.rays.cpu.packed_volume import Store, add, empty, fill, part_of, store_of
from mvrecon.kernels.rays.cpu.plan import Plan, Scene, parts_of, plan_of, ray_plan_of
from mvrecon.kernels.rays.cpu.skip_policy import occupancy_of
from mvrecon.kernels.rays.cpu.trace import Columns, Reads, Rig, Slabs, Units
from mvrecon.kernels.rays.lines import unshifted
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.kernels.threads import parallel_for

#: Rows of a half-precision volume converted at a time.
TOGETHER = 8


class Copy(NamedTuple):
    """A piece of volumes in one layout: its rig, the main axes of the rays that read it, and its
    rows (along y) in the whole volume.
    """

    store: Store
    rig: Rig
    axes: tuple[bool, bool, bool]
    rows: slice


def piece_sizes(piece: Rig) -> tuple[int, int, int]:
    """The voxels (x, y, z) of a piece."""
    x, y, z = (high - low for low, high in zip(piece.box[:3], piece.box[3:], strict=True))
    return x, y, z


def _overlap(
    occupancy: Occupancy, rows: slice, piece: Rig
) -> tuple[slice, tuple[slice, slice, slice]]:
    """The occupied rows (along y) in a piece, counted from the box; and their position in the
    store.
    """
    box = occupancy.box
    first, last = max(box.low[1], rows.start), min(box.high[1], rows.stop)
    low = box.low[2] - piece.box[0], first - rows.start - piece.box[1], box.low[0] - piece.box[2]
    size = (box.shape[2], last - first, box.shape[0])
    x, y, z = (slice(start, start + n) for start, n in zip(low, size, strict=True))
    return slice(first - box.low[1], last - box.low[1]), (x, y, z)


def copies(volume: Tensor, occupancy: Occupancy, plan: Plan) -> Iterator[Copy]:
    """Pieces of volumes in each layout that the plan needs; `volume` is the occupied box."""
    if not len(volume):  # numba would compile every loop anew for arrays without an element
        return
    # grad mode belongs to a thread: in the pool's threads it would be on
    volume = volume.detach()
    into, real = None, to_accumulation_dtype(volume[:0]).numpy().dtype
    for near, axes in plan.layouts:
        for rows, piece in plan.pieces:
            into = empty(len(volume), piece_sizes(piece), near, plan.lanes, real, into)
            overlap, where = _overlap(occupancy, rows, piece)
            to, values = part_of(into, near, where), volume[:, :, overlap]

            def copy(first: int, last: int, to=to, near=near, values=values) -> None:
                for row in range(first, last, TOGETHER):
                    fill(
                        to_accumulation_dtype(
                            values[:, :, row : min(row + TOGETHER, last)]
                        ).numpy(),
                        near,
                        to,
                        row,
                    )

            parallel_for(copy, values.shape[2], values.numel(), 4)
            yield Copy(store_of(into, near), piece, axes, rows)


def occupied(volume, lines, window, detector, method, skip):
    """Where volumes [n d h w] are not zero, in code; see `skip_policy.occupancy_of`."""
    return occupancy_of(volume, Scene(lines, window, detector, method), skip).encoded()


def _read(
    volume: Tensor, support: Tensor | Occupancy | None, occupied: Tensor | None
) -> tuple[Tensor, Occupancy]:
    """What is to be read of volumes, and where it lies in the whole."""
    if support is not None or occupied is None:
        return volume, Occupancy.of(volume.shape[1:], support)
    occupancy = Occupancy.decoded(occupied)
    return volume[:, *occupancy.box.slices], occupancy


def project(volume, lines, window, detector, method, support=None, occupied=None):
    """Line integrals of volumes [n d h w] as views [n m v u]; see `reference.project`."""
    volume, occupancy = _read(volume, support, occupied)
    real = to_accumulation_dtype(volume[:0]).numpy().dtype
    plan = plan_of(Scene(lines, window, detector, method), occupancy, len(volume), real.itemsize)
    sizes, reads, columns = plan.rig.sizes, plan.reads, plan.upright
    views = np.zeros((len(volume), len(lines), *plan.rig.detector), real)
    upright = len(columns.views) * plan.rig.detector[1]
    for copy in copies(volume, occupancy, plan):

        def add_rows(first: int, last: int, copy=copy) -> None:
            scratch, units = scratch_of(copy.rig, copy.store), Units(copy.axes, first, last)
            project_rows(copy.store, copy.rig, scratch, reads[copy.store.near], views, units)

        def add_columns(first: int, last: int, copy=copy) -> None:
            scratch = column_of(copy.rig, copy.store, len(views))
            project_columns(copy.store, copy.rig, scratch, columns, views, first, last)

        parallel_for(add_rows, plan.units, views.size * max(sizes), 4)
        parallel_for(
            add_columns, upright if copy.store.near == 2 else 0, views.size * max(sizes), 4
        )
    return torch.from_numpy(views)


def backproject(views, lines, window, shape, method, support=None):
    """The exact transpose of `project`."""
    occupancy = Occupancy.of(shape, support)
    values = np.ascontiguousarray(views.numpy())
    scene = Scene(lines, window, views.shape[2:], method)
    plan = plan_of(scene, occupancy, len(views), values.itemsize)
    volume, into = np.zeros((len(views), *occupancy.box.shape), values.dtype), None
    if not len(views):  # as in `copies`
        return torch.from_numpy(volume)
    for near, axes in plan.layouts:
        for rows, piece in plan.pieces:
            into = empty(len(views), piece_sizes(piece), near, plan.lanes, values.dtype, into)
            overlap, where = _overlap(occupancy, rows, piece)
            source, part = part_of(into, near, where), volume[:, :, overlap]
            for axis in range(3):
                upright = near == 2 and axis < 2 and len(plan.upright.views)
                if axes[axis] or upright:
                    reads = plan.reads[near] if axes[axis] else None
                    columns = plan.upright if upright else None
                    _spread(store_of(into, near), piece, axis, reads, columns, values)
            parallel_for(
                lambda a, b, source=source, to=part, near=near: add(source, near, to, a, b),
                part.shape[2],
                part.size,
            )
    return torch.from_numpy(volume)


def _spread(
    values: Store,
    piece: Rig,
    axis: int,
    reads: Reads | None,
    columns: Columns | None,
    views: np.ndarray,
) -> None:
    """Spread views along the rays of one main axis, slab by slab: oblique ones, then upright
    ones.
    """

    def add_slabs(low: int, high: int) -> None:
        axes = axis == 0, axis == 1, axis == 2
        slabs = Slabs(axis, axes, piece.box[axis] + low, piece.box[axis] + high)
        if reads:
            backproject_slabs(values, piece, scratch_of(piece, values), reads, views, slabs)
        if columns:
            scratch = column_of(piece, values, len(views))
            backproject_columns(values, piece, scratch, columns, views, slabs)

    parallel_for(add_slabs, piece_sizes(piece)[axis], views.size * max(piece.sizes))


def lines_vjp(volume, views, lines, window, method, support=None, occupied=None):
    """The derivative of <views, project(volume, lines)> by the lines [m 4 3 k]; float64."""
    volume, occupancy = _read(volume, support, occupied)
    values = np.ascontiguousarray(views.numpy())
    scene = Scene(lines, window, views.shape[2:], method)
    size = to_accumulation_dtype(volume[:0]).element_size()
    parts = parts_of(scene.method, occupancy.shape, len(volume) * size)
    plan = ray_plan_of(scene, occupancy, parts)
    sizes, reads = plan.rig.sizes, plan.reads
    total = torch.zeros(lines.shape, dtype=torch.float64)
    for copy in copies(volume, occupancy, plan):
        # a row or column of pixels has its own sum, so that threads change no bit
        change = np.zeros((len(lines), max(plan.rig.detector), *lines.shape[1:]))

        def vary(first: int, last: int, copy=copy, change=change) -> None:
            scratch, units = scratch_of(copy.rig, copy.store), Units(copy.axes, first, last)
            vary_rows(copy.store, copy.rig, scratch, reads[copy.store.near], values, change, units)

        parallel_for(vary, plan.units, values.size * max(sizes), 4)
        middle = (copy.rows.start + copy.rows.stop - sizes[1]) / 2
        total += unshifted(torch.from_numpy(change).sum(dim=1), middle)
    return total
