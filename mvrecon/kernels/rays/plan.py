"""How the loops share out a rig: which views are read how, and the volume in which layout, piece by
piece.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mvrecon.kernels.padding import padded_shape
from mvrecon.kernels.rays.lanes import LANES
from mvrecon.kernels.rays.lines import DIRECTION, START, shifted
from mvrecon.kernels.rays.loops import Rig
from mvrecon.kernels.rays.occupancy import EDGE, Occupancy, boxes_of, bricks_of_rig
from mvrecon.kernels.rays.shadow import spans_of
from mvrecon.kernels.rays.trace import JOSEPH, TRILINEAR, numbered
from mvrecon.kernels.rays.upright import columnar

#: Bytes of the copy of a piece of the volume.
BUDGET = 24 * 2**20


#: The oblique views, which of them are tall, and the spans of their units, see `loops.walk` and
#: `shadow.spans_of`.
Reads = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Plan:
    """Which views are read how.

    Args:
        upright: indices of the views whose columns are read as rows of voxels.
        oblique: indices of the others.
        axes: whether a ray of an oblique view can have each main axis.
        lanes: volumes that lie side by side.
        boxes: what the rays are to meet, see `shadow.spans_of`.
    """

    upright: np.ndarray
    oblique: np.ndarray
    axes: tuple[bool, bool, bool]
    lanes: int
    boxes: Float[np.ndarray, "n 6"] | None

    @property
    def layouts(self) -> list[tuple[int, tuple[bool, bool, bool]]]:
        """The near axes of the stores that are needed, each with the main axes of the rays that
        read it.
        """
        x, y, z = self.axes
        turned = [(2, (x, y, False))] if x or y or len(self.upright) else []
        return turned + ([(0, (False, False, z))] if z else [])

    def reads(self, rig: Rig, near: int) -> Reads:
        """How the oblique views are read: those are tall for a near axis whose greatest steps are
        from row to row.
        """
        lines = rig.lines[self.oblique]
        steps = np.abs(lines[:, DIRECTION, near]) + np.abs(lines[:, START, near])
        tall = steps[:, 1] > steps[:, 0] if lines.shape[3] == 3 else np.zeros(len(steps), bool)
        return self.oblique, tall, spans_of(lines, rig.detector, tall, self.boxes)

    def columns(self, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
        """The upright views, and the spans of their columns."""
        tall = np.ones(len(self.upright), bool)
        return self.upright, spans_of(rig.lines[self.upright], rig.detector, tall, self.boxes)


def rig_of(
    lines: Tensor, window: Sequence[float], held: Occupancy, detector: Sequence[int], method: str
) -> Rig:
    """What the loops know of the rays, and of the part of the volume that they are to meet."""
    maps = np.ascontiguousarray(lines.detach().numpy(), dtype=np.float64)
    ends = (float(window[0]), float(window[1]))
    sizes = (held.shape[2], held.shape[1], held.shape[0])
    number, samples = numbered(method)
    return Rig(
        maps,
        ends,
        sizes,
        (int(detector[0]), int(detector[1])),
        number,
        samples,
        bounds_of(held),
        *bricks_of_rig(held),
    )


def bounds_of(held: Occupancy) -> tuple[int, ...]:
    """The box (x0, y0, z0, x1, y1, z1) that rays are clipped to."""
    return (*held.read.low[::-1], *held.read.high[::-1])


def plan_of(rig: Rig, held: Occupancy, volumes: int) -> Plan:
    """The plan for projecting volumes, or for back-projecting into them."""
    upright = columnar(rig) if rig.method != TRILINEAR else np.zeros(len(rig.lines), bool)
    oblique = np.flatnonzero(~upright)
    lanes = LANES if rig.method == JOSEPH and volumes > 2 else 1
    return Plan(
        np.flatnonzero(upright),
        oblique,
        _main_axes(rig, rig.lines[oblique, 0]),
        lanes,
        boxes_of(held),
    )


def ray_plan_of(rig: Rig, held: Occupancy) -> Plan:
    """The plan that goes ray by ray, volume by volume, for derivatives in the geometry."""
    every = np.arange(len(rig.lines))
    return Plan(every[:0], every, _main_axes(rig, rig.lines[:, 0]), 1, boxes_of(held))


def _main_axes(rig: Rig, direction: Float[np.ndarray, "m 3 k"]) -> tuple[bool, bool, bool]:
    rows, columns = rig.detector
    corners = np.array([[u, v, 1] for u in (-1, 1) for v in (-1, 1)]) * [
        (columns - 1) / 2,
        (rows - 1) / 2,
        1,
    ]
    corners = (
        corners[:1] if direction.shape[2] == 1 else corners
    )  # a ray given by itself is its own corner
    # [corner axis view], so that numpy goes through many views in one loop
    ends = np.stack(
        [direction.transpose(1, 0, 2) @ corner for corner in corners[:, -direction.shape[2] :]]
    )
    # the ray of a pixel lies between those of the corners
    least = np.where(ends.min(axis=0) * ends.max(axis=0) > 0, np.abs(ends).min(axis=0), 0)
    x, y, z = (np.abs(ends).max(axis=0) * (1 + 1e-9) >= least.max(axis=0)).any(axis=1)
    return bool(x), bool(y), bool(z)


def pieces(rig: Rig, held: Occupancy, volumes: int, itemsize: int) -> Iterator[tuple[slice, Rig]]:
    """Ranges of the volume's rows whose copies fit the budget, each with the rig about its own
    centre.

    Weights of both methods are of single voxels, so that the pieces' projections add up to the
    whole volume's. The samples of "trilinear" are spaced along the ray's way through the whole
    volume: it is one piece. What is held cuts pieces short, but never moves them, so that sums keep
    their order.
    """
    width, height, depth = rig.sizes
    size = volumes * math.prod(padded_shape(rig.sizes)) * itemsize
    parts = 1 if rig.method == TRILINEAR else max(1, -(-size // BUDGET))
    rows = (
        -(-height // (parts * EDGE)) * EDGE
    )  # the first is the greatest, and its memory serves the others
    for low in range(0, height, rows):
        high = min(low + rows, height)
        part = held.rows(low, high)
        if part.box.size:
            lines = shifted(rig.lines, (low + high - height) / 2)
            sizes, bounds = (width, high - low, depth), bounds_of(part)
            yield (
                slice(low, high),
                Rig(lines, *rig[1:2], sizes, *rig[3:6], bounds, *bricks_of_rig(part)),
            )
