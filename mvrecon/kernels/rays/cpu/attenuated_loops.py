"""The compiled loops over attenuated rays: those of `loops.py`, each cell times the transmission
from it to the detector.

Views [n m v u k] have k layers of magnification (one: all of the ray), see `layers.py`. The volume
of attenuation is volume `at` of a store of its own, in the layout of the emission's.
Counts run towards the end where w, see `cameras/camera.py`, is greatest.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.cpu import joseph, siddon
from mvrecon.kernels.rays.cpu.layers import deal, gather, layer_of, silent
from mvrecon.kernels.rays.cpu.loops import walk
from mvrecon.kernels.rays.cpu.rig import steps_of
from mvrecon.kernels.rays.cpu.summation import visit
from mvrecon.kernels.rays.cpu.transmission import (
    bend,
    cells,
    integrals,
    retain,
    segments_of,
    transmit,
    weigh,
)
from mvrecon.kernels.rays.trace import SIDDON, from_centre, main_axis, trace, within
from mvrecon.kernels.rays.trace import at as component

#: A store of emission, and what its rays are traced through to where it may be anything but zero;
#: a store and one of its volumes, as of attenuation; what one thread works in: see `loops.Room`
#: and `transmission.Path`; and the layers [m k] of every view, see `layers.py`.
Emission = namedtuple("Emission", ["store", "space"])
Matter = namedtuple("Matter", ["store", "at"])
Desk = namedtuple("Desk", ["room", "path", "layers"])


@scalar
def ascends(line, ray, pixel):
    """Whether the slab at the detector's end of a ray is its first."""
    return component(line, 0, ray.axis, pixel[0], pixel[1]) < 0


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
        m, tall = reads.views[view], reads.tall[view]
        line = rig.lines[m]
        for other in range(start, stop):
            u, v = (place, other) if tall else (other, place)
            pixel = from_centre(rig, u, v)
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
        m, tall = reads.views[view], reads.tall[view]
        line = rig.lines[m]
        for other in range(start, stop):
            u, v = (place, other) if tall else (other, place)
            pixel = from_centre(rig, u, v)
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
        m, tall = reads.views[view], reads.tall[view]
        line = rig.lines[m]
        for other in range(start, stop):
            u, v = (place, other) if tall else (other, place)
            pixel = from_centre(rig, u, v)
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
