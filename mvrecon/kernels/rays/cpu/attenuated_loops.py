"""The compiled loops over attenuated rays: those of `loops.py`, each cell times the transmission
from it to the detector.

A segment is the part of a ray in which attenuation is taken as constant: a slab for Joseph's
method, the part in one cell for Siddon's. Of what it emits the share

    exp(-A) (1 - exp(-m)) / m

comes out at the ray's end on the detector's side: m its optical depth mu D, A the sum of those on
the way out (Gullberg et al., Phys. Med. Biol. 30 (1985) 799). Counts run towards the end where w,
see `cameras/camera.py`, is greatest.

Segments stand slab by slab for Joseph's method. For Siddon's the first cells of all slabs come
first, then the second ones, then the third: so every loop but one runs along memory, and that one,
over what is left of a ray behind each slab, takes a step for a slab and not for a cell.

Views [n m v u k] have k layers (one: all of the ray) at equal steps of 1 / w, the magnification of
a pinhole's image but for its sign; a segment between two of them is shared out linearly. The volume
of attenuation is volume `at` of a store of its own, in the layout of the emission's.
"""

from collections import namedtuple
from math import exp, expm1

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.cpu import joseph, siddon
from mvrecon.kernels.rays.cpu.lanes import between
from mvrecon.kernels.rays.cpu.loops import ray_of, walk
from mvrecon.kernels.rays.cpu.rig import steps_of
from mvrecon.kernels.rays.cpu.summation import visit
from mvrecon.kernels.rays.lines import DIRECTION, START
from mvrecon.kernels.rays.trace import SIDDON, at, main_axis, trace, within

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


@scalar
def layer_of(rig, ray, line, pixel, layers, count, desk):
    """Write where the segments of the slabs that were visited lie among the layers of a view."""
    slab, layer, real = desk.room.four, desk.path.layer, desk.path.layer.dtype.type
    last = len(layers) - 1
    if last == 0:
        return
    D = at(line, DIRECTION, ray.axis, pixel[0], pixel[1])
    start = at(line, START, ray.axis, pixel[0], pixel[1])
    scale = last / (layers[last] - layers[0])
    for i in range(np.uint32(count)):
        along = (D / (np.float64(slab[i]) - start) - layers[0]) * scale
        between = real(min(max(along, 0.0), np.float64(last)))
        if rig.method == SIDDON:
            layer[i], layer[count + i], layer[2 * count + i] = between, between, between
        else:
            layer[i] = between


@scalar
def deal(path, count, values):
    """Add what segments send out to the layers of a pixel."""
    last = len(values) - 2
    for i in range(count):
        k = min(int(path.layer[i]), last)
        part, sent = path.layer[i] - k, path.share[i] * path.emission[i]
        values[k] += sent - part * sent
        values[k + 1] += part * sent


@scalar
def gather(path, count, values):
    """Into `value`: the value of a pixel's layers at its segments, the transpose of `deal`."""
    last = len(values) - 2
    for i in range(count):
        k = min(int(path.layer[i]), last) if last >= 0 else 0
        part = path.layer[i] - k if last >= 0 else path.layer.dtype.type(0)
        path.value[i] = (
            values[k] if last < 0 else values[k] - part * values[k] + part * values[k + 1]
        )


@scalar
def silent(views, m, v, u):
    """Whether a pixel is zero in all layers of all views [n m v u k]."""
    for n in range(len(views)):
        for k in range(views.shape[4]):
            if views[n, m, v, u, k] != 0:
                return False
    return True


#: A store of emission, and what its rays are traced through to where it may be anything but zero;
#: a store and one of its volumes, as of attenuation; what one thread works in: see `loops.Room`
#: and `transmission.Path`; and the layers [m k] of every view, see `layers.py`.
Emission = namedtuple("Emission", ["store", "space"])
Matter = namedtuple("Matter", ["store", "at"])
Desk = namedtuple("Desk", ["room", "path", "layers"])


@scalar
def ascends(line, ray, pixel):
    """Whether the slab at the detector's end of a ray is its first."""
    return at(line, 0, ray.axis, pixel[0], pixel[1]) < 0


@scalar
def _attenuate(matter, rig, ray, part, ascending, steps, desk):
    """Make the cells of a part of a ray that begins at the detector's end, and the shares of its
    segments; returns what `visit` does.
    """
    visited = visit(rig, ray, part, desk.room)
    cells(rig, ray, visited[0], steps, desk.room)
    integrals(matter, rig, ray, steps, desk.room, visited[0], desk.path.depth)
    transmit(desk.path, rig, visited[0], ascending)
    return visited


@scalar
def _cut(rig, ray, span, known, steps, desk):
    """Of the segments that are known, from a first slab on so many slabs, leave those of a span
    with their cells and shares; returns what `visit` does.
    """
    visited = visit(rig, ray, span, desk.room)
    if visited[0] != known[1]:
        cells(rig, ray, visited[0], steps, desk.room)
        retain(rig, desk.path.share, known[1], span[0] - known[0], visited[0])
    return visited


@scalar
def _spread(volume, rig, ray, span, made, steps, desk):
    """Add to a volume, along a span of a ray, every segment's length times its number in `value`.

    `made` is of the segments that are known: their first slab, how many slabs, and whether the
    cells of these are in the room.
    """
    store, n, real = volume.store, volume.at, volume.store.values.dtype.type
    count = np.uint32(span[1] - span[0])
    if not made[2] or made[1] != count:
        count = visit(rig, ray, span, desk.room)[0]
        cells(rig, ray, count, steps, desk.room)
    weigh(rig, desk.room, desk.path.value, made[1], span[0] - made[0], count)
    if rig.method == SIDDON:
        siddon.spread(store, n, count, desk.room, real(ray.length))
    else:
        joseph.spread(store, n, steps, count, desk.room, real(ray.length))


