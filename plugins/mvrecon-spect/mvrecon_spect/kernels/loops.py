"""Compiled loops over blocks of voxels along x, whose footprints are computed side by side.

Forward adds a block's voxels to the view of one pinhole; adjoint gathers the pixels of a block.
Both use the same weights. Blocks without emission, and blocks whose footprints all miss the
detector, are skipped, which does not change any value.
"""

from math import sqrt

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon_spect.kernels.profile import (
    COEFFICIENTS,
    PIECES,
    STEPS,
    VARIANCE,
    VARIANCE_STEP,
)
from mvrecon_spect.kernels.reference import AREA, BEFORE_PLANE, LEAST_COSINE, LENGTH
from mvrecon_spect.kernels.rows import add_rows, sum_rows

#: Voxels in a block; values added to a row of a view at a time, and of narrow footprints.
BLOCK, ROW, HALF = 16, 8, 4
#: Half width of the smoothest profile in standard deviations.
WIDEST = sqrt(15.0)
LAST = len(PIECES) - 1
U, V, W, SECANT, FOOT, TANGENT, PER_MM, HOLE = 0, 4, 8, 14, 21, 23, 25, 27
WIDTH_U, WIDTH_V, DETECTOR, RADIAL, SHIFT, EFFICIENCY = 29, 35, 41, 47, 53, 55
#: Rows of a block's values: weight, and along u and v inverse half width, the first and the last
#: edge in half widths, centre, variance and power of the profile; and of its integers: first pixel
#: and number of pixels along u and v.
WEIGHT, SCALE_U, EDGE_U, CENTRE_U, VARIANCE_U, POWER_U, END_U = 0, 1, 3, 5, 7, 9, 16
UNIT, BEFORE, SUM, VALUES = 11, 12, 13, 18
FIRST_U, FIRST_V, PIECE, NUMBERS = 0, 1, 2, 4
#: Last piece of the profiles whose cumulative distributions have degree 7.
LOW = 2


@scalar
def _at(row, lane):
    """Place in a block's scratch, one-dimensional so that rows have known distances, without which
    loops are not vectorised.
    """
    return row * BLOCK + lane


@scalar
def _coefficients(r, at):
    return r[at], r[at + 1], r[at + 2], r[at + 3], r[at + 4], r[at + 5]


@scalar
def _poly(c, m, t):
    return c[0] + m * (c[1] + m * c[2]) + t * (c[3] + m * (c[4] + m * c[5]))


@scalar
def _reach(record, j, k, width, detector):
    """Distances in pixels along u and v beyond which no footprint of a row of voxels reaches from
    its voxel's image, infinite if the pinhole's plane cuts the row; negative if all miss the
    detector. Bounds may be too wide, never too narrow.
    """
    r = record
    q1, q2 = r[U + 1] * j + r[U + 2] * k + r[U + 3], r[V + 1] * j + r[V + 2] * k + r[V + 3]
    w0 = r[W + 1] * j + r[W + 2] * k + r[W + 3]
    last = width - 1
    w1 = w0 + last * r[W]
    if w0 > -1e-6 and w1 > -1e-6:
        return -1.0, -1.0
    if w0 > -1e-6 or w1 > -1e-6:
        return np.inf, np.inf
    u0, u1 = q1 / w0, (q1 + last * r[U]) / w1
    v0, v1 = q2 / w0, (q2 + last * r[V]) / w1
    near = min(-w0, -w1)
    m = 1 / near
    um, vm = max(abs(u0), abs(u1)), max(abs(v0), abs(v1))
    tu = max(abs(u0 - r[FOOT]), abs(u1 - r[FOOT])) * r[TANGENT]
    tv = max(abs(v0 - r[FOOT + 1]), abs(v1 - r[FOOT + 1])) * r[TANGENT + 1]
    t = 1 - 1 / sqrt(1 + tu * tu + tv * tv)
    depth = abs(r[W]) + abs(r[W + 1]) + abs(r[W + 2])
    eu = (abs(r[U]) + abs(r[U + 1]) + abs(r[U + 2]) + um * depth) * m
    ev = (abs(r[V]) + abs(r[V + 1]) + abs(r[V + 2]) + vm * depth) * m
    blur, radial = _most(r, DETECTOR, m, t), _most(r, RADIAL, m, t)
    shift = abs(r[SHIFT]) + abs(r[SHIFT + 1]) * t
    au = _most(r, WIDTH_U, m, t) * r[HOLE] + blur + radial * tu * tu
    av = _most(r, WIDTH_V, m, t) * r[HOLE] + blur + radial * tv * tv
    pu, pv = r[PER_MM], r[PER_MM + 1]
    du = WIDEST * sqrt(eu * eu / 12 + au * pu * pu) + shift * tu * pu + 1
    dv = WIDEST * sqrt(ev * ev / 12 + av * pv * pv) + shift * tv * pv + 1
    if _beside(u0, u1, du, detector[1]) or _beside(v0, v1, dv, detector[0]):
        return -1.0, -1.0
    return du, dv


