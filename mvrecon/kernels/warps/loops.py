"""The compiled loops over the rows of warped volumes: forward, transpose, and how the result
changes with the maps.
"""

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.warps import trilinear


@compiled
def warp_rows(flat, warp, room, out, first, last):
    """Write the rows first to last, counted through (s, k, d, h), of the warped volumes [n s k c d
    h w].
    """
    at, weight = room.at, room.weight
    depth, height, width = warp.shape
    kinds = warp.maps.shape[1]
    for number in range(first, last):
        z, y = number // height % depth, number % height
        k, s = number // (height * depth) % kinds, number // (height * depth * kinds)
        row = trilinear.row_of(warp.maps[s, k], warp.shape, z, y)
        part = trilinear.inside(row, warp.sizes)
        count = max(0, part[1] - part[0])
        trilinear.cells(row, part, warp.sizes, warp.steps, at, weight)
        for n in range(flat.shape[0]):
            for c in range(flat.shape[2]):
                line = out[n, s, k, c, z, y]
                line[: part[0]] = 0
                line[part[0] + count :] = 0
                trilinear.fetch(flat[n, s, c], warp.steps, count, at, weight, line[part[0] :])


@scalar
def _hand_over(own, warp, volume, low, high):
    """Copy the slabs [low, high) of a volume out of the border around them."""
    for z in range(low, high):
        for y in range(warp.sizes[1]):
            begin = (z - low + 1) * warp.steps[2] + (y + 1) * warp.steps[1] + 1
            for x in range(warp.sizes[0]):
                volume[z, y, x] = own[begin + x]


@compiled
def spread_slabs(values, warp, room, volumes, s, low, high):
    """Into the slabs [low, high) of volume s of [n s c d h w]: everything that values [n s k c d h
    w] put there.

    The room's own is [n c p], those slabs and one on either side.
    """
    at, weight, own = room.at, room.weight, room.own
    depth, height, width = warp.shape
    batch, channels = values.shape[0], values.shape[3]
    for number in range(warp.maps.shape[1] * depth * height):
        k, z, y = number // (height * depth), number // height % depth, number % height
        row = trilinear.row_of(warp.maps[s, k], warp.shape, z, y)
        part = trilinear.inside(row, warp.sizes)
        if high - low < warp.sizes[2]:
            part = trilinear.near_slabs(row, warp.sizes, low, high, part)
        count = part[1] - part[0]
        if count <= 0:
            continue
        trilinear.cells(row, part, warp.sizes, warp.steps, at, weight)
        for i in range(count):
            at[i] -= low * warp.steps[2]
        for n in range(batch):
            for c in range(channels):
                line = values[n, s, k, c, z, y]
                trilinear.spread(own[n, c], warp.steps, count, at, weight, line[part[0] :])
    for n in range(batch):
        for c in range(channels):
            _hand_over(own[n, c], warp, volumes[n, s, c], low, high)


@scalar
def _pull_back(row, part, place, slopes, change):
    """Add to `change` [5 2 3] the derivative that the `slopes` [3 n] of a row have by its map.

    Each numerator t and denominator w give t / w: its change is (dt - (t / w) dw) / w.
    """
    y, z = place
    for n in range(part[1] - part[0]):
        i = n + part[0] - row.half
        across, depth = row.across[0] + i * row.across[1], row.depth[0] + i * row.depth[1]
        by_x, by_y, by_z = slopes[0, n] / across, slopes[1, n] / across, slopes[2, n] / depth
        by_across = -(by_x * (row.x[0] + i * row.x[1]) + by_y * (row.y[0] + i * row.y[1])) / across
        by_depth = -by_z * (row.z[0] + i * row.z[1]) / depth
        for r, by in enumerate((by_x, by_y, by_z, by_across, by_depth)):
            for c, factor in enumerate((i, y, 1.0)):
                change[r, 0, c] += by * factor
                change[r, 1, c] += by * factor * z


@compiled
def vary_planes(flat, warp, room, values, change, first, last):
    """Into `change` [s k d 5 2 3]: per plane of the output, the derivative of sum(values * warped)
    by the maps.
    """
    at, weight = room.at, room.weight
    depth, height, width = warp.shape
    kinds = warp.maps.shape[1]
    for number in range(first, last):
        z, k, s = number % depth, number // depth % kinds, number // (depth * kinds)
        for y in range(height):
            row = trilinear.row_of(warp.maps[s, k], warp.shape, z, y)
            part = trilinear.inside(row, warp.sizes)
            count = max(0, part[1] - part[0])
            trilinear.cells(row, part, warp.sizes, warp.steps, at, weight)
            room.own[:] = 0
            for n in range(flat.shape[0]):
                for c in range(flat.shape[2]):
                    line = values[n, s, k, c, z, y]
                    trilinear.slopes(
                        flat[n, s, c], warp.steps, count, at, weight, line[part[0] :], room.own
                    )
            place = (y - (height - 1) / 2, z - (depth - 1) / 2)
            _pull_back(row, part, place, room.own, change[s, k, z])
