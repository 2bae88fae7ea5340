"""The compiled loops over rays: projection, back-projection, and derivatives by the geometry."""

from collections import namedtuple

import numpy as np

from mvrecon.kernels.compiling import compiled, scalar
from mvrecon.kernels.rays.cpu import joseph, siddon, trace, trilinear
from mvrecon.kernels.rays.cpu.packed_volume import Store
from mvrecon.kernels.rays.lines import JOSEPH, SIDDON, TRILINEAR
from mvrecon.kernels.rays.occupancy import EDGE

#: Cells of one ray: flat indices, four numbers each, pairs of corners whole and in parts; one
#: number for each of a group of volumes.
Scratch = namedtuple(
    "Scratch",
    "index index_b index_c one two three four low high low_parts high_parts terms totals",
)


def scratch_of(rig: trace.Rig, store: Store) -> Scratch:
    """Memory for the cells of one ray of a thread; the loops themselves allocate nothing."""
    length = max(2 * rig.samples, max(rig.sizes))
    index = np.empty((3, length), store.strides.dtype)
    corners = np.empty((2, length), store.pairs.dtype)
    numbers = np.empty((4, length), store.values.dtype)
    own = np.empty(length + 2 * EDGE, numbers.dtype), np.empty(trace.LANES, numbers.dtype)
    return Scratch._make((*index, *numbers, *corners, *corners.view(numbers.dtype), *own))


@scalar
def ray_span(rig, spans, unit):
    """The pixels of one unit: the index of its view among those processed, its index in the view,
    and its half-open range of rays.

    A unit is a row, or a column if a step between rows is along the near axis, so that consecutive
    rays share cached voxels.
    """
    units = max(rig.detector)
    view, place = unit // units, unit % units
    return view, place, spans[view, place, 0], spans[view, place, 1]


@scalar
def pixel_of(rig, reads, view, place, other):
    """A pixel of a unit: its view m, u, v, the view's maps, and the pixel from the centre."""
    u, v = (place, other) if reads.tall[view] else (other, place)
    m = reads.views[view]
    return m, u, v, rig.lines[m], trace.from_centre(rig, u, v)


@scalar
def ray_of(rig, store, line, pixel, axes):
    """The ray of a pixel; a miss if its main axis is not in `axes` (x, y, z)."""
    axis = trace.main_axis(line, pixel[0], pixel[1])
    return (
        trace.trace(line, axis, store.near, pixel, rig, rig.method)
        if axes[axis]
        else trace.missing(axis)
    )


@scalar
def cells(rig, ray, span, steps, scratch):
    """Write the cells of a ray in the slabs of a span; returns as `traverse`."""
    if rig.method == TRILINEAR:
        return trilinear.cells(ray, span, steps, scratch)
    traversed = trace.traverse(rig, ray, span, scratch)
    if rig.method == JOSEPH:
        joseph.cells(ray, traversed[0], steps, scratch)
    else:
        siddon.cells(ray, traversed[0], steps, scratch)
    return traversed


@scalar
def sum_along(rig, store, n, steps, traversed, scratch):
    """The sum of volume n along a ray, in voxels of the main axis."""
    if rig.method == SIDDON:
        return siddon.sum(store, n, traversed, scratch)
    return joseph.sum(store, n, steps, traversed, scratch)


@scalar
def spread_along(rig, store, n, steps, count, scratch, value):
    """Add a value to volume n along a ray with the weights of `sum_along`: its transpose."""
    if rig.method == SIDDON:
        siddon.spread(store, n, count, scratch, value)
    else:
        joseph.spread(store, n, steps, count, scratch, value)


@scalar
def all_zero(views, m, v, u):
    """Whether a pixel is zero in all views [n m v u]."""
    for n in range(len(views)):
        if views[n, m, v, u] != 0:
            return False
    return True


@compiled
def project_rows(store, rig, scratch, reads, views, units):
    """Add to views [n m v u] the sums of volumes along the rays of some units; `Reads` and `Units`
    are in `trace.py`.
    """
    volumes = len(views)
    for unit in range(units.first, units.last):
        view, place, start, stop = ray_span(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = pixel_of(rig, reads, view, place, other)
            ray = ray_of(rig, store, line, pixel, units.axes)
            if ray.first >= ray.last:
                continue
            steps = trace.steps_of(rig, store, ray.axis)
            traversed = cells(rig, ray, (ray.first, ray.last), steps, scratch)
            length = store.values.dtype.type(ray.length)
            if store.lanes > 1:
                for n in range(0, volumes, store.lanes):
                    joseph.sum_lanes(store, n // store.lanes, steps, traversed[0], scratch)
                    for lane in range(min(store.lanes, volumes - n)):
                        views[n + lane, m, v, u] += length * scratch.totals[lane]
                continue
            for n in range(volumes):
                total = sum_along(rig, store, n, steps, traversed, scratch)
                views[n, m, v, u] += length * total


@compiled
def backproject_slabs(store, rig, scratch, reads, views, slabs):
    """Spread views [n m v u] into slabs along rays; `Reads` and `Slabs` are in `trace.py`.

    Rays on which all views are zero are skipped.
    """
    volumes, steps = len(views), trace.steps_of(rig, store, slabs.axis)
    for unit in range(len(reads.views) * max(rig.detector)):
        view, place, start, stop = ray_span(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = pixel_of(rig, reads, view, place, other)
            if all_zero(views, m, v, u):
                continue
            ray = ray_of(rig, store, line, pixel, slabs.axes)
            span = trace.within(ray, slabs.low, slabs.high)
            if span[0] >= span[1]:
                continue
            count, _ = cells(rig, ray, span, steps, scratch)
            length = store.values.dtype.type(ray.length)
            if store.lanes > 1:
                for n in range(0, volumes, store.lanes):
                    for lane in range(store.lanes):
                        scratch.totals[lane] = (
                            length * views[n + lane, m, v, u] if n + lane < volumes else 0
                        )
                    joseph.spread_lanes(store, n // store.lanes, steps, count, scratch)
                continue
            for n in range(volumes):
                value = length * views[n, m, v, u]
                spread_along(rig, store, n, steps, count, scratch, value)


@compiled
def vary_rows(store, rig, scratch, reads, views, change, units):
    """Into `change` [m unit 4 3 k]: the derivative of sum(views * projections) by the maps, of the
    rays of some units; `Reads` and `Units` are in `trace.py`.
    """
    for unit in range(units.first, units.last):
        view, place, start, stop = ray_span(rig, reads.spans, unit)
        for other in range(start, stop):
            m, u, v, line, pixel = pixel_of(rig, reads, view, place, other)
            ray = ray_of(rig, store, line, pixel, units.axes)
            if ray.first >= ray.last:
                continue
            steps, p, count = trace.steps_of(rig, store, ray.axis), (pixel[0], pixel[1], 1.0), 0
            if rig.method == JOSEPH:
                count = cells(rig, ray, (ray.first, ray.last), steps, scratch)[0]
            for n in range(len(views)):
                if rig.method == JOSEPH:
                    slopes = joseph.slopes(store, n, steps, count, scratch, ray)
                elif rig.method == TRILINEAR:
                    slopes = trilinear.slopes(store, n, ray, steps)
                else:
                    slopes = siddon.slopes(store, n, ray, steps)
                value = views[n, m, v, u]
                trace.pull_back(line, ray, p, rig.window, value, slopes, change[m, place])