@scalar
def _beside(first, second, reach, pixels):
    return max(first, second) + reach < 0 or min(first, second) - reach > pixels - 1


@scalar
def _misses(record, i, j, k, count, reach, detector):
    """Whether all footprints of a block miss the detector, by the reach of its row."""
    r = record
    last = count - 1
    q1 = r[U] * i + r[U + 1] * j + r[U + 2] * k + r[U + 3]
    q2 = r[V] * i + r[V + 1] * j + r[V + 2] * k + r[V + 3]
    w0 = r[W] * i + r[W + 1] * j + r[W + 2] * k + r[W + 3]
    w1 = w0 + last * r[W]
    if w0 > -1e-6 or w1 > -1e-6:
        return w0 > -1e-6 and w1 > -1e-6
    m0, m1 = 1 / w0, 1 / w1
    return _beside(q1 * m0, (q1 + last * r[U]) * m1, reach[0], detector[1]) or _beside(
        q2 * m0, (q2 + last * r[V]) * m1, reach[1], detector[0]
    )


@scalar
def _most(c, at, m, t):
    """An upper bound of a polynomial up to m and t."""
    return (
        abs(c[at])
        + m * (abs(c[at + 1]) + m * abs(c[at + 2]))
        + t * (abs(c[at + 3]) + m * (abs(c[at + 4]) + m * abs(c[at + 5])))
    )


@scalar
def _block(record, r, pieces, i, j, k, count, detector, s, n, cu, cv):
    """Compute the footprints of a block into its scratch, and return the most pixels along u and v,
    zero if no pixel is reached, and the last piece of their profiles.

    Args:
        record, r: record of the pinhole in float64 and in the type of the arithmetic.
        pieces: constants of the profiles.
        s, n: values and integers of the block.
        cu, cv: coefficients of the cumulative distributions.
    """
    real = s.dtype.type
    one = real(1)
    q1 = real(record[U] * i + record[U + 1] * j + record[U + 2] * k + record[U + 3])
    q2 = real(record[V] * i + record[V + 1] * j + record[V + 2] * k + record[V + 3])
    q3 = real(record[W] * i + record[W + 1] * j + record[W + 2] * k + record[W + 3])
    a0, a1, a2 = r[U], r[U + 1], r[U + 2]
    b0, b1, b2 = r[V], r[V + 1], r[V + 2]
    d0, d1, d2 = r[W], r[W + 1], r[W + 2]
    c0, c1, c2, c3, c4, c5 = (
        r[SECANT], r[SECANT + 1], r[SECANT + 2], r[SECANT + 3], r[SECANT + 4], r[SECANT + 5]
    )  # fmt: skip
    near = real(BEFORE_PLANE) * (abs(d0) + abs(d1) + abs(d2))
    footu, footv, tanu, tanv = r[FOOT], r[FOOT + 1], r[TANGENT], r[TANGENT + 1]
    pu, pv, second, fourth = r[PER_MM], r[PER_MM + 1], r[HOLE], r[HOLE + 1]
    pu2, pv2, twelfth, share4 = pu * pu, pv * pv, real(1 / 12), real(1 / 120)
    scale, least = r[AREA] / (r[LENGTH] * r[LENGTH]), r[LEAST_COSINE]
    sh0, sh1, e0, e1, e2 = (
        r[SHIFT], r[SHIFT + 1], r[EFFICIENCY], r[EFFICIENCY + 1], r[EFFICIENCY + 2]
    )  # fmt: skip
    smoothest, last_piece, three, limit = real(LAST + 1), real(LAST), real(3), real(2.5)
    # loaded before the loop, which is not vectorised otherwise
    wide_u, wide_v = _coefficients(r, WIDTH_U), _coefficients(r, WIDTH_V)
    flat, slanted = _coefficients(r, DETECTOR), _coefficients(r, RADIAL)
    zero, valid = real(0), real(count)
    for lane in range(BLOCK):
        at = real(lane)
        w = q3 + at * d0
        ahead = -w > near
        w = w if ahead else -one
        inverse = one / w
        u, v, m = (q1 + at * a0) * inverse, (q2 + at * b0) * inverse, -inverse
        tu, tv = (u - footu) * tanu, (v - footv) * tanv
        secant2 = c0 + c1 * u + c2 * v + c3 * u * u + c4 * u * v + c5 * v * v
        cosine = one / np.sqrt(secant2)
        t = one - cosine
        ok = ahead & (cosine >= least) & (at < valid)
        weight = scale * (e0 + t * (e1 + t * e2)) * cosine * cosine * cosine * m * m
        x0, x1, x2 = (a0 - u * d0) * inverse, (a1 - u * d1) * inverse, (a2 - u * d2) * inverse
        y0, y1, y2 = (b0 - v * d0) * inverse, (b1 - v * d1) * inverse, (b2 - v * d2) * inverse
        x0, x1, x2, y0, y1, y2 = x0 * x0, x1 * x1, x2 * x2, y0 * y0, y1 * y1, y2 * y2
        image_u, image_v = _poly(wide_u, m, t) * pu2, _poly(wide_v, m, t) * pv2
        blur, radial = _poly(flat, m, t), _poly(slanted, m, t)
        var_u = (x0 + x1 + x2) * twelfth + image_u * second + (blur + radial * tu * tu) * pu2
        var_v = (y0 + y1 + y2) * twelfth + image_v * second + (blur + radial * tv * tv) * pv2
        four_u = (x0 * x0 + x1 * x1 + x2 * x2) * share4 + image_u * image_u * fourth
        four_v = (y0 * y0 + y1 * y1 + y2 * y2) * share4 + image_v * image_v * fourth
        shift = sh0 + sh1 * t
        s[_at(WEIGHT, lane)] = weight if ok else zero
        s[_at(CENTRE_U, lane)], s[_at(CENTRE_U + 1, lane)] = (
            u + shift * tu * pu,
            v + shift * tv * pv,
        )
        s[_at(VARIANCE_U, lane)], s[_at(VARIANCE_U + 1, lane)] = var_u, var_v
        s[_at(POWER_U, lane)] = min(max(three * var_u * var_u / four_u - limit, zero), smoothest)
        s[_at(POWER_U + 1, lane)] = min(
            max(three * var_v * var_v / four_v - limit, zero), smoothest
        )
        n[_at(PIECE, lane)] = np.int32(min(s[_at(POWER_U, lane)], last_piece))
        n[_at(PIECE + 1, lane)] = np.int32(min(s[_at(POWER_U + 1, lane)], last_piece))
    most_u, last_u = _profile(s, n, cu, pieces, 0, real(detector[1]))
    most_v, last_v = _profile(s, n, cv, pieces, 1, real(detector[0]))
    return most_u, most_v, max(last_u, last_v)


