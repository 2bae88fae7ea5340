"""The compiled loops over attenuated rays: those of `mvrecon.kernels.rays.cpu.loops`, with each
cell multiplied by the transmission from it to the detector.

A segment is the part of a ray with constant attenuation: a slab for Joseph's method, the part in
one cell for Siddon's. The fraction of its emission

    exp(-A) (1 - exp(-m)) / m

reaches the ray's end on the detector's side, where m is its optical depth mu D and A the sum of
those between it and that end (Gullberg et al., Phys. Med. Biol. 30 (1985) 799). Counts travel
towards the end of greatest w, see `Cameras`.

Segments are stored slab by slab for Joseph's method. For Siddon's, the first cells of all slabs
precede the second ones and these the third: all loops but one access memory contiguously, and that
one, over the transmission behind each slab, has one step per slab instead of per cell.

Views [n m v u k] have k layers (one layer: the entire ray) at equal steps of 1 / w, up to the sign
the magnification of a pinhole's image; segments between two layers are distributed linearly. The
attenuation is volume `at` of a separate store, in the layout of the emission. The transmission from
each segment may be cached between calls as [m u v s], s over the slabs of the volume, three times
for Siddon's method; if empty, it is recomputed for every ray, with the same bits.
"""

from collections import namedtuple
from math import exp, expm1

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.cpu import joseph, siddon
from mvrecon.kernels.rays.cpu.loops import (
    cells as cells_of_ray,
    pixel_of,
    ray_span,
    spread_along as spread_along_ray,
    sum_along as sum_along_ray,
)
from mvrecon.kernels.rays.cpu.trace import at, main_axis, missing, steps_of, trace, within
from mvrecon.kernels.rays.lines import DIRECTION, SIDDON, START
from mvrecon_spect.kernels import distance_driven

#: A store and the index of one of its volumes, as for mu (-1: no attenuation); emission: a store
#: and the range in which it may be nonzero; memory of one thread: the core's `Scratch`, the
#: segments of one ray, the layers [m k] of every view, the preceding layer of every slab, `TURNS`
#: sums of every layer, and the `Areas` of distance-driven rays.
MuVolume = namedtuple("MuVolume", ["store", "at"])
Emission = namedtuple("Emission", ["store", "space"])
Scratch = namedtuple("Scratch", ["cells", "path", "layers", "node", "sums", "areas"])
#: Per segment: optical depth; mean transmission within the segment, then from the entire segment to
#: the end; transmission from its near end; its emission; that of one volume; its back-projected
#: value; per slab, the fraction in the layer behind it.
Path = namedtuple("Path", ["depth", "share", "passed", "source", "emission", "value", "part"])
#: Optical depth up to which (1 - exp(-m)) / m and its slope are series; omitted terms are below
#: double precision.
SERIES = 0.5
#: Partial sums of a layer, each over every fourth slab of the volume, so that consecutive additions
#: are independent.
TURNS = 4


@scalar
def segments_of(rig, slabs):
    """Number of segments in a number of slabs."""
    return 3 * slabs if rig.method == SIDDON else slabs


@scalar
def course(space, method, store, line, pixel, axes, scratch):
    """The ray of a pixel, a miss if its main axis is not in `axes` (x, y, z), and its footprint."""
    near, none = store.near, 0.0
    foot = distance_driven.Footprint(none, none, none, none)
    if scratch.areas.used:
        axis = distance_driven.axis_of(line, pixel)
        if not axes[axis]:
            return missing(axis), foot
        foot = distance_driven.footprint_of(line, axis, near, pixel)
        return distance_driven.ray_of(space, line, axis, near, pixel, foot), foot
    axis = main_axis(line, pixel[0], pixel[1])
    if not axes[axis]:
        return missing(axis), foot
    return trace(line, axis, near, pixel, space, method), foot


@scalar
def cells(rig, ray, foot, span, steps, scratch):
    """Write the cells of a ray in the slabs of a span; returns as `traverse`."""
    if scratch.areas.used:
        return distance_driven.cells(rig, ray, foot, span, steps, scratch)
    return cells_of_ray(rig, ray, span, steps, scratch.cells)


@scalar
def sum_along(rig, store, n, ray, foot, steps, traversed, scratch):
    """The sum of volume n along a ray, in voxels of the main axis."""
    if scratch.areas.used:
        return distance_driven.total(store, n, rig, ray, foot, steps, traversed, scratch)
    return sum_along_ray(rig, store, n, steps, traversed, scratch.cells)


