"""The transmission to each segment of one ray, from its optical depths; the step of
`attenuated.py`.

A segment is the part of a ray in which attenuation is taken as constant: a slab for Joseph's
method, the part in one cell for Siddon's. Of what it emits the share

    exp(-A) (1 - exp(-m)) / m

comes out at the ray's end on the detector's side: m its optical depth mu D, A the sum of those on
the way out (Gullberg et al., Phys. Med. Biol. 30 (1985) 799).

Segments stand slab by slab for Joseph's method. For Siddon's the first cells of all slabs come
first, then the second ones, then the third: so every loop but one runs along memory, and that one,
over what is left of a ray behind each slab, takes a step for a slab and not for a cell.
"""

from collections import namedtuple
from math import exp, expm1

import numpy as np

from mvrecon.kernels.compiling import scalar
from mvrecon.kernels.rays.cpu import joseph, siddon
from mvrecon.kernels.rays.cpu.lanes import between
from mvrecon.kernels.rays.trace import SIDDON

#: Per segment: optical depth, mean transmission within the segment and then from all of it to the
#: end, transmission from its near end, what it emits, that of one volume, what is
#: spread into it, and its place among the layers.
Path = namedtuple("Path", ["depth", "share", "passed", "source", "emission", "value", "layer"])
#: Up to this optical depth (1 - exp(-m)) / m and its slope are series; the terms that are left out
#: are below the last digit of double precision.
SERIES = 0.5


def path_of(room) -> Path:
    """Room for the segments of one ray of a thread."""
    return Path(*np.empty((7, 3 * len(room.one)), room.one.dtype))


@scalar
def segments_of(rig, slabs):
    """How many segments so many slabs are."""
    return 3 * slabs if rig.method == SIDDON else slabs


@scalar
def mean_transmission(m):
    """(1 - exp(-m)) / m for 0 <= m <= SERIES: a segment's own, sum (-m)^k / (k + 1)!."""
    real = type(m)
    sums, single = real(1), real(1) + real(1e-10) == real(1)
    for k in range(8 if single else 14, 1, -1):
        sums = real(1) - m * sums * real(1.0 / k)
    return sums


@scalar
def slope_of_mean(m):
    """The derivative of (1 - exp(-m)) / m for 0 <= m <= SERIES, -sum k (-m)^(k - 1) / (k + 1)!."""
    real = type(m)
    sums = real(1)
    for k in range(14, 2, -1):
        sums = real(1) - m * sums * real((k - 1.0) / (k * (k - 2.0)))
    return real(-0.5) * sums


@scalar
def cells(rig, ray, count, steps, room):
    """The cells of a ray in the slabs that were visited; see `joseph.cells`, `siddon.cells`."""
    if rig.method == SIDDON:
        siddon.cells(ray, count, steps, room)
    else:
        joseph.cells(ray, count, steps, room)


@scalar
def integrals(volume, rig, ray, steps, room, count, into):
    """The integrals of a volume over the segments of a ray, in mm times its unit."""
    store, n, real = volume.store, volume.at, into.dtype.type
    length = real(ray.length)
    if rig.method == SIDDON:
        index0, index1, index2, part0, part1, part2 = siddon.crossed(room)
        flat, offset = store.values, np.uint64(n * store.size)
        for i in range(np.uint32(count)):
            second, third = np.uint32(count) + i, np.uint32(2 * count) + i
            into[i] = length * part0[i] * flat[np.uint64(index0[i]) + offset]
            into[second] = length * part1[i] * flat[np.uint64(index1[i]) + offset]
            into[third] = length * part2[i] * flat[np.uint64(index2[i]) + offset]
        return
    joseph.fetch(store.pairs, n * store.size, steps.far, count, room)
    y, z, share, low, high = room.one, room.two, room.three, room.low_parts, room.high_parts
    one = real(1)
    for i in range(np.uint32(count)):
        rest = one - z[i]
        lower = between(low[2 * i], low[2 * i + 1], z[i], rest)
        upper = between(high[2 * i], high[2 * i + 1], z[i], rest)
        into[i] = length * share[i] * between(lower, upper, y[i], one - y[i])


@scalar
def deepest(depth, number):
    """The greatest of the optical depths."""
    most = depth.dtype.type(0)
    for i in range(np.uint32(number)):
        most = max(most, depth[i])
    return most