@scalar
def _profile(s, n, c, pieces, axis, pixels):
    """Set the profiles of a block along an axis, and return the most pixels that one reaches, and
    the last piece.
    """
    real = s.dtype.type
    one, half, zero = real(1), real(0.5), real(0)
    first = last = n[_at(PIECE + axis, 0)]
    for lane in range(BLOCK):
        first = min(first, n[_at(PIECE + axis, lane)])
        last = max(last, n[_at(PIECE + axis, lane)])
    # all terms in one loop, as short ones are unrolled before they are vectorised
    base, low, step = real(first), pieces[first, VARIANCE], pieces[first, VARIANCE_STEP]
    a0, a1, a2, a3, a4, a5, a6 = _terms(pieces, first, COEFFICIENTS)
    b0, b1, b2, b3, b4, b5, b6 = _terms(pieces, first, STEPS)
    for lane in range(BLOCK):
        share = min(s[_at(POWER_U + axis, lane)] - base, one)
        s[_at(UNIT, lane)] = low + share * step
        c[_at(0, lane)], c[_at(1, lane)] = a0 + share * b0, a1 + share * b1
        c[_at(2, lane)], c[_at(3, lane)] = a2 + share * b2, a3 + share * b3
        c[_at(4, lane)], c[_at(5, lane)] = a4 + share * b4, a5 + share * b5
        c[_at(6, lane)] = a6 + share * b6
    for piece in range(first + 1, last + 1):
        base, step = real(piece), pieces[piece, VARIANCE_STEP]
        b0, b1, b2, b3, b4, b5, b6 = _terms(pieces, piece, STEPS)
        for lane in range(BLOCK):
            share = min(max(s[_at(POWER_U + axis, lane)] - base, zero), one)
            s[_at(UNIT, lane)] += share * step
            c[_at(0, lane)] += share * b0
            c[_at(1, lane)] += share * b1
            c[_at(2, lane)] += share * b2
            c[_at(3, lane)] += share * b3
            c[_at(4, lane)] += share * b4
            c[_at(5, lane)] += share * b5
            c[_at(6, lane)] += share * b6
    most = np.int32(0)
    for lane in range(BLOCK):
        centre, variance, own = (
            s[_at(CENTRE_U + axis, lane)],
            s[_at(VARIANCE_U + axis, lane)],
            s[_at(UNIT, lane)],
        )
        root = np.sqrt(one / (variance * own))
        wide, inverse = variance * root, own * root
        low, high = centre - wide + half, centre + wide + half
        reached = (s[_at(WEIGHT, lane)] != zero) & (high > zero) & (low < pixels)
        start = np.int32(min(max(low, zero), pixels - one))
        end = np.int32(min(max(high, zero), pixels - one))
        start = np.int32(start if reached else np.int32(0))
        number = np.int32(np.int32(end - start) + np.int32(1) if reached else np.int32(0))
        n[_at(FIRST_U + axis, lane)] = start
        s[_at(SCALE_U + axis, lane)] = inverse
        edge = (real(start) - half - centre) * inverse
        s[_at(EDGE_U + axis, lane)] = edge
        s[_at(END_U + axis, lane)] = min(max(edge + real(number) * inverse, -one), one)
        most = max(most, number)
    return most, last