@scalar
def spread_along(rig, store, n, ray, foot, steps, count, scratch, value):
    """Add a value to volume n along a ray with the weights of `sum_along`: its transpose."""
    if scratch.areas.used:
        distance_driven.spread(store, n, rig, ray, foot, steps, count, scratch, value)
    else:
        spread_along_ray(rig, store, n, steps, count, scratch.cells, value)


@scalar
def mean_transmission(m):
    """(1 - exp(-m)) / m for 0 <= m <= SERIES within a segment, sum (-m)^k / (k + 1)!."""
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
def integrals(volume, rig, ray, foot, steps, scratch, count, into):
    """The integrals of a volume over the segments of a ray, in mm times its unit."""
    store, n, real = volume.store, volume.at, into.dtype.type
    length = real(ray.length)
    if scratch.areas.used:
        distance_driven.integrals(store, n, rig, ray, foot, steps, scratch, count, length, into)
        return
    if rig.method == SIDDON:
        index0, index1, index2, part0, part1, part2 = siddon.crossed(scratch.cells)
        flat, offset = store.values, np.uint64(n * store.size)
        for i in range(np.uint32(count)):
            second, third = np.uint32(count) + i, np.uint32(2 * count) + i
            into[i] = length * part0[i] * flat[np.uint64(index0[i]) + offset]
            into[second] = length * part1[i] * flat[np.uint64(index1[i]) + offset]
            into[third] = length * part2[i] * flat[np.uint64(index2[i]) + offset]
        return
    joseph.integrals(store, n, steps, count, scratch.cells, length, into)


@scalar
def deepest(depth, number):
    """Maximum optical depth."""
    most = depth.dtype.type(0)
    for i in range(np.uint32(number)):
        most = max(most, depth[i])
    return most


@scalar
def transmit_within(path, number):
    """Convert optical depths to the mean transmission within each segment, and to the transmission
    through it.
    """
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
    """Convert optical depths to transmitted fractions, from the first segment on if `ascending`,
    otherwise from the last. Overwrites `value`.
    """
    share, passed, gone, number = path.share, path.passed, path.value, segments_of(rig, slabs)
    transmit_within(path, number)
    if rig.method == SIDDON:
        pass_slabs(path, slabs, ascending)
    before = gone if rig.method == SIDDON else passed
    left = 1.0  # in double precision, since it is a product of one factor per slab
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
    """For Siddon's three cells in each slab: write to `passed` the transmission through the cells
    closer to the detector, and to the first third of `value`, from that of each, that of all three.
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
def weigh(rig, cells, share, slabs, first, count):
    """Multiply the cells of some slabs, from `first` on, by the fractions of their segments."""
    if rig.method == SIDDON:
        part0, part1, part2 = siddon.crossed(cells)[3:]
        for i in range(np.uint32(count)):
            k = np.uint32(first) + i
            part0[i] *= share[k]
            part1[i] *= share[np.uint32(slabs) + k]
            part2[i] *= share[np.uint32(2 * slabs) + k]
        return
    one = cells.three
    for i in range(np.uint32(count)):
        one[i] *= share[first + i]


@scalar
def vjp_segments(path, rig, slabs, ascending):
    """Write to `value` the derivative of the summed contributions of all segments with respect to
    their optical depths.

    A segment attenuates itself and all segments behind it.
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


@scalar
def layer_of(rig, ray, line, pixel, layers, count, scratch):
    """Write the positions of the traversed slabs between the layers of a view."""
    slab, node, part = scratch.cells.four, scratch.node, scratch.path.part
    last, real = len(layers) - 1, part.dtype.type
    if last == 0:
        return
    scale = last / (layers[last] - layers[0])
    start = real(at(line, START, ray.axis, pixel[0], pixel[1]))
    way = real(at(line, DIRECTION, ray.axis, pixel[0], pixel[1]) * scale)
    first, none, most = real(layers[0] * scale), real(0), real(last)
    for i in range(np.uint32(count)):
        place = way / (slab[i] - start)
        # the centre of a slab that contains the source may be behind it: use the nearest layer
        along = min(max(place - first, none), most) if place * first >= none else none
        node[i] = min(np.int32(along), np.int32(last - 1))
        part[i] = along - real(node[i])


@scalar
def deal(rig, path, count, slab, node, sums, values):
    """Add the contributions of segments in `emission` to the layers of a pixel; their first is in a
    slab of the volume.
    """
    sent, high, part, size = path.emission, path.value, path.part, np.uint32(len(values))
    for k in range(np.uint32(TURNS) * size):
        sums[k] = 0
    for piece in range(segments_of(rig, 1)):
        first = np.uint32(piece * count)
        for i in range(np.uint32(count)):
            high[i] = part[i] * sent[first + i]
            sent[first + i] -= high[i]
        for i in range(np.uint32(count)):
            k = np.uint32(node[i]) + size * ((np.uint32(slab) + i) % np.uint32(TURNS))
            sums[k] += sent[first + i]
            sums[k + np.uint32(1)] += high[i]
    for k in range(size):
        two = sums[k] + sums[size + k]
        values[k] += two + (sums[2 * size + k] + sums[3 * size + k])


