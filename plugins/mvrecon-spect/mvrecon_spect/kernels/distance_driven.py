"""Distance-driven pixels on the CPU: in each slab of the main axis, the mean over a footprint.

B. De Man & S. Basu, Distance-driven projection and backprojection in three dimensions, Phys. Med.
Biol. 49 (2004) 2463. The footprint is a rectangle along the voxels' axes, centred on the ray, with
the sides of the pixel's image in the slab, scaled to the area of that image; the weight of a voxel
is the part of the footprint in it. All rays of a view have the main axis of its centre, so that
footprints of adjacent pixels adjoin, except for rays that are `STEEPEST` times as fast along
another axis.

A footprint reaches at most int(side) + 2 voxels along an axis. They are processed in blocks of 2 x
2, like the cells of `mvrecon.kernels.rays.cpu.joseph`, each block in the slabs where footprints are
wide enough to reach it.
"""

from collections import namedtuple
from math import ceil, sqrt

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.cpu import joseph
from mvrecon.kernels.rays.cpu.trace import Space, at, flat_index, fold, main_axis, trace, traverse
from mvrecon.kernels.rays.lines import DIRECTION, JOSEPH, START

#: Ratio of a ray's components above which it has its own main axis instead of its view's.
STEEPEST = 5.0
#: Minimum side of a footprint in voxels, as next to a pinhole.
NARROWEST = 0.1
#: Slabs processed together by compiled loops; `Scratch` has room for as many more.
VECTORS = 32
#: Sides of a ray's footprints in voxels along the far (b) and near (c) axis: |start + s rate| at
#: the slab coordinate s.
Footprint = namedtuple("Footprint", ["start_b", "rate_b", "start_c", "rate_c"])
#: Whether rays are distance-driven; and for each slab and axis the start of the footprint in its
#: first voxel, and the inverse of its side.
Areas = namedtuple("Areas", ["used", "sides"])


@scalar
def axis_of(line, pixel):
    """The main axis of the view, or of a ray that is much faster along another axis."""
    axis, own = main_axis(line, 0.0, 0.0), main_axis(line, pixel[0], pixel[1])
    fast = abs(at(line, DIRECTION, own, pixel[0], pixel[1]))
    return own if fast > STEEPEST * abs(at(line, DIRECTION, axis, pixel[0], pixel[1])) else axis


@scalar
def footprint_of(line, axis, near, pixel):
    """The footprints of a ray with this main axis."""
    (u, v), far = pixel, 3 - axis - near
    parallel = True
    for i in range(3):
        parallel = parallel and line[DIRECTION, i, 0] == 0 and line[DIRECTION, i, 1] == 0
    D, kind = at(line, DIRECTION, axis, u, v), START if parallel else DIRECTION
    slope_b, slope_c = (
        at(line, DIRECTION, far, u, v) / D,
        at(line, DIRECTION, near, u, v) / D,
    )
    # images of the steps between columns and between rows, for cones per slab from the source
    column_b = line[kind, far, 0] - slope_b * line[kind, axis, 0]
    column_c = line[kind, near, 0] - slope_c * line[kind, axis, 0]
    row_b = line[kind, far, 1] - slope_b * line[kind, axis, 1]
    row_c = line[kind, near, 1] - slope_c * line[kind, axis, 1]
    b, c = max(abs(column_b), abs(row_b)), max(abs(column_c), abs(row_c))
    area = abs(column_b * row_c - column_c * row_b)
    scale = sqrt(area / (b * c)) if b * c > 0 else 1.0
    b, c = b * scale, c * scale
    if parallel:
        return Footprint(b, 0.0, c, 0.0)
    source = at(line, START, axis, u, v)
    return Footprint(-source * b / D, b / D, -source * c / D, c / D)


@scalar
def side(start, rate, s):
    """A side of the footprint at s."""
    return max(abs(start + s * rate), NARROWEST)