@scalar
def _terms(pieces, piece, at):
    p = pieces[piece]
    return p[at], p[at + 1], p[at + 2], p[at + 3], p[at + 4], p[at + 5], p[at + 6]


@scalar
def _low(c, lane, q):
    return c[_at(0, lane)] + q * (c[_at(1, lane)] + q * (c[_at(2, lane)] + q * c[_at(3, lane)]))


@scalar
def _high(c, lane, q):
    return c[_at(4, lane)] + q * (c[_at(5, lane)] + q * c[_at(6, lane)])


@scalar
def _shares(s, n, c, axis, most, last, shares):
    """Shares of the pixels of a block's footprints along an axis, zero beyond each footprint."""
    real = s.dtype.type
    one, zero = real(1), real(0)
    for lane in range(BLOCK):
        t = min(max(s[_at(EDGE_U + axis, lane)], -one), s[_at(END_U + axis, lane)])
        q = t * t
        q2 = q * q
        s[_at(BEFORE, lane)] = t * (_low(c, lane, q) + q2 * q2 * _high(c, lane, q))
    if last <= LOW:  # further terms are zero
        for pixel in range(most):
            at = real(pixel + 1)
            for lane in range(BLOCK):
                t = s[_at(EDGE_U + axis, lane)] + at * s[_at(SCALE_U + axis, lane)]
                t = min(max(t, -one), s[_at(END_U + axis, lane)])
                p = t * _low(c, lane, t * t)
                shares[pixel, lane] = max(p - s[_at(BEFORE, lane)], zero)
                s[_at(BEFORE, lane)] = p
    else:
        for pixel in range(most):
            at = real(pixel + 1)
            for lane in range(BLOCK):
                t = s[_at(EDGE_U + axis, lane)] + at * s[_at(SCALE_U + axis, lane)]
                t = min(max(t, -one), s[_at(END_U + axis, lane)])
                q = t * t
                q2 = q * q
                p = t * (_low(c, lane, q) + q2 * q2 * _high(c, lane, q))
                shares[pixel, lane] = max(p - s[_at(BEFORE, lane)], zero)
                s[_at(BEFORE, lane)] = p


@scalar
def _emits(volumes, k, j, i, count):
    """Whether a block has a value other than zero."""
    emits = False
    for b in range(len(volumes)):
        for lane in range(np.uint32(count)):
            emits |= volumes[b, k, j, np.uint32(i + lane)] != 0
    return emits


@scalar
def _rows(wu, most, rows):
    """Set the shares along u, voxel by voxel, and return the number of values of a voxel."""
    wide = HALF if most <= HALF else (most + ROW - 1) // ROW * ROW
    for lane in range(BLOCK):
        for p in range(most):
            rows[lane * wide + p] = wu[p, lane]
        for p in range(most, wide):
            rows[lane * wide + p] = 0
    return wide


@scalar
def _spread(value, n, lane, rows, wide, wv, most, view, stride):
    """Add a voxel's view to the view of a pinhole."""
    start = n[_at(FIRST_V, lane)] * stride + n[_at(FIRST_U, lane)]
    if wide == HALF:
        add_rows(HALF, view, start, stride, most, rows, lane * HALF, wv, lane, BLOCK, value)
    else:
        for p in range(0, wide, ROW):
            own = lane * wide + p
            add_rows(ROW, view, start + p, stride, most, rows, own, wv, lane, BLOCK, value)


