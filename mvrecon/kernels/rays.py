"""Where one ray runs through the volume, for every compiled kernel.

A ray is first clipped to the slabs in which it can touch the volume, so that no later loop tests a bound. Slabs are
counted along its main axis; the other two axes b, c follow cyclically. `joseph.py` and `siddon.py` go on from here.
Everything is scalar and knows no CPU, so that a GPU back end can compile the same source.
"""

from collections import namedtuple
from math import ceil, floor, sqrt

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.lines import TIE

JOSEPH, SIDDON = 0, 1
#: One ray: main axis; transverse padded coordinates at the centre slab and their slopes; mm per slab; where it begins
#: and ends (slab coordinate about the centre); first slab and the one behind the last; the centre's slab coordinate.
Ray = namedtuple("Ray", ["axis", "b", "slope_b", "c", "slope_c", "length", "begin", "end", "first", "last", "centre"])


@scalar
def at(line, kind, axis, u, v):
    """Component `axis` of one of a view's four linear maps, at the pixel (u, v) counted from the detector's centre."""
    return line[kind, axis, 0] * u + line[kind, axis, 1] * v + line[kind, axis, 2]


@scalar
def main_axis(line, u, v):
    """The axis along which the ray runs fastest."""
    x, y, z = abs(at(line, 0, 0, u, v)), abs(at(line, 0, 1, u, v)), abs(at(line, 0, 2, u, v))
    if x * (1 + TIE) >= y and x * (1 + 2 * TIE) >= z:
        return 0
    return 1 if y * (1 + TIE) >= z else 2


@scalar
def transverse(value, slope, half, lower, upper):
    """The part of (lower, upper) in which -half <= value + s slope < half."""
    if slope == 0:
        return (lower, upper) if -half <= value < half else (0.0, -1.0)
    one, two = (-half - value) / slope, (half - value) / slope
    return max(lower, min(one, two)), min(upper, max(one, two))


@scalar
def trace(line, axis, u, v, window, sizes, method):
    """Where the ray of a pixel runs; `first >= last` says that it misses. All in float64.

    Args:
        line: the view's maps [4 3 3], see `lines.py`.
        axis: the ray's main axis.
        u, v: the pixel, counted from the detector's centre.
        window: the part of the ray that counts, as fractions of its direction.
        sizes: voxels along (x, y, z).
        method: JOSEPH or SIDDON.
    """
    b, c = (axis + 1) % 3, (axis + 2) % 3
    D = at(line, 0, axis, u, v)
    slope_b, slope_c = at(line, 0, b, u, v) / D, at(line, 0, c, u, v) / D
    # divided, not multiplied by 1 / D: a ray on a face must stay on it to the last bit
    value_b, value_c = -at(line, 1, c, u, v) / D, at(line, 1, b, u, v) / D
    world = at(line, 3, 0, u, v) ** 2 + at(line, 3, 1, u, v) ** 2 + at(line, 3, 2, u, v) ** 2
    one = at(line, 2, axis, u, v) + window[0] * D
    two = at(line, 2, axis, u, v) + window[1] * D
    half = sizes[axis] / 2.0
    begin, end = max(-half, min(one, two)), min(half, max(one, two))
    # hat functions reach one voxel from the outermost centres, cells half a voxel
    reach, margin = (0.5, 0.0) if method == JOSEPH else (0.0, 0.5)
    lower, upper = transverse(value_b, slope_b, sizes[b] / 2.0 + reach, begin - 0.5 + margin, end + 0.5 - margin)
    lower, upper = transverse(value_c, slope_c, sizes[c] / 2.0 + reach, lower, upper)
    centre = (sizes[axis] - 1) / 2.0
    first, last = 0, 0
    if begin < end and lower <= upper:
        first = max(0, int(ceil(lower + centre - margin)))
        last = min(sizes[axis], int(floor(upper + centre + margin)) + 1)
    b0, c0 = value_b + (sizes[b] - 1) / 2.0 + 1, value_c + (sizes[c] - 1) / 2.0 + 1
    return Ray(axis, b0, slope_b, c0, slope_c, sqrt(world) / abs(D), begin, end, first, last, centre)


@scalar
def within(ray, low, high):
    """The slabs of a ray that lie in [low, high)."""
    first, last = max(ray.first, low), min(ray.last, high)
    return Ray(
        ray.axis, ray.b, ray.slope_b, ray.c, ray.slope_c, ray.length, ray.begin, ray.end, first, last, ray.centre
    )
