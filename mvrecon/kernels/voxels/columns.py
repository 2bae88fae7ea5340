"""Views that stand upright over the volume: a column of voxels along z has its image in one
detector column, at even steps.

That is so for every circular orbit about z whose detector columns run along z, and every stack of
slices. The two neighbouring detector columns are blended once, as contiguous vectors, and a voxel
then takes a pair of neighbours out of the blend: no division and two values in place of four, with
the weights of `loops.py`. Views must be turned so that detector columns are contiguous.
"""

from collections import namedtuple
from math import ceil, floor

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar

#: Columns of voxels that are computed before they are written, so that whole cache lines are.
TILE = 16
#: From so many voxels along z on it pays.
LEAST_DEPTH = 8
COMPLEX = {np.dtype(np.float32): np.complex64, np.dtype(np.float64): np.complex128}

#: What a thread works in: the blended column [n p] flat, each value and the next as one complex
#: number on the same memory; per voxel its place and share of the upper neighbour, the pair taken
#: and its parts; sums [n x z] of a tile.
Column = namedtuple("Column", ["blend", "pairs", "places", "shares", "taken", "parts", "sums"])
#: Where a column's images lie: padded place along u, of the first voxel along v and step, the
#: distance weight, and the voxels first to last whose images touch the detector.
Image = namedtuple("Image", ["u", "v", "step", "weight", "first", "last"])


def upright(maps: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Which views [m] of maps [m 4 2 3] are such, but for rounding."""
    if shape[0] < LEAST_DEPTH:
        return np.zeros(len(maps), bool)
    level = maps[:, [0, 2, 3]]
    rising = np.abs(level[:, :, 1]).sum(axis=2) * shape[0]
    return (rising <= 1e-13 * np.abs(level[:, :, 0]).sum(axis=2)).all(axis=1)


def turned(views: np.ndarray) -> np.ndarray:
    """Views [n m v u] as padded columns [n m u+3 v+3]."""
    n, m, v, u = views.shape
    columns = np.zeros((n, m, u + 3, v + 3), views.dtype)
    columns[:, :, 1:-2, 1:-2] = views.swapaxes(2, 3)
    return columns


def room_of(columns: np.ndarray, depth: int) -> Column:
    """Room for a thread."""
    count, _, _, width = columns.shape
    real, pair = columns.dtype, COMPLEX[columns.dtype]
    blend, taken = np.zeros(count * width, real), np.empty(depth, pair)
    pairs = np.ndarray((len(blend) - 1,), pair, blend, strides=blend.strides)
    sums = np.empty((count, TILE, depth), real)
    places, shares = np.empty(depth, np.uint32), np.empty(depth, real)
    return Column(blend, pairs, places, shares, taken, taken.view(real), sums)


@scalar
def _image(lines, sight, i, j, depth):
    nowhere = Image(0.0, 0.0, 0.0, 0.0, 0, 0)
    under = lines[2, 0, 0] * i + lines[2, 0, 1] * j + lines[2, 0, 2]
    fraction = lines[3, 0, 0] * i + lines[3, 0, 1] * j + lines[3, 0, 2]
    if under <= 0 or fraction <= sight.window[0] or fraction >= sight.window[1]:
        return nowhere
    inverse, border = 1.0 / under, sight.detector[1] + 1.0
    u = (lines[0, 0, 0] * i + lines[0, 0, 1] * j + lines[0, 0, 2]) * inverse
    u += (sight.detector[0] + 1) / 2
    if u <= 0 or u >= sight.detector[0] + 1:
        return nowhere
    step = lines[1, 1, 2] * inverse
    v = (lines[1, 0, 0] * i + lines[1, 0, 1] * j + lines[1, 0, 2]) * inverse + border / 2
    v -= step * (depth - 1) / 2
    low, high = 0.0, depth - 1.0
    if step > 0:
        low, high = max(low, -v / step), min(high, (border - v) / step)
    elif step < 0:
        low, high = max(low, (border - v) / step), min(high, -v / step)
    elif v <= 0 or v >= border:
        return nowhere
    if low > high:
        return nowhere
    weight = inverse * inverse if sight.weighted else 1.0
    return Image(u, v, step, weight, int(ceil(low)), int(floor(high)) + 1)


@scalar
def _places(image, room):
    """Lower neighbours of a column's images, and the upper ones' shares."""
    real, places, shares = room.shares.dtype.type, room.places, room.shares
    v, step = real(image.v + image.first * image.step), real(image.step)
    for k in range(np.uint32(image.last - image.first)):
        place = v + real(np.int32(k)) * step
        below = np.int32(place)
        places[k], shares[k] = np.uint32(below), place - real(below)


@scalar
def _blend(image, columns, blend):
    """The detector's column at u, times the weight, where images lie."""
    real, left = blend.dtype.type, int(image.u)
    share = image.u - left
    low, high = real((1 - share) * image.weight), real(share * image.weight)
    one = image.v + image.first * image.step
    other = image.v + (image.last - 1) * image.step
    first = max(0, int(min(one, other)) - 1)
    last = min(columns.shape[1], int(max(one, other)) + 3)
    near, far = columns[left], columns[left + 1]
    for v in range(np.uint32(first), np.uint32(last)):
        blend[v] = low * near[v] + high * far[v]


@scalar
def _take(room, start, line, count):
    places, shares, taken, parts = room.places, room.shares, room.taken, room.parts
    for k in range(count):
        taken[k] = room.pairs[np.uint64(places[k]) + start]
    for k in range(count):
        lower = parts[2 * k]
        line[k] += lower + shares[k] * (parts[2 * k + 1] - lower)


@scalar
def _add_tile(columns, sight, room, tile, volumes):
    """The sums of all views over the voxels tile = (y, first x, one behind the last x)."""
    depth, height, width = volumes.shape[1:]
    y, start, end = tile
    room.sums[:] = 0
    for x in range(start, end):
        for m in range(len(sight.maps)):
            i, j = x - (width - 1) / 2, y - (height - 1) / 2
            image = _image(sight.maps[m], sight, i, j, depth)
            if image.first >= image.last:
                continue
            _places(image, room)
            for n in range(len(volumes)):
                begin = n * columns.shape[3]
                _blend(image, columns[n, m], room.blend[begin:])
                line = room.sums[n, x - start, image.first :]
                _take(room, np.uint64(begin), line, np.uint32(image.last - image.first))


@compiled
def look_up_columns(columns, sight, room, volumes, first, last):
    """Add to the rows first to last along y of volumes [n d h w] what their voxels see in views."""
    depth, _, width = volumes.shape[1:]
    for y in range(first, last):
        for start in range(0, width, TILE):
            end = min(start + TILE, width)
            _add_tile(columns, sight, room, (y, start, end), volumes)
            for n in range(len(volumes)):
                for z in range(depth):
                    for x in range(start, end):
                        volumes[n, z, y, x] += room.sums[n, x - start, z]
