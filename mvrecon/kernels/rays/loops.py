"""The compiled loops over rays: project, back-project, and how the projections change with the
geometry.
"""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays import joseph, siddon, trilinear
from mvrecon.kernels.rays.lanes import LANES
from mvrecon.kernels.rays.methods.siddon import slopes as siddon_slopes
from mvrecon.kernels.rays.methods.strides import Steps
from mvrecon.kernels.rays.methods.trilinear import slopes as trilinear_slopes
from mvrecon.kernels.rays.occupancy import EDGE
from mvrecon.kernels.rays.packed_volume import Store
from mvrecon.kernels.rays.summation import visit
from mvrecon.kernels.rays.trace import (
    JOSEPH,
    SIDDON,
    TRILINEAR,
    at,
    crossing,
    main_axis,
    trace,
    within,
)

#: lines [m 4 3 k], window (w0, w1), sizes (x, y, z), detector (rows, columns), method, samples a
#: ray (trilinear); the box of what may be there, see `trace.Space`; bricks, their strides and
#: heights, see `occupancy.bricks_of_rig`.
Rig = namedtuple(
    "Rig",
    [
        "lines",
        "window",
        "sizes",
        "detector",
        "method",
        "samples",
        "box",
        "bricks",
        "strides",
        "heights",
    ],
)


@scalar
def steps_of(rig, store, axis):
    """How the loops step through a store along rays of one main axis."""
    x, y, z = store.strides[0], store.strides[1], store.strides[2]
    origin = rig.box[0] * x + rig.box[1] * y + rig.box[2] * z
    return Steps(store.strides[axis], store.strides[3 - axis - store.near], 1, rig.samples, origin)


#: What is known of the cells of one ray: flat indices, four numbers each, pairs of corners whole
#: and in their parts; one number for each of a group of volumes.
Room = namedtuple(
    "Room",
    [
        "index",
        "index_b",
        "index_c",
        "one",
        "two",
        "three",
        "four",
        "low",
        "high",
        "low_parts",
        "high_parts",
    ]
    + ["terms", "totals"],
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
def pixel(rig, u, v):
    """A pixel counted from the detector's centre."""
    rows, columns = rig.detector
    return u - (columns - 1) / 2, v - (rows - 1) / 2


@scalar
def walk(rig, spans, unit):
    """The part of the detector to go through as one unit: its view and place, the first of its rays
    and one behind.

    It is a row, or a column where a step from row to row goes along the near axis: rays in turn
    then meet again the voxels that the cache still holds.
    """
    units = max(rig.detector)
    view, place = unit // units, unit % units
    return view, place, spans[view, place, 0], spans[view, place, 1]


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
def project_rows(store, rig, room, reads, views, first, last):
    """Add to views [n m v u] the sums of volumes along the rays of reads = (chosen views, tall
    ones, spans, main axes).

    Of all units of those views, see `walk`, these are the first to last.
    """
    chosen, tall, spans, axes = reads
    volumes = len(views)
    for unit in range(first, last):
        view, place, start, stop = walk(rig, spans, unit)
        m = chosen[view]
        line = rig.lines[m]
        for other in range(start, stop):
            u, v = (place, other) if tall[view] else (other, place)
            here = pixel(rig, u, v)
            axis = main_axis(line, here[0], here[1])
            if not axes[axis]:
                continue
            ray = trace(line, axis, store.near, here, rig, rig.method)
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
def backproject_slabs(store, rig, room, reads, views, low, high):
    """Spread views [n m v u] into slabs [low, high) along the rays of reads = (chosen views, tall
    ones, spans, axis).

    A ray on which all views are zero is left out.
    """
    chosen, tall, spans, axis = reads
    volumes, steps = len(views), steps_of(rig, store, axis)
    for unit in range(len(chosen) * max(rig.detector)):
        view, place, start, stop = walk(rig, spans, unit)
        m = chosen[view]
        line = rig.lines[m]
        for other in range(start, stop):
            u, v = (place, other) if tall[view] else (other, place)
            here = pixel(rig, u, v)
            if silent(views, m, v, u) or main_axis(line, here[0], here[1]) != axis:
                continue
            ray = trace(line, axis, store.near, here, rig, rig.method)
            span = within(ray, low, high)
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


@scalar
def pull_back(line, ray, p, window, value, change_of, change):
    """Add to a row's `change` [4 3 k] the derivative of value * (one ray's integral) by the maps in
    `line`.
    """
    total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end = change_of
    axis, b, c = ray.axis, ray.far, ray.near
    D = at(line, 0, axis, p[0], p[1])
    value_b, value_c = crossing(line, axis, b, p[0], p[1]), crossing(line, axis, c, p[0], p[1])
    across = by_b * value_b + by_slope_b * ray.slope_b + by_c * value_c + by_slope_c * ray.slope_c
    scale = ray.length * value
    by_D = -(across + total) / D
    near, far = (window[0], window[1]) if D > 0 else (window[1], window[0])
    # an end without limit is never inside the box, and infinity times nothing is not a number
    by_D -= at_begin * near if at_begin != 0 else 0.0
    by_D += at_end * far if at_end != 0 else 0.0
    world = (ray.length * D) ** 2
    turn_b = 1.0 if (b + 1) % 3 == axis else -1.0
    first = 3 - line.shape[2]
    for k in range(first, 3):
        change[0, axis, k - first] += scale * by_D * p[k]
        change[0, b, k - first] += scale * by_slope_b / D * p[k]
        change[0, c, k - first] += scale * by_slope_c / D * p[k]
        change[1, c, k - first] += turn_b * scale * by_b / D * p[k]
        change[1, b, k - first] -= turn_b * scale * by_c / D * p[k]
        change[2, axis, k - first] += scale * (at_end - at_begin) * p[k]
        for x in range(3):
            change[3, x, k - first] += scale * total * at(line, 3, x, p[0], p[1]) / world * p[k]


@compiled
def vary_rows(store, rig, room, reads, given, first, last):
    """For given = (views, change): into `change` [m unit 4 3 k], the derivative of sum(views *
    projections) by maps.
    """
    chosen, tall, spans, axes = reads
    views, change = given
    volumes = len(views)
    for unit in range(first, last):
        view, place, start, stop = walk(rig, spans, unit)
        m = chosen[view]
        line = rig.lines[m]
        for other in range(start, stop):
            u, v = (place, other) if tall[view] else (other, place)
            here = pixel(rig, u, v)
            axis = main_axis(line, here[0], here[1])
            if not axes[axis]:
                continue
            ray = trace(line, axis, store.near, here, rig, rig.method)
            steps = steps_of(rig, store, axis)
            count = (
                _cells(rig, ray, (ray.first, ray.last), steps, room)[0]
                if rig.method == JOSEPH
                else 0
            )
            for n in range(volumes):
                if rig.method == JOSEPH:
                    change_of = joseph.slopes(store, n, steps, count, room, ray)
                elif rig.method == TRILINEAR:
                    change_of = trilinear_slopes(store, n, ray, steps)
                else:
                    change_of = siddon_slopes(store, n, ray, steps)
                value = views[n, m, v, u]
                pull_back(
                    line,
                    ray,
                    (here[0], here[1], 1.0),
                    rig.window,
                    value,
                    change_of,
                    change[m, place],
                )
