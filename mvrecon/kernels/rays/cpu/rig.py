"""What the loops of the CPU know of a rig, and which part of its rays one call goes through."""

from collections import namedtuple
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.padding import PAD
from mvrecon.kernels.rays.cpu.packed_volume import FRONT
from mvrecon.kernels.rays.occupancy import Occupancy, bricks_of_rig
from mvrecon.kernels.rays.trace import Steps, numbered

#: lines [m 4 3 k], window (w0, w1), sizes (x, y, z), detector (rows, columns), method, samples a
#: ray (trilinear); the box of what may be there, see `trace.Space`; bricks, their strides and
#: heights, see `occupancy.bricks_of_rig`.
Rig = namedtuple(
    "Rig",
    ["lines", "window", "sizes", "detector", "method", "samples"]
    + ["box", "bricks", "strides", "heights"],
)
#: Rays that are met one by one, in units of a row or a column of pixels, see `loops.walk`: indices
#: of their views; whether the units of these are columns (tall); spans [view unit 2], see
#: `footprint.spans_of`.
Reads = namedtuple("Reads", ["views", "tall", "spans"])
#: Rays that are met a detector column at a time: indices of their views, and spans [view u 2].
Columns = namedtuple("Columns", ["views", "spans"])
#: The units of `Reads` from the first to one behind the last, counted through their views; of whose
#: rays those count whose main axis does (x, y, z).
Units = namedtuple("Units", ["axes", "first", "last"])
#: Slabs from `low` to one behind the last along a main axis, and the rays of this main axis.
Slabs = namedtuple("Slabs", ["axis", "low", "high"])


@scalar
def steps_of(rig, store, axis):
    """How the loops step through a store along rays of one main axis."""
    x, y, z = store.strides[0], store.strides[1], store.strides[2]
    more = FRONT - PAD[0]  # places of rays have the padding `PAD`
    origin = (rig.box[0] - more) * x + (rig.box[1] - more) * y + (rig.box[2] - more) * z
    return Steps(store.strides[axis], store.strides[3 - axis - store.near], 1, rig.samples, origin)


def rig_of(
    lines: Tensor,
    window: Sequence[float],
    occupancy: Occupancy,
    detector: Sequence[int],
    method: str,
) -> Rig:
    """What the loops know of the rays, and of the part of the volume that they are to meet."""
    maps = np.ascontiguousarray(lines.detach().numpy(), dtype=np.float64)
    ends = (float(window[0]), float(window[1]))
    shape = (int(detector[0]), int(detector[1]))
    number, samples = numbered(method)
    sizes, bounds = occupancy.shape[::-1], bounds_of(occupancy)
    return Rig(maps, ends, sizes, shape, number, samples, bounds, *bricks_of_rig(occupancy))


def bounds_of(occupancy: Occupancy) -> tuple[int, ...]:
    """The box (x0, y0, z0, x1, y1, z1) that rays are clipped to."""
    return (*occupancy.read.low[::-1], *occupancy.read.high[::-1])
