"""The compiled loops over rays: project, back-project, and how the projections change with the
geometry.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.cpu import joseph, siddon, trilinear
from mvrecon.kernels.rays.cpu.lanes import LANES
from mvrecon.kernels.rays.cpu.packed_volume import Store
from mvrecon.kernels.rays.cpu.rig import Rig, steps_of
from mvrecon.kernels.rays.cpu.summation import visit
from mvrecon.kernels.rays.occupancy import EDGE
from mvrecon.kernels.rays.trace import (
    JOSEPH,
    SIDDON,
    TRILINEAR,
    from_centre,
    main_axis,
    pull_back,
    trace,
    within,
)

#: What is known of the cells of one ray: flat indices, four numbers each, pairs of corners whole
#: and in their parts; one number for each of a group of volumes.
Room = namedtuple(
    "Room",
    ["index", "index_b", "index_c", "one", "two", "three", "four"]
    + ["low", "high", "low_parts", "high_parts", "terms", "totals"],
)


def room_of(rig: Rig, store: Store) -> Room:
    """Room for the cells of one ray of a thread; the loops themselves make no arrays."""
    length = max(2 * rig.samples, max(rig.sizes))
    index, corners = (
        np.empty((3, length), store.strides.dtype),
        np.empty((2, length), store.pairs.dtype),
    )
    numbers = np.empty((4, length), store.values.dtype)
    own = np.empty(length + 2 * EDGE, numbers.dtype), np.empty(LANES, numbers.dtype)
    return Room._make((*index, *numbers, *corners, *corners.view(numbers.dtype), *own))


@scalar
def walk(rig, spans, unit):
    """The part of the detector to go through as one unit: the place of its view among those that
    are read, its own place in the view, the first of its rays and one behind.

    It is a row, or a column where a step from row to row goes along the near axis: rays in turn
    then meet again the voxels that the cache still holds.
    """
    units = max(rig.detector)
    view, place = unit // units, unit % units
    return view, place, spans[view, place, 0], spans[view, place, 1]


@scalar
def ray_of(rig, reads, view, place, other):
    """A ray of a unit: its view m, pixel u, v, the view's maps, the pixel from the centre."""
    u, v = (place, other) if reads.tall[view] else (other, place)
    m = reads.views[view]
    return m, u, v, rig.lines[m], from_centre(rig, u, v)


@scalar
def _cells(rig, ray, span, steps, room):
    if rig.method == TRILINEAR:
        return trilinear.cells(ray, span, steps, room)
    visited = visit(rig, ray, span, room)
    if rig.method == JOSEPH:
        joseph.cells(ray, visited[0], steps, room)
    else:
        siddon.cells(ray, visited[0], steps, room)
    return visited


@scalar
def silent(views, m, v, u):
    """Whether a pixel is zero in all views [n m v u]."""
    for n in range(len(views)):
        if views[n, m, v, u] != 0:
            return False
    return True


@compiled
def project_rows(store, rig, room, reads, views, units):
    """Add to views [n m v u] the sums of volumes along the rays of some units; `Reads` and `Units`
    are in `rig.py`.
    """
    volumes = len(views)
    for unit in range(units.first, units.last):
        view, place, start, stop = walk(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = ray_of(rig, reads, view, place, other)
            axis = main_axis(line, pixel[0], pixel[1])
            if not units.axes[axis]:
                continue
            ray = trace(line, axis, store.near, pixel, rig, rig.method)
            steps = steps_of(rig, store, axis)
            visited = _cells(rig, ray, (ray.first, ray.last), steps, room)
            count = visited[0]
            length = store.values.dtype.type(ray.length)
            if store.lanes > 1:
                for n in range(0, volumes, store.lanes):
                    joseph.sum_lanes(store, n // store.lanes, steps, count, room)
                    for lane in range(min(store.lanes, volumes - n)):
                        views[n + lane, m, v, u] += length * room.totals[lane]
                continue
            for n in range(volumes):
                if rig.method == SIDDON:
                    views[n, m, v, u] += length * siddon.sum(store, n, visited, room)
                else:
                    views[n, m, v, u] += length * joseph.sum(store, n, steps, visited, room)


@compiled
def backproject_slabs(store, rig, room, reads, views, slabs):
    """Spread views [n m v u] into slabs along rays; `Reads` and `Slabs` are in `rig.py`.

    A ray on which all views are zero is left out.
    """
    volumes, steps = len(views), steps_of(rig, store, slabs.axis)
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
            count, _ = _cells(rig, ray, span, steps, room)
            length = store.values.dtype.type(ray.length)
            if store.lanes > 1:
                for n in range(0, volumes, store.lanes):
                    for lane in range(store.lanes):
                        room.totals[lane] = (
                            length * views[n + lane, m, v, u] if n + lane < volumes else 0
                        )
                    joseph.spread_lanes(store, n // store.lanes, steps, count, room)
                continue
            for n in range(volumes):
                value = length * views[n, m, v, u]
                if rig.method == SIDDON:
                    siddon.spread(store, n, count, room, value)
                else:
                    joseph.spread(store, n, steps, count, room, value)


@compiled
def vary_rows(store, rig, room, reads, views, change, units):
    """Into `change` [m unit 4 3 k]: the derivative of sum(views * projections) by the maps, of the
    rays of some units; `Reads` and `Units` are in `rig.py`.
    """
    for unit in range(units.first, units.last):
        view, place, start, stop = walk(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = ray_of(rig, reads, view, place, other)
            axis = main_axis(line, pixel[0], pixel[1])
            if not units.axes[axis]:
                continue
            ray = trace(line, axis, store.near, pixel, rig, rig.method)
            steps, p = steps_of(rig, store, axis), (pixel[0], pixel[1], 1.0)
            count = (
                _cells(rig, ray, (ray.first, ray.last), steps, room)[0]
                if rig.method == JOSEPH
                else 0
            )
            for n in range(len(views)):
                if rig.method == JOSEPH:
                    slopes = joseph.slopes(store, n, steps, count, room, ray)
                elif rig.method == TRILINEAR:
                    slopes = trilinear.slopes(store, n, ray, steps)
                else:
                    slopes = siddon.slopes(store, n, ray, steps)
                value = views[n, m, v, u]
                pull_back(line, ray, p, rig.window, value, slopes, change[m, place])