@scalar
def ray_of(space, line, axis, near, pixel, foot):
    """The ray of a pixel through the slabs in which its footprint touches the box of a `Space`."""
    half, box = space.sizes[axis] / 2, space.box
    b = max(side(foot.start_b, foot.rate_b, -half), side(foot.start_b, foot.rate_b, half))
    c = max(side(foot.start_c, foot.rate_c, -half), side(foot.start_c, foot.rate_c, half))
    b, c, far = int(ceil(b / 2)), int(ceil(c / 2)), 3 - axis - near
    x, y, z = (
        b if far == 0 else c if near == 0 else 0,
        b if far == 1 else c if near == 1 else 0,
        b if far == 2 else c if near == 2 else 0,
    )
    wider = (box[0] - x, box[1] - y, box[2] - z, box[3] + x, box[4] + y, box[5] + z)
    return trace(line, axis, near, pixel, Space(space.window, space.sizes, wider), JOSEPH)


@scalar
def cells(rig, ray, foot, span, steps, scratch):
    """Write the footprints of a ray in the slabs of a span; returns as `trace.traverse`."""
    count, lead = traverse(rig, ray, span, scratch.cells)
    share, slab, sides = scratch.cells.three, scratch.cells.four, scratch.areas.sides
    real = share.dtype.type
    course, half, number = joseph.course_of(ray, real), real(0.5), whole_vectors(count)
    for i in range(number):
        share[i] = min(course.end, slab[i] + half) - max(course.begin, slab[i] - half)
    b, c = (course.b, course.slope_b), (course.c, course.slope_c)
    side_b, side_c = (foot.start_b, foot.rate_b), (foot.start_c, foot.rate_c)
    _along(slab, b, side_b, scratch.cells.index_b, sides[0], sides[1], number)
    _along(slab, c, side_c, scratch.cells.index_c, sides[2], sides[3], number)
    return count, lead


