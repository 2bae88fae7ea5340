"""Joseph's method: in a slab of the main axis, bilinear in the two other axes.

P. M. Joseph, An improved algorithm for reprojecting rays through pixel images, IEEE Trans. Med.
Imaging 1, 1982.

Two adjacent corners are fetched as one complex number, which leaves arithmetic to loops without
gathers. `real` and `whole` are the types of weights and of flat indices.
"""

from typing import Any, NamedTuple

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.cpu import trace


class Cell(NamedTuple):
    """A bilinear cell: its lower corner along the far and the near axis, and the position in it
    towards the upper one.
    """

    iy: Any
    iz: Any
    y: Any
    z: Any


class Course(NamedTuple):
    """The course of a ray, see `trace.Ray`, in the type of weights."""

    b: Any
    slope_b: Any
    c: Any
    slope_c: Any
    begin: Any
    end: Any
    centre: Any


@scalar
def course_of(ray, real):
    """The course of a ray."""
    b, slope_b, c, slope_c = real(ray.b), real(ray.slope_b), real(ray.c), real(ray.slope_c)
    return Course(b, slope_b, c, slope_c, real(ray.begin), real(ray.end), real(ray.centre))


@scalar
def split(place, real):
    """The lower neighbour of a padded place along an axis, and the weight of the upper one."""
    cell = np.int32(place)
    return cell, place - real(cell)


@scalar
def cell(course, s, real):
    """The bilinear cell that a ray meets at s."""
    iy, y = split(course.b + s * course.slope_b, real)
    iz, z = split(course.c + s * course.slope_c, real)
    return Cell(iy, iz, y, z)


@scalar
def face(low, beside_low, high, beside_high, y, z):
    """The bilinear value at the place (y, z) between four corners, and its slopes along the far and
    the near axis.
    """
    low_z, high_z = beside_low - low, beside_high - high
    lower, upper = low + z * low_z, high + z * high_z
    return lower + y * (upper - lower), upper - lower, low_z + y * (high_z - low_z)


@scalar
def face_at(flat, k, steps, y, z):
    """`face` of the cell at the flat index k."""
    above, near = k + steps.far, steps.near
    return face(flat[k], flat[k + near], flat[above], flat[above + near], y, z)


@scalar
def with_slab(sums, course, s, share, place):
    """Slopes including one more slab, at s, with the ray's share of it; place as of `face`."""
    value, slope_b, slope_c = place
    half, none = type(s)(0.5), type(s)(0)
    along_b, along_c = share * slope_b, share * slope_c
    return trace.Slopes(
        sums.total + share * value,
        sums.by_b + along_b,
        sums.by_slope_b + s * along_b,
        sums.by_c + along_c,
        sums.by_slope_c + s * along_c,
        sums.at_begin + (value if s - half < course.begin else none),
        sums.at_end + (value if s + half > course.end else none),
    )


@scalar
def cells(ray, count, steps, scratch):
    """For each slab of `summation.traverse`: flat index of a bilinear cell, position in it towards
    b and c, length.
    """
    index, y, z, share, slab = scratch.index, scratch.one, scratch.two, scratch.three, scratch.four
    real, whole = y.dtype.type, index.dtype.type
    course, half = course_of(ray, real), real(0.5)
    for i in range(np.uint32(count)):
        s = slab[i]
        iy, iz, y[i], z[i] = cell(course, s, real)
        share[i] = min(course.end, s + half) - max(course.begin, s - half)
        index[i] = trace.flat_index(steps, np.int32(s + course.centre), iy, iz, whole)


@scalar
def fetch(pairs, offset, far, count, scratch):
    """The two pairs of corners of every cell, as complex numbers."""
    index, low, high = scratch.index, scratch.low, scratch.high
    above = np.uint64(offset) + np.uint64(far)
    for i in range(np.uint32(count)):
        k = np.uint64(index[i])
        low[i], high[i] = pairs[k + np.uint64(offset)], pairs[k + above]


@scalar
def integrals(store, n, steps, count, scratch, length, into):
    """Write the integrals of volume n over a ray's cells, with the length in a slab."""
    fetch(store.pairs, n * store.size, steps.far, count, scratch)
    y, z, share = scratch.one, scratch.two, scratch.three
    low, high, one = scratch.low_parts, scratch.high_parts, y.dtype.type(1)
    for i in range(np.uint32(count)):
        rest = one - z[i]
        lower = trace.blend(low[2 * i], low[2 * i + 1], z[i], rest)
        upper = trace.blend(high[2 * i], high[2 * i + 1], z[i], rest)
        into[i] = length * share[i] * trace.blend(lower, upper, y[i], one - y[i])