@scalar
def gather(rig, path, count, node, values):
    """Write to `value` the values of a pixel's layers at its segments, the transpose of `deal`."""
    value, part = path.value, path.part
    if len(values) == 1:
        for i in range(segments_of(rig, np.uint32(count))):
            value[i] = values[0]
        return
    for i in range(np.uint32(count)):
        k = np.uint32(node[i])
        low, high = values[k], values[k + np.uint32(1)]
        value[i] = low - part[i] * low + part[i] * high
    if rig.method == SIDDON:
        for i in range(np.uint32(count)):
            value[count + i] = value[2 * count + i] = value[i]


@scalar
def all_zero(views, m, v, u):
    """Whether a pixel is zero in all layers of all views [n m v u k]."""
    for n in range(len(views)):
        for k in range(views.shape[4]):
            if views[n, m, v, u, k] != 0:
                return False
    return True


@scalar
def _emitting(rig, store, line, pixel, space, axes, whole, scratch):
    """The slabs of a ray (first and one past the last) that may contain emission, and the ray with
    its footprint; `whole`: through the entire mu.
    """
    ray, foot = course(space, rig.method, store, line, pixel, axes, scratch)
    span = (ray.first, ray.last)
    if whole and ray.first < ray.last and space.box != rig.box:
        ray, _ = course(rig, rig.method, store, line, pixel, axes, scratch)
    return ray, foot, span


@scalar
def _attenuate(mu, rig, line, pixel, ray, foot, span, steps, scratch):
    """Compute the cells and the transmitted fractions of a ray's segments from the detector's end
    to the far end of a span.

    Returns:
        the slabs (first and one past the last); whether the slab at the detector's end is the ray's
        first.
    """
    ascending = at(line, DIRECTION, ray.axis, pixel[0], pixel[1]) < 0
    part = (ray.first, span[1]) if ascending else (span[0], ray.last)
    count, _ = cells(rig, ray, foot, part, steps, scratch)
    integrals(mu, rig, ray, foot, steps, scratch, count, scratch.path.depth)
    transmit(scratch.path, rig, count, ascending)
    return part, ascending


@scalar
def _shares(mu, kept, rig, place, line, pixel, ray, foot, span, steps, scratch):
    """Transmitted fractions of the segments of the ray at (m, u, v), cached or computed; their
    number of slabs (0: no attenuation); and the index of the first slab of a span.
    """
    if len(kept):
        m, u, v = place
        return kept[m, u, v], np.uint32(max(rig.sizes)), np.uint32(span[0])
    if mu.at < 0:
        return scratch.path.share, np.uint32(0), np.uint32(0)
    part, _ = _attenuate(mu, rig, line, pixel, ray, foot, span, steps, scratch)
    return scratch.path.share, np.uint32(part[1] - part[0]), np.uint32(span[0] - part[0])