@scalar
def whole_vectors(count):
    """`count` rounded up to whole vectors of a processor, whose loops process the rest singly."""
    return np.uint32((count + VECTORS - 1) // VECTORS * VECTORS)


@scalar
def _along(slab, place, sides, first, starts, inverses, number):
    """Write the first voxel of the footprints along an axis, their starts in it, and the inverses
    of their sides; places and sides are linear along the slabs.
    """
    real = slab.dtype.type
    half, least, start, rate = real(0.5), real(NARROWEST), real(sides[0]), real(sides[1])
    for i in range(number):
        width = max(abs(start + slab[i] * rate), least)
        low = place[0] + slab[i] * place[1] + half - half * width
        cell = np.int32(low)
        cell = np.int32(cell - np.int32(low < real(cell)))  # compilers vectorise no `floor`
        starts[i], inverses[i], first[i] = low - real(cell), real(1) / width, cell


@scalar
def _blocks(foot, slab, count):
    """Numbers of blocks along both axes that footprints reach in `count` slabs from `slab` on."""
    end = slab + count - 1
    b = max(side(foot.start_b, foot.rate_b, slab), side(foot.start_b, foot.rate_b, end))
    c = max(side(foot.start_c, foot.rate_c, slab), side(foot.start_c, foot.rate_c, end))
    return (int(b) + 3) // 2, (int(c) + 3) // 2


@scalar
def _reaching(start, rate, slab, count, block):
    """The half-open range of slabs, of `count` from `slab` on, whose footprints may reach a
    block.
    """
    least, one, two = 2 * block - 1.0, start + slab * rate, start + (slab + count - 1) * rate
    if block == 0 or one * two <= 0:
        return 0, count
    if max(abs(one), abs(two)) <= least:
        return 0, 0
    if min(abs(one), abs(two)) > least:
        return 0, count
    place = int(((least if one > 0 else -least) - start) / rate - slab)
    return (0, min(place + 2, count)) if abs(one) > least else (max(place, 0), count)


@scalar
def _block(rig, ray, foot, steps, scratch, count, block, rows):
    """Write the flat indices of a block of the footprints that may reach it, in a half-open range
    of slabs `rows` at most; returns the first of these slabs and their number.
    """
    cells, (b, c) = scratch.cells, (np.int32(2 * block[0]), np.int32(2 * block[1]))
    index, slab, first_b, first_c = cells.index, cells.four, cells.index_b, cells.index_c
    columns = _reaching(foot.start_c, foot.rate_c, np.float64(slab[0]), count, block[1])
    low, high = max(rows[0], columns[0]), min(rows[1], columns[1])
    least, centre, whole = np.int32(-1), slab.dtype.type(ray.centre), index.dtype.type
    # in the zero padding if it is outside of the volume
    top_b, top_c = np.int32(rig.sizes[ray.far] + 1), np.int32(rig.sizes[ray.near] + 1)
    number = np.uint32(max(high - low, 0))
    slab, first_b, first_c = slab[low:], first_b[low:], first_c[low:]
    for i in range(whole_vectors(number)):
        row = min(max(first_b[i] + b, least), top_b)
        column = min(max(first_c[i] + c, least), top_c)
        index[i] = flat_index(steps, np.int32(slab[i] + centre), row, column, whole)
    return low, number


@scalar
def _from(sides, start):
    """The rows of `Areas.sides` from a slab on, contiguous."""
    return sides[0][start:], sides[1][start:], sides[2][start:], sides[3][start:]


@scalar
def _part(start, per, j):
    """The part of a footprint in its voxel j."""
    real = type(start)
    one, none, at_j = real(1), real(0), real(np.int32(j))
    below = min(max((at_j - start) * per, none), one)
    return min(max((at_j + one - start) * per, none), one) - below


@scalar
def integrals(store, n, rig, ray, foot, steps, scratch, count, length, into):
    """Write the integrals of volume n over the footprints of a ray, with the length in a slab."""
    for i in range(np.uint32(count)):
        into[i] = 0
    cells, slab = scratch.cells, np.float64(scratch.cells.four[0])
    low, high = cells.low_parts, cells.high_parts
    down, across = _blocks(foot, slab, count)
    for j in range(down):
        rows = _reaching(foot.start_b, foot.rate_b, slab, count, j)
        for k in range(across):
            start, number = _block(rig, ray, foot, steps, scratch, count, (j, k), rows)
            joseph.fetch(store.pairs, n * store.size, steps.far, number, cells)
            share, sums = cells.three[start:], into[start:]
            of_b, per_b, of_c, per_c = _from(scratch.areas.sides, start)
            for i in range(whole_vectors(number) if start + number == count else number):
                c0 = _part(of_c[i], per_c[i], 2 * k)
                c1 = _part(of_c[i], per_c[i], 2 * k + 1)
                lower = _part(of_b[i], per_b[i], 2 * j) * (low[2 * i] * c0 + low[2 * i + 1] * c1)
                upper = _part(of_b[i], per_b[i], 2 * j + 1) * (
                    high[2 * i] * c0 + high[2 * i + 1] * c1
                )
                sums[i] += length * share[i] * (lower + upper)


@scalar
def total(store, n, rig, ray, foot, steps, traversed, scratch):
    """The sum of volume n along a ray, in voxels of the main axis."""
    count, lead = traversed
    one, terms = scratch.cells.three.dtype.type(1), scratch.cells.terms
    integrals(store, n, rig, ray, foot, steps, scratch, count, one, terms[lead:])
    return fold(terms, lead, count)


@scalar
def spread(store, n, rig, ray, foot, steps, count, scratch, value):
    """Add a value to volume n along a ray with the weights of `total`: its transpose."""
    cells, slab, pairs = scratch.cells, np.float64(scratch.cells.four[0]), store.pairs
    low, high, lowers, uppers = cells.low_parts, cells.high_parts, cells.low, cells.high
    offset, above = np.uint64(n * store.size), np.uint64(n * store.size) + np.uint64(steps.far)
    down, across = _blocks(foot, slab, count)
    for j in range(down):
        rows = _reaching(foot.start_b, foot.rate_b, slab, count, j)
        for k in range(across):
            start, number = _block(rig, ray, foot, steps, scratch, count, (j, k), rows)
            share = cells.three[start:]
            of_b, per_b, of_c, per_c = _from(scratch.areas.sides, start)
            for i in range(whole_vectors(number)):
                both = value * share[i]
                lower = both * _part(of_b[i], per_b[i], 2 * j)
                upper = both * _part(of_b[i], per_b[i], 2 * j + 1)
                c0 = _part(of_c[i], per_c[i], 2 * k)
                c1 = _part(of_c[i], per_c[i], 2 * k + 1)
                low[2 * i], low[2 * i + 1] = lower * c0, lower * c1
                high[2 * i], high[2 * i + 1] = upper * c0, upper * c1
            for i in range(number):
                at_pair = np.uint64(cells.index[i])
                pairs[at_pair + offset] += lowers[i]
                pairs[at_pair + above] += uppers[i]
