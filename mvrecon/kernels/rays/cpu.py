"""The compiled operators of the CPU: no compiler on the user's machine, as many threads as torch
has.

Every result is the same to the last bit for any number of threads: each ray's sum belongs to one
thread, and so does each voxel of the adjoint (a thread owns a range of slabs, one main axis at a
time, and meets the rays in one order).

Rays read copies of the volume, see `packed_volume.py`, made piece by piece so that little is added
to the caller's memory.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.backends import wide
from mvrecon.kernels.rays.columns import backproject_columns, column_of, project_columns
from mvrecon.kernels.rays.lines import unshifted
from mvrecon.kernels.rays.loops import Rig, backproject_slabs, project_rows, room_of, vary_rows
from mvrecon.kernels.rays.occupancy import Occupancy
from mvrecon.kernels.rays.packed_volume import Store, add, empty, fill, part_of, store
from mvrecon.kernels.rays.plan import Plan, Scene, plan_of, ray_plan_of
from mvrecon.kernels.threads import share

#: Rows of a volume of half precision that are widened at a time.
TOGETHER = 8


def _piece_sizes(piece: Rig) -> tuple[int, int, int]:
    x, y, z = (high - low for low, high in zip(piece.box[:3], piece.box[3:], strict=True))
    return x, y, z


def _overlap(held: Occupancy, rows: slice, piece: Rig) -> tuple[slice, tuple[slice, slice, slice]]:
    """The rows (along y) of what is held that lie in a piece, counted from the box; and where it
    lies in the store.
    """
    first, last = max(held.box.low[1], rows.start), min(held.box.high[1], rows.stop)
    low = (
        held.box.low[2] - piece.box[0],
        first - rows.start - piece.box[1],
        held.box.low[0] - piece.box[2],
    )
    size = (held.box.shape[2], last - first, held.box.shape[0])
    x, y, z = (slice(start, start + n) for start, n in zip(low, size, strict=True))
    return slice(first - held.box.low[1], last - held.box.low[1]), (x, y, z)


def _copies(
    volume: Tensor, held: Occupancy, plan: Plan
) -> Iterator[tuple[Store, Rig, tuple[bool, bool, bool], slice]]:
    """Pieces of volumes in each layout that the plan needs: the rig about them, the main axes that
    read them, rows.

    `volume` is what is held.
    """
    # grad mode belongs to a thread: in the pool's threads it would be on
    volume = volume.detach()
    into, real = None, wide(volume[:0]).numpy().dtype
    for near, axes in plan.layouts:
        for rows, piece in plan.pieces:
            into = empty(len(volume), _piece_sizes(piece), (near, plan.lanes), real, into)
            some, where = _overlap(held, rows, piece)
            to, given = part_of(into, near, where), volume[:, :, some]

            def copy(first: int, last: int, to=to, near=near, given=given) -> None:
                for row in range(first, last, TOGETHER):
                    fill(wide(given[:, :, row : min(row + TOGETHER, last)]).numpy(), near, to, row)

            share(copy, given.shape[2], given.numel(), 4)
            yield store(into, near), piece, axes, rows


def project(
    volume: Float[Tensor, "n d h w"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    held: Occupancy,
    detector: Sequence[int],
    method: str,
) -> Float[Tensor, "n m v u"]:
    """Line integrals of volumes, in mm times their unit; see `reference.project`. `volume` is what
    is held.
    """
    real = wide(volume[:0]).numpy().dtype
    plan = plan_of(Scene(lines, window, detector, method), held, len(volume), real.itemsize)
    rig, reads, columns = plan.rig, plan.reads, plan.upright
    views = np.zeros((len(volume), len(lines), *rig.detector), real)
    oblique, upright = len(plan.oblique) * max(rig.detector), len(columns[0]) * rig.detector[1]
    for copy, piece, axes, _ in _copies(volume, held, plan):

        def add_rows(first: int, last: int, copy=copy, piece=piece, axes=axes) -> None:
            project_rows(
                copy, piece, room_of(piece, copy), (*reads[copy.near], axes), views, first, last
            )

        def add_columns(first: int, last: int, copy=copy, piece=piece) -> None:
            project_columns(
                copy, piece, column_of(piece, copy, len(views)), columns, views, first, last
            )

        share(add_rows, oblique, views.size * max(rig.sizes), 4)
        share(add_columns, upright if copy.near == 2 else 0, views.size * max(rig.sizes), 4)
    return torch.from_numpy(views)


def backproject(
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    held: Occupancy,
    method: str,
) -> Float[Tensor, "n d h w"]:
    """The exact transpose of `project`, the same to the last bit for any number of threads."""
    given = np.ascontiguousarray(views.numpy())
    scene = Scene(lines, window, views.shape[2:], method)
    plan = plan_of(scene, held, len(views), given.itemsize)
    volume, into = np.zeros((len(views), *held.box.shape), given.dtype), None
    for near, axes in plan.layouts:
        for rows, piece in plan.pieces:
            into = empty(len(views), _piece_sizes(piece), (near, plan.lanes), given.dtype, into)
            some, where = _overlap(held, rows, piece)
            source, part = part_of(into, near, where), volume[:, :, some]
            for axis in range(3):
                oblique = plan.reads[near] if axes[axis] else None
                stands = near == 2 and axis < 2 and len(plan.upright[0])
                upright = plan.upright if stands else None
                _spread(store(into, near), piece, axis, (oblique, upright), given)
            share(
                lambda a, b, source=source, to=part, near=near: add(source, near, to, a, b),
                part.shape[2],
                part.size,
            )
    return torch.from_numpy(volume)


def _spread(held: Store, piece: Rig, axis: int, reads: tuple, views: np.ndarray) -> None:
    """Spread views along the rays of one main axis, slab by slab, where reads = (oblique, upright)
    are not None.
    """
    oblique, upright = reads

    def add_slabs(low: int, high: int) -> None:
        span = piece.box[axis] + low, piece.box[axis] + high
        backproject_slabs(held, piece, room_of(piece, held), (*oblique, axis), views, *span)

    def add_columns(low: int, high: int) -> None:
        span = piece.box[axis] + low, piece.box[axis] + high
        backproject_columns(
            held, piece, column_of(piece, held, len(views)), (*upright, axis), views, *span
        )

    slabs, steps = _piece_sizes(piece)[axis], views.size * max(piece.sizes)
    share(add_slabs, slabs if oblique is not None else 0, steps)
    share(add_columns, slabs if upright is not None else 0, steps)


def lines_vjp(
    volume: Float[Tensor, "n d h w"],
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    held: Occupancy,
    method: str,
) -> Float[Tensor, "m 4 3 k"]:
    """The derivative of <views, project(volume, lines)> by the lines, all methods by hand;
    float64.
    """
    given = np.ascontiguousarray(views.numpy())
    scene = Scene(lines, window, views.shape[2:], method)
    plan = ray_plan_of(scene, held, len(volume), wide(volume[:0]).element_size())
    rig, reads = plan.rig, plan.reads
    total = torch.zeros(lines.shape, dtype=torch.float64)
    for copy, piece, axes, rows in _copies(volume, held, plan):
        # a row or column of pixels has its own sum, so that threads change no bit
        change = np.zeros((len(lines), max(rig.detector), *lines.shape[1:]))

        def vary(first: int, last: int, copy=copy, piece=piece, axes=axes, change=change) -> None:
            rays = *reads[copy.near], axes
            vary_rows(copy, piece, room_of(piece, copy), rays, (given, change), first, last)

        share(vary, len(lines) * max(rig.detector), given.size * max(rig.sizes), 4)
        total += unshifted(
            torch.from_numpy(change).sum(dim=1), (rows.start + rows.stop - rig.sizes[1]) / 2
        )
    return total