@scalar
def weaken(path, number):
    """From optical depths to the mean transmission within each segment, and to what it takes."""
    depth, share, gone = path.depth, path.share, path.value
    real = depth.dtype.type
    for i in range(np.uint32(number)):
        share[i] = mean_transmission(depth[i])
    if deepest(depth, number) > real(SERIES):  # rare
        for i in range(np.uint32(number)):
            if depth[i] > real(SERIES):
                share[i] = real(-expm1(-depth[i]) / depth[i])
    for i in range(np.uint32(number)):
        gone[i] = depth[i] * share[i]


@scalar
def transmit(path, rig, slabs, ascending):
    """From optical depths to shares: from the first segment on when `ascending`, else from the
    last. It overwrites `value`.
    """
    share, passed, gone, number = path.share, path.passed, path.value, segments_of(rig, slabs)
    weaken(path, number)
    if rig.method == SIDDON:
        pass_slabs(path, slabs, ascending)
    before = gone if rig.method == SIDDON else passed
    left = 1.0  # in double, since it is a product of as many factors as there are slabs
    for j in range(np.uint32(slabs)):
        i = j if ascending else np.uint32(slabs) - np.uint32(1) - j
        lost = gone[i]
        before[i] = passed.dtype.type(left)
        left -= left * lost
    if rig.method == SIDDON:
        n = np.uint32(slabs)
        for i in range(n):
            passed[i] *= gone[i]
            passed[n + i] *= gone[i]
            passed[n + n + i] *= gone[i]
    for i in range(np.uint32(number)):
        share[i] *= passed[i]


@scalar
def pass_slabs(path, slabs, ascending):
    """Of Siddon's three cells in each slab: into `passed` what those of them that are nearer to the
    detector leave of a ray; into the first third of `value`, from what each takes, what all do.
    """
    passed, gone = path.passed, path.value
    one, n = gone.dtype.type(1), np.uint32(slabs)
    for i in range(n):
        first, second, third = gone[i], gone[n + i], gone[n + n + i]
        near, far = (first, third) if ascending else (third, first)
        both = near + second - near * second
        passed[i] = one if ascending else one - both
        passed[n + i] = one - near
        passed[n + n + i] = one - both if ascending else one
        gone[i] = both + far - both * far


@scalar
def retain(rig, share, slabs, first, count):
    """Of the segments' shares of so many slabs keep those from `first` on, in front."""
    for third in range(3 if rig.method == SIDDON else 1):
        for i in range(np.uint32(count)):
            share[third * count + i] = share[third * slabs + first + i]


@scalar
def weigh(rig, room, share, slabs, first, count):
    """The cells of a room with shares of their segments: of so many slabs those from `first` on."""
    if rig.method == SIDDON:
        part0, part1, part2 = siddon.crossed(room)[3:]
        for i in range(np.uint32(count)):
            k = np.uint32(first) + i
            part0[i] *= share[k]
            part1[i] *= share[np.uint32(slabs) + k]
            part2[i] *= share[np.uint32(2 * slabs) + k]
        return
    one = room.three
    for i in range(np.uint32(count)):
        one[i] *= share[first + i]


@scalar
def bend(path, rig, slabs, ascending):
    """Into `value`: the derivative of the sum of what all segments send out by their optical
    depths.

    A segment weakens itself and all those beyond it.
    """
    depth, share, passed, source = path.depth, path.share, path.passed, path.source
    value, real, number = path.value, depth.dtype.type, segments_of(rig, slabs)
    for i in range(np.uint32(number)):
        value[i] = slope_of_mean(depth[i])
    if deepest(depth, number) > real(SERIES):
        for i in range(np.uint32(number)):
            m = np.float64(depth[i])
            if m > SERIES:
                value[i] = real((exp(-m) * (1 + m) - 1) / (m * m))
    for i in range(np.uint32(number)):
        value[i] *= passed[i] * source[i]
        source[i] *= share[i]
    beyond, pieces = 0.0, number // np.uint32(max(slabs, 1))
    for j in range(np.uint32(slabs)):
        for k in range(pieces):
            i = np.uint32(j + k * slabs)
            i = np.uint32(number) - np.uint32(1) - i if ascending else i
            value[i] = real(value[i] - beyond)
            beyond += source[i]