@compiled
def keep_rows(mu, rig, scratch, reads, kept, units):
    """Cache the transmitted fractions of all segments of some units' rays."""
    share, size = scratch.path.share, np.uint32(max(rig.sizes))
    for unit in range(units.first, units.last):
        view, place, start, stop = ray_span(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = pixel_of(rig, reads, view, place, other)
            ray, foot = course(rig, rig.method, mu.store, line, pixel, units.axes, scratch)
            if ray.first >= ray.last:
                continue
            steps, span = steps_of(rig, mu.store, ray.axis), (ray.first, ray.last)
            _attenuate(mu, rig, line, pixel, ray, foot, span, steps, scratch)
            slabs = np.uint32(ray.last - ray.first)
            for piece in range(segments_of(rig, np.uint32(1))):
                into = kept[m, u, v, piece * size + np.uint32(ray.first) :]
                for i in range(slabs):
                    into[i] = share[piece * slabs + i]


@compiled
def project_rows(emission, mu, kept, rig, scratch, reads, views, units):
    """Add the attenuated sums of volumes along the rays of some units to views [n m v u].

    The part of a ray behind the emission is skipped; the part in front of it only attenuates.
    """
    store, space = emission
    path, whole = scratch.path, mu.at >= 0
    for unit in range(units.first, units.last):
        view, place, start, stop = ray_span(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = pixel_of(rig, reads, view, place, other)
            ray, foot, span = _emitting(rig, store, line, pixel, space, units.axes, whole, scratch)
            if span[0] >= span[1]:
                continue
            steps = steps_of(rig, store, ray.axis)
            share, slabs, first = _shares(
                mu, kept, rig, (m, u, v), line, pixel, ray, foot, span, steps, scratch
            )
            count, lead = cells(rig, ray, foot, span, steps, scratch)
            if slabs:
                weigh(rig, scratch.cells, share, slabs, first, count)
            if len(scratch.layers[m]) > 1:
                layer_of(rig, ray, line, pixel, scratch.layers[m], count, scratch)
                for n in range(len(views)):
                    volume, sums = MuVolume(store, n), scratch.sums
                    integrals(volume, rig, ray, foot, steps, scratch, count, path.emission)
                    deal(rig, path, count, span[0], scratch.node, sums, views[n, m, v, u])
                continue
            length = store.values.dtype.type(ray.length)
            for n in range(len(views)):
                total = sum_along(rig, store, n, ray, foot, steps, (count, lead), scratch)
                views[n, m, v, u, 0] += length * total


@compiled
def backproject_slabs(store, mu, kept, rig, scratch, reads, views, slabs):
    """Back-project views [n m v u] into slabs along attenuated rays: the transpose of
    `project_rows`.
    """
    steps, path, real = steps_of(rig, store, slabs.axis), scratch.path, store.values.dtype.type
    for unit in range(len(reads.views) * max(rig.detector)):
        view, place, start, stop = ray_span(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = pixel_of(rig, reads, view, place, other)
            if all_zero(views, m, v, u):
                continue
            ray, foot = course(rig, rig.method, store, line, pixel, slabs.axes, scratch)
            span = within(ray, slabs.low, slabs.high)
            if span[0] >= span[1]:
                continue
            share, known, first = _shares(
                mu, kept, rig, (m, u, v), line, pixel, ray, foot, span, steps, scratch
            )
            for n in range(len(views)):
                count, _ = cells(rig, ray, foot, span, steps, scratch)
                if n == 0:
                    layer_of(rig, ray, line, pixel, scratch.layers[m], count, scratch)
                gather(rig, path, count, scratch.node, views[n, m, v, u])
                weigh(rig, scratch.cells, path.value, count, 0, count)
                if known:
                    weigh(rig, scratch.cells, share, known, first, count)
                length = real(ray.length)
                spread_along(rig, store, n, ray, foot, steps, count, scratch, length)


@compiled
def mu_vjp_slabs(store, emission, rig, scratch, reads, views, slabs):
    """Back-project into volume 0 of a store the derivative of sum(views * projections) with respect
    to mu, which follows the volumes in the emission's store.

    Matter behind the emission has no effect, so rays end there.
    """
    source, space = emission
    mu, path, real = MuVolume(source, len(views)), scratch.path, store.values.dtype.type
    steps = steps_of(rig, store, slabs.axis)
    for unit in range(len(reads.views) * max(rig.detector)):
        view, place, start, stop = ray_span(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = pixel_of(rig, reads, view, place, other)
            if all_zero(views, m, v, u):
                continue
            ray, foot, emits = _emitting(rig, store, line, pixel, space, slabs.axes, True, scratch)
            if emits[0] >= emits[1]:
                continue
            ascending = at(line, DIRECTION, ray.axis, pixel[0], pixel[1]) < 0
            low, high = (ray.first, emits[1]) if ascending else (emits[0], ray.last)
            span = (max(slabs.low, low), min(slabs.high, high))
            if span[0] >= span[1]:
                continue
            part, _ = _attenuate(mu, rig, line, pixel, ray, foot, emits, steps, scratch)
            known = np.uint32(part[1] - part[0])
            layer_of(rig, ray, line, pixel, scratch.layers[m], known, scratch)
            count = segments_of(rig, known)
            for i in range(count):
                path.source[i] = 0
            for n in range(len(views)):
                volume = MuVolume(source, n)
                integrals(volume, rig, ray, foot, steps, scratch, known, path.emission)
                gather(rig, path, known, scratch.node, views[n, m, v, u])
                for i in range(count):
                    path.source[i] += path.value[i] * path.emission[i]
            vjp_segments(path, rig, known, ascending)
            size, _ = cells(rig, ray, foot, span, steps, scratch)
            weigh(rig, scratch.cells, path.value, known, span[0] - part[0], size)
            length = real(ray.length)
            spread_along(rig, store, 0, ray, foot, steps, size, scratch, length)
