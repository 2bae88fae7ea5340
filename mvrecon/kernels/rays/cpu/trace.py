"""The CPU loops' view of a rig, the course of a ray through the volume, and its integral's
derivatives by the geometry; `cuda/source/2_trace.cu` is the same in C++.

A ray is first clipped to the slabs in which it can touch the volume, so that later loops test no
bounds. Slabs are counted along its main axis; of the two other axes the `near` one is contiguous in
memory, the `far` one is not.

Numbers of four adjacent volumes are written out, so that they are processed as one vector: in a
loop a store would precede the next load, which prevents vectorisation.

A sum is kept in eight parts, one for each slab of a brick, each over every eighth slab of the
volume. Zero terms may then be skipped or not without changing any bit, however the compiler
vectorises the terms.
"""

from collections import namedtuple
from collections.abc import Sequence
from math import ceil, floor, sqrt
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from mvrecon.kernels.compiling import ordered, scalar
from mvrecon.kernels.rays.cpu.packed_volume import FRONT
from mvrecon.kernels.rays.lines import JOSEPH, SIDDON, TIE, TRILINEAR, numbered
from mvrecon.kernels.rays.occupancy import EDGE, Occupancy, bricks_of_rig
from mvrecon.kernels.rows import PAD

#: Number of volumes that may be adjacent.
LANES = 4
#: Deviation of a ray in single from double precision, in voxels.
SLACK = 1e-3


@scalar
def take(values, k):
    """The four numbers at k."""
    return values[k], values[k + np.uint64(1)], values[k + np.uint64(2)], values[k + np.uint64(3)]


@scalar
def put(values, k, four):
    """Write four numbers at k."""
    values[k], values[k + np.uint64(1)], values[k + np.uint64(2)], values[k + np.uint64(3)] = four


@ordered
def blend(low, high, share, rest):
    """The sum of `rest` = 1 - share of `low` and `share` of `high`, as in the transpose.

    low + share * (high - low) saves a product, but rounds to the precision of the greater: with
    hardly any weight on `low`, zero in `high` would lose the digits that the transpose keeps. In
    another order compilers replace one by the other.
    """
    return rest * low + share * high


@scalar
def mix(low, high, share, rest):
    """`blend` of each."""
    return (
        blend(low[0], high[0], share, rest),
        blend(low[1], high[1], share, rest),
        blend(low[2], high[2], share, rest),
        blend(low[3], high[3], share, rest),
    )


@scalar
def times(weight, four):
    """weight * four."""
    return weight * four[0], weight * four[1], weight * four[2], weight * four[3]


@ordered
def plus(four, other):
    """four + other, in this order: a ray's sum must not depend on the number of its zero terms."""
    return four[0] + other[0], four[1] + other[1], four[2] + other[2], four[3] + other[3]


@scalar
def more(four, weight, other):
    """four + weight * other."""
    return (
        four[0] + weight * other[0],
        four[1] + weight * other[1],
        four[2] + weight * other[2],
        four[3] + weight * other[3],
    )


@ordered
def fold(terms, lead, count):
    """The sum of terms[lead : lead + count], a term at k in the part k % 8; writes zeros around
    them.
    """
    none = terms.dtype.type(0)
    blocks = (lead + count + EDGE - 1) // EDGE
    for k in range(lead):
        terms[k] = none
    for k in range(lead + count, blocks * EDGE):
        terms[k] = none
    a = b = c = d = e = f = g = h = none
    for block in range(np.uint32(blocks)):
        k = np.uint64(block) * np.uint64(EDGE)
        a += terms[k]
        b += terms[k + np.uint64(1)]
        c += terms[k + np.uint64(2)]
        d += terms[k + np.uint64(3)]
        e += terms[k + np.uint64(4)]
        f += terms[k + np.uint64(5)]
        g += terms[k + np.uint64(6)]
        h += terms[k + np.uint64(7)]
    return ((a + e) + (c + g)) + ((b + f) + (d + h))


@scalar
def bricks_between(low, high, size):
    """The first and the last brick of the voxels from low to high, within the existing ones."""
    first = min(max(int(np.floor(low - SLACK)), 0), size - 1)
    last = min(max(int(np.floor(high + SLACK)), 0), size - 1)
    return first // EDGE, last // EDGE