@scalar
def _gather(n, lane, rows, wide, wv, most, view, stride):
    """The sum over the pixels of a voxel's footprint, times their shares."""
    start = n[_at(FIRST_V, lane)] * stride + n[_at(FIRST_U, lane)]
    if wide == HALF:
        return sum_rows(HALF, view, start, stride, most, rows, lane * HALF, wv, lane, BLOCK)
    total = view.dtype.type(0)
    for p in range(0, wide, ROW):
        own = lane * wide + p
        total += sum_rows(ROW, view, start + p, stride, most, rows, own, wv, lane, BLOCK)
    return total


@compiled
def forward(volumes, transmission, records, typed, pieces, camera, slices, detector, view, scratch):
    """Add the voxels of slices z to the views [n rows * stride] of one camera.

    Args:
        volumes: [n d h w].
        transmission: [1 d h w] of the camera, or empty.
        records, typed: records of the pinholes in float64 and in the type of the arithmetic.
        slices: first and last.
        detector: rows, columns and values in a row of `view`.
        scratch: values, integers, coefficients and shares of a block, rows of its footprints.
    """
    s, n, cu, cv, wu, wv, rows = scratch
    batch, _, height, width = volumes.shape
    attenuates = transmission.size > 0
    record, own = records[camera], typed[camera]
    for k in range(slices[0], slices[1]):
        for j in range(height):
            reach, known = (0.0, 0.0), False
            for i in range(0, width, BLOCK):
                count = min(BLOCK, width - i)
                if not _emits(volumes, k, j, i, count):
                    continue
                if not known:
                    reach, known = _reach(record, j, k, width, detector), True
                if reach[0] < 0:
                    break
                if _misses(record, i, j, k, count, reach, detector):
                    continue
                most_u, most_v, last = _block(
                    record, own, pieces, i, j, k, count, detector, s, n, cu, cv
                )
                if most_u * most_v == 0:
                    continue
                _shares(s, n, cu, 0, most_u, last, wu)
                _shares(s, n, cv, 1, most_v, last, wv)
                wide = _rows(wu, most_u, rows)
                if attenuates:
                    for lane in range(np.uint32(count)):
                        s[_at(WEIGHT, lane)] *= transmission[0, k, j, np.uint32(i + lane)]
                for b in range(batch):
                    line, seen = volumes[b, k, j], view[b]
                    for lane in range(np.uint32(count)):
                        s[_at(SUM, lane)] = line[np.uint32(i + lane)] * s[_at(WEIGHT, lane)]
                    for lane in range(count):
                        x = s[_at(SUM, lane)]
                        if x != 0:
                            _spread(x, n, lane, rows, wide, wv, most_v, seen, detector[2])


@compiled
def adjoint(volumes, transmission, records, typed, pieces, lines, detector, views, scratch):
    """Set lines (z, y) of volumes [n d h w] to the transpose of views [n m rows * stride].

    Args: see `forward`.
        transmission: [m d h w], or empty.
        lines: first and last row (z, y), of all d * h.
    """
    s, n, cu, cv, wu, wv, rows = scratch
    batch, _, height, width = volumes.shape
    stride = detector[2]
    attenuates = transmission.size > 0
    for place in range(lines[0], lines[1]):
        k, j = place // height, place % height
        for camera in range(len(records)):
            record, own = records[camera], typed[camera]
            reach = _reach(record, j, k, width, detector)
            if reach[0] < 0:
                continue
            for i in range(0, width, BLOCK):
                count = min(BLOCK, width - i)
                if _misses(record, i, j, k, count, reach, detector):
                    continue
                most_u, most_v, last = _block(
                    record, own, pieces, i, j, k, count, detector, s, n, cu, cv
                )
                if most_u * most_v == 0:
                    continue
                _shares(s, n, cu, 0, most_u, last, wu)
                _shares(s, n, cv, 1, most_v, last, wv)
                wide = _rows(wu, most_u, rows)
                if attenuates:
                    for lane in range(np.uint32(count)):
                        s[_at(WEIGHT, lane)] *= transmission[camera, k, j, np.uint32(i + lane)]
                for b in range(batch):
                    view, line = views[b, camera], volumes[b, k, j]
                    for lane in range(count):
                        s[_at(SUM, lane)] = _gather(n, lane, rows, wide, wv, most_v, view, stride)
                    for lane in range(np.uint32(count)):
                        line[np.uint32(i + lane)] += s[_at(WEIGHT, lane)] * s[_at(SUM, lane)]
