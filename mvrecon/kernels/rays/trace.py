"""Where one ray runs through the volume, for every compiled kernel.

A ray is first clipped to the slabs in which it can touch the volume, so that no later loop tests a bound. Slabs are
counted along its main axis; of the two other axes the `near` one is contiguous in memory, the `far` one is not.
Everything is scalar and knows no CPU, so that a GPU back end can compile the same source.
"""

from collections import namedtuple
from math import ceil, floor, sqrt

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.lines import TIE

JOSEPH, SIDDON, TRILINEAR = 0, 1, 2
METHODS = {"joseph": JOSEPH, "siddon": SIDDON, "trilinear": TRILINEAR}

#: One ray: main, far and near axis; padded coordinates along far (b) and near (c) at the centre slab, and their slopes;
#: mm per slab; where it begins and ends (slab coordinate about the centre); what bounds the beginning and the end, see
#: below; first slab and the one behind the last; the centre's slab coordinate.
Ray = namedtuple(
    "Ray",
    ["axis", "far", "near", "b", "slope_b", "c", "slope_c", "length"]
    + ["begin", "end", "from_", "to", "first", "last", "centre"],
)
#: What bounds a ray: a face across its main axis, its own end, or a face across its far or near axis.
FACE, OWN, FAR, NEAR = 0, 1, 2, 3


def numbered(method: str) -> tuple[int, int]:
    """The number of a method, and its samples a ray: "trilinear" has them behind its name, ":samples"."""
    name, _, samples = method.partition(":")
    return METHODS[name], int(samples or 0)


@scalar
def at(line, kind, axis, u, v):
    """Component `axis` of one of a view's four linear maps, at the pixel (u, v) counted from the detector's centre."""
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
    """Where the ray crosses the centre slab: its coordinate along the other axis, in voxels from the centre."""
    moment = at(line, 1, 3 - axis - other, u, v)
    # divided, not multiplied by 1 / D: a ray on a face must stay on it to the last bit
    return (moment if (other + 1) % 3 == axis else -moment) / at(line, 0, axis, u, v)


@scalar
def slab_length(line, axis, u, v):
    """Mm of a ray in one slab of its main axis."""
    x, y, z = at(line, 3, 0, u, v), at(line, 3, 1, u, v), at(line, 3, 2, u, v)
    return sqrt(x * x + y * y + z * z) / abs(at(line, 0, axis, u, v))


@scalar
def transverse(value, slope, half, lower, upper):
    """The part of (lower, upper) in which -half <= value + s slope < half."""
    if slope == 0:
        return (lower, upper) if -half <= value < half else (0.0, -1.0)
    one, two = (-half - value) / slope, (half - value) / slope
    return max(lower, min(one, two)), min(upper, max(one, two))


@scalar
def trace(line, axis, near, pixel, window, sizes, method):
    """Where the ray of a pixel runs; `first >= last` says that it misses. All in float64.

    Args:
        line: the view's maps [4 3 3], see `lines.py`.
        axis: the ray's main axis.
        near: the other axis that is contiguous in memory.
        pixel: the pixel (u, v), counted from the detector's centre.
        window: the part of the ray that counts, as fractions of its direction.
        sizes: voxels along (x, y, z).
        method: JOSEPH, SIDDON or TRILINEAR.
    """
    (u, v), far = pixel, 3 - axis - near
    D = at(line, 0, axis, u, v)
    slope_b, slope_c = at(line, 0, far, u, v) / D, at(line, 0, near, u, v) / D
    value_b, value_c = crossing(line, axis, far, u, v), crossing(line, axis, near, u, v)
    one = at(line, 2, axis, u, v) + window[0] * D
    two = at(line, 2, axis, u, v) + window[1] * D
    # hat functions reach one voxel from the outermost centres, cells half a voxel
    reach = 0.0 if method == SIDDON else 0.5
    half = sizes[axis] / 2.0 + (0.5 if method == TRILINEAR else 0.0)
    begin, end = max(-half, min(one, two)), min(half, max(one, two))
    from_, to = OWN if begin > -half else FACE, OWN if end < half else FACE
    # a slab counts where it overlaps the ray
    slack, margin = (0.5, 0.0) if method == JOSEPH else (0.0, 0.5 if method == SIDDON else 1.0)
    lower, upper = transverse(value_b, slope_b, sizes[far] / 2.0 + reach, begin - slack, end + slack)
    far_lower, far_upper = lower, upper
    lower, upper = transverse(value_c, slope_c, sizes[near] / 2.0 + reach, lower, upper)
    centre, first, last = (sizes[axis] - 1) / 2.0, 0, 0
    if begin < end and lower <= upper:
        first = max(0, int(ceil(lower + centre - margin)))
        last = min(sizes[axis], int(floor(upper + centre + margin)) + 1)
    if method == TRILINEAR:
        from_ = NEAR if lower > far_lower else FAR if far_lower > begin else from_
        to = NEAR if upper < far_upper else FAR if far_upper < end else to
        begin, end = lower, upper
    b0, c0 = value_b + (sizes[far] - 1) / 2.0 + 1, value_c + (sizes[near] - 1) / 2.0 + 1
    length = slab_length(line, axis, u, v)
    return Ray(axis, far, near, b0, slope_b, c0, slope_c, length, begin, end, from_, to, first, last, centre)


@scalar
def within(ray, low, high):
    """The first slab of a ray that lies in [low, high), and the one behind the last."""
    return max(ray.first, low), min(ray.last, high)