@scalar
def _towards(ray, span, ascending):
    """The part of a ray from the detector's end to the far end of a span."""
    return (ray.first, span[1]) if ascending else (span[0], ray.last)


@compiled
def project_rows(emission, matter, rig, desk, reads, views, units):
    """Add to views [n m v u] the attenuated sums of volumes along the rays of some units.

    What lies behind the emission is not met, and what lies before it weakens alone.
    """
    store, space = emission
    for unit in range(units.first, units.last):
        view, place, start, stop = walk(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = ray_of(rig, reads, view, place, other)
            axis = main_axis(line, pixel[0], pixel[1])
            if not units.axes[axis]:
                continue
            emits = trace(line, axis, store.near, pixel, space, rig.method)
            if emits.first >= emits.last:
                continue
            ray = emits
            if space.box != rig.box:
                ray = trace(line, axis, store.near, pixel, rig, rig.method)
            steps, span = steps_of(rig, store, axis), (emits.first, emits.last)
            ascending = ascends(line, ray, pixel)
            part = _towards(ray, span, ascending)
            visited = _attenuate(matter, rig, ray, part, ascending, steps, desk)
            visited = _cut(rig, ray, span, (part[0], visited[0]), steps, desk)
            if len(desk.layers[m]) > 1:
                layer_of(rig, ray, line, pixel, desk.layers[m], visited[0], desk)
                count, path = segments_of(rig, visited[0]), desk.path
                for n in range(len(views)):
                    integrals(
                        Matter(store, n), rig, ray, steps, desk.room, visited[0], path.emission
                    )
                    deal(path, count, views[n, m, v, u])
                continue
            weigh(rig, desk.room, desk.path.share, visited[0], 0, visited[0])
            length = store.values.dtype.type(ray.length)
            for n in range(len(views)):
                if rig.method == SIDDON:
                    total = siddon.sum(store, n, visited, desk.room)
                else:
                    total = joseph.sum(store, n, steps, visited, desk.room)
                views[n, m, v, u, 0] += length * total


@compiled
def backproject_slabs(store, matter, rig, desk, reads, views, slabs):
    """Spread views [n m v u] into slabs along attenuated rays: the transpose of `project_rows`."""
    steps = steps_of(rig, store, slabs.axis)
    for unit in range(len(reads.views) * max(rig.detector)):
        view, place, start, stop = walk(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = ray_of(rig, reads, view, place, other)
            if silent(views, m, v, u) or main_axis(line, pixel[0], pixel[1]) != slabs.axis:
                continue
            ray = trace(line, slabs.axis, store.near, pixel, rig, rig.method)
            span = within(ray, slabs.low, slabs.high)
            if span[0] >= span[1]:
                continue
            ascending = ascends(line, ray, pixel)
            part = _towards(ray, span, ascending)
            visited = _attenuate(matter, rig, ray, part, ascending, steps, desk)
            layer_of(rig, ray, line, pixel, desk.layers[m], visited[0], desk)
            count, path = segments_of(rig, visited[0]), desk.path
            for n in range(len(views)):
                gather(path, count, views[n, m, v, u])
                for i in range(count):
                    path.value[i] *= path.share[i]
                made = (part[0], visited[0], n == 0)
                _spread(Matter(store, n), rig, ray, span, made, steps, desk)


@compiled
def bend_slabs(store, emission, rig, desk, reads, views, slabs):
    """Spread into volume 0 of a store the derivative of sum(views * projections) by the
    attenuation, which follows the volumes in the emission's store.

    What lies behind the emission weakens nothing, so that rays end with it.
    """
    source, space = emission
    matter = Matter(source, len(views))
    steps = steps_of(rig, store, slabs.axis)
    for unit in range(len(reads.views) * max(rig.detector)):
        view, place, start, stop = walk(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = ray_of(rig, reads, view, place, other)
            if silent(views, m, v, u) or main_axis(line, pixel[0], pixel[1]) != slabs.axis:
                continue
            emits = trace(line, slabs.axis, store.near, pixel, space, rig.method)
            if emits.first >= emits.last:
                continue
            ray = emits
            if space.box != rig.box:
                ray = trace(line, slabs.axis, store.near, pixel, rig, rig.method)
            ascending = ascends(line, ray, pixel)
            part = _towards(ray, (emits.first, emits.last), ascending)
            span = within(ray, slabs.low, slabs.high)
            span = (max(span[0], part[0]), min(span[1], part[1]))
            if span[0] >= span[1]:
                continue
            visited = _attenuate(matter, rig, ray, part, ascending, steps, desk)
            layer_of(rig, ray, line, pixel, desk.layers[m], visited[0], desk)
            count, path = segments_of(rig, visited[0]), desk.path
            for i in range(count):
                path.source[i] = 0
            for n in range(len(views)):
                integrals(Matter(source, n), rig, ray, steps, desk.room, visited[0], path.emission)
                gather(path, count, views[n, m, v, u])
                for i in range(count):
                    path.source[i] += path.value[i] * path.emission[i]
            bend(path, rig, visited[0], ascending)
            made = (part[0], visited[0], True)
            _spread(Matter(store, 0), rig, ray, span, made, steps, desk)
