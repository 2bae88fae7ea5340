"""Compiled loops of `mvrecon_spect.operators.path_integrals`, the same sums without derivatives."""

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon_spect.kernels.memory import read, write


@scalar
def _linear(low, high, share):
    return low + share * (high - low)


@scalar
def _between(flat, at, low, high, share):
    return _linear(read(flat, np.int32(at + low)), read(flat, np.int32(at + high)), share)


@scalar
def _clipped(ends, start, slope, most):
    """The part of a range in which start + slope x is from -2 to a bound."""
    low, high = ends
    if slope == 0:
        return (low, high) if -2 <= start <= most else (low, low)
    first, last = (-2 - start) / slope, (most - start) / slope
    return min(max(low, min(first, last)), high), max(min(high, max(first, last)), low)


@compiled
def add_up(mu, start, along, world, ends, step, sums):
    """Sums of mu from the pinhole outwards.

    Args:
        mu: [d h w] with a margin of one voxel of zeros.
        start: index (x, y, z) of the pinhole, in halves of voxels.
        along: [3 3] steps of this index per mm of depth: of a pixel along u, along v, of pixel
            (0, 0).
        world: the same in mm.
        ends: first ray and distance of rays along u and v in pixels, first depth in mm.
        step: step of depth, in mm.
        sums: [slabs + 1, rows, columns], to be set.
    """
    slabs, rows, columns = sums.shape
    real = mu.dtype.type
    depth, height, width = mu.shape
    top_x, top_y, top_z = real(2 * width - 4), real(2 * height - 4), real(2 * depth - 4)
    least, one = real(-2), real(1)
    flat, out = mu.reshape(-1), sums.reshape(-1)
    slice_, line = np.int32(height * width), np.int32(width)
    sx, sy, sz = real(start[0]), real(start[1]), real(start[2])
    for row in range(rows):
        v = ends[2] + row * ends[3]
        bx = real(along[0, 2] + v * along[0, 1])
        by = real(along[1, 2] + v * along[1, 1])
        bz = real(along[2, 2] + v * along[2, 1])
        ux, uy, uz = real(along[0, 0]), real(along[1, 0]), real(along[2, 0])
        wx = real(world[0, 2] + v * world[0, 1])
        wy = real(world[1, 2] + v * world[1, 1])
        wz = real(world[2, 2] + v * world[2, 1])
        ax, ay, az = real(world[0, 0]), real(world[1, 0]), real(world[2, 0])
        first, apart, long = real(ends[0]), real(ends[1]), real(step)
        for column in range(columns):
            sums[0, row, column] = 0
        for slab in range(slabs - 1):
            middle = ends[4] + (slab + 0.5) * step
            h, after = real(middle), ((slab + 1) * rows + row) * columns
            inside = (0.0, columns - 1.0)
            for axis, most in enumerate((top_x, top_y, top_z)):
                slope = middle * along[axis, 0]
                base = start[axis] + middle * (along[axis, 2] + v * along[axis, 1])
                inside = _clipped(inside, base + slope * ends[0], slope * ends[1], most)
            for column in range(columns):
                sums[slab + 1, row, column] = 0
            # one further on both sides, for rounding; mu is zero outside
            low, high = max(int(inside[0]) - 1, 0), min(int(inside[1]) + 3, columns)
            for column in range(np.uint32(low), np.uint32(max(low, high))):
                u = first + real(column) * apart
                x = min(max(sx + h * (bx + u * ux), least), top_x)
                y = min(max(sy + h * (by + u * uy), least), top_y)
                z = min(max(sz + h * (bz + u * uz), least), top_z)
                x, y, z = x + one + one, y + one + one, z + one + one
                i, j, k = np.int32(x), np.int32(y), np.int32(z)
                fx, fy, fz = x - real(i), y - real(j), z - real(k)
                i0, i1 = i >> 1, (i + 1) >> 1
                j0, j1 = (j >> 1) * line, ((j + 1) >> 1) * line
                k0, k1 = (k >> 1) * slice_, ((k + 1) >> 1) * slice_
                a = _between(flat, k0 + j0, i0, i1, fx)
                b = _between(flat, k0 + j1, i0, i1, fx)
                c = _between(flat, k1 + j0, i0, i1, fx)
                d = _between(flat, k1 + j1, i0, i1, fx)
                value = _linear(_linear(a, b, fy), _linear(c, d, fy), fz)
                px, py, pz = wx + u * ax, wy + u * ay, wz + u * az
                length = np.sqrt(px * px + py * py + pz * pz) * long
                write(out, after + column, value * length)
            for column in range(columns):
                sums[slab + 1, row, column] += sums[slab, row, column]


@compiled
def look_up(sums, to_pixels, length, ends, step, result):
    """Interpolate in the sums at voxels.

    Args:
        sums, ends, step: see `add_up`.
        to_pixels: [3 4] from index (i, j, k, 1) to w (u, v, 1).
        length: distance from hole to detector, in mm.
        result: [d h w], to be set.
    """
    slabs, rows, columns = sums.shape
    real = sums.dtype.type
    flat, out = sums.reshape(-1), result.reshape(-1)
    line, slice_ = np.int32(columns), np.int32(rows * columns)
    top_x, top_y, top_z = real(columns - 1.001), real(rows - 1.001), real(slabs - 1.001)
    zero, tiny = real(0), real(-1e-6)
    low_u, low_v, low_h = real(ends[0]), real(ends[2]), real(ends[4])
    per_u, per_v, per_h = real(1 / ends[1]), real(1 / ends[3]), real(1 / step)
    p = to_pixels
    du, dv, dw, way = real(p[0, 0]), real(p[1, 0]), real(p[2, 0]), real(length)
    for k in range(result.shape[0]):
        for j in range(result.shape[1]):
            q1 = real(p[0, 1] * j + p[0, 2] * k + p[0, 3])
            q2 = real(p[1, 1] * j + p[1, 2] * k + p[1, 3])
            q3 = real(p[2, 1] * j + p[2, 2] * k + p[2, 3])
            first = (k * result.shape[1] + j) * result.shape[2]
            for i in range(np.uint32(result.shape[2])):
                w = min(q3 + real(i) * dw, tiny)
                x = ((q1 + real(i) * du) / w - low_u) * per_u
                y = ((q2 + real(i) * dv) / w - low_v) * per_v
                z = (-w * way - low_h) * per_h
                x = min(max(x, zero), top_x)
                y = min(max(y, zero), top_y)
                z = min(max(z, zero), top_z)
                a, b, c = np.int32(x), np.int32(y), np.int32(z)
                fx, fy, fz = x - real(a), y - real(b), z - real(c)
                at = c * slice_ + b * line + a
                s = _between(flat, at, 0, 1, fx)
                t = _between(flat, at + line, 0, 1, fx)
                at += slice_
                e = _between(flat, at, 0, 1, fx)
                g = _between(flat, at + line, 0, 1, fx)
                write(out, first + i, _linear(_linear(s, t, fy), _linear(e, g, fy), fz))