@scalar
def empty(rig, ray, low, high):
    """Whether all cells that a ray meets in the slabs [low, high) of one layer of bricks are in
    empty bricks.
    """
    # positions of lower corners, without padding; siddon's cells are met from face to face
    more, half = (0.5, 0.5) if rig.method == SIDDON else (0.0, 0.0)
    s0, s1 = low - ray.centre - half, high - 1 - ray.centre + half
    y0, y1 = ray.b - 1 + more + s0 * ray.slope_b, ray.b - 1 + more + s1 * ray.slope_b
    z0, z1 = ray.c - 1 + more + s0 * ray.slope_c, ray.c - 1 + more + s1 * ray.slope_c
    first_b, last_b = bricks_between(min(y0, y1), max(y0, y1), rig.sizes[ray.far])
    first_c, last_c = bricks_between(min(z0, z1), max(z0, z1), rig.sizes[ray.near])
    base = low // EDGE * rig.strides[ray.axis]
    for i in range(first_b, last_b + 1):
        for j in range(first_c, last_c + 1):
            if rig.bricks[base + i * rig.strides[ray.far] + j * rig.strides[ray.near]]:
                return False
    return True


@scalar
def traverse(rig, ray, span, scratch):
    """Write the positions of the slabs in span = (first, last) that are not known to be empty into
    scratch.four.

    Returns:
        their number; start of their terms, see `fold`.
    """
    slab = scratch.four
    real, whole = slab.dtype.type, scratch.index.dtype.type
    if not len(rig.bricks):
        start, count = real(span[0] - ray.centre), np.uint32(max(0, span[1] - span[0]))
        for i in range(count):
            slab[i] = real(whole(i)) + start
        return count, np.uint32(span[0] % EDGE)
    count, lead = np.uint32(0), np.uint32(0)
    low = span[0]
    while low < span[1]:
        high = min(span[1], low // EDGE * EDGE + EDGE)
        if not empty(rig, ray, low, high):
            lead = np.uint32(low % EDGE) if count == 0 else lead
            for k in range(low, high):
                slab[count] = real(k - ray.centre)
                count += np.uint32(1)
        low = high
    return count, lead


#: lines [m 4 3 k], window (w0, w1), sizes (x, y, z), detector (rows, columns), method, samples a
#: ray (trilinear); occupied box, see `Space`; bricks, their strides and heights, see
#: `occupancy.bricks_of_rig`.
Rig = namedtuple(
    "Rig",
    "lines window sizes detector method samples box bricks strides heights",
)
#: Rays processed singly, in units of a row or column of pixels, see `loops.ray_span`: indices of
#: their views; whether units are columns (tall); spans [view unit 2], see `footprint.spans_of`.
Reads = namedtuple("Reads", ["views", "tall", "spans"])
#: Rays processed by detector columns: indices of their views, and spans [view u 2].
Columns = namedtuple("Columns", ["views", "spans"])
#: A half-open range of units of `Reads`, counted through their views; the allowed main axes (x, y,
#: z) of rays.
Units = namedtuple("Units", ["axes", "first", "last"])
#: A half-open range of slabs along a main axis, and that axis as one of (x, y, z).
Slabs = namedtuple("Slabs", ["axis", "axes", "low", "high"])
#: One ray: main, far and near axis; padded coordinates along far (b) and near (c) at the centre
#: slab, and their slopes; mm per slab; start and end (slab coordinate about the centre); what
#: bounds them, see below; entry into and exit from the box; its first slab there, one past the
#: last; the centre's slab coordinate.
Ray = namedtuple(
    "Ray",
    "axis far near b slope_b c slope_c length begin end from_ to enter leave first last centre",
)
#: The domain of a ray: its valid range (w0, w1), voxels along (x, y, z), and the occupied box (x0,
#: y0, z0, x1, y1, z1).
Space = namedtuple("Space", ["window", "sizes", "box"])
#: Bounds of a ray: a face across its main axis, its own end, or a face across its far or near axis.
FACE, OWN, FAR, NEAR = 0, 1, 2, 3


def rig_of(
    lines: Tensor,
    window: Sequence[float],
    occupancy: Occupancy,
    detector: Sequence[int],
    method: str,
) -> Rig:
    """Arguments of the loops: the rays, and the part of the volume to process."""
    maps = np.ascontiguousarray(lines.detach().numpy(), dtype=np.float64)
    ends = (float(window[0]), float(window[1]))
    shape = (int(detector[0]), int(detector[1]))
    number, samples = numbered(method)
    sizes, bounds = occupancy.shape[::-1], bounds_of(occupancy)
    return Rig(maps, ends, sizes, shape, number, samples, bounds, *bricks_of_rig(occupancy))


def bounds_of(occupancy: Occupancy) -> tuple[int, ...]:
    """The box (x0, y0, z0, x1, y1, z1) to which rays are clipped."""
    return (*occupancy.read.low[::-1], *occupancy.read.high[::-1])


@scalar
def from_centre(rig, u, v):
    """A pixel (u, v), counted from the detector's centre."""
    rows, columns = rig.detector
    return u - (columns - 1) / 2, v - (rows - 1) / 2


@scalar
def at(line, kind, axis, u, v):
    """Component `axis` of one of a view's four linear maps, at the pixel (u, v) counted from the
    detector's centre.
    """
    if line.shape[2] == 1:  # an explicit ray is the same for every pixel
        return line[kind, axis, 0]
    return line[kind, axis, 0] * u + line[kind, axis, 1] * v + line[kind, axis, 2]


@scalar
def main_axis(line, u, v):
    """The axis along which the ray runs fastest."""
    x, y, z = abs(at(line, 0, 0, u, v)), abs(at(line, 0, 1, u, v)), abs(at(line, 0, 2, u, v))
    if x * (1 + TIE) >= y and x * (1 + 2 * TIE) >= z:
        return 0
    return 1 if y * (1 + TIE) >= z else 2


@scalar
def crossing(line, axis, other, u, v):
    """The other coordinate of a ray's intersection with the centre slab, in voxels from
    the centre.
    """
    moment = at(line, 1, 3 - axis - other, u, v)
    # divided, not multiplied by 1 / D, so that a ray on a face stays exactly on it
    return (moment if (other + 1) % 3 == axis else -moment) / at(line, 0, axis, u, v)


@scalar
def slab_length(line, axis, u, v):
    """Mm of a ray in one slab of its main axis."""
    x, y, z = at(line, 3, 0, u, v), at(line, 3, 1, u, v), at(line, 3, 2, u, v)
    return sqrt(x * x + y * y + z * z) / abs(at(line, 0, axis, u, v))


@scalar
def transverse(value, slope, low, high, lower, upper):
    """The part of (lower, upper) in which low <= value + s slope < high."""
    if slope == 0:
        return (lower, upper) if low <= value < high else (0.0, -1.0)
    one, two = (low - value) / slope, (high - value) / slope
    return max(lower, min(one, two)), min(upper, max(one, two))


@scalar
def faces(space, axis, reach):
    """Both faces of the box across an axis, from the volume's centre, with the reach of a voxel's
    values.
    """
    half = space.sizes[axis] / 2.0
    return space.box[axis] - half - reach, space.box[3 + axis] - half + reach


@scalar
def shortened(across, begin, end, from_, to):
    """The part of a ray between the faces across its far and near axis, and its bounds; across as
    `transverse`.
    """
    (value_b, slope_b, half_b), (value_c, slope_c, half_c) = across
    far_lower, far_upper = transverse(value_b, slope_b, -half_b, half_b, begin, end)
    lower, upper = transverse(value_c, slope_c, -half_c, half_c, far_lower, far_upper)
    from_ = NEAR if lower > far_lower else FAR if far_lower > begin else from_
    to = NEAR if upper < far_upper else FAR if far_upper < end else to
    return lower, upper, from_, to


@scalar
def trace(line, axis, near, pixel, space, method):
    """Compute the course of a pixel's ray in float64; `first >= last` for a miss.

    The box affects only the range of slabs, so skipping zeros changes no bit of a sum.
    Args:
        line: the view's maps [4 3 3], see `lines.py`.
        axis: the ray's main axis.
        near: the other axis that is contiguous in memory.
        pixel: the pixel (u, v), counted from the detector's centre.
        space: window, sizes and box, of a `Space` or a larger tuple.
        method: JOSEPH, SIDDON or TRILINEAR.
    """
    (u, v), far = pixel, 3 - axis - near
    D = at(line, 0, axis, u, v)
    slope_b, slope_c = at(line, 0, far, u, v) / D, at(line, 0, near, u, v) / D
    value_b, value_c = crossing(line, axis, far, u, v), crossing(line, axis, near, u, v)
    one = at(line, 2, axis, u, v) + space.window[0] * D
    two = at(line, 2, axis, u, v) + space.window[1] * D
    # reach of a voxel's values: its own cell, or its neighbours' centres (hat functions)
    reach = 0.0 if method == SIDDON else 0.5
    half = space.sizes[axis] / 2.0 + (0.5 if method == TRILINEAR else 0.0)
    begin, end = max(-half, min(one, two)), min(half, max(one, two))
    from_, to = OWN if begin > -half else FACE, OWN if end < half else FACE
    if method == TRILINEAR:  # its samples are spaced along its way through the whole volume
        across = (
            (value_b, slope_b, space.sizes[far] / 2 + reach),
            (value_c, slope_c, space.sizes[near] / 2 + reach),
        )
        begin, end, from_, to = shortened(across, begin, end, from_, to)
    # a slab counts where it overlaps the ray
    slack, margin = (0.5, 0.0) if method == JOSEPH else (0.0, 0.5 if method == SIDDON else 1.0)
    enter, leave = transverse(
        value_b, slope_b, *faces(space, far, reach), begin - slack, end + slack
    )
    enter, leave = transverse(value_c, slope_c, *faces(space, near, reach), enter, leave)
    centre, first, last = (space.sizes[axis] - 1) / 2.0, 0, 0
    if begin < end and enter <= leave:
        first = max(space.box[axis], int(ceil(enter + centre - margin)))
        last = min(space.box[3 + axis], int(floor(leave + centre + margin)) + 1)
        # a ray may end on a face, or rounded beyond it; samples of "trilinear" are between slabs
        if method != TRILINEAR:
            first += int(first + 0.5 <= begin + centre)
            last -= int(last - 1.5 >= end + centre)
    b0, c0 = value_b + (space.sizes[far] - 1) / 2.0 + 1, value_c + (space.sizes[near] - 1) / 2.0 + 1
    return Ray(
        *(axis, far, near, b0, slope_b, c0, slope_c, slab_length(line, axis, u, v)),
        *(begin, end, from_, to, enter, leave, first, last, centre),
    )


@scalar
def missing(axis):
    """A ray with a main axis that misses everything."""
    none = 0.0
    return Ray(
        *(axis, 0, 0, none, none, none, none, none),
        *(none, none, FACE, FACE, none, none, 0, 0, none),
    )


@scalar
def within(ray, low, high):
    """A ray's first slab in [low, high), and one past its last."""
    return max(ray.first, low), min(ray.last, high)


class Steps(NamedTuple):
    """Flat strides along the ray's main, far and near axis; samples per ray; offset of the box's
    first voxel from the volume's in a store of the box only.
    """

    along: Any
    far: Any
    near: Any
    samples: Any
    origin: Any


@scalar
def steps_of(rig, store, axis):
    """The steps through a store along rays of one main axis."""
    x, y, z = store.strides[0], store.strides[1], store.strides[2]
    more = FRONT - PAD[0]  # positions of rays have the padding `PAD`
    origin = (rig.box[0] - more) * x + (rig.box[1] - more) * y + (rig.box[2] - more) * z
    return Steps(store.strides[axis], store.strides[3 - axis - store.near], 1, rig.samples, origin)


@scalar
def flat_index(steps, k, iy, iz, whole):
    """The flat index of a voxel, of type `whole`: slab k counted from the volume, the others with
    padding.
    """
    slab, row = whole(whole(k + 1) * whole(steps.along)), whole(whole(iy) * whole(steps.far))
    return whole(
        whole(whole(slab + row) + whole(whole(iz) * whole(steps.near))) - whole(steps.origin)
    )


class Slopes(NamedTuple):
    """Derivatives of a ray's sum by its position.

    The sum, in voxels of the main axis; its derivatives by b, slope_b, c, slope_c, see `trace.Ray`;
    the volume at the ray's start and end inside the box.
    """

    total: Any
    by_b: Any
    by_slope_b: Any
    by_c: Any
    by_slope_c: Any
    at_begin: Any
    at_end: Any


@scalar
def pull_back(line, ray, p, window, value, slopes, change):
    """Add to a row's `change` [4 3 k] the derivative of value * (one ray's integral) by the maps in
    `line`, at the pixel p = (u, v, 1).
    """
    axis, b, c = ray.axis, ray.far, ray.near
    D = at(line, 0, axis, p[0], p[1])
    value_b, value_c = crossing(line, axis, b, p[0], p[1]), crossing(line, axis, c, p[0], p[1])
    across = (
        slopes.by_b * value_b
        + slopes.by_slope_b * ray.slope_b
        + slopes.by_c * value_c
        + slopes.by_slope_c * ray.slope_c
    )
    scale = ray.length * value
    by_D = -(across + slopes.total) / D
    near, far = (window[0], window[1]) if D > 0 else (window[1], window[0])
    # an unlimited end is never inside the box, and infinity times zero is NaN
    by_D -= slopes.at_begin * near if slopes.at_begin != 0 else 0.0
    by_D += slopes.at_end * far if slopes.at_end != 0 else 0.0
    world = (ray.length * D) ** 2
    turn_b = 1.0 if (b + 1) % 3 == axis else -1.0
    first = 3 - line.shape[2]
    for k in range(first, 3):
        change[0, axis, k - first] += scale * by_D * p[k]
        change[0, b, k - first] += scale * slopes.by_slope_b / D * p[k]
        change[0, c, k - first] += scale * slopes.by_slope_c / D * p[k]
        change[1, c, k - first] += turn_b * scale * slopes.by_b / D * p[k]
        change[1, b, k - first] -= turn_b * scale * slopes.by_c / D * p[k]
        change[2, axis, k - first] += scale * (slopes.at_end - slopes.at_begin) * p[k]
        for x in range(3):
            along = at(line, 3, x, p[0], p[1])
            change[3, x, k - first] += scale * slopes.total * along / world * p[k]