@scalar
def sum(store, n, steps, traversed, scratch):
    """The sum of volume n along a ray, in voxels of the main axis; traversed = (number of cells,
    lead of their terms).
    """
    count, lead = traversed
    one = scratch.one.dtype.type(1)
    integrals(store, n, steps, count, scratch, one, scratch.terms[lead:])
    return trace.fold(scratch.terms, lead, count)


@scalar
def spread(store, n, steps, count, scratch, value):
    """Add a value to volume n along a ray with the weights of `sum`: its transpose."""
    y, z, share, low, high = (
        scratch.one,
        scratch.two,
        scratch.three,
        scratch.low_parts,
        scratch.high_parts,
    )
    one = y.dtype.type(1)
    for i in range(np.uint32(count)):
        both, rest = value * share[i], one - z[i]
        lower, upper = both * (one - y[i]), both * y[i]
        low[2 * i], low[2 * i + 1] = lower * rest, lower * z[i]
        high[2 * i], high[2 * i + 1] = upper * rest, upper * z[i]
    pairs, index, lowers, uppers = store.pairs, scratch.index, scratch.low, scratch.high
    offset, above = np.uint64(n * store.size), np.uint64(n * store.size) + np.uint64(steps.far)
    for i in range(np.uint32(count)):
        k = np.uint64(index[i])
        pairs[k + offset] += lowers[i]
        pairs[k + above] += uppers[i]


@scalar
def sum_lanes(store, group, steps, count, scratch):
    """The sums of four volumes along a ray, in voxels of the main axis, into scratch.totals."""
    index, y, z, share, values = (
        scratch.index,
        scratch.one,
        scratch.two,
        scratch.three,
        store.values,
    )
    first, four = np.uint64(group * store.size) * np.uint64(trace.LANES), np.uint64(trace.LANES)
    far, none, one = np.uint64(steps.far) * four, y.dtype.type(0), y.dtype.type(1)
    totals = (none, none, none, none)
    for i in range(np.uint32(count)):
        k, rest = np.uint64(index[i]) * four + first, one - z[i]
        lower = trace.mix(trace.take(values, k), trace.take(values, k + four), z[i], rest)
        upper = trace.mix(
            trace.take(values, k + far), trace.take(values, k + far + four), z[i], rest
        )
        totals = trace.plus(
            totals, trace.times(share[i], trace.mix(lower, upper, y[i], one - y[i]))
        )
    trace.put(scratch.totals, np.uint64(0), totals)


@scalar
def spread_lanes(store, group, steps, count, scratch):
    """Add scratch.totals to four volumes along a ray: the transpose of `sum_lanes`."""
    index, y, z, share, values = (
        scratch.index,
        scratch.one,
        scratch.two,
        scratch.three,
        store.values,
    )
    first, four = np.uint64(group * store.size) * np.uint64(trace.LANES), np.uint64(trace.LANES)
    far, totals, one = (
        np.uint64(steps.far) * four,
        trace.take(scratch.totals, np.uint64(0)),
        y.dtype.type(1),
    )
    for i in range(np.uint32(count)):
        k, rest = np.uint64(index[i]) * four + first, one - z[i]
        low, high = share[i] * (one - y[i]), share[i] * y[i]
        trace.put(values, k, trace.more(trace.take(values, k), low * rest, totals))
        trace.put(values, k + four, trace.more(trace.take(values, k + four), low * z[i], totals))
        trace.put(values, k + far, trace.more(trace.take(values, k + far), high * rest, totals))
        trace.put(
            values,
            k + far + four,
            trace.more(trace.take(values, k + far + four), high * z[i], totals),
        )


@scalar
def slopes(store, n, steps, count, scratch, ray):
    """Derivatives of a ray's `sum` by its position, as `trace.Slopes`."""
    fetch(store.pairs, n * store.size, steps.far, count, scratch)
    y, z, share, slab, low, high = (
        scratch.one,
        scratch.two,
        scratch.three,
        scratch.four,
        scratch.low_parts,
        scratch.high_parts,
    )
    course, none = course_of(ray, y.dtype.type), y.dtype.type(0)
    sums = trace.Slopes(none, none, none, none, none, none, none)
    for i in range(np.uint32(count)):
        place = face(low[2 * i], low[2 * i + 1], high[2 * i], high[2 * i + 1], y[i], z[i])
        sums = with_slab(sums, course, slab[i], share[i], place)
    real = np.float64
    return trace.Slopes(
        *(real(sums.total), real(sums.by_b), real(sums.by_slope_b)),
        *(real(sums.by_c), real(sums.by_slope_c)),
        *(real(sums.at_begin), real(sums.at_end)),
    )
