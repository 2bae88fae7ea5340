"""The compiled operators of the CPU: no compiler on the user's machine, as many threads as torch has.

Every result is the same to the last bit for any number of threads: each ray's sum belongs to one thread, and so does
each voxel of the adjoint (a thread owns a range of slabs, one main axis at a time, and meets the rays in one order).

Rays read copies of the volume, see `stores.py`, made piece by piece so that little is added to the caller's memory.
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
from mvrecon.kernels.rays.plan import Plan, pieces, plan_of, ray_plan_of, rig_of
from mvrecon.kernels.rays.stores import Store, add, empty, fill, inner, store
from mvrecon.kernels.threads import share

#: Rows of a volume of half precision that are widened at a time.
TOGETHER = 8


def _copies(volume: Tensor, rig: Rig, plan: Plan) -> Iterator[tuple[Store, Rig, tuple[bool, bool, bool], slice]]:
    """Pieces of volumes in each layout that the plan needs: the rig about them, the main axes that read them, rows."""
    # grad mode belongs to a thread: in the pool's threads it would be on
    volume = volume.detach()
    into, real = None, wide(volume[:0]).numpy().dtype
    for near, axes in plan.layouts:
        for rows, piece in pieces(rig, len(volume), real.itemsize):
            into = empty(len(volume), piece.sizes, (near, plan.lanes), real, into)

            def copy(first: int, last: int, into=into, near=near, start=rows.start) -> None:
                for row in range(first, last, TOGETHER):
                    part = volume[:, :, start + row : start + min(row + TOGETHER, last)]
                    fill(wide(part).numpy(), near, inner(into), row)

            share(copy, rows.stop - rows.start, into.size, 4)
            yield store(into, near), piece, axes, rows


def project(
    volume: Float[Tensor, "n d h w"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    detector: Sequence[int],
    method: str,
) -> Float[Tensor, "n m v u"]:
    """Line integrals of volumes, in mm times their unit; see `reference.project`."""
    rig = rig_of(lines, window, volume.shape[1:], detector, method)
    plan = plan_of(rig, len(volume))
    views = np.zeros((len(volume), len(lines), *rig.detector), wide(volume[:0]).numpy().dtype)
    oblique, upright = len(plan.oblique) * max(rig.detector), len(plan.upright) * rig.detector[1]
    for held, piece, axes, _ in _copies(volume, rig, plan):

        def add_rows(first: int, last: int, held=held, piece=piece, axes=axes) -> None:
            project_rows(held, piece, room_of(piece, held), (*plan.reads(piece, held.near), axes), views, first, last)

        def add_columns(first: int, last: int, held=held, piece=piece) -> None:
            room = column_of(piece, held, len(views))
            project_columns(held, piece, room, plan.upright, views, first, last)

        share(add_rows, oblique, views.size * max(rig.sizes), 4)
        share(add_columns, upright if held.near == 2 else 0, views.size * max(rig.sizes), 4)
    return torch.from_numpy(views)


def backproject(
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    shape: Sequence[int],
    method: str,
) -> Float[Tensor, "n d h w"]:
    """The exact transpose of `project`, the same to the last bit for any number of threads."""
    rig = rig_of(lines, window, shape, views.shape[2:], method)
    plan, given = plan_of(rig, len(views)), np.ascontiguousarray(views.numpy())
    volume, into = np.zeros((len(views), *shape), given.dtype), None
    for near, axes in plan.layouts:
        for rows, piece in pieces(rig, len(views), given.itemsize):
            into = empty(len(views), piece.sizes, (near, plan.lanes), given.dtype, into)
            part = volume[:, :, rows]
            for axis in range(3):
                _spread(store(into, near), piece, plan, (axis, axes[axis]), given)
            share(
                lambda a, b, held=into, to=part, near=near: add(inner(held), near, to, a, b), part.shape[2], part.size
            )
    return torch.from_numpy(volume)


def _spread(held: Store, piece: Rig, plan: Plan, axis: tuple[int, bool], views: np.ndarray) -> None:
    """Spread views along the rays of one main axis, slab by slab, where it has oblique or upright ones."""
    along, oblique = axis

    def add_slabs(low: int, high: int) -> None:
        backproject_slabs(held, piece, room_of(piece, held), (*plan.reads(piece, held.near), along), views, low, high)

    def add_columns(low: int, high: int) -> None:
        room = column_of(piece, held, len(views))
        backproject_columns(held, piece, room, (plan.upright, along), views, low, high)

    steps = views.size * max(piece.sizes)
    share(add_slabs, piece.sizes[along] if oblique else 0, steps)
    share(add_columns, piece.sizes[along] if held.near == 2 and along < 2 and len(plan.upright) else 0, steps)


def lines_vjp(
    volume: Float[Tensor, "n d h w"],
    views: Float[Tensor, "n m v u"],
    lines: Float[Tensor, "m 4 3 k"],
    window: Sequence[float],
    method: str,
) -> Float[Tensor, "m 4 3 k"]:
    """The derivative of <views, project(volume, lines)> by the lines, all methods by hand; float64."""
    rig = rig_of(lines, window, volume.shape[1:], views.shape[2:], method)
    plan, given = ray_plan_of(rig), np.ascontiguousarray(views.numpy())
    total = torch.zeros(lines.shape, dtype=torch.float64)
    for held, piece, axes, rows in _copies(volume, rig, plan):
        # a row or column of pixels has its own sum, so that threads change no bit
        change = np.zeros((len(lines), max(rig.detector), *lines.shape[1:]))

        def vary(first: int, last: int, held=held, piece=piece, axes=axes, change=change) -> None:
            vary_rows(
                held, piece, room_of(piece, held), (*plan.reads(piece, held.near), axes), (given, change), first, last
            )

        share(vary, len(lines) * max(rig.detector), given.size * max(rig.sizes), 4)
        total += unshifted(torch.from_numpy(change).sum(dim=1), (rows.start + rows.stop - rig.sizes[1]) / 2)
    return total
